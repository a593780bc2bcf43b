"""The command `lowfc export`: convert a log for other tools."""

import contextlib
from collections.abc import Callable
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lowfc.adapters.logs.selection import selection
from lowfc.adapters.process.extras import package_required
from lowfc.adapters.process.terminal import Json, Logs
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.control.loop.wording import counted
from lowfc.programs.cli.output import print_result

if TYPE_CHECKING:
    from rich.console import Console

    from lowfc.adapters.logs.history import History
    from lowfc.adapters.logs.parts import LogFiles


class Format(StrEnum):
    """Export formats."""

    CSV = "csv"
    NPZ = "npz"
    FITS = "fits"
    AOT = "aot"


_ENDINGS = {Format.CSV: ".csv", Format.NPZ: ".npz", Format.FITS: ".fits", Format.AOT: ".aot.fits"}


def export(
    logs: Logs,
    to: Annotated[
        Format | None, typer.Option("--to", help="csv, npz, fits (default), or aot: Adaptive Optics Telemetry.")
    ] = None,
    decimate: Annotated[
        int | None,
        typer.Option(min=1, help="Write a smaller log: every Nth frame and mirror state, all steps and commands."),
    ] = None,
    topics: Annotated[
        list[str] | None,
        typer.Option(
            help="With --decimate: keep only this one of the optional topics (key or pattern); repeat for several."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Output file; default: next to the log, with its name, or NAME-every-N.mcap with --decimate."
        ),
    ] = None,
    frames: Annotated[
        bool, typer.Option("--frames", help="Export the frames, too; with npz in a second file, NAME.frames.npy.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    as_json: Json = False,
) -> None:
    """Convert a log for other tools: its steps with units, its calibration and, with --frames, its frames.

    With --decimate, write a smaller log.

    Example: lowfc export last --to fits --frames
    """
    from rich.console import Console

    from lowfc.adapters.logs.parts import named_logs
    from lowfc.adapters.logs.thinning import thin
    from lowfc.adapters.process.progress import reading_bar

    if decimate is None and topics:
        raise ConfigurationError("--topics chooses what a smaller log keeps: add --decimate, such as --decimate 1")
    if decimate is not None and (to is not None or frames or force):
        raise ConfigurationError("--decimate writes a smaller log, without --to, --frames and --force: leave these out")
    console = Console(stderr=True)
    for log in named_logs(logs, out, as_json=as_json):
        if decimate is not None:
            chosen = selection(decimate, topics or ())
            with reading_bar(console) as count:
                results = thin(log, out, chosen, partial(count, "copying"))
            print_result(results, render_copy(results), as_json=as_json)
        else:
            results = export_log(log, to or Format.FITS, out, frames=frames, force=force, console=console)
            print_result(results, render(results), as_json=as_json)


def export_log(
    log: "LogFiles",
    to: Format,
    out: Path | None = None,
    *,
    frames: bool = False,
    force: bool = False,
    console: "Console",
) -> dict[str, Any]:
    """Export a log; return the results that `--json` prints."""
    from lowfc.adapters.files.whole_file import being_written, require_folder
    from lowfc.adapters.logs.history import read_history
    from lowfc.adapters.logs.parts import WholeLog
    from lowfc.adapters.logs.recovery import missing_parts
    from lowfc.adapters.logs.writer import stem_of
    from lowfc.adapters.process.progress import reading_bar

    if frames and to is Format.CSV:
        raise ConfigurationError("a CSV file cannot hold frames: use --to npz, fits or aot, or omit --frames")
    write = _writer(to, with_frames=frames)
    reader = WholeLog(log)
    out = out if out is not None else reader.path.parent / (stem_of(reader.path) + _ENDINGS[to])
    files = [out] + ([out.parent / f"{out.stem}.frames.npy"] if frames and to is Format.NPZ else [])
    require_folder(*files)
    for file in files:
        if file.exists() and not force:
            raise DataFileError(f"{file} already exists; use another name (--out), or replace it with --force")
    with contextlib.ExitStack() as stack:
        count = stack.enter_context(reading_bar(console))
        reader.progress = partial(count, "reading")
        history = read_history(reader)
        if frames and not history.frame_sequence.size:
            raise DataFileError(f"{reader.path} has no frames; export without --frames")
        reader.progress = partial(count, "writing")
        write([stack.enter_context(being_written(file, reader.path)) for file in files], history)
    return {
        "format": str(to),
        "files": [str(file) for file in files],
        "steps": len(history.steps.sequence),
        "modes": history.steps.error_nm.shape[1],
        "frames": len(history.frame_sequence) if frames else 0,
        "steps_left_out": history.excluded_messages,
        "selection": reader.selection.description,
        **missing_parts(reader),
        "remarks": history.remarks,
    }


def render(results: dict[str, Any]) -> str:
    """Summary of an export as text."""
    from lowfc.adapters.logs.recovery import faults

    frames = f", {results['frames']} frames" if results["frames"] else ""
    lines = [f"recorded           {results['selection']}"] if results["selection"] else []
    lines += [f"{', '.join(results['files'])}: {results['steps']} steps of {results['modes']} modes{frames}"]
    if results["steps_left_out"]:
        mismatch = "with another number of modes than the calibration or with impossible values"
        lines.append(f"left out           {counted(results['steps_left_out'], 'message')} {mismatch}")
    lines += faults(results["damaged"], results["no_end"])
    lines += [f"configuration      {remark}" for remark in results["remarks"]]
    return "\n".join(lines)


def render_copy(results: dict[str, Any]) -> str:
    """Summary of a smaller log as text."""
    from lowfc.adapters.logs.recovery import faults

    copied = (
        f"{results['file']}: {results['messages']} of {results['messages_before']} messages, "
        f"{results['bytes'] / 1e6:.1f} of {results['bytes_before'] / 1e6:.1f} MB; "
        f"{results['selection'] or 'nothing was left out'}"
    )
    return "\n".join([copied, *faults(results["damaged"], results["no_end"])])


def _writer(to: Format, *, with_frames: bool) -> "Callable[[list[Path], History], None]":
    """The writer of a format: a function of the output files and the log's history."""
    if to is Format.AOT:
        with package_required("--to aot requires aotpy", "aot"):
            from lowfc.programs.logs.export.aot import write_aot
        return partial(write_aot, with_frames=with_frames)
    from lowfc.programs.logs.export import files

    if to is Format.FITS:
        return partial(files.write_fits, with_frames=with_frames)
    return files.write_csv if to is Format.CSV else files.write_npz
