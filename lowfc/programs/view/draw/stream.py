"""A rerun stream with the layout on it: to a viewer, or into a file."""

from pathlib import Path

import rerun as rr
import rerun.blueprint as rrb

from lowfc.programs.view.layout import APPLICATION


def to_viewer(url: str, recording: str, blueprint: rrb.Blueprint) -> rr.RecordingStream:
    """Stream of that name to a viewer that listens at `url`; what it does not take waits, and then holds up."""
    stream = _stream(recording)
    stream.connect_grpc(url)
    stream.send_blueprint(blueprint)
    return stream


def to_file(path: Path, recording: str, blueprint: rrb.Blueprint) -> rr.RecordingStream:
    """Stream of that name into a file that rerun opens."""
    stream = _stream(recording)
    stream.save(str(path))
    stream.send_blueprint(blueprint)
    return stream


def _stream(recording: str) -> rr.RecordingStream:
    stream = rr.RecordingStream(APPLICATION, recording_id=recording)
    stream.set_log_time_enabled(False)  # one timeline, that of the data
    stream.set_log_tick_enabled(False)
    return stream
