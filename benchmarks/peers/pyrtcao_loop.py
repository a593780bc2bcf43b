"""The compared loop in pyrtcao: each component is a process with the arguments listed in `benchmarks.peers.shared`.

Stock arrangement: a `WavefrontSensor`, a custom component that computes the signal from the pixels,
`Loop.leaky_integrator`, and a `WavefrontCorrector`, which converts modes to actuators. Fused arrangement: one custom
component between sensor and corrector computes the whole step in one compiled function, as fast as pyrtcao permits.

This module runs in an interpreter with pyrtcao, and imports nothing of lowfc. Under normal scheduling pyrtcao itself
sets nice -20, if permitted.
"""

import os
import sys
import threading
import time
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import jit
from pyrtc.component import Component
from pyrtc.loop import Loop
from pyrtc.streams import clear_shms, create_stream, open_stream
from pyrtc.utils import set_affinity_and_priority
from pyrtc.wavefront_corrector import WavefrontCorrector
from pyrtc.wavefront_sensor import WavefrontSensor

from benchmarks.peers.shared import ACTUATORS, GAIN, LEAK, LIMIT_NM, MODES, PIXELS, SIDE, RoleProcess, RunData

Array = npt.NDArray[np.float32]

_STREAMS = ("wfs_raw", "wfs", "signal", "wfc")


class Sensor(WavefrontSensor):
    """Publishes the frames at their scheduled times."""

    role_process: RoleProcess

    def run(self) -> None:
        """Publish all frames of a run, then end the process."""
        run_data, published = RunData(self.role_process.folder), self.role_process.time_stamps("published")
        for number in self.role_process.frame_numbers():
            self.data = run_data.frame(number)
            published[number] = time.monotonic_ns()
            self.expose()  # pyrtcao numbers frames from 1, too
        clear(self.role_process)
        os._exit(0)


class PixelSignal(Component):
    """Component that computes the signal: pixels minus reference image."""

    def __init__(self, conf: dict[str, Any], run_data: RunData) -> None:
        super().__init__(conf)
        self._reference = run_data.I0.reshape(SIDE, SIDE)
        self._image = np.empty((SIDE, SIDE), np.int32)
        self._signal = np.empty((SIDE, SIDE), np.float32)
        self.register_input_stream("wfs", open_stream(self.input_stream_name("wfs")))
        self.read_stream("wfs", out=self._image)  # the stream's initial content
        self.register_output_stream("signal", create_stream(self.output_stream_name("signal"), (PIXELS,), np.float32))

    def compute_signal(self) -> None:
        """Read a frame and publish its signal."""
        image = self.read_stream("wfs", out=self._image)
        np.subtract(image, self._reference, out=self._signal, dtype=np.float32, casting="unsafe")
        self.write_stream("signal", self._signal.reshape(-1))


class StockLoop(Loop):
    """pyrtcao's loop, which also records the time at which each command was sent."""

    commanded: memoryview

    def send_to_wfc(self, correction: Array, slopes: Array | None = None) -> None:
        """Send the command, then record the time."""
        super().send_to_wfc(correction, slopes=slopes)
        self.commanded[self.frame_id] = time.monotonic_ns()


class FusedLoop(Component):
    """Component that computes the whole step from frame to actuator values."""

    def __init__(self, conf: dict[str, Any], run_data: RunData, commanded: memoryview) -> None:
        super().__init__(conf)
        self._arrays = (run_data.I0, run_data.R, run_data.to_actuators)
        self._image = np.empty((SIDE, SIDE), np.int32)
        self._difference = np.empty(PIXELS, np.float32)
        self._command = np.zeros(MODES, np.float32)
        self._commanded = commanded
        self.register_input_stream("wfs", open_stream(self.input_stream_name("wfs")))
        self.read_stream("wfs", out=self._image)  # the stream's initial content
        self.register_output_stream("wfc", open_stream(self.output_stream_name("wfc")))
        _fused(np.zeros(PIXELS, np.int32), *self._arrays, self._difference, self._command.copy())  # compiled here

    def step(self) -> None:
        """Read a frame and publish its actuator values."""
        image = self.read_stream("wfs", out=self._image).reshape(-1)
        self.write_stream("wfc", _fused(image, *self._arrays, self._difference, self._command))
        self._commanded[self.frame_id] = time.monotonic_ns()


@jit(nopython=True, nogil=True, fastmath=True)
def _fused(
    image: npt.NDArray[np.int32], I0: Array, R: Array, to_actuators: Array, difference: Array, command: Array
) -> Array:
    for pixel in range(difference.size):
        difference[pixel] = np.float32(image[pixel]) - I0[pixel]
    error = np.dot(R, difference)
    for mode in range(command.size):
        unlimited = np.float32(1 - LEAK) * command[mode] - np.float32(GAIN) * error[mode]
        command[mode] = min(max(unlimited, np.float32(-LIMIT_NM)), np.float32(LIMIT_NM))
    actuators: Array = np.dot(to_actuators, command)
    return actuators


class StockMirror(WavefrontCorrector):
    """pyrtcao's corrector without hardware; it records when the actuator values of each command arrived."""

    received: memoryview
    last: Array

    def shape(self) -> Array:
        """Actuator values of the next command, computed from its modes."""
        super().send_to_hardware()
        actuators: Array = self.current_shape
        return actuators

    def send_to_hardware(self) -> None:
        """Record the actuator values of the next command and their time of arrival."""
        actuators = self.shape()
        self.received[self.frame_id] = time.monotonic_ns()
        self.last[:] = actuators


class FusedMirror(StockMirror):
    """A corrector that receives actuator values instead of modes."""

    def shape(self) -> Array:
        """Actuator values of the next command, as received."""
        actuators: Array = self.read_stream("wfc", out=self._wfc_buffer)
        return actuators


def clear(role_process: RoleProcess) -> None:
    """Remove a run's streams from shared memory."""
    clear_shms([_name(role_process, stream) for stream in _STREAMS])


def _name(role_process: RoleProcess, stream: str) -> str:
    return f"{role_process.folder.name}_{stream}"


def _configuration(role_process: RoleProcess, function: str) -> dict[str, Any]:
    streams = {stream: _name(role_process, stream) for stream in _STREAMS}
    return {
        "affinity": role_process.cpu,
        "realtime_priority": role_process.priority,
        "functions": [function],
        "input_streams": streams,
        "output_streams": streams,
    }


def _component(role_process: RoleProcess) -> Component:
    run_data = RunData(role_process.folder)
    if role_process.role == "source":
        sensor = Sensor(_configuration(role_process, "run") | {"name": "wfs", "width": SIDE, "height": SIDE})
        sensor.role_process = role_process
        return sensor
    if role_process.role == "signal":
        return PixelSignal(_configuration(role_process, "compute_signal"), run_data)
    if role_process.role == "fused":
        return FusedLoop(_configuration(role_process, "step"), run_data, role_process.time_stamps("commanded"))
    if role_process.role == "loop":
        loop = StockLoop(_configuration(role_process, "leaky_integrator") | {"leaky_gain": LEAK})
        loop.cm = run_data.R.copy()
        loop.gain = GAIN
        loop.commanded = role_process.time_stamps("commanded")
        return loop
    fused = role_process.role == "mirror"
    matrix = role_process.folder / "m2c.npy"
    np.save(matrix, np.eye(ACTUATORS, dtype=np.float32) if fused else run_data.to_actuators)
    own_options = {"name": "wfc", "num_actuators": ACTUATORS, "m2c_file": str(matrix)}
    own_options["num_modes"] = ACTUATORS if fused else MODES
    corrector = (FusedMirror if fused else StockMirror)(_configuration(role_process, "send_to_hardware") | own_options)
    corrector.received, corrector.last = role_process.time_stamps("received"), role_process.last_actuators()
    return corrector


if __name__ == "__main__":
    own = RoleProcess(sys.argv[1:])
    if own.role == "clear":  # after a failed run
        clear(own)
        sys.exit()
    set_affinity_and_priority(own.role, own.cpu, own.priority)  # as pyrtcao's launcher does
    own.reduce_jitter()
    component = _component(own)
    component.start()
    if own.role != "source":  # the source reports in `frame_numbers` that it is ready
        own.ready()
    threading.Event().wait()
