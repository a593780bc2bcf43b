"""The same loop in pyrtcao, each component a process: python -m benchmarks.peers.pyrtcao_loop ROLE FOLDER.

A component of one's own between its `WavefrontSensor` and its `WavefrontCorrector` does the whole step in one compiled
function, which is the best that pyrtcao can do. It runs in an interpreter that has pyrtcao, and needs nothing of
lowfc's. Where pyrtcao may, it sets nice -20 in the normal class by itself.
"""

import os
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from numba import jit
from pyrtc.component import Component
from pyrtc.streams import clear_shms, open_stream
from pyrtc.utils import set_affinity_and_priority
from pyrtc.wavefront_corrector import WavefrontCorrector
from pyrtc.wavefront_sensor import WavefrontSensor

from benchmarks.peers.shared import ACTUATORS, DIFFERENT, GAIN, LEAK, LIMIT_NM, MODES, SHAPE, Part, Problem

Array = npt.NDArray[np.float32]

_STREAMS = ("wfs_raw", "wfs", "wfc")
_PIXELS = SHAPE[0] * SHAPE[1]


class Sensor(WavefrontSensor):
    """Exposes the frames when they are due."""

    part: Part

    def run(self) -> None:
        """All frames of a run; ends the process."""
        frames, published = Problem().frames, self.part.marks("published")
        for number in self.part.frames():
            self.data = frames[number % DIFFERENT]
            published[number] = time.monotonic_ns()
            self.expose()  # it numbers them from 1, too
        clear(self.part)
        os._exit(0)


class FusedLoop(Component):
    """Everything between frame and actuators."""

    commanded: memoryview

    def __init__(self, conf: dict[str, Any]) -> None:
        super().__init__(conf)
        problem = Problem()
        self._arrays = (problem.I0, problem.R, problem.to_actuators)
        self._image = np.empty(SHAPE, np.int32)
        self._difference = np.empty(_PIXELS, np.float32)
        self._command = np.zeros(MODES, np.float32)
        self.register_input_stream("wfs", open_stream(self.input_stream_name("wfs")))
        self.register_output_stream("wfc", open_stream(self.output_stream_name("wfc")))
        _fused(np.zeros(_PIXELS, np.int32), *self._arrays, self._difference, self._command.copy())  # compiled here

    def step(self) -> None:
        """One frame."""
        image = self.read_stream("wfs", out=self._image).reshape(-1)
        self.write_stream("wfc", _fused(image, *self._arrays, self._difference, self._command))
        self.commanded[self.frame_id] = time.monotonic_ns()


@jit(nopython=True, nogil=True, fastmath=True)
def _fused(
    image: npt.NDArray[np.int32], I0: Array, R: Array, to_actuators: Array, difference: Array, command: Array
) -> Array:
    for pixel in range(difference.size):
        difference[pixel] = np.float32(image[pixel]) - I0[pixel]
    error = np.dot(R, difference)
    for mode in range(command.size):
        wanted = np.float32(1 - LEAK) * command[mode] - np.float32(GAIN) * error[mode]
        command[mode] = min(max(wanted, np.float32(-LIMIT_NM)), np.float32(LIMIT_NM))
    actuators: Array = np.dot(to_actuators, command)
    return actuators


class Corrector(WavefrontCorrector):
    """Its own corrector without hardware, with the moment noted when the actuators are there."""

    received: memoryview

    def send_to_hardware(self) -> None:
        """Its own, then the time."""
        super().send_to_hardware()
        self.received[self.frame_id] = time.monotonic_ns()


def clear(part: Part) -> None:
    """Remove what a run has in shared memory."""
    clear_shms([_name(part, stream) for stream in _STREAMS])


def _name(part: Part, stream: str) -> str:
    return f"{part.folder.name}_{stream}"


def _configuration(part: Part, function: str) -> dict[str, Any]:
    streams = {stream: _name(part, stream) for stream in _STREAMS}
    return {
        "affinity": part.cpu,
        "realtime_priority": part.priority,
        "functions": [function],
        "input_streams": streams,
        "output_streams": streams,
    }


def _source(part: Part) -> Component:
    sensor = Sensor(_configuration(part, "run") | {"name": "wfs", "width": SHAPE[1], "height": SHAPE[0]})
    sensor.part = part
    return sensor


def _mirror(part: Part) -> Component:
    matrix = part.folder / "m2c.npy"
    np.save(matrix, np.eye(ACTUATORS, dtype=np.float32))  # a command's actuators are made already
    of_its_own = {"name": "wfc", "num_actuators": ACTUATORS, "num_modes": ACTUATORS, "m2c_file": str(matrix)}
    corrector = Corrector(_configuration(part, "send_to_hardware") | of_its_own)
    corrector.received = part.marks("received")
    return corrector


def _controller(part: Part) -> Component:
    loop = FusedLoop(_configuration(part, "step"))
    loop.commanded = part.marks("commanded")
    return loop


_ROLES = {"source": _source, "mirror": _mirror, "controller": _controller}


if __name__ == "__main__":
    role, folder = sys.argv[1:]
    own = Part(role, Path(folder))
    if role == "clear":  # after a run that failed
        clear(own)
        sys.exit()
    set_affinity_and_priority(role, own.cpu, own.priority)  # as its launcher does
    own.quiet()
    component = _ROLES[role](own)
    component.start()
    if role != "source":  # which is ready when it is about to wait for the start
        own.ready()
    threading.Event().wait()
