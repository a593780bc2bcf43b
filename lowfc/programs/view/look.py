"""Looking at a run or at logs, in one place, from the beginning to the end."""

import contextlib
import sys
import time
from pathlib import Path
from typing import Any

import rerun as rr
from rich.console import Console

from lowfc.adapters.join import clock_of
from lowfc.adapters.progress import passing_bar
from lowfc.adapters.rerun_viewer import RerunViewer, Show
from lowfc.adapters.run import open_run
from lowfc.adapters.whole_file import being_written, require_folder
from lowfc.adapters.zenoh_bus import ZenohBus
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.messages import Role
from lowfc.programs.view.bridge import Bridge, ViewError
from lowfc.programs.view.layout import LIVE_WINDOW_S
from lowfc.programs.view.painter import Painter
from lowfc.programs.view.place import Place
from lowfc.programs.view.recorded import Drawn, draw_logs

PICTURE_AFTER_S = 8.0
"""Of a running loop: its plots have something to show by then."""
_POLL_S = 0.1


def look_at_run(run_id: str, config: Configuration | None, where: Place, seconds: float | None) -> dict[str, Any]:
    """Show a running loop until told to stop, until the window is closed, or for some seconds.

    Raises:
        ViewerError, ViewError: there is no viewer, or it fails again and again.
        DataFileError: a file cannot be written.
    """
    require_folder(where.save, where.picture)
    run = open_run(run_id, ())
    own = run.path / "config.toml"
    config = config or load(own if own.exists() else None)
    clock = clock_of(config)
    with contextlib.ExitStack() as stack:
        part = stack.enter_context(being_written(where.save)) if where.save is not None else None
        bus = ZenohBus(run.links, Role.VIEWER, clock, looks_on=True)
        stack.callback(bus.close)
        bridge = Bridge(
            config,
            run_id,
            clock,
            bus,
            where.viewer if where.show is not None else None,
            lambda viewer: where.stream(viewer, part, run_id, LIVE_WINDOW_S),
            round(where.memory_mb * 1e6),
        )
        stack.callback(bridge.close)
        bridge.service.catch_signals()
        bridge.service.announces = True
        bridge.service.awaited = lambda: "" if bridge.service.heard else "any other process"
        until_s = seconds if seconds is not None or where.picture is None else PICTURE_AFTER_S
        try:
            summary = bridge.run(until_s, lambda: _say_where(where, bridge.viewer))
        except ViewError as error:
            if part is None:
                raise
            rest = Path(f"{where.save}.part")
            part.replace(rest)
            raise ViewError(f"{error}; what there is of it is in {rest}") from error
        if not bridge.service.heard and where.show in (None, Show.HEADLESS):
            raise ViewError(f"nothing was heard of run {run_id!r}: nothing is written")
        if where.picture is not None and bridge.viewer is not None:
            bridge.viewer.screenshot(where.picture)
    _say_written(where)
    return {
        "run": run_id,
        "moments": summary.moments,
        "renewals": summary.renewals,
        "memory_mb": round(summary.most_bytes / 1e6, 1),
        "file": str(where.save or where.picture or "") or None,
    }


def look_at_logs(logs: list[Path], config: Configuration | None, where: Place) -> dict[str, Any]:
    """Show logs that follow each other; a window or page stays until it is closed or Ctrl-C.

    Raises:
        ViewerError: there is no viewer, or it ended while it was drawn on.
        DataFileError: a file cannot be read or written.
    """
    require_folder(where.save, where.picture)
    with contextlib.ExitStack() as stack:
        part = stack.enter_context(being_written(where.save)) if where.save is not None else None
        viewer = where.viewer() if where.show is not None else None
        if viewer is not None:
            stack.callback(viewer.stop)
        stream = where.stream(viewer, part, logs[0].stem, None)
        stack.callback(_end, stream, viewer)
        if viewer is None or where.picture is not None:
            _say_where(where, viewer)
            drawn = _draw(logs, config, stream, where)
            stream.disconnect()  # a viewer keeps what it has
            if viewer is not None:
                viewer.screenshot(where.picture)
        else:
            drawn = Drawn()
            with contextlib.suppress(KeyboardInterrupt):  # the way to end it, whether everything is drawn yet or not
                _say_where(where, viewer)
                drawn = _draw(logs, config, stream, where)
                while viewer.alive:
                    time.sleep(_POLL_S)
    _say_written(where)
    return {
        "logs": [str(log) for log in logs],
        "moments": drawn.moments,
        "log_s": round(drawn.log_s, 3),
        "remarks": drawn.remarks,
        "file": str(where.save or where.picture or "") or None,
    }


def _draw(logs: list[Path], config: Configuration | None, stream: rr.RecordingStream, where: Place) -> Drawn:
    total = sum(log.stat().st_size for log in logs if log.exists())
    with passing_bar(Console(stderr=True)) as bar:
        task = bar.add_task("drawing", total=total)
        drawn = draw_logs(logs, config, lambda own: Painter(own, stream), lambda done: bar.update(task, completed=done))
    where.show_whole(stream, drawn.span_ns)
    for remark in drawn.remarks:
        sys.stderr.write(f"{remark}\n")
    return drawn


def _end(stream: rr.RecordingStream, viewer: RerunViewer | None) -> None:
    """End a stream; one into a viewer that hangs would wait for it, so that goes first."""
    if viewer is not None and not viewer.answers():
        viewer.stop()
    stream.disconnect()


def _say_where(where: Place, viewer: RerunViewer | None) -> None:
    if viewer is not None and where.show is Show.WEB:
        sys.stderr.write(f"look at {viewer.web_address}\nCtrl-C ends the view\n")


def _say_written(where: Place) -> None:
    for file in (where.save, where.picture):
        if file is not None:
            sys.stderr.write(f"{file} written\n")
