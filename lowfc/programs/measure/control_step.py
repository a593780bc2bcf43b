"""References for a loop's latency, measured in one process: the control step without a bus, and the host's timer."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lowfc.adapters.files.factory import settings
from lowfc.adapters.process import compiled
from lowfc.adapters.process.clock import HostClock
from lowfc.arrays import Long
from lowfc.contract.codecs import codec
from lowfc.contract.configuration import Configuration
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Load
from lowfc.control.loop.state import State
from lowfc.programs.core.controller import CHANNEL
from lowfc.programs.measure.frame_source import Payloads


class ControlStep:
    """The controller's arithmetic: a frame's bytes in, a command's bytes out."""

    def __init__(self, config: Configuration, calibration: Calibration, now_ns: int) -> None:
        realtime = config.realtime
        self._settings = replace(settings(config), kernel=compiled.kernel(realtime.kernel, realtime.threads))
        self._valid_ns = round(config.control.command_timeout_ms * 1e6)
        self.state, _ = advance(self._settings, State(), Load(now_ns, calibration, "the run's"))

    def __call__(self, payload: bytes) -> bytes:
        """The command for a frame, which is processed as the next frame, whatever its time."""
        frame = codec.decode_frame(payload, self.state.frame_sequence + 1, 0)
        self.state, outputs = advance(self._settings, self.state, frame)
        assert outputs.command is not None  # noqa: S101  # each of these frames yields a command
        return codec.encode_command(outputs.command, self._valid_ns, CHANNEL, self.state.input_number)


def time_alone(
    step: Callable[[bytes], object], payloads: Payloads, clock: HostClock, seconds: float, period_ns: int | None
) -> tuple[Long, Long]:
    """Time the control step for `seconds`: once per period after a sleep, or back to back if `period_ns` is None.

    Returns the wake-up latencies of the host's timer, ns (empty without a period), and the durations of the step, ns.
    """
    timer_ns: list[int] = []
    step_ns: list[int] = []
    due_ns = clock.host_ns()
    end_ns = due_ns + round(seconds * 1e9)
    while due_ns < end_ns:
        payload = payloads.at(len(step_ns), due_ns)
        if period_ns is not None:
            late_ns = max(0, clock.host_ns() - due_ns)
            due_ns += period_ns * (1 + late_ns // period_ns)  # the next due time that is still in the future
            clock.sleep_until_ns(due_ns)
        begun_ns = clock.host_ns()
        step(payload)
        done_ns = clock.host_ns()
        step_ns.append(done_ns - begun_ns)
        if period_ns is not None:
            timer_ns.append(begun_ns - due_ns)
        else:
            due_ns = done_ns
    return np.array(timer_ns, np.int64), np.array(step_ns, np.int64)
