"""lowfc's own control step, from the bytes of a frame to the bytes of a command, on the problem of all contestants."""

import numpy as np
import numpy.typing as npt

from benchmarks.peers.problem import GAIN, GRID, LEAK, LIMIT_NM, MODES, SHAPE, Problem
from lowfc.contract import codec
from lowfc.contract.messages import image
from lowfc.control.calibration import Calibration
from lowfc.control.inputs import Load, Outputs
from lowfc.control.loop import advance
from lowfc.control.safety import Limits, LoopMode
from lowfc.control.state import Settings, State

_VALID_NS = 50_000_000


class LowfcStep:
    """Decode, checks, estimate, law, limits, encode: all that lies between a frame and its command."""

    def __init__(self, problem: Problem) -> None:
        self._settings = _settings()
        self._state, _ = advance(self._settings, State(), Load(0, _calibration(problem), "made for the benchmark"))

    @staticmethod
    def payload(pixels: npt.NDArray[np.uint16], time_ns: int) -> bytes:
        """A frame as it is sent."""
        return image(pixels, time_ns, "sensor").SerializeToString()

    def command(self, payload: bytes, sequence: int, age_ns: int) -> bytes:
        """The answer to a frame.

        Raises:
            ValueError: the frame was refused: then this is not the step that shall be measured.
        """
        self._state, outputs = self._advanced(payload, sequence, age_ns)
        if outputs.command is None or outputs.step is None or outputs.step.reasons:
            raise ValueError(f"frame {sequence} was not used as it came: {outputs.step}")
        return codec.encode_command(outputs.command, _VALID_NS, "lowfc", self._state.taken)

    def rehearse(self, payload: bytes) -> None:
        """The answer to a frame, for nothing."""
        state, outputs = self._advanced(payload, self._state.frame_sequence + 1, 0)
        if outputs.command is not None:
            codec.encode_command(outputs.command, _VALID_NS, "lowfc", state.taken)

    def _advanced(self, payload: bytes, sequence: int, age_ns: int) -> tuple[State, Outputs]:
        return advance(self._settings, self._state, codec.decode_frame(payload, sequence, age_ns))


def _settings() -> Settings:
    return Settings(
        limits=Limits(stroke_nm=1e4, slew_nm=1e4, neighbour_nm=1e4),  # looked at for every frame, never in the way
        delay_frames=2.0,
        start_mode=LoopMode.CLOSED,
        late_ns=10**12,
        hold_ns=10**12,
        silence="hold",
        least_flux=0.1,
        most_saturated=0,
        gain=(GAIN, GAIN),
        leak=(LEAK, LEAK),
        limit_nm=(LIMIT_NM, LIMIT_NM),
    )


def _calibration(problem: Problem) -> Calibration:
    flux_dn = float(problem.I0.sum())
    pixels = problem.I0.size
    R = problem.R * np.float32(flux_dn)
    return Calibration(
        noll=tuple(range(2, 2 + MODES)),
        reference=problem.I0 / np.float32(flux_dn),
        response=np.linalg.pinv(R.astype(np.float64)).astype(np.float32),
        reconstructor=R,
        good=np.ones(pixels, np.float32),
        dark=np.zeros(pixels, np.float32),
        modes_to_actuators=problem.to_actuators,
        shape=SHAPE,
        grid=GRID,
        flux_dn=flux_dn,
        saturation_dn=65535.0,
        estimator="pinv",
        wavelength_nm=550.0,
        operator_hash="",
        id="benchmark",
    )
