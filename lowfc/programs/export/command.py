"""The command `lowfc export`: a log for the field's own tools."""

import contextlib
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lowfc.adapters.extras import install_advice
from lowfc.adapters.log_selection import Selection, selection
from lowfc.adapters.terminal import Json, Logs
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.programs.output import put

if TYPE_CHECKING:
    from rich.console import Console

    from lowfc.adapters.history import History
    from lowfc.adapters.log_parts import LogFiles, Parts
    from lowfc.programs.export.rows import Progress


class Format(StrEnum):
    """What a log can become."""

    CSV = "csv"
    NPZ = "npz"
    FITS = "fits"
    AOT = "aot"


_ENDINGS = {Format.CSV: ".csv", Format.NPZ: ".npz", Format.FITS: ".fits", Format.AOT: ".aot.fits"}


def export(
    logs: Logs,
    to: Annotated[
        Format | None, typer.Option("--to", help="csv, npz, fits, or aot: Adaptive Optics Telemetry.")
    ] = None,
    decimate: Annotated[
        int | None,
        typer.Option(min=1, help="A smaller log instead: every Nth frame and mirror state, all steps and commands."),
    ] = None,
    topics: Annotated[
        list[str] | None,
        typer.Option(help="Decimate: of frames, mirror state and surface, truth and timing, only these; repeat."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="File to write; default: the log's name beside the log.")] = None,
    frames: Annotated[bool, typer.Option("--frames", help="The frames too; with npz as OUT.frames.npy.")] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace a file that is there already.")] = False,
    as_json: Json = False,
) -> None:
    """Write the steps of a log with their units, the calibration, and the frames if asked, for other tools.

    Or, with --decimate, a smaller log.

    Example: lowfc export last --to fits --frames
    """
    from rich.console import Console

    from lowfc.adapters.log_parts import one_by_one

    of_table, of_log = bool(frames or force), bool(topics)
    if (to is None) == (decimate is None) or (of_log if decimate is None else of_table):
        raise ConfigurationError(
            "an export is a table (--to FORMAT, with --frames and --force) or a smaller log (--decimate N, with "
            "--topics): choose one"
        )
    for log in one_by_one(logs, out, as_json=as_json):
        if decimate is not None:
            figures = decimate_log(log, selection(decimate, topics or ()), out, console=Console(stderr=True))
            put(figures, render_smaller(figures), as_json=as_json)
        elif to is not None:
            figures = export_log(log, to, out, frames=frames, force=force, console=Console(stderr=True))
            put(figures, render(figures), as_json=as_json)


def decimate_log(log: "Parts", asked: Selection, out: Path | None = None, *, console: "Console") -> dict[str, Any]:
    """Write a smaller log; return the figures that `--json` prints.

    Raises:
        DataFileError: the log cannot be read, or the new one is there already or cannot be written.
    """
    from lowfc.adapters.log_thinning import thin, thinned_path
    from lowfc.adapters.progress import reading_bar

    with reading_bar(console) as bar:
        task = bar.add_task("copying", total=None)
        done = thin(
            log,
            thinned_path(log[0], asked) if out is None else out,
            asked,
            lambda position, size: bar.update(task, completed=position, total=size),
        )
    return {
        "file": str(done.path),
        "selection": done.selection.sentence,
        "messages": done.messages,
        "bytes": done.size,
        "messages_before": done.messages_before,
        "bytes_before": done.size_before,
        "finished": done.finished,
        "damaged": done.damage,
    }


def render_smaller(figures: dict[str, Any]) -> str:
    """What became of a log, for a person."""
    lines = [
        f"{figures['file']}: {figures['messages']} of {figures['messages_before']} messages, "
        f"{figures['bytes'] / 1e6:.1f} of {figures['bytes_before'] / 1e6:.1f} MB; "
        f"{figures['selection'] or 'nothing was left out'}"
    ]
    if not figures["finished"]:
        lines.append("truncated          the log has no end: its recorder was killed, or is still writing")
    return "\n".join([*lines, *(f"damaged            left out: {part}" for part in figures["damaged"])])


def export_log(
    log: "LogFiles",
    to: Format,
    out: Path | None = None,
    *,
    frames: bool = False,
    force: bool = False,
    console: "Console",
) -> dict[str, Any]:
    """Export a log; return the figures that `--json` prints.

    Args:
        log: finished or not.
        to: what it becomes.
        out: file to write; the log's name with another ending, beside it, when None.
        frames: export the frames too.
        force: replace a file that is there, unless it is a log.
        console: for the progress.

    Raises:
        ConfigurationError: this format has no place for frames, or needs a library that is not there.
        DataFileError: the log cannot be read or has no steps, or the file is there already or cannot be written.
    """
    from lowfc.adapters.history_reader import read_history
    from lowfc.adapters.log_parts import WholeLog
    from lowfc.adapters.log_reader import LogReader
    from lowfc.adapters.progress import reading_bar
    from lowfc.adapters.whole_file import being_written
    from lowfc.programs.log.guard import refuse_log

    if frames and to is Format.CSV:
        raise ConfigurationError("a CSV file has no place for frames: use --to npz, fits or aot, or leave out --frames")
    write = _writer(to)
    reader = WholeLog(log, skip_damaged=True)
    stem = reader.path.name.removesuffix(".part").removesuffix(".mcap")
    out = out if out is not None else reader.path.parent / (stem + _ENDINGS[to])
    files = [out] + ([out.with_suffix(".frames.npy")] if frames and to is Format.NPZ else [])
    for file in files:
        refuse_log(file, reader.path)
        if file.exists() and not force:
            raise DataFileError(f"{file} exists already; choose another name (--out), or --force replaces it")
    with contextlib.ExitStack() as held:
        bar = held.enter_context(reading_bar(console))
        task = bar.add_task("reading", total=None)

        def progress(reader: LogReader) -> None:
            bar.update(task, completed=reader.position, total=reader.size)

        history = read_history(reader, lambda _: progress(reader))
        bar.update(task, description="writing")
        write([held.enter_context(being_written(file)) for file in files], history, frames, progress)
    return {
        "format": str(to),
        "files": [str(file) for file in files],
        "steps": len(history.steps.sequence),
        "modes": history.steps.error_nm.shape[1],
        "frames": len(history.frame_sequence) if frames else 0,
        "steps_left_out": history.left_out,
        "selection": reader.selection.sentence,
        "finished": reader.finished,
        "damaged": [f"byte {one.position}, {one.why}" for one in reader.damage],
        "remarks": history.remarks,
    }


def render(figures: dict[str, Any]) -> str:
    """What was written, for a person."""
    frames = f", {figures['frames']} frames" if figures["frames"] else ""
    lines = [f"the log has        {figures['selection']}"] if figures["selection"] else []
    lines += [f"{', '.join(figures['files'])}: {figures['steps']} steps of {figures['modes']} modes{frames}"]
    if figures["steps_left_out"]:
        lines.append(f"left out           {figures['steps_left_out']} steps with another calibration's modes")
    if not figures["finished"]:
        lines.append("truncated          the log has no end: its recorder was killed, or is still writing")
    lines += [f"damaged            left out: {part}" for part in figures["damaged"]]
    lines += [f"configuration      {remark}" for remark in figures["remarks"]]
    return "\n".join(lines)


def _writer(to: Format) -> "Callable[[list[Path], History, bool, Progress], None]":
    """What writes a format: it gets the files to write, the run, whether its frames are wanted, and the progress."""
    if to is Format.AOT:
        try:
            from lowfc.programs.export.aot import write_aot
        except ModuleNotFoundError as error:
            raise ConfigurationError(
                f"--to aot needs aotpy, which is not there ({error}); install it with: {install_advice('aot')}"
            ) from None
        return lambda files, history, frames, progress: write_aot(files[0], history, progress, with_frames=frames)
    from lowfc.programs.export import files as formats

    if to is Format.CSV:
        return lambda files, history, frames, progress: formats.write_csv(files[0], history)
    if to is Format.FITS:
        return lambda files, history, frames, progress: formats.write_fits(
            files[0], history, progress, with_frames=frames
        )
    return lambda files, history, frames, progress: formats.write_npz(files, history, progress)
