"""The recorder's process: joins a run, and records it until it is stopped."""

from collections.abc import Callable
from collections.abc import Set as AbstractSet
from pathlib import Path

from lowfc.adapters.bus.run import Run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.logs.selection import EVERYTHING, Selection
from lowfc.adapters.logs.series import STANDARD, Limits, shortage
from lowfc.adapters.logs.writer import Attachment
from lowfc.adapters.process.clock import Clock, HostClock
from lowfc.adapters.process.provenance import provenance
from lowfc.adapters.process.realtime import step_back
from lowfc.adapters.process.service import Service
from lowfc.contract.codecs import input_file
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import Role
from lowfc.programs.core.recording.recorder import Recorder
from lowfc.programs.core.recording.summary import Summary

_LARGEST_ATTACHMENT_BYTES = 1 << 28


def record(
    run: Run,
    folder: Path,
    *,
    configuration: Path | None = None,
    calibration: Path | None = None,
    seed: int | None = None,
    limits: Limits = STANDARD,
    clock: Clock | None = None,
    priority: int | None = None,
    cpus: set[int] | None = None,
    selection: Selection = EVERYTHING,
    expected_bytes_per_s: float = 0.0,
    begins: Callable[[], None] = lambda: None,
    alarm: Callable[[Service], object] = lambda service: None,
) -> Summary:
    """Record a run into `folder` until SIGTERM or SIGINT; the process of `lowfc record`.

    The files `configuration` (TOML) and `calibration` (FITS) go into each log; `begins` is called once there is room,
    and `alarm` with the service whose events it watches.
    """
    if short := shortage(folder, limits.min_free_bytes):
        raise DataFileError(short)
    begins()
    attachments = [
        _attached(path, media_type)
        for path, media_type in ((configuration, "application/toml"), (calibration, "application/fits"))
        if path is not None
    ]
    granted = step_back(priority, cpus)
    clock = HostClock() if clock is None else clock
    bus = ZenohBus(run.links, Role.RECORDER, clock)
    try:
        recorder = Recorder(
            bus,
            clock,
            run.run_id,
            folder,
            metadata={"lowfc": {**provenance(run.run_id, seed), "clock_ahead_ms": f"{clock.ahead_ns() / 1e6:.3f}"}},
            attachments=attachments,
            limits=limits,
            granted=granted,
            selection=selection,
            expected_bytes_per_s=expected_bytes_per_s,
            awaited=_launched(run),
        )
        recorder.catch_signals()
        recorder.service.announces = True
        alarm(recorder.service)
        return recorder.run()
    finally:
        bus.close()


def _launched(run: Run) -> AbstractSet[str]:
    """The processes that a launcher starts beside the recorder; it sends no Health itself."""
    ports = run.links.ports.keys()
    return ports - {Role.LAUNCHER, Role.RECORDER} if Role.LAUNCHER in ports else frozenset()


def _attached(path: Path, media_type: str) -> Attachment:
    try:
        return Attachment(path.name, media_type, input_file.read_whole(path, _LARGEST_ATTACHMENT_BYTES))
    except OSError as fault:
        raise DataFileError(f"{path} cannot be read for the log: {fault.strerror}") from fault
