"""Every request, once: its key, the fields of `lowfc.v1.Request` that it takes, what it does, how `lowfc ctl` asks it.

The client's methods, the commands of `lowfc ctl` and the table in docs/operating.md are made of it; a test holds it
against what the controller and the recorder know.
"""

from typing import NamedTuple

from lowfc.contract.messages import RECORD_KEY, REQUEST_KEY


class Asked(NamedTuple):
    """One kind of request.

    Attributes:
        key: of the query.
        fields: of the message, with what they hold.
        sentence: what it does.
        example: of a command line; none where there is only the message.
    """

    key: str
    fields: tuple[tuple[str, str], ...]
    sentence: str
    example: str

    @property
    def name(self) -> str:
        """Last part of the key."""
        return self.key.rpartition("/")[2]


_MODES = ("modes", "Noll indices, none for all")
_ONE_OR_EACH = "one, or one for each mode"


def _asked(name: str, sentence: str, example: str, *fields: tuple[str, str]) -> Asked:
    return Asked(REQUEST_KEY.format(name=name), fields, sentence, example)


ASKED: tuple[Asked, ...] = (
    _asked("status", "Say what the controller is doing; the answer holds the whole state.", "status"),
    _asked("open", "Stop driving the mirror, which holds its shape.", "open"),
    _asked("close", "Let the control law drive the mirror.", "close"),
    _asked("pause", "Hold the command; `close` goes on from it.", "pause"),
    _asked(
        "step", "Close the loop for some frames; then it opens by itself.", "step 100", ("values", "number of frames")
    ),
    _asked("safe", "Relax the mirror to flat and latch it there, whatever else is asked.", "safe"),
    _asked("clear", "Leave the latched safe state; the loop is open afterwards.", "clear"),
    _asked("reset", "Take the modal command to zero within the slew limit, and clear the law's memory.", "reset"),
    _asked(
        "gain",
        "Set integrator gains; one at which the loop would be unstable is refused.",
        "gain 0.4 --modes 2,3",
        _MODES,
        ("values", _ONE_OR_EACH),
    ),
    _asked("leak", "Set integrator leaks.", "leak 0.01", _MODES, ("values", _ONE_OR_EACH)),
    _asked(
        "limit",
        "Set the largest modal commands.",
        "limit 100 --modes 2,3",
        _MODES,
        ("values", f"{_ONE_OR_EACH}, nm rms of wavefront"),
    ),
    _asked(
        "offset",
        "Set where the loop holds the wavefront; zero without values.",
        "offset 5 -3 --modes 4,11",
        _MODES,
        ("values", f"{_ONE_OR_EACH}, nm rms of wavefront"),
    ),
    _asked(
        "channel",
        "Add a shape to the mirror in place of the one of that name, and take the sensor's zero point along, so that "
        "the loop does not undo it; `flat` is added without.",
        "channel dark-hole shape.fits",
        ("text", "name: up to 32 of a-z, 0-9 and -, a letter first"),
        ("actuators", "float32, nm of surface, rows x columns; empty removes the channel"),
    ),
    _asked(
        "play",
        "Add a row of a table for each frame, from the answered frame on, without the loop being told; it ends by "
        "itself.",
        "",
        ("text", "`mirror` or `offset`"),
        ("table", "float32, frames x columns: factors of the shapes, or nm rms of wavefront of each mode"),
        ("columns", "of the table"),
        ("actuators", "of `mirror`: one shape for each column, float32, nm of surface"),
    ),
    _asked("stop", "End what is being played.", "stop"),
    _asked(
        "law",
        "Let a linear law drive the mirror: it observes for a while, then takes over in a cross-fade; refused where it "
        "is not stable.",
        "law lqg.fits",
        ("law", "none for the integrator"),
    ),
    _asked("load", "Use another calibration; the loop must be open.", "load calibration.fits", ("calibration", "all")),
    _asked("note", "Leave a note in the log.", 'note "new star"', ("text", "the note")),
    _asked(
        "lease",
        "Reserve the loop: until that ends, requests of others that would change it are refused; `safe`, `open`, "
        "`pause` and `stop` are granted to anybody, and end it.",
        "",
        ("lease_id", "a random number, which all requests of the holder carry"),
        ("values", "seconds for which it holds without being renewed, at most 60"),
        ("text", "the holder and its purpose, for people"),
    ),
    _asked(
        "renew",
        "Let a reservation that is in force hold longer; refused where it has ended, with the cause.",
        "",
        ("lease_id", "as in `lease`"),
        ("values", "seconds"),
        ("text", "as in `lease`"),
    ),
    _asked("release", "End a reservation.", "", ("lease_id", "as in `lease`")),
    _asked("configuration", "Answer with the configuration that the controller was started with.", "configuration"),
    Asked(RECORD_KEY.format(name="start"), (), "Start the next log and print its path.", "record start"),
    Asked(
        RECORD_KEY.format(name="stop"),
        (),
        "Finish the log and print its path; the file is complete when the answer comes.",
        "record stop",
    ),
)


BY_NAME = {asked.key.partition("/")[2].removeprefix("request/"): asked for asked in ASKED}
"""By name, as "gain" and "record/start"."""


def table() -> str:
    """Markdown table of all requests."""
    lines = ["| query | fields of the request | what it does | `lowfc ctl` |", "|---|---|---|---|"]
    for asked in ASKED:
        fields = "; ".join(f"`{name}`: {what}" for name, what in asked.fields)
        example = f"`{asked.example}`" if asked.example else ""
        lines.append(f"| `{asked.key}` | {fields} | {asked.sentence} | {example} |")
    return "\n".join(lines) + "\n"
