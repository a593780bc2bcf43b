"""The table of requests: key, fields of `lowfc.v1.Request`, description and `lowfc ctl` command of each.

The client's methods, the commands of `lowfc ctl` and the table in docs/reference/requests.md are generated from it; a
test compares it with the requests that the controller and the recorder accept.
"""

from typing import NamedTuple

from lowfc.contract.messages import RECORD_KEY, REQUEST_KEY


class Declaration(NamedTuple):
    """Declaration of one kind of request.

    Attributes:
        key: key of the query.
        fields: fields of the message, with their content.
        sentence: what it does.
        example: an example command line; empty if the request has no command.
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


def _declared(name: str, sentence: str, example: str, *fields: tuple[str, str]) -> Declaration:
    return Declaration(REQUEST_KEY.format(name=name), fields, sentence, example)


DECLARED: tuple[Declaration, ...] = (
    _declared("status", "Report what the controller is doing; the answer holds the whole state.", "status"),
    _declared("open", "Stop driving the mirror, which holds its shape.", "open"),
    _declared("close", "Let the control law drive the mirror.", "close"),
    _declared("pause", "Hold the command; `close` goes on from it.", "pause"),
    _declared(
        "step", "Close the loop for some frames, then open it again.", "step 100", ("values", "number of frames")
    ),
    _declared("safe", "Relax the mirror to flat and latch it there, whatever else is requested.", "safe"),
    _declared("clear", "Leave the latched safe state; the loop is open afterwards.", "clear"),
    _declared("reset", "Take the modal command to zero within the slew limit, and clear the law's memory.", "reset"),
    _declared(
        "gain",
        "Set integrator gains, or let them be automatic; one at which the loop would be unstable is refused.",
        "gain 0.4 --modes 2,3",
        _MODES,
        ("values", f"{_ONE_OR_EACH}; none for automatic gains"),
        ("text", "`auto` for automatic gains"),
    ),
    _declared("leak", "Set integrator leaks.", "leak 0.01", _MODES, ("values", _ONE_OR_EACH)),
    _declared(
        "limit",
        "Set the largest modal commands.",
        "limit 100 --modes 2,3",
        _MODES,
        ("values", f"{_ONE_OR_EACH}, nm rms of wavefront"),
    ),
    _declared(
        "offset",
        "Set where the loop holds the wavefront; zero without values.",
        "offset 5 -3 --modes 4,11",
        _MODES,
        ("values", f"{_ONE_OR_EACH}, nm rms of wavefront"),
    ),
    _declared(
        "channel",
        "Set a shape that is added to the mirror, and shift the sensor's zero point with it, so that the loop does not "
        "undo it; `flat` shifts nothing.",
        "channel dark-hole shape.fits",
        ("text", "name: up to 32 of a-z, 0-9 and -, a letter first"),
        ("actuators", "float32, nm of surface, rows x columns; empty removes the channel"),
    ),
    _declared(
        "play",
        "Add a row of a table for each frame, from the answered frame on, unknown to the control law; it ends by "
        "itself.",
        "",
        ("text", "`mirror` or `offset`"),
        ("table", "float32, frames x columns: factors of the shapes, or nm rms of wavefront of each mode"),
        ("columns", "of the table"),
        ("actuators", "of `mirror`: one shape for each column, float32, nm of surface"),
    ),
    _declared("stop", "End the play.", "stop"),
    _declared(
        "law",
        "Let a linear law drive the mirror: it observes for a while, then takes over in a cross-fade; refused where it "
        "is not stable.",
        "law lqg.fits",
        ("law", "none for the integrator"),
    ),
    _declared("load", "Use another calibration in an open loop.", "load calibration.fits", ("calibration", "all")),
    _declared("note", "Write a note to the log.", 'note "new star"', ("text", "the note")),
    _declared(
        "lease",
        "Reserve the loop: until that ends, other clients' requests that would change it are refused; `safe`, `open`, "
        "`pause` and `stop` are granted to everyone, and end it.",
        "",
        ("lease_id", "a random number, which all requests of the holder carry"),
        ("values", "seconds for which it holds without being renewed, at most 60"),
        ("text", "the holder and its purpose, for people"),
    ),
    _declared(
        "renew",
        "Extend a reservation that is in force; refused with the cause if it has ended.",
        "",
        ("lease_id", "as in `lease`"),
        ("values", "seconds"),
        ("text", "as in `lease`"),
    ),
    _declared("release", "End a reservation.", "", ("lease_id", "as in `lease`")),
    _declared(
        "permit",
        "Ask permission to move something on the bench; with a time, a closed loop holds its command and the loop is "
        "reserved for that long, or until it is released.",
        'permit "moving the mask" --hold 5',
        ("text", "what is moved, for people"),
        ("values", "seconds for which the loop is held, at most 60; none only asks"),
        ("lease_id", "of a hold: as in `lease`"),
    ),
    _declared("configuration", "Answer with the configuration that the controller was started with.", "configuration"),
    Declaration(RECORD_KEY.format(name="start"), (), "Start the next log and print its path.", "record start"),
    Declaration(
        RECORD_KEY.format(name="stop"),
        (),
        "Finish the log and print its path; the file is complete when the answer comes.",
        "record stop",
    ),
)


BY_NAME = {one.key.partition("/")[2].removeprefix("request/"): one for one in DECLARED}
"""By name, as "gain" and "record/start"."""


def table() -> str:
    """Markdown table of all requests."""
    lines = ["| query | fields of the request | what it does | `lowfc ctl` |", "|---|---|---|---|"]
    for one in DECLARED:
        fields = "; ".join(f"`{name}`: {what}" for name, what in one.fields)
        example = f"`{one.example}`" if one.example else ""
        lines.append(f"| `{one.key}` | {fields} | {one.sentence} | {example} |")
    return "\n".join(lines) + "\n"
