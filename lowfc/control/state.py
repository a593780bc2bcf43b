"""What the controller knows: settings that stay, the state that changes."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.control.calibration import Calibration
from lowfc.control.estimator import Estimator
from lowfc.control.law import Law
from lowfc.control.safety import Limits, LoopMode, Reason
from lowfc.control.stability import delay_weights

Single = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Settings:
    """What does not change during a run.

    Attributes:
        limits: of the mirror, applied here before they are applied again by the mirror.
        delay_frames: frames from the one a command is made from to the first exposed wholly under it.
        start_mode: mode once a calibration is loaded: open or closed.
        late_ns: age above which a frame is refused.
        hold_ns: silence after which it is an event, and `silence` is done.
        silence: hold the command, or relax the mirror to flat.
        least_flux: fraction of the expected flux below which a frame is dark.
        most_saturated: good pixels at full well above which a frame is refused.
        gain: gain, leak and limit (nm) of tip and tilt, then of the other modes.
    """

    limits: Limits
    delay_frames: float
    start_mode: LoopMode
    late_ns: int
    hold_ns: int
    silence: str
    least_flux: float
    most_saturated: int
    gain: tuple[float, float]
    leak: tuple[float, float]
    limit_nm: tuple[float, float]

    def law(self, noll: tuple[int, ...]) -> Law:
        """The law for these modes: the first figure of each pair for tip and tilt, the second for the rest."""

        def per_mode(pair: tuple[float, float]) -> Single:
            return np.array([pair[0] if index in (2, 3) else pair[1] for index in noll], dtype=np.float32)

        return Law(per_mode(self.gain), per_mode(self.leak), per_mode(self.limit_nm))


class Drive(NamedTuple):
    """What there is once a calibration is loaded.

    Attributes:
        to_actuators: (actuators, modes) as in the calibration, laid out for the quicker product.
        inverse: (modes, actuators) modal command of a mirror shape.
        weights: which commands of the history are seen in an exposure, and how much of each.
        history_nm: modal commands, newest first.
        actuators_nm: (rows, columns), the last command.
    """

    calibration: Calibration
    estimator: Estimator
    law: Law
    to_actuators: Single
    inverse: Single
    weights: tuple[tuple[int, np.float32], ...]
    history_nm: tuple[Single, ...]
    actuators_nm: Single

    @classmethod
    def at_rest(cls, settings: Settings, calibration: Calibration) -> "Drive":
        """A drive with nothing commanded yet, under the law that the settings begin with."""
        modes = len(calibration.noll)
        weights = delay_weights(settings.delay_frames).astype(np.float32)
        return cls(
            calibration,
            Estimator.of(calibration),
            settings.law(calibration.noll),
            np.asfortranarray(calibration.modes_to_actuators),
            np.linalg.pinv(calibration.modes_to_actuators.astype(np.float64)).astype(np.float32),
            tuple((lag, weight) for lag, weight in enumerate(weights) if weight),
            (np.zeros(modes, np.float32),) * len(weights),
            np.zeros(calibration.grid, np.float32),
        )

    def seen_nm(self) -> Single:
        """The modal command (modes,) that the last exposure saw."""
        (lag, weight), *others = self.weights
        seen: Single = self.history_nm[lag] if weight == 1 else weight * self.history_nm[lag]
        for lag, weight in others:
            seen = seen + weight * self.history_nm[lag]
        return seen

    def pushed(self, command_nm: Single, actuators_nm: Single) -> "Drive":
        """One frame later, under this command."""
        fixed = self[:-2]  # `_replace` takes four times as long
        return Drive(*fixed, (command_nm, *self.history_nm[:-1]), actuators_nm)

    def stayed(self, frames: int) -> "Drive":
        """Some frames later, the command held under each of them."""
        held = min(frames, len(self.history_nm))
        return self._replace(history_nm=(self.history_nm[:1] * held + self.history_nm)[: len(self.history_nm)])


class State(NamedTuple):
    """Everything the next command depends on.

    Attributes:
        frame_sequence: of the newest frame taken; its time is `frame_time_ns`.
        refused: why the last frame was refused, if it was, and how many in a row.
        limits_hit: limits that acted on the last command.
        silent: whether the silence has been announced.
        commanded: whether a command has been sent, so that the mirror is no longer adopted.
        taken: inputs that changed something or gave rise to something; the order of what is replayed.
    """

    mode: LoopMode = LoopMode.IDLE
    drive: Drive | None = None
    frame_sequence: int = 0
    frame_time_ns: int = 0
    frames_used: int = 0
    refused: Reason | None = None
    refused_count: int = 0
    limits_hit: tuple[Reason, ...] = ()
    silent: bool = False
    commanded: bool = False
    counts: Mapping[Reason, int] = MappingProxyType({})
    taken: int = 0
