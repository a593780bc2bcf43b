"""The simulated bench in front of the detector: mirror and disturbance in, frame and truth out."""

from dataclasses import dataclass
from math import sqrt

import numpy as np
import numpy.typing as npt

from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.detector.detector import Detector, expose, laws_of, saturation_dn
from lowfc.optics.twin.twin import Evaluator, Twin, node_radii, wavefront_rms_nm
from lowfc.optics.twin.twin_mirror import TwinMirror, wavefront_nm
from sim_camera.disturbance import BLOCK, Disturbance, modes_nm, screen

Single = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Truth:
    """What no sensor knows: modes (modes,) over the circle and rms over the open pupil, nm of wavefront."""

    disturbance_nm: Single
    residual_nm: Single
    disturbance_rms_nm: float
    residual_rms_nm: float


class Bench:
    """Optics, star, detector and disturbance of one run; it draws noise from a generator of its own."""

    def __init__(
        self,
        optics: Twin,
        mirror: TwinMirror,
        detector: Detector,
        electrons: float,
        shaken: Disturbance,
        rate_hz: float,
        seed: int,
        noise: bool = True,
    ) -> None:
        """Prepare everything that does not change from frame to frame."""
        self._optics = optics
        self._mirror = mirror
        self._evaluator = Evaluator(optics)
        self._detector = detector
        self._electrons = np.float32(electrons)
        self._shaken = shaken
        self._rate_hz = rate_hz
        self._rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([seed, 3])))
        self._noise = noise
        self._area = optics.area_weights.astype(np.float32)
        self._basis = zernikes(shaken.noll, *node_radii(optics)).astype(np.float32)
        self._screen = self._static_screen(seed)
        self._screen_modes = np.asarray(self._project(self._screen), dtype=np.float32)
        self._mirror_to_modes = self._mirror_projection()
        self._block = np.zeros((0, len(shaken.noll)), np.float32)
        self._block_start = 0
        laws_of(detector)  # the first frame has no time for it

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        pixels = len(self._optics.to_pixels)
        return pixels, pixels

    def expose(self, index: int, actuators_nm: Single) -> tuple[npt.NDArray[np.uint16], Truth]:
        """Frame (rows, columns) with the mirror's actuators (rows, columns), and its truth."""
        modes = self._modes(index)
        disturbance_nm: Single = modes @ self._basis
        disturbance_nm += self._screen
        residual_nm = disturbance_nm + wavefront_nm(self._mirror, actuators_nm)
        electrons = self._evaluator.image(residual_nm) * self._electrons
        frame = expose(self._detector, electrons, self._rng) if self._noise else self._noiseless(electrons)
        true_modes = modes + self._screen_modes
        truth = Truth(
            true_modes,
            true_modes + self._mirror_to_modes @ actuators_nm.reshape(-1),
            self._rms_nm(disturbance_nm),
            self._rms_nm(residual_nm),
        )
        return frame, truth

    def _rms_nm(self, opd_nm: Single) -> float:
        """As `wavefront_rms_nm`, in single precision: less than half its time."""
        from_mean = opd_nm - self._area @ opd_nm
        return sqrt(max(float((from_mean * self._area) @ from_mean), 0.0))

    def _modes(self, index: int) -> Single:
        """Disturbance (modes,) of a frame, from a block computed every `BLOCK` frames."""
        offset = index - self._block_start
        if not 0 <= offset < len(self._block):
            self._block_start, offset = index - index % BLOCK, index % BLOCK  # a frame is the same in whatever order
            self._block = modes_nm(self._shaken, self._block_start, BLOCK, self._rate_hz).astype(np.float32)
        row: Single = self._block[offset]
        return row

    def _noiseless(self, electrons: Single) -> npt.NDArray[np.uint16]:
        values = electrons / self._detector.gain_e_per_dn + self._detector.bias_dn
        return np.asarray(np.rint(np.clip(values, 0, saturation_dn(self._detector))), dtype=np.uint16)

    def _static_screen(self, seed: int) -> Single:
        """The preset's screen at the nodes, of the asked rms over the open pupil, piston removed."""
        axis = self._optics.axis
        if not self._shaken.screen_nm:
            return np.zeros(self._optics.used.size, np.float32)
        opd = screen(seed, axis.size, float(axis[1] - axis[0])).reshape(-1)[self._optics.used]
        opd -= self._optics.area_weights @ opd
        return (opd * (self._shaken.screen_nm / wavefront_rms_nm(self._optics, opd))).astype(np.float32)

    def _project(self, opd_nm: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Modes over the circle, least squares with piston, of wavefronts (used,) or (used, many)."""
        x, y = node_radii(self._optics)
        inside = np.hypot(x, y) <= 1
        basis = np.vstack([np.ones(inside.sum()), self._basis[:, inside]]).astype(np.float64)
        return np.asarray(np.linalg.lstsq(basis.T, opd_nm[inside].astype(np.float64), rcond=None)[0][1:])

    def _mirror_projection(self) -> Single:
        """(modes, actuators): modes of the wavefront, twice the surface, per nm of each actuator."""
        rows, columns = np.divmod(self._mirror.used, self._optics.axis.size)
        factors = self._mirror.y_factors[rows][:, :, None] * self._mirror.x_factors[columns][:, None, :]
        surface = factors.reshape(rows.size, -1) + self._mirror.expand @ self._mirror.reduce
        return self._project(2 * surface).astype(np.float32)
