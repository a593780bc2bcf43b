"""What the checks of `lowfc doctor` go by, and what each of them finds."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from lowfc.adapters.host import Host
from lowfc.adapters.trial import Trial
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import COMMAND, FRAME, MIRROR_STATE
from lowfc.programs.recording.volume import payload_bytes


class Status(StrEnum):
    """How a check ended."""

    OK = "ok"
    WARNING = "warning"
    NOTE = "note"


class Finding(NamedTuple):
    """What a check found.

    Attributes:
        status: a warning is something that costs; a note is worth knowing, or could not be read.
        detail: what was found.
        advice: what to do about it; empty where there is nothing to do.
        cost: what it costs otherwise.
    """

    status: Status
    detail: str
    advice: str = ""
    cost: str = ""


@dataclass(frozen=True, slots=True)
class Facts:
    """What the checks go by.

    Attributes:
        host: the kernel's files.
        config: of the loop that is to run.
        trial: what was granted and measured; why not, where it could not be tried.
        busy: other processes while that was measured, the busiest first: name with number, and share of one
            processor.
    """

    host: Host
    config: Configuration
    trial: Trial | OSError
    busy: tuple[tuple[str, float], ...]

    @property
    def tried(self) -> Trial:
        """What was granted and measured.

        Raises:
            OSError: it could not be tried.
        """
        if isinstance(self.trial, OSError):
            raise self.trial
        return self.trial

    @property
    def asked_cpus(self) -> set[int]:
        """Processors that the configuration names."""
        return named_cpus(self.config)

    @property
    def bytes_per_frame(self) -> int:
        """Of a frame, its command and the mirror's state; all else that is sent for a frame is small."""
        sizes = payload_bytes(self.config)
        return sizes[FRAME] + sizes[COMMAND] + sizes[MIRROR_STATE]

    @property
    def bytes_per_s(self) -> float:
        """Of the loop's traffic."""
        return self.bytes_per_frame * self.config.camera.rate_hz


def named_cpus(config: Configuration) -> set[int]:
    """Processors that a configuration names for camera, controller, mirror and recorder."""
    realtime = config.realtime
    return {*realtime.camera_cpus, *realtime.controller_cpus, *realtime.mirror_cpus, *realtime.recorder_cpus}


def ok(detail: str) -> Finding:
    """As it should be."""
    return Finding(Status.OK, detail)


def warning(detail: str, advice: str, cost: str) -> Finding:
    """Something that costs."""
    return Finding(Status.WARNING, detail, advice, cost)


def note(detail: str, advice: str = "", cost: str = "") -> Finding:
    """Something worth knowing."""
    return Finding(Status.NOTE, detail, advice, cost)


def ranges(cpus: Iterable[int]) -> str:
    """Processors as the kernel writes them, such as 0-3,8."""
    runs: list[list[int]] = []
    for cpu in sorted(cpus):
        if runs and runs[-1][-1] == cpu - 1:
            runs[-1].append(cpu)
        else:
            runs.append([cpu])
    return ",".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)
