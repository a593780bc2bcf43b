"""Input of the checks of `lowfc doctor`."""

from collections.abc import Iterable
from dataclasses import dataclass

from lowfc.adapters.process.host import Host
from lowfc.adapters.process.trial import Trial, try_out
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import COMMAND, FRAME, MIRROR_STATE
from lowfc.programs.core.recording.volume import payload_bytes


@dataclass(frozen=True, slots=True)
class Facts:
    """Input of the checks.

    Attributes:
        host: the host, as reported by its kernel.
        config: configuration of the loop.
        trial: refused real-time settings and wake-up latencies, or the error if the trial failed.
        busy: name, and load in processors, of other busy processes during the measurement, from `Host.busy`.
    """

    host: Host
    config: Configuration
    trial: Trial | OSError
    busy: tuple[tuple[str, float], ...]

    @property
    def completed_trial(self) -> Trial:
        """Refused real-time settings and wake-up latencies; OSError if the trial failed."""
        if isinstance(self.trial, OSError):
            raise self.trial
        return self.trial

    @property
    def bytes_per_s(self) -> float:
        """Traffic of frames, commands and mirror states, bytes per second; other messages are small."""
        sizes = payload_bytes(self.config)
        return (sizes[FRAME] + sizes[COMMAND] + sizes[MIRROR_STATE]) * self.config.camera.rate_hz


def gather(host: Host, config: Configuration, seconds: float) -> Facts:
    """Try the loop's real-time settings, measure wake-up latencies in each scheduling class, list busy processes."""
    host.busy()  # the next call reports the load since this one
    trial: Trial | OSError
    try:
        trial = try_out(config.realtime, named_cpus(config), seconds)
    except OSError as fault:
        trial = fault
    return Facts(host, config, trial, tuple(host.busy()))


def named_cpus(config: Configuration) -> set[int]:
    """Processors that a configuration names for camera, controller, mirror and recorder."""
    section = config.realtime
    return {*section.camera_cpus, *section.controller_cpus, *section.mirror_cpus, *section.recorder_cpus}


def ranges(cpus: Iterable[int]) -> str:
    """Processors as the kernel writes them, such as 0-3,8."""
    runs: list[list[int]] = []
    for cpu in sorted(cpus):
        if runs and runs[-1][-1] == cpu - 1:
            runs[-1].append(cpu)
        else:
            runs.append([cpu])
    return ",".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)
