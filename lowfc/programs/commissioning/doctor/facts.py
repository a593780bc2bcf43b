"""What the checks of `lowfc doctor` look at."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

from lowfc.adapters.process.host import Host
from lowfc.adapters.process.trial import Trial, try_out
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import COMMAND, FRAME, MIRROR_STATE
from lowfc.programs.core.recording.volume import payload_bytes


@dataclass(frozen=True, slots=True)
class Facts:
    """What the checks look at.

    Attributes:
        host: the kernel's account of it.
        config: of the loop that is to run.
        trial: what was granted and measured; why not, where it could not be tried.
        busy: other processes while that was measured, as `Host.busy`.
    """

    host: Host
    config: Configuration
    trial: Trial | OSError
    busy: tuple[tuple[str, float], ...]

    @property
    def tried(self) -> Trial:
        """What was granted and measured; OSError where it could not be tried."""
        if isinstance(self.trial, OSError):
            raise self.trial
        return self.trial

    @property
    def named_cpus(self) -> set[int]:
        """Processors that the configuration names for camera, controller, mirror and recorder."""
        section = self.config.realtime
        return {*section.camera_cpus, *section.controller_cpus, *section.mirror_cpus, *section.recorder_cpus}

    @property
    def bytes_per_s(self) -> float:
        """Of frames, commands and the mirror's states; all else that is sent for a frame is small."""
        sizes = payload_bytes(self.config)
        return (sizes[FRAME] + sizes[COMMAND] + sizes[MIRROR_STATE]) * self.config.camera.rate_hz


def gather(host: Host, config: Configuration, seconds: float) -> Facts:
    """Try what the loop asks for and measure wake-ups for so long in each class; note who else is busy meanwhile."""
    facts = Facts(host, config, OSError("not tried"), ())
    host.busy()
    trial: Trial | OSError
    try:
        trial = try_out(config.realtime, facts.named_cpus, seconds)
    except OSError as fault:
        trial = fault
    return replace(facts, trial=trial, busy=tuple(host.busy()))


def ranges(cpus: Iterable[int]) -> str:
    """Processors as the kernel writes them, such as 0-3,8."""
    runs: list[list[int]] = []
    for cpu in sorted(cpus):
        if runs and runs[-1][-1] == cpu - 1:
            runs[-1].append(cpu)
        else:
            runs.append([cpu])
    return ",".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)
