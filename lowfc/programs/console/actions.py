"""The buttons of the console, with their keys and actions. The requests are those of `lowfc.client.requests`."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any, NamedTuple

from lowfc.client import Answer, Client
from lowfc.client.requests import BY_NAME
from lowfc.contract.codecs.input_file import user_path
from lowfc.contract.errors import ConfigurationError, RequestRefusedError
from lowfc.control.loop.wording import AUTO
from lowfc.programs.cli.modes import noll_of

LOAD = "load"
Values = Mapping[str, str]
"""Input of an operator, by field."""


class Field(NamedTuple):
    """One line of a form: a request's field or an option, its label and its initial value."""

    name: str
    label: str
    default: Callable[[], str] = str


class Action(NamedTuple):
    """A button and its key.

    The operator first fills in `fields` or answers the question `confirm`. The button then sends a request to the loop
    (`ask`), or starts the `lowfc` command `task` in a separate process, with the fields as options.
    """

    key: str
    name: str
    description: str
    fields: tuple[Field, ...] = ()
    ask: Callable[[Client, Values], Answer] | None = None
    task: tuple[str, ...] = ()
    confirm: str = ""

    def command(self, values: Values, run: str) -> list[str]:
        """Arguments of `lowfc` for the task."""
        filled = {name: str(user_path(value)) for name, value in values.items() if value and name != LOAD}
        options = [word for name, value in filled.items() for word in (f"--{name}", value)]
        answer = values.get(LOAD, "").lower()
        if answer not in ("y", "yes", "n", "no", ""):
            raise ConfigurationError(f"load must be yes or no, got {answer!r}: write yes, y, no or n; empty means no")
        load = ["--load"] if answer in ("y", "yes") else []
        return [*self.task, *options, *load, "--run", run]


def parse_numbers(text: str) -> list[float]:
    """Parse numbers separated by spaces or commas; ConfigurationError for anything else."""
    try:
        return [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        raise ConfigurationError(f"{text!r}: write numbers, as in 0.3 or 0.3 0.2") from None


def _modes(text: str) -> tuple[int, ...]:
    return noll_of([text] if text else None)


def _shape(text: str) -> Any:
    from lowfc.adapters.files.mirror_maps import read_shape  # imports astropy, needed only for files

    return read_shape(user_path(text)) if text else None


def _law(text: str) -> Any:
    from lowfc.adapters.files import law_file

    return law_file.load(user_path(text)) if text else None


def _calibration(text: str) -> Any:
    from lowfc.adapters.files import calibration_file

    return calibration_file.load(user_path(text))


_READERS: dict[str, tuple[str, Callable[[str], Any]]] = {
    "modes": ("modes", _modes),
    "values": ("values", parse_numbers),
    "text": ("text", str),
    "actuators": ("actuators_nm", _shape),
    "law": ("law", _law),
    "calibration": ("calibration", _calibration),
}
"""Argument of `Client.ask`, and parser of the operator's text, for each field of a request."""
_LABELS = {
    "modes": "modes: Noll indices as in 2,3 or 4-8; empty for all",
    "actuators": "shape: file (FITS or .npy), nm of surface; empty removes the channel",
    "law": "law: file (FITS); empty for the integrator",
    "calibration": "calibration: file (FITS)",
    "step values": "number of frames",
    "gain values": "gain: one value, or one for each mode; auto for automatic gains",
    "leak values": "leak: one value, or one for each mode",
    "limit values": "limit: one value, or one for each mode, nm rms of wavefront",
    "offset values": "offset: one value, or one for each mode, nm rms of wavefront; empty for zero",
    "channel text": "name: up to 32 of a-z, 0-9 and -, starting with a letter",
    "note text": "note",
}
"""Labels of the fields of requests in a form; the key is the field, or the request and the field."""


def request_action(key: str, name: str, confirm: str = "") -> Action:
    """Make the button of a declared request, with its fields as a form."""
    declared = BY_NAME[name]

    def ask(loop: Client, values: Values) -> Answer:
        if name == "gain" and values["values"].strip() == AUTO:
            return loop.automatic_gain(_modes(values["modes"]))
        arguments = {_READERS[field][0]: _READERS[field][1](text) for field, text in values.items()}
        if name == "channel":  # this method of the client checks the shape against the mirror's grid
            return loop.channel(arguments["text"], arguments["actuators_nm"])
        return loop.ask(name, **arguments)

    names = sorted((field for field, _ in declared.fields), key=lambda field: field == "modes")  # modes last
    labels = ((field, _LABELS.get(field) or _LABELS.get(f"{name} {field}")) for field in names)
    fields = tuple(Field(field, label) for field, label in labels if label)
    return Action(key, name, declared.description, fields, ask, confirm=confirm)


def _record(loop: Client, values: Values) -> Answer:
    with suppress(RequestRefusedError):  # refused if nothing is being recorded
        loop.record(False)
    answer = loop.record(True)
    if note := "; ".join(f"{name}: {value}" for name, value in values.items() if value):
        loop.note(note)
    return answer


_OUT = Field("out", "out: output file (FITS)", lambda: f"calibration-{datetime.now(UTC):%Y%m%dT%H%M%S}.fits")
_LOAD = Field(LOAD, "load: load the calibration into the loop, which must be open (yes, no)", lambda: "yes")
_TARGET = (Field("target", "target"), Field("observer", "observer"))

SAFE = request_action("s", "safe")
ACTIONS = (
    request_action("c", "close"),
    request_action("o", "open"),
    request_action("p", "pause"),
    request_action("t", "step"),
    request_action("g", "gain"),
    request_action("l", "leak"),
    request_action("x", "limit"),
    request_action("w", "law"),
    Action("i", "no law", "Return from a linear law to the integrator.", ask=lambda loop, _: loop.law()),
    request_action("f", "offset"),
    request_action("h", "channel"),
    request_action("z", "reset"),
    request_action("y", "stop"),
    request_action("k", "clear", confirm="Leave safe mode? The loop is open afterwards."),
    Action(
        "d",
        "dark",
        "Measure the dark and find bad pixels. Block the star first: there is no prompt.",
        (Field("frames", "frames: number averaged", lambda: "400"), _OUT, _LOAD),
        task=("calibrate", "dark", "--star-blocked"),
    ),
    Action(
        "e",
        "reference",
        "Take the present wavefront as the zero point.",
        (Field("frames", "frames: number averaged", lambda: "1000"), _OUT, _LOAD),
        task=("calibrate", "reference"),
    ),
    Action(
        "b",
        "calibrate",
        "Measure a calibration by poking the mirror.",
        (
            Field("method", "method: poke, hadamard, in-loop", lambda: "hadamard"),
            Field("snr", "snr: signal-to-noise ratio to reach in the noisiest mode", lambda: "70"),
            _OUT,
            _LOAD._replace(label="load: load the calibration into the loop (yes, no)"),
        ),
        task=("calibrate",),
    ),
    request_action("a", "load"),
    Action("r", "record", "Start a new log, with a note of target and observer.", _TARGET, _record),
    Action("v", "end log", BY_NAME["record/stop"].description, ask=lambda loop, _: loop.record(False)),
    request_action("n", "note"),
)
"""Buttons in the order of the screen."""
ALL_ACTIONS = {action.name: action for action in (*ACTIONS, SAFE)}
