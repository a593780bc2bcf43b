"""Command lines: display of users' errors, and the options and arguments that several commands share."""

import errno
import io
import os
import signal
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from typer.core import TyperGroup

from lowfc.adapters.bus import DEFAULT_RUN as DEFAULT_RUN
from lowfc.contract.errors import LowfcError, brief, reworded
from lowfc.contract.printable import LINES, printable

if TYPE_CHECKING:
    from lowfc.contract.configuration import Configuration

INTERRUPTED = 130
"""Exit status after Ctrl-C."""
_HOST_FAULTS = (
    errno.EACCES,
    errno.EBADF,
    errno.EDQUOT,
    errno.EFBIG,
    errno.EIO,
    errno.ENAMETOOLONG,
    errno.ENOSPC,
    errno.EPIPE,
    errno.EROFS,
)

RunId = Annotated[str, typer.Option("--run", help="Name of the run; processes of one run find each other by it.")]
AnyRun = Annotated[str | None, typer.Option("--run", help="Name of the run; default: the only one.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on standard output.")]
_LOGS = "Logs (MCAP), finished or not; all files of a recording are one log. `last`: the newest in the log folder."
Logs = Annotated[list[Path], typer.Argument(help=_LOGS, metavar="LOG", readable=False, show_default=False)]
_IfAny = partial(typer.Argument, metavar="LOG", readable=False, show_default=False)
LogsIfAny = Annotated[list[Path] | None, _IfAny(help=f"{_LOGS} Without one: the running loop.")]
LogsOrLive = Annotated[list[Path] | None, _IfAny(help=f"{_LOGS} Without one, --live is required.")]
LogsOrMeasure = Annotated[list[Path] | None, _IfAny(help=f"{_LOGS} Without one: a loop started for this measurement.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="Configuration file (TOML).", show_default=False)]


class AppGroup(TyperGroup):
    """Command group."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """List each command with its full first sentence."""
        with formatter.section("Commands"):
            formatter.write_dl(
                [(name, command.get_short_help_str(limit=999)) for name, command in self.commands.items()]
            )

    def invoke(self, ctx: Any) -> Any:
        """Run the command; an error about one of its arguments is reworded."""
        try:
            return super().invoke(ctx)
        except typer.BadParameter as fault:
            cause: Any = fault.__cause__
            fault.message = reworded(fault.message)
            if fault.message.startswith("must ") and hasattr(cause, "errors"):  # a ValidationError
                fault.message += f", got {brief(cause.errors()[0]['input'])}"
                fault.__cause__ = None  # in a nested group, the outer group handles the error too
            raise


def new_app(help_text: str) -> typer.Typer:
    """Make a command line with plain error messages."""
    return typer.Typer(
        help=help_text,
        cls=AppGroup,
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )


def _warn(text: str) -> None:
    sys.stderr.write(f"warning: {printable(text)}\n")


def run_app(app: Callable[[], object]) -> NoReturn:
    """Run a command line; a user's error gives one message and the error's exit status, never a traceback.

    The status is 2 unless the error's class sets another.

    SIGTERM ends a command as Ctrl-C does; the processes of a loop catch both themselves. A lost terminal acts as
    SIGTERM.
    """
    _prepare_process()
    try:
        try:
            app()
        finally:  # typer ends by SystemExit
            sys.stdout.flush()
    except OSError as fault:
        if fault.filename is None and fault.errno == errno.ENOENT:
            text = "the working directory has been removed: change to another one"
        elif fault.filename is None and fault.errno in _HOST_FAULTS:
            text = f"standard output cannot be written: {fault.strerror}"
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # discard the rest
        elif fault.errno in _HOST_FAULTS:
            text = f"{printable(str(fault.filename))} cannot be read or written: {fault.strerror}"
        else:
            raise
        sys.stderr.write(f"error: {text}\n")
        sys.exit(2)
    except LowfcError as error:
        sys.stderr.write(f"error: {printable(str(error), keep=LINES)}\n")
        sys.exit(error.exit_status)
    except SystemExit as end:
        if end.code == INTERRUPTED:
            sys.stderr.write("interrupted\n")
        raise
    sys.exit(0)


def _prepare_process() -> None:
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # set by nohup
        signal.signal(signal.SIGHUP, _terminate)
    if os.path.expanduser("~") == "~":  # noqa: PTH111  # Path.home, and astropy with it, would raise RuntimeError
        os.environ["HOME"] = "/"
    for name, flags, mode in (("stdin", os.O_RDONLY, "r"), ("stdout", os.O_RDONLY, "w"), ("stderr", os.O_WRONLY, "w")):
        if getattr(sys, name) is None:  # closed by the caller: input is empty, and writing a result fails
            setattr(sys, name, os.fdopen(os.open(os.devnull, flags), mode))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # as stderr, for a terminal without UTF-8


def _terminate(number: int, frame: object) -> None:
    signal.signal(number, signal.SIG_IGN)  # the shell and the kernel may each send SIGHUP
    signal.raise_signal(signal.SIGTERM)


def options_set(context: typer.Context) -> list[str]:
    """Options (such as --out) and arguments (such as logs) that the command line sets."""
    return [
        parameter.opts[0]
        for parameter in context.command.params
        if parameter.name and str(context.get_parameter_source(parameter.name)).endswith("COMMANDLINE")
    ]


def configuration(
    file: Path | None, overrides: dict[str, Any] | None = None, defaults: dict[str, Any] | None = None
) -> "Configuration":
    """Load the configuration: options that are not None override the file, and the file overrides the defaults."""
    from lowfc.contract.configuration import load

    overriding = {key: value for key, value in (overrides or {}).items() if value is not None}
    return load(file, overriding, defaults, remark=_warn)
