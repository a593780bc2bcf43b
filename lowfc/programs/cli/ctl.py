"""`lowfc ctl`: a command for each request of `lowfc.client.requests` that has an example; its fields are arguments."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from typer.core import TyperGroup

from lowfc.adapters.process.terminal import AnyRun, Json, new_app
from lowfc.client.requests import BY_NAME
from lowfc.contract.errors import BusError, ConfigurationError, DataFileError
from lowfc.contract.messages import Role, wire
from lowfc.control.loop.wording import AUTO
from lowfc.programs.cli.modes import Modes, noll_of
from lowfc.programs.cli.output import print_result
from lowfc.programs.commissioning.calibrate.command import dark, reference

if TYPE_CHECKING:
    from lowfc.client import Answer, Client

ctl_app = new_app("Operate a running loop.\n\nExample: lowfc ctl status")
record_app = new_app("Start the next log or finish the current one.\n\nExample: lowfc ctl record stop")
ctl_app.add_typer(record_app, name="record")

ZERO = "--zero"
INTEGRATOR = "integrator"
SAFE_BY_SIGNAL = (
    "if the controller does not answer, run this command on its host; it puts every loop there in safe mode: "
    "pkill -USR1 -f '^[^ ]*python.* (-m |[^ ]*/)lowfc controller'"
)


def number(word: str) -> float:
    """Parse a number; the error quotes the word."""
    try:
        return float(word)
    except ValueError:
        mode, equals, value = word.partition("=")
        write = f"{value} --modes {mode}" if equals else "0.3, and several as 0.3 0.2"
        raise typer.BadParameter(f"{word!r} is not a number: write {write}") from None


def gain_word(word: str) -> str:
    """Parse a gain, or `auto`."""
    return word if word == AUTO else str(number(word))


def frame_count(word: str) -> int:
    """Parse a number of frames."""
    try:
        return int(word)
    except ValueError:
        raise typer.BadParameter(f"{word!r} is not a whole number: write one, as in 50") from None


def bench_value(word: str) -> bool | float | str:
    """Parse a bench value: true or false (upper or lower case), a number, or else a text."""
    if word.lower() in ("true", "false"):
        return word.lower() == "true"
    try:
        return float(word)
    except ValueError:
        if word.startswith("-"):  # with `ignore_unknown_options` a misspelt option arrives here
            raise typer.BadParameter(f"{word!r} is neither an option of this command nor a number") from None
        return word


def bench_name(word: str) -> str:
    """Refuse a misspelt option, which `ignore_unknown_options` passes as an argument."""
    if word.startswith("-"):
        raise typer.BadParameter(f"{word!r} is not an option of this command")
    return word


_VALUES_HELP = "One value for all modes, or one for each mode."
Values = Annotated[list[float], typer.Argument(help=_VALUES_HELP, parser=number)]
Gains = Annotated[list[str], typer.Argument(help=f"{_VALUES_HELP[:-1]}; or {AUTO}.", parser=gain_word)]
ValuesIfAny = Annotated[list[float] | None, typer.Argument(help=f"{_VALUES_HELP} nm rms of wavefront.", parser=number)]
ZeroOffset = Annotated[bool, typer.Option(ZERO, help="Set the offset to zero.")]
ZeroChannel = Annotated[bool, typer.Option(ZERO, help="Remove the channel.")]
Frames = Annotated[int, typer.Argument(help="Number of frames with the loop closed.", parser=frame_count)]
Text = Annotated[str, typer.Argument(help="The note.")]
Purpose = Annotated[str, typer.Argument(help="What will be moved.")]
Hold = Annotated[
    float | None,
    typer.Option(help="Seconds to hold the loop's command, at most 60; `open` ends the hold.", parser=number),
]
_BENCH_NAME_HELP = "Name of the value, as in [[interlocks]] of the configuration."
BenchName = Annotated[str, typer.Argument(help=_BENCH_NAME_HELP, parser=bench_name)]
BenchValue = Annotated[str, typer.Argument(help="true, false, a number or a text.")]
Channel = Annotated[str, typer.Argument(help="Name of the channel; `flat` does not shift the sensor's zero point.")]
Shape = Annotated[Path | None, typer.Argument(help="FITS or .npy array (rows, columns), nm of surface.")]
CalibrationFile = Annotated[Path, typer.Argument(help="Calibration file (FITS).")]
LawFile = Annotated[str, typer.Argument(help="Law file (FITS), or `integrator`.")]

_Command = Callable[..., None]


def _plain_command(name: str) -> _Command:
    def command(run: AnyRun = None, as_json: Json = False) -> None:
        try:
            _request_and_print(run, as_json, lambda loop: loop.ask(name))
        except (BusError, DataFileError) as fault:
            if name != "safe":
                raise
            raise type(fault)(f"{fault}\n{SAFE_BY_SIGNAL}") from None

    return command


def _values_command(name: str) -> _Command:
    def command(values: Values, modes: Modes = None, run: AnyRun = None, as_json: Json = False) -> None:
        _request_and_print(run, as_json, lambda loop: loop.ask(name, noll_of(modes), values))

    return command


def _gain(values: Gains, modes: Modes = None, run: AnyRun = None, as_json: Json = False) -> None:
    if AUTO in values and len(values) > 1:
        raise ConfigurationError(f"gain takes numbers, or `{AUTO}` alone")

    def ask(loop: "Client") -> "Answer":
        if values == [AUTO]:
            return loop.automatic_gain(noll_of(modes))
        return loop.gain([float(word) for word in values], noll_of(modes))

    _request_and_print(run, as_json, ask)


def _close(run: AnyRun = None, as_json: Json = False) -> None:
    def ask(loop: "Client") -> "Answer":
        harm = loop.processes().get(Role.CONTROLLER, wire.Health()).closing_harm
        answer = loop.close_loop()
        return answer._replace(reply=f"{answer.reply}; {harm}") if harm else answer

    _request_and_print(run, as_json, ask)


def _status(run: AnyRun = None, as_json: Json = False) -> None:
    from lowfc.programs.cli.status import json_object, text

    with _client(run) as loop:
        state, processes = loop.status().state, loop.processes()
        assert state is not None  # noqa: S101  # a status reply always has a state
    status = json_object(state, processes, loop.run_id)
    print_result(status, text(status), as_json=as_json)


def _configuration(run: AnyRun = None, as_json: Json = False) -> None:
    import json
    import tomllib

    with _client(run) as loop:
        text = loop.configuration()
    parsed = json.loads(json.dumps(tomllib.loads(text), default=str), parse_constant=str)  # dates, inf, nan as text
    print_result(parsed, f"# run {loop.run_id}\n{text.rstrip()}", as_json=as_json)


def _step(frames: Frames, run: AnyRun = None, as_json: Json = False) -> None:
    _request_and_print(run, as_json, lambda loop: loop.step(frames))


def _note(text: Text, run: AnyRun = None, as_json: Json = False) -> None:
    _request_and_print(run, as_json, lambda loop: loop.note(text))


def _offset(
    values: ValuesIfAny = None, modes: Modes = None, zero: ZeroOffset = False, run: AnyRun = None, as_json: Json = False
) -> None:
    if zero == bool(values):
        raise ConfigurationError(f"offset requires values or {ZERO}")
    _request_and_print(run, as_json, lambda loop: loop.offset([0.0] if zero else values or (), noll_of(modes)))


def _channel(
    name: Channel, file: Shape = None, zero: ZeroChannel = False, run: AnyRun = None, as_json: Json = False
) -> None:
    from lowfc.adapters.files.mirror_maps import read_shape

    if zero == (file is not None):
        raise ConfigurationError(f"channel requires a file or {ZERO}")
    shape = None if file is None else read_shape(file)
    _request_and_print(run, as_json, lambda loop: loop.channel(name, shape))


def _permit(text: Purpose, hold: Hold = None, run: AnyRun = None, as_json: Json = False) -> None:
    _request_and_print(run, as_json, lambda loop: loop.permit(text, hold))


def bench(name: BenchName, value: BenchValue, run: AnyRun = None, as_json: Json = False) -> None:
    """Publish a bench value once, and print which interlocks act.

    Example: lowfc ctl bench mask-moving true
    """
    from lowfc.programs.cli.status import interlocks_in_words, json_object

    parsed = bench_value(value)
    with _client(run) as loop:
        loop.status()  # wait for the connection: a controller that has replied also receives the value
        loop.bench(name, parsed)
        state = loop.status().state
        assert state is not None  # noqa: S101  # a status reply always has a state
    status = json_object(state, run=loop.run_id)
    names = sorted({interlock.name for interlock in state.settings.interlocks})
    unused = "" if name in names else f"; no interlock uses it (interlocks use {', '.join(names)})" if names else ""
    acting = f"interlocks: {interlocks_in_words(status)}" if names else "no interlock is configured"
    result = {"run": loop.run_id, "name": name, "value": parsed, "interlocks": status["interlocks"]}
    print_result(result, f"{name} is {value}{unused}; {acting} (run {loop.run_id})", as_json=as_json)


def _load(file: CalibrationFile, run: AnyRun = None, as_json: Json = False) -> None:
    from lowfc.adapters.files import calibration_file

    calibration = calibration_file.load(file)
    _request_and_print(run, as_json, lambda loop: loop.load(calibration))


def _law(file: LawFile, run: AnyRun = None, as_json: Json = False) -> None:
    from lowfc.adapters.files import law_file

    law = None if file == INTEGRATOR else law_file.load(Path(file))
    _request_and_print(run, as_json, lambda loop: loop.law(law))


def _recording_command(name: str) -> _Command:
    def command(run: AnyRun = None, as_json: Json = False) -> None:
        with _client(run) as loop:
            answer = loop.record(name == "record/start")
        result = {"run": answer.run, "accepted": answer.accepted, "reply": answer.reply, "log": answer.text}
        print_result(result, f"{answer.reply} (run {answer.run})", as_json=as_json)

    return command


_SPECIAL: dict[str, _Command] = {
    "status": _status,
    "configuration": _configuration,
    "close": _close,
    "gain": _gain,
    "step": _step,
    "note": _note,
    "permit": _permit,
    "offset": _offset,
    "channel": _channel,
    "load": _load,
    "law": _law,
}
"""Functions for the requests whose arguments do not follow from their fields, or that print more than the reply."""
_BY_FIELDS: dict[tuple[str, ...], Callable[[str], _Command]] = {
    (): _plain_command,
    ("modes", "values"): _values_command,
}
"""How to make the command of any other request, by the request's fields."""

for _name, _request in BY_NAME.items():
    if _request.example:
        _fields = tuple(field for field, _ in _request.fields)
        _records = _name.startswith("record/")
        _command = _recording_command(_name) if _records else _SPECIAL.get(_name) or _BY_FIELDS[_fields](_name)
        (record_app if _records else ctl_app).command(
            _request.name,
            help=f"{_request.description}\n\nExample: lowfc ctl {_request.example}",
            context_settings={"ignore_unknown_options": "values" in _fields},  # -5 is a value, not an option
        )(_command)
ctl_app.command(context_settings={"ignore_unknown_options": True})(bench)
for _measurement in (dark, reference):
    ctl_app.command(help=str(_measurement.__doc__).replace("lowfc calibrate", "lowfc ctl"))(_measurement)


@ctl_app.callback()
def _run_before_request(context: typer.Context, run: AnyRun = None) -> None:
    """Accept --run also before the request; `start` and `stop` are the commands in the group `record`."""
    defaults, group = {"run": run}, context.command
    assert isinstance(group, TyperGroup)  # noqa: S101  # `ctl_app` is a group
    context.default_map = {name: {**defaults, "start": defaults, "stop": defaults} for name in group.commands}


def _client(run: str | None) -> "Client":
    from lowfc.client import Client

    return Client(run)


def _request_and_print(run: str | None, as_json: bool, ask: "Callable[[Client], Answer]") -> None:
    with _client(run) as loop:
        answer = ask(loop)
        result = {name: getattr(answer, name) for name in ("run", "accepted", "reply", "frame", "frame_sequence")}
        print_result(result, answer.sentence, as_json=as_json)  # before the connection is closed, which may take long
