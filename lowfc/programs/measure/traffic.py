"""The messages of a loop without the loop: one process sends those of camera, controller and mirror, at any rate."""

import time
from typing import Any

import numpy as np

from lowfc.adapters.bus.bus import Publisher
from lowfc.adapters.bus.run import Run, mirror_role
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.service import Service
from lowfc.contract.messages import (
    COMMAND,
    FRAME,
    MIRROR_STATE,
    STEP,
    TIMING,
    TRUTH,
    Message,
    Role,
    image,
    timestamp,
    wire,
)

_MODES = 14
_GRID = (34, 34)  # rows and columns of actuators
_FRAME_SHAPE = (80, 80)
_MIRROR = "dm"
_TIME_NS = 1_767_225_600_000_000_000  # time stamp of every message: 2026-01-01 UTC

_VARIETY = 32  # number of different frames: a payload repeats only beyond the window of the log's compression
_TIMING_HZ = 10.0  # messages of stage durations per second
_BEAT_FRAMES = 50  # frames from one call of `beat` to the next
_WAIT_S = 0.05  # time for which each role in turn waits for a process


class Traffic:
    """Sends the messages of camera, controller and mirror, frame after frame."""

    def __init__(self, run: Run, rate_hz: float) -> None:
        """Join `run` as camera, controller and mirror of a loop of `rate_hz`."""
        self.frames = 0
        self._clock = HostClock()
        self._period_ns = round(1e9 / rate_hz)
        self._services = [
            Service(role, run.run_id, self._clock, ZenohBus(run.links, role, self._clock))
            for role in (Role.CAMERA, Role.CONTROLLER, mirror_role(_MIRROR))
        ]
        camera, controller, mirror = self._services
        publishers = (
            camera.publisher(FRAME),
            controller.publisher(COMMAND, _MIRROR),
            controller.publisher(STEP),
            mirror.publisher(MIRROR_STATE, _MIRROR),
            camera.publisher(TRUTH),
        )
        self._by_frame: list[list[tuple[Publisher, bytes]]] = [
            list(zip(publishers, payloads, strict=True)) for payloads in frame_payloads()
        ]
        self._timing_publisher = controller.publisher(TIMING)
        self._timing_frames = max(1, round(rate_hz / _TIMING_HZ))
        self._timing = _timing(self._timing_frames)
        for service in self._services:
            service.state = "ready"

    @property
    def messages(self) -> int:
        """Messages sent so far, including Health and events."""
        return sum(publisher.published for service in self._services for publisher in service.publishers)

    def wait_for(self, name: str, timeout_s: float) -> bool:
        """Wait until a process is ready and has received Health from all three roles; False after the timeout."""
        deadline_s = time.monotonic() + timeout_s
        while sum(len(service.wait_for([name], _WAIT_S)) for service in self._services):
            if time.monotonic() >= deadline_s:
                return False
        return True

    def run(self, seconds: float) -> None:
        """Send messages at the loop's rate for `seconds`; overdue messages are sent at once: none is left out."""
        due_ns = begun_ns = self._clock.host_ns()
        while due_ns - begun_ns < seconds * 1e9:
            self._clock.sleep_until_ns(due_ns)
            self._send()
            due_ns += self._period_ns

    def finish(self) -> None:
        """Send the last Health of each role, with its counts; nothing may be sent afterwards."""
        for service in self._services:
            service.finish()

    def close(self) -> None:
        """Leave the bus."""
        for service in self._services:
            service.bus.close()

    def _send(self) -> None:
        for publisher, payload in self._by_frame[self.frames % _VARIETY]:
            publisher.put(payload)
        self.frames += 1
        if self.frames % self._timing_frames == 0:
            self._timing_publisher.put(self._timing)
        if self.frames % _BEAT_FRAMES == 0:
            for service in self._services:
                service.beat()


def frame_payloads() -> list[list[bytes]]:
    """Payloads of different frames: frame, command, step, mirror state and truth, of nearly the sizes in a loop."""
    rng = np.random.default_rng(1)
    return [[message.SerializeToString() for message in _messages(rng)] for _ in range(_VARIETY)]


def _messages(rng: np.random.Generator) -> tuple[Message, ...]:
    sequence = _TIME_NS // 1_000_000_000 << 32
    pixels = (100 + rng.poisson(rng.gamma(2.0, 30.0, _FRAME_SHAPE))).astype(np.uint16)
    error, pol, command, disturbance = (rng.normal(0.0, 5.0, _MODES).tolist() for _ in range(4))
    actuators = rng.normal(0.0, 20.0, _GRID).astype(np.float32).tobytes()
    frame_fields: dict[str, Any] = {"timestamp": timestamp(_TIME_NS), "frame_sequence": sequence}
    shape: dict[str, Any] = {"rows": _GRID[0], "columns": _GRID[1], "actuators": actuators, "command_nm": command}
    modes: dict[str, Any] = {"error_nm": error, "pol_nm": pol, "command_nm": command}
    rms: dict[str, Any] = {"disturbance_rms_nm": 20.0, "residual_rms_nm": 2.0}
    return (
        image(pixels, _TIME_NS, "sensor"),
        wire.MirrorCommand(channel="loop", valid_for_ns=200_000_000, **frame_fields, **shape),
        wire.ControlStep(mode=wire.LOOP_MODE_CLOSED, flux_dn=float(pixels.sum()), **frame_fields, **modes),
        wire.MirrorState(status=wire.MIRROR_STATUS_FOLLOWING, channels=["loop"], **frame_fields, **shape),
        wire.Truth(disturbance_nm=disturbance, residual_nm=error, **frame_fields, **rms),
    )


def _timing(frames: int) -> bytes:
    rng = np.random.default_rng(2)
    stages = ("transport_ns", "wakeup_ns", "compute_ns", "publish_ns", "frame_to_command_ns")
    durations: dict[str, Any] = {stage: rng.integers(50_000, 400_000, frames).tolist() for stage in stages}
    sequences = [(_TIME_NS // 1_000_000_000 << 32) + number for number in range(frames)]
    return wire.ControlTiming(timestamp=timestamp(_TIME_NS), frame_sequence=sequences, **durations).SerializeToString()
