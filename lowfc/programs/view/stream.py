"""A rerun stream with the layout on it: to a viewer, or into a file."""

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from lowfc.programs.view.layout import APPLICATION


def to_viewer(url: str, blueprint: rrb.Blueprint) -> rr.RecordingStream:
    """Stream to a viewer that listens at `url`; what is logged waits where the viewer does not take it."""
    stream = _stream()
    stream.connect_grpc(url)
    stream.send_blueprint(blueprint)
    return stream


def to_file(path: Path, blueprint: rrb.Blueprint) -> rr.RecordingStream:
    """Stream into a file that rerun opens."""
    stream = _stream()
    stream.save(str(path))
    stream.send_blueprint(blueprint)
    return stream


def _stream() -> rr.RecordingStream:
    stream = rr.RecordingStream(APPLICATION)
    stream.set_log_time_enabled(False)  # one timeline, that of the data
    stream.set_log_tick_enabled(False)
    return stream
