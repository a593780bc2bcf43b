"""`lowfc ctl`: arguments only; what is asked is in `lowfc.client`."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from lowfc.adapters.process.terminal import AnyRun, Json, new_app
from lowfc.client.requests import BY_NAME
from lowfc.contract.errors import BusError, ConfigurationError, DataFileError
from lowfc.programs.cli.modes import Modes, noll_of
from lowfc.programs.cli.output import put
from lowfc.programs.commissioning.calibrate.command import dark, reference

if TYPE_CHECKING:
    from lowfc.client import Answer, Client

ctl_app = new_app("Ask a running controller.\n\nExample: lowfc ctl status")
record_app = new_app("Start the next log, or finish this one.\n\nExample: lowfc ctl record stop")
ctl_app.add_typer(record_app, name="record")

OF_MODES = ("gain", "leak", "limit")
"""Requests that take a value for all modes, or one for each."""
SIMPLE = ("open", "close", "pause", "safe", "clear", "reset", "stop")
"""Requests without an argument."""
ZERO = "--zero"
INTEGRATOR = "integrator"
SIGNAL = (
    "a controller that cannot be asked is made safe by a signal on its host: "
    "pkill -USR1 -f '^[^ ]*python.* (-m |[^ ]*/)lowfc controller'"
)
_SIGNED = {"ignore_unknown_options": True}
"""So that -5 is a value and no option."""


def number(word: str) -> float:
    """A number as it was typed; one that is none is shown."""
    try:
        return float(word)
    except ValueError:
        raise typer.BadParameter(f"{word!r} is not a number: write 0.3, and several as 0.3 0.2") from None


Values = Annotated[list[float], typer.Argument(help="One value for all modes, or one for each.", parser=number)]
Zero = Annotated[bool, typer.Option(ZERO, help="Take it away.")]


@ctl_app.command()
def status(run: AnyRun = None, as_json: Json = False) -> None:
    """Say how the loop is: whether all is well in the first line, then what the controller is doing.

    Example: lowfc ctl status --json
    """
    from lowfc.programs.cli.ctl.status import figures, text

    with _joined(run) as loop:
        state, processes = loop.status().state, loop.processes()
        assert state is not None  # noqa: S101  # that is what it answers with
    known = state, processes, loop.run_id
    put(figures(*known), text(*known), as_json=as_json)


def _simple(name: str) -> Callable[..., None]:
    def ask(run: AnyRun = None, as_json: Json = False) -> None:
        try:
            _say(run, as_json, lambda loop: loop.ask(name))
        except (BusError, DataFileError) as fault:
            if name != "safe":
                raise
            raise type(fault)(f"{fault}\n{SIGNAL}") from None

    return ask


def _of_modes(name: str) -> Callable[..., None]:
    def ask(values: Values, modes: Modes = None, run: AnyRun = None, as_json: Json = False) -> None:
        _say(run, as_json, lambda loop: loop.ask(name, noll_of(modes), values))

    return ask


def _recording(name: str) -> Callable[..., None]:
    def ask(run: AnyRun = None, as_json: Json = False) -> None:
        with _joined(run) as loop:
            answer = loop.record(name == "record/start")
        said = {"run": answer.run, "accepted": answer.accepted, "reply": answer.reply, "log": answer.text}
        put(said, f"{answer.reply} (run {answer.run})", as_json=as_json)

    return ask


def _declared(app: typer.Typer, names: Iterable[str], made: Callable[[str], Callable[..., None]]) -> None:
    """Commands whose help is what the table of requests says."""
    for name in names:
        asked = BY_NAME[name]
        text = f"{asked.sentence}\n\nExample: lowfc ctl {asked.example}"
        app.command(name.rpartition("/")[2], help=text, context_settings=_SIGNED if made is _of_modes else None)(
            made(name)
        )


_declared(ctl_app, SIMPLE, _simple)
_declared(ctl_app, OF_MODES, _of_modes)
_declared(record_app, ("record/start", "record/stop"), _recording)


@ctl_app.command()
def step(
    frames: Annotated[int, typer.Argument(help="Frames for which the loop is closed.")],
    run: AnyRun = None,
    as_json: Json = False,
) -> None:
    """Close the loop for some frames; then it opens by itself.

    Example: lowfc ctl step 100
    """
    _say(run, as_json, lambda loop: loop.step(frames))


@ctl_app.command(context_settings=_SIGNED)
def offset(
    values: Annotated[
        list[float] | None, typer.Argument(help="One for all modes, or one for each; nm rms.", parser=number)
    ] = None,
    modes: Modes = None,
    zero: Zero = False,
    run: AnyRun = None,
    as_json: Json = False,
) -> None:
    """Set where the loop holds the wavefront, nm rms of each mode.

    Example: lowfc ctl offset 5 -3 --modes 4,11
    """
    if zero == bool(values):
        raise ConfigurationError(f"offset takes values, or {ZERO}")
    _say(run, as_json, lambda loop: loop.offset([0.0] if zero else values or (), noll_of(modes)))


@ctl_app.command()
def channel(
    name: Annotated[str, typer.Argument(help="Of the channel; `flat` does not shift the sensor's zero point.")],
    file: Annotated[Path | None, typer.Argument(help="FITS or .npy array (rows, columns), nm of surface.")] = None,
    zero: Zero = False,
    run: AnyRun = None,
    as_json: Json = False,
) -> None:
    """Add a shape to the mirror, in place of the one of that name; the loop does not undo it.

    Example: lowfc ctl channel dark-hole shape.fits
    """
    from lowfc.adapters.files.mirror_maps import read_shape

    if zero == (file is not None):
        raise ConfigurationError(f"channel takes a file, or {ZERO}")
    shape = None if file is None else read_shape(file)
    _say(run, as_json, lambda loop: loop.channel(name, shape))


@ctl_app.command()
def load(
    file: Annotated[Path, typer.Argument(help="Calibration file (FITS).")], run: AnyRun = None, as_json: Json = False
) -> None:
    """Use another calibration from now on; the loop must be open.

    Example: lowfc ctl load calibration.fits
    """
    from lowfc.adapters.files import calibration_file

    calibration = calibration_file.load(file)
    _say(run, as_json, lambda loop: loop.load(calibration))


@ctl_app.command()
def law(
    file: Annotated[str, typer.Argument(help="Law file (FITS), or integrator.")],
    run: AnyRun = None,
    as_json: Json = False,
) -> None:
    """Let another control law drive the mirror; refused where it is not stable.

    Example: lowfc ctl law lqg.fits
    """
    from lowfc.adapters.files import law_file

    wanted = None if file == INTEGRATOR else law_file.load(Path(file))
    _say(run, as_json, lambda loop: loop.law(wanted))


@ctl_app.command()
def configuration(run: AnyRun = None, as_json: Json = False) -> None:
    """Print the configuration that the controller was started with, as TOML.

    Example: lowfc ctl configuration > running.toml
    """
    import tomllib

    with _joined(run) as loop:
        text = loop.configuration()
    put(tomllib.loads(text), f"# run {loop.run_id}\n{text.rstrip()}", as_json=as_json)


@ctl_app.command()
def note(
    text: Annotated[str, typer.Argument(help="What to remember.")], run: AnyRun = None, as_json: Json = False
) -> None:
    """Leave a note in the log.

    Example: lowfc ctl note "clouds from here on"
    """
    _say(run, as_json, lambda loop: loop.note(text))


ctl_app.command()(dark)
ctl_app.command()(reference)


def _joined(run: str | None) -> "Client":
    from lowfc.client import Client

    return Client(run)


def _say(run: str | None, as_json: bool, ask: "Callable[[Client], Answer]") -> None:
    with _joined(run) as loop:
        answer = ask(loop)
    said = {"run": answer.run, "accepted": answer.accepted, "reply": answer.reply}
    put({**said, "frame": answer.frame, "frame_sequence": answer.frame_sequence}, answer.sentence, as_json=as_json)
