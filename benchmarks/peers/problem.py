"""The problem that every contestant solves, of the same numbers for all; needs numpy only."""

import numpy as np
import numpy.typing as npt

Single = npt.NDArray[np.float32]

SHAPE = (80, 80)
MODES = 20
ACTUATORS = 144
GRID = (12, 12)
GAIN, LEAK, LIMIT_NM = 0.3, 0.01, 100.0
DIFFERENT = 16  # frames, sent in turn

_DARK_DN, _PEAK_DN = 100.0, 400.0
_ERROR_NM = 2.0


class Problem:
    """Frames, and the matrices that make actuators of them.

    Attributes:
        frames: (DIFFERENT, 80, 80) uint16, DN.
        I0: (6400,) float32, DN, dark included.
        R: (20, 6400) float32, nm per DN, scaled so that the noise of a frame is some nm in every mode.
        to_actuators: (144, 20) float32, nm of surface per nm of wavefront.
    """

    def __init__(self, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        pixels = SHAPE[0] * SHAPE[1]
        image = _DARK_DN + _PEAK_DN * rng.random(pixels)
        self.frames = rng.poisson(image, (DIFFERENT, pixels)).astype(np.uint16).reshape(DIFFERENT, *SHAPE)
        self.I0: Single = image.astype(np.float32)
        R = rng.standard_normal((MODES, pixels))
        self.R: Single = (R * _ERROR_NM / np.sqrt((R**2) @ image)[:, None]).astype(np.float32)
        self.to_actuators: Single = (rng.standard_normal((ACTUATORS, MODES)) / MODES).astype(np.float32)


class NumpyStep:
    """Bytes of pixels to bytes of actuators, as one would write it in numpy, into arrays that stay.

    y = R (I - I0); command = (1 - leak) command - gain y, cut to the limit; actuators of the command.
    """

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._difference = np.empty(SHAPE[0] * SHAPE[1], np.float32)
        self._error = np.empty(MODES, np.float32)
        self._command = np.zeros(MODES, np.float32)
        self._actuators = np.empty(ACTUATORS, np.float32)

    @staticmethod
    def payload(pixels: npt.NDArray[np.uint16], _time_ns: int) -> bytes:
        """A frame as it is sent."""
        return pixels.tobytes()

    def command(self, payload: bytes, _sequence: int, _age_ns: int) -> bytes:
        """The answer to a frame."""
        problem, command = self._problem, self._command
        np.subtract(np.frombuffer(payload, np.uint16), problem.I0, out=self._difference)
        np.matmul(problem.R, self._difference, out=self._error)
        command *= np.float32(1 - LEAK)
        self._error *= np.float32(GAIN)
        command -= self._error
        np.clip(command, -LIMIT_NM, LIMIT_NM, out=command)
        np.matmul(problem.to_actuators, command, out=self._actuators)
        return self._actuators.tobytes()
