"""The loop of the comparison in pyrtcao, each component a process with the arguments in `benchmarks.peers.shared`.

Stock: a `WavefrontSensor`, a custom component that computes the signal from the pixels, `Loop.leaky_integrator`, and
a `WavefrontCorrector`, which converts modes to actuators. Fused: one custom component between sensor and corrector
computes the whole step in one compiled function, the fastest arrangement that pyrtcao permits.

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

    part: RoleProcess

    def run(self) -> None:
        """Publish all frames of a run, then end the process."""
        run_data, published = RunData(self.part.folder), self.part.time_stamps("published")
        for number in self.part.frame_numbers():
            self.data = run_data.frame(number)
            published[number] = time.monotonic_ns()
            self.expose()  # pyrtcao numbers frames from 1, too
        clear(self.part)
        os._exit(0)


class PixelSignal(Component):
    """The signal: pixels minus reference image."""

    def __init__(self, conf: dict[str, Any], run_data: RunData) -> None:
        super().__init__(conf)
        self._reference = run_data.I0.reshape(SIDE, SIDE)
        self._image = np.empty((SIDE, SIDE), np.int32)
        self._signal = np.empty((SIDE, SIDE), np.float32)
        self.register_input_stream("wfs", open_stream(self.input_stream_name("wfs")))
        self.read_stream("wfs", out=self._image)  # the stream's initial content
        self.register_output_stream("signal", create_stream(self.output_stream_name("signal"), (PIXELS,), np.float32))

    def compute_signal(self) -> None:
        """Process one frame."""
        image = self.read_stream("wfs", out=self._image)
        np.subtract(image, self._reference, out=self._signal, dtype=np.float32, casting="unsafe")
        self.write_stream("signal", self._signal.reshape(-1))


class StockLoop(Loop):
    """pyrtcao's loop; records when each command was sent."""

    commanded: memoryview

    def send_to_wfc(self, correction: Array, slopes: Array | None = None) -> None:
        """Send the command, then record the time."""
        super().send_to_wfc(correction, slopes=slopes)
        self.commanded[self.frame_id] = time.monotonic_ns()


class FusedLoop(Component):
    """The whole step from frame to actuators."""

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
        """Process one frame."""
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
    """pyrtcao's corrector without hardware; records when the actuators arrived."""

    received: memoryview
    last: Array

    def shape(self) -> Array:
        """Actuators of the next command."""
        super().send_to_hardware()
        actuators: Array = self.current_shape
        return actuators

    def send_to_hardware(self) -> None:
        """Record when the actuators arrived."""
        actuators = self.shape()
        self.received[self.frame_id] = time.monotonic_ns()
        self.last[:] = actuators


class FusedMirror(StockMirror):
    """A corrector that receives actuators."""

    def shape(self) -> Array:
        """Actuators of the next command, as received."""
        actuators: Array = self.read_stream("wfc", out=self._wfc_buffer)
        return actuators


def clear(part: RoleProcess) -> None:
    """Remove a run's streams from shared memory."""
    clear_shms([_name(part, stream) for stream in _STREAMS])


def _name(part: RoleProcess, stream: str) -> str:
    return f"{part.folder.name}_{stream}"


def _configuration(part: RoleProcess, function: str) -> dict[str, Any]:
    streams = {stream: _name(part, stream) for stream in _STREAMS}
    return {
        "affinity": part.cpu,
        "realtime_priority": part.priority,
        "functions": [function],
        "input_streams": streams,
        "output_streams": streams,
    }


def _component(part: RoleProcess) -> Component:
    run_data = RunData(part.folder)
    if part.role == "source":
        sensor = Sensor(_configuration(part, "run") | {"name": "wfs", "width": SIDE, "height": SIDE})
        sensor.part = part
        return sensor
    if part.role == "signal":
        return PixelSignal(_configuration(part, "compute_signal"), run_data)
    if part.role == "fused":
        return FusedLoop(_configuration(part, "step"), run_data, part.time_stamps("commanded"))
    if part.role == "loop":
        loop = StockLoop(_configuration(part, "leaky_integrator") | {"leaky_gain": LEAK})
        loop.cm = run_data.R.copy()
        loop.gain = GAIN
        loop.commanded = part.time_stamps("commanded")
        return loop
    fused = part.role == "mirror"
    matrix = part.folder / "m2c.npy"
    np.save(matrix, np.eye(ACTUATORS, dtype=np.float32) if fused else run_data.to_actuators)
    own_options = {"name": "wfc", "num_actuators": ACTUATORS, "m2c_file": str(matrix)}
    own_options["num_modes"] = ACTUATORS if fused else MODES
    corrector = (FusedMirror if fused else StockMirror)(_configuration(part, "send_to_hardware") | own_options)
    corrector.received, corrector.last = part.time_stamps("received"), part.last_actuators()
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
    if own.role != "source":  # the source reports ready in `frame_numbers`
        own.ready()
    threading.Event().wait()
