"""The recorder's process: joins a run and records it until stopped."""

import contextlib
import sys
from collections.abc import Set as AbstractSet
from pathlib import Path

from lowfc.adapters.bus.run import MODE, Run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.files.whole_file import write_whole
from lowfc.adapters.logs.series import LogLimits
from lowfc.adapters.logs.writer import Attachment
from lowfc.adapters.process.join import clock_of, fifo_priority
from lowfc.adapters.process.provenance import provenance
from lowfc.adapters.process.realtime import set_up_below_loop
from lowfc.contract.codecs import input_file
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import DataFileError, raised_as
from lowfc.contract.events import Level
from lowfc.contract.messages import Role, wire
from lowfc.programs.core.recording.alarm import Alarm
from lowfc.programs.core.recording.recorder import Recorder
from lowfc.programs.core.recording.summary import Summary
from lowfc.programs.core.recording.volume import bytes_per_s, check_folder, configured_selection, estimate

_MAX_ATTACHMENT_BYTES = 1 << 28


def record(run: Run, config: Configuration, calibration: Path | None, shared: bytes | None = None) -> Summary:
    """Record a run until SIGTERM or SIGINT; the configuration and the calibration (FITS) are attached to each log.

    `shared` (TOML) is written to the run's directory, for other processes, once the recorder has joined.

    Raises:
        BusError: another recorder is recording this run.
        ConfigurationError: an entry of recorder.topics matches no topic.
        DataFileError: a file cannot be read, or no log can be written in the folder.
    """
    recorder_section, realtime = config.recorder, config.realtime
    limits, selection = log_limits(config), configured_selection(config)
    check_folder(config)

    def announced_bytes_per_s(camera: wire.CameraState | None) -> float:
        sys.stderr.write(f"{estimate(config, camera)}\n")
        return bytes_per_s(config, selection, camera)

    # All values, including the defaults of keys that the user's file omits.
    attachments = [Attachment("config.toml", "application/toml", config.to_toml().encode())]
    if calibration is not None:
        with raised_as(DataFileError, OSError, f"{calibration} cannot be read for the log"):
            content = input_file.read_whole(calibration, _MAX_ATTACHMENT_BYTES)
        attachments.append(Attachment(calibration.name, "application/fits", content))
    granted = set_up_below_loop(
        (fifo_priority(config) and realtime.recorder_priority) or None, set(realtime.recorder_cpus) or None
    )
    clock = clock_of(config)
    origin = {**provenance(run.run_id, config.seed), "clock_ahead_ms": f"{clock.ahead_ns() / 1e6:.3f}"}
    with contextlib.closing(ZenohBus(run.links, Role.RECORDER, clock)) as bus, contextlib.ExitStack() as cleanup:
        recorder = Recorder(
            bus,
            clock,
            run.run_id,
            input_file.user_path(recorder_section.folder),
            metadata={"lowfc": origin},
            attachments=attachments,
            limits=limits,
            granted=granted,
            selection=selection,
            expected_bytes_per_s=announced_bytes_per_s,
            awaited=_launched_processes(run),
        )
        if shared is not None:
            write_whole(run.path / "config.toml", shared, mode=MODE)
        recorder.catch_signals()
        recorder.service.announces = True
        if recorder_section.on_event:
            level = Level[recorder_section.on_event_level.upper()]
            alarm = Alarm(recorder.service, recorder_section.on_event, level, recorder_section.on_event_every_s)
            cleanup.callback(alarm.close)
        return recorder.run()


def log_limits(config: Configuration) -> LogLimits:
    """Size and duration of a log file, free disk space to leave, and file mode."""
    log = config.recorder
    return LogLimits(round(log.largest_mb * 1e6), log.longest_s, round(log.min_free_mb * 1e6), int(log.file_mode, 8))


def _launched_processes(run: Run) -> AbstractSet[str]:
    """The processes that a launcher starts besides the recorder; the launcher itself sends no Health."""
    ports = run.links.ports.keys()
    return ports - {Role.LAUNCHER, Role.RECORDER} if Role.LAUNCHER in ports else frozenset()
