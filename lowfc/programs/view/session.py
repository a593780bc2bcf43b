"""Show a run or logs."""

import contextlib
import sys
import time
from pathlib import Path
from typing import Any

import rerun as rr
from rich.console import Console

from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.files.whole_file import draft, require_folder
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.process.join import clock_of
from lowfc.adapters.process.progress import reading_bar
from lowfc.adapters.viewer.rerun_viewer import RerunViewer
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import Role
from lowfc.programs.view.live_view import LiveView, ViewError
from lowfc.programs.view.recorded import DrawnLogs, draw_logs
from lowfc.programs.view.target import Target

PICTURE_AFTER_S = 8.0
"""Time after which the picture of a running loop is taken, so that its plots have data."""
_POLL_S = 0.1


def show_run(run_id: str, config: Configuration | None, target: Target, seconds: float | None) -> dict[str, Any]:
    """Show a running loop until stopped, until the window is closed, or for some seconds.

    Raises:
        ViewerError, ViewError: no viewer starts, it fails repeatedly, memory stays above its limit, or writing fails.
        DataFileError: a file cannot be written.
    """
    require_folder(target.written)
    run = open_run(run_id, ())
    run_config = run.path / "config.toml"
    config = config or load(run_config if run_config.exists() else None)
    clock = clock_of(config)
    with contextlib.ExitStack() as stack:
        if target.save is not None:
            target.part = stack.enter_context(draft(target.save))
        bus = ZenohBus(run.links, Role.VIEWER, clock, monitor=True)
        stack.callback(bus.close)
        view = LiveView(config, run_id, clock, bus, target)
        stack.callback(view.close)
        view.service.catch_signals()
        view.service.announces = True
        view.service.awaited = lambda: "" if view.service.last_health else "any other process"
        duration_s = seconds if seconds is not None or target.picture is None else PICTURE_AFTER_S
        try:
            view.run(duration_s, lambda: target.print_address(view.viewer))
        except ViewError as error:
            if target.part is None:
                raise
            unfinished = target.part.replace(f"{target.save}.part")
            raise ViewError(f"{error}; the part written so far is in {unfinished}") from error
        if not view.service.last_health and target.written is not None:
            raise ViewError(f"no message of run {run_id!r} has arrived: nothing is written")
        if target.picture is not None and view.viewer is not None:
            view.viewer.screenshot(target.picture)
    return {
        "run": run_id,
        "moments": view.snapshots,
        "renewals": view.renewals,
        "memory_mb": round(view.peak_bytes / 1e6, 1),
        "file": _report_written(target),
    }


def show_logs(logs: list[Path], config: Configuration | None, target: Target) -> dict[str, Any]:
    """Show consecutive logs; a window or page stays until it is closed or Ctrl-C is pressed.

    Raises:
        ViewerError: no viewer starts, or it ended during drawing.
        DataFileError: a file cannot be read or written.
    """
    require_folder(target.written)
    for log in logs:
        next(iter(LogReader(log, skip_damaged=True)), None)  # reports an unreadable file before a viewer starts
    drawn = DrawnLogs()
    with contextlib.ExitStack() as stack:
        if target.save is not None:
            target.part = stack.enter_context(draft(target.save, logs[0]))
        viewer = target.viewer()
        if viewer is not None:
            stack.callback(viewer.stop)
        stream = target.stream(viewer, logs[0].stem, None)
        stack.callback(_end, stream, viewer)
        if target.written is None:  # Ctrl-C ends the view, even before everything is drawn
            with contextlib.suppress(KeyboardInterrupt):
                target.print_address(viewer)
                drawn = _draw(logs, config, stream, target)
                while viewer is not None and viewer.alive:
                    time.sleep(_POLL_S)
        else:
            drawn = _draw(logs, config, stream, target)
            if target.save is not None:
                try:
                    stream.flush()
                except RuntimeError as fault:
                    raise DataFileError(f"{target.save} cannot be written: is the disk full? {fault}") from None
            stream.disconnect()  # the viewer keeps its data
            if viewer is not None:
                viewer.screenshot(target.picture)
    return {
        "logs": [str(log) for log in logs],
        "moments": drawn.snapshots,
        "log_s": round(drawn.log_s, 3),
        "remarks": drawn.remarks,
        "file": _report_written(target),
    }


def memory_remarks(log_bytes: int, target: Target) -> list[str]:
    """A remark if a viewer may not keep all of a log of this size; a file keeps everything."""
    if target.save is not None or log_bytes <= target.memory_mb * 1e6:
        return []
    return [
        f"the log has {log_bytes / 1e6:.0f} MB, the viewer keeps {target.memory_mb:g} MB (--memory-mb): curves "
        "with a point for every frame may begin late; trend, tiles and mode cover the whole log"
    ]


def _draw(logs: list[Path], config: Configuration | None, stream: rr.RecordingStream, target: Target) -> DrawnLogs:
    total = sum(log.stat().st_size for log in logs if log.exists())
    with reading_bar(Console(stderr=True)) as count:
        drawn = draw_logs(logs, config, stream, lambda done: count("drawing", done, total))
    target.show_all(stream, drawn.span_ns)
    drawn.remarks += memory_remarks(total, target)
    for remark in drawn.remarks:
        sys.stderr.write(f"{remark}\n")
    return drawn


def _end(stream: rr.RecordingStream, viewer: RerunViewer | None) -> None:
    """End a stream; a viewer that hangs is stopped first, because the stream would wait for it."""
    if viewer is not None and not viewer.answers():
        viewer.stop()
    stream.disconnect()


def _report_written(target: Target) -> str | None:
    if target.written is None:
        return None
    sys.stderr.write(f"{target.written} written\n")
    return str(target.written)
