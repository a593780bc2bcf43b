"""The table of requests: key, fields of `lowfc.v1.Request`, description and `lowfc ctl` command of each.

The client's methods without arguments, names and help of the commands of `lowfc ctl`, and the table in
docs/reference/requests.md are made from it; a test compares it with the requests that controller and recorder accept.
"""

from typing import NamedTuple

from lowfc.contract.messages import RECORD_KEY, REQUEST_KEY


class Declaration(NamedTuple):
    """Declaration of one kind of request.

    Attributes:
        key: key of the query.
        fields: fields of the message, with their content.
        description: what the request does.
        example: arguments of `lowfc ctl` that send the request; empty if it has no command.
    """

    key: str
    fields: tuple[tuple[str, str], ...]
    description: str
    example: str

    @property
    def name(self) -> str:
        """Name of the request: the last part of the key."""
        return self.key.rpartition("/")[2]


_MODES = ("modes", "Noll indices, none for all")
_ONE_OR_EACH = "one value, or one per mode"


def _declared(name: str, description: str, example: str, *fields: tuple[str, str]) -> Declaration:
    return Declaration(REQUEST_KEY.format(name=name), fields, description, example)


DECLARED: tuple[Declaration, ...] = (
    _declared("status", "Report the loop mode; the answer contains the controller's whole state.", "status"),
    _declared("open", "Open the loop; the mirror holds its shape.", "open"),
    _declared("close", "Close the loop: the control law drives the mirror.", "close"),
    _declared(
        "pause",
        "Open a closed loop; closing it resumes from the held command. The loop is reported as paused, unless the "
        "holder of a reservation sent the request.",
        "pause",
    ),
    _declared(
        "step",
        "Close the loop until a number of frames has been used, then open it again.",
        "step 100",
        ("values", "number of frames"),
    ),
    _declared("safe", "Relax the mirror to flat and latch it there until `clear`.", "safe"),
    _declared("clear", "Leave safe mode; the loop is open afterwards, or idle without a calibration.", "clear"),
    _declared("reset", "Return the modal command to zero within the slew limit, and clear the law's memory.", "reset"),
    _declared(
        "gain",
        "Set integrator gains, or have them chosen automatically; gains that make the loop unstable are refused.",
        "gain 0.4 --modes 2,3",
        _MODES,
        ("values", f"{_ONE_OR_EACH}; none with `text`"),
        ("text", "`auto` for automatic gains"),
    ),
    _declared("leak", "Set integrator leaks.", "leak 0.01", _MODES, ("values", _ONE_OR_EACH)),
    _declared(
        "limit",
        "Set the modal limits, nm rms of wavefront.",
        "limit 100 --modes 2,3",
        _MODES,
        ("values", f"{_ONE_OR_EACH}, nm rms of wavefront"),
    ),
    _declared(
        "offset",
        "Set the loop's target wavefront.",
        "offset 5 -3 --modes 4,11",
        _MODES,
        ("values", f"{_ONE_OR_EACH}, nm rms of wavefront; none for zero"),
    ),
    _declared(
        "channel",
        "Add a shape to the mirror, and shift the sensor's zero point with it so that the loop does not undo it; "
        "the channel `flat` does not shift the zero point. Other programs apply the channel `external`: it only shifts "
        "the zero point.",
        "channel dark-hole shape.fits",
        ("text", "name: up to 32 of a-z, 0-9 and -, a letter first"),
        ("actuators", "float32, nm of surface, rows x columns; empty removes the channel"),
    ),
    _declared(
        "play",
        "Play a probe sequence: one row of a table per frame, from the frame in the answer to the end of the table. "
        "Rows played on `mirror` are unknown to the control law; rows played on `offset` change the loop's target.",
        "",
        ("text", "`mirror` or `offset`"),
        ("table", "float32, frames x columns: factors of the shapes, or nm rms of wavefront of each mode"),
        ("columns", "number of columns of the table"),
        ("actuators", "for `mirror`: one shape per column, float32, nm of surface"),
    ),
    _declared("stop", "End the probe sequence.", "stop"),
    _declared(
        "law",
        "Let a linear law drive the mirror: it first observes, then takes over in a cross-fade; a law that is "
        "unstable, or made for another rate, other modes or (from POL) another delay, is refused.",
        "law lqg.fits",
        ("law", "the linear law; none for the integrator"),
    ),
    _declared(
        "load",
        "Use another calibration; a closed loop must be opened first.",
        "load calibration.fits",
        ("calibration", "the complete calibration"),
    ),
    _declared("note", "Write a note to the log.", 'note "new star"', ("text", "the note")),
    _declared(
        "lease",
        "Reserve the loop: until the reservation ends, other clients' requests that would change the loop are refused; "
        "`safe` from anyone, and `open`, `pause` or `stop` from another client, are accepted and end it.",
        "",
        ("lease_id", "random number, sent with all requests of the holder"),
        ("values", "seconds in force without renewal, at most 60"),
        ("text", "holder and purpose, as text"),
    ),
    _declared(
        "renew",
        "Extend a reservation; refused with the cause if the reservation has ended.",
        "",
        ("lease_id", "as in `lease`"),
        ("values", "as in `lease`"),
        ("text", "as in `lease`"),
    ),
    _declared("release", "End a reservation.", "", ("lease_id", "as in `lease`")),
    _declared(
        "permit",
        "Ask permission to move something on the bench; with a time, the loop is reserved for that time, or until "
        "released, and a closed loop holds its command.",
        'permit "moving the mask" --hold 5',
        ("text", "what is moved, as text"),
        ("values", "seconds to hold the loop, at most 60; none: permission only"),
        ("lease_id", "for a hold, as in `lease`"),
    ),
    _declared("configuration", "Report the configuration that the controller was started with.", "configuration"),
    Declaration(
        RECORD_KEY.format(name="start"),
        (),
        "After `record stop`, start the next log and print its path; refused while recording.",
        "record start",
    ),
    Declaration(
        RECORD_KEY.format(name="stop"),
        (),
        "Finish the log and print its path; the file is complete when the answer arrives.",
        "record stop",
    ),
)


BY_NAME = {declared.key.partition("/")[2].removeprefix("request/"): declared for declared in DECLARED}
"""Declarations by name, such as "gain" and "record/start"."""
