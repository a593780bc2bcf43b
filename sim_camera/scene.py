"""The simulated optics: frame and true wavefront, computed from the mirror's shape and the disturbance.

Time is continuous: the star moves while the mirror holds its shape. An image is the mean over its exposure. The true
wavefront is given at the start of the exposure, and as the root mean square over the period.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Single
from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.detector.detector import Detector, expose, noise_table_of, saturation_dn
from lowfc.optics.twin.twin import Evaluator, Twin, node_radii, wavefront_rms_nm
from lowfc.optics.twin.twin_mirror import TwinMirror, poke_wavefronts_nm, wavefront_nm
from sim_camera.disturbance import Disturbance, Sampler, highest_hz, screen, shear_at, speeds_hz
from sim_camera.path import MirrorMotion
from sim_camera.pixels import PixelErrors

GAUSS_LEGENDRE = (1 + np.array([-1, 1]) / np.sqrt(3)) / 2
"""The two Gauss-Legendre nodes in [0, 1], in exposure times: their mean is exact to third order in time."""
MAX_TRUTHS = 10
"""Largest number of frames for which the truth is computed together."""
_MAX_NODES = 256
"""Largest number of nodes in an exposure; it bounds the time to compute a frame. The presets reach it at frame rates
below 1 Hz, fast wheels also at higher frame rates."""


@dataclass(frozen=True, slots=True)
class Wavefront:
    """Modes (modes,) over the circular aperture, and rms over the open part of the pupil mask; nm of wavefront."""

    disturbance_nm: Single
    residual_nm: Single
    disturbance_rms_nm: float
    residual_rms_nm: float


@dataclass(frozen=True, slots=True)
class Truth:
    """True wavefront of one frame, from the simulation.

    Attributes:
        sampled: wavefront at the start of the exposure.
        continuous: root mean squares over the period, modes included; None if not computed.
        sensed_nm: (modes,) mean of the residual over the exposure, as the sensor sees it.
        instants_nm: (2, instants, modes) disturbance and residual at each instant.
        wheel_speed_hz: (wheels,) speed of each wheel at the start of the exposure.
        shear: (2,) shear of the beam along x and y at mid-exposure, pupil diameters; empty without shear.
    """

    sampled: Wavefront
    continuous: Wavefront | None
    sensed_nm: Single
    instants_nm: Single
    wheel_speed_hz: Array
    shear: Array


def exposure_nodes(cycles: float) -> tuple[Array, Array]:
    """Nodes (n,) in [0, 1], in exposure times, and their weights (n,) for the mean over an exposure.

    The mean of a wave is exact to 0.5 % of its amplitude, up to 127 cycles in an exposure.

    Args:
        cycles: Number of cycles of the fastest wave in an exposure.
    """
    if cycles <= 0.25:
        return GAUSS_LEGENDRE, np.full(2, 0.5)
    count = 4 + 2 * int(np.ceil(max(0.0, cycles - 1.2)))
    nodes, weights = np.polynomial.legendre.leggauss(min(count, _MAX_NODES))
    return (1 + nodes) / 2, weights / 2


class Scene:
    """Optics, star, detector and disturbance of one run, with its own noise generator.

    Attributes:
        instants: (instants,) times at which the continuous truth is sampled, in periods after the period's start.
    """

    def __init__(
        self,
        optics: Twin,
        mirror: TwinMirror,
        detector: Detector,
        electrons: float,
        disturbance: Disturbance,
        rate_hz: float,
        seed: int,
        noise: bool,
        exposure: float,
        instants: int,
        pixels: PixelErrors | None,
        shear_slopes: Array | None,
    ) -> None:
        """Prepare everything that does not change from frame to frame.

        Args:
            optics: the twin.
            mirror: the mirror on the twin's nodes.
            detector: the sensor's detector.
            electrons: electrons of one exposure through the circular aperture, without any mask.
            disturbance: the disturbance.
            rate_hz: frame rate.
            seed: seed of noise and screen.
            noise: whether to add photon and read noise.
            exposure: exposure time, in periods.
            instants: number of times in each period at which the truth is computed; with 1, truth and image are
                those at the start of the exposure, without blur.
            pixels: pixel errors; None for none.
            shear_slopes: (pixels, 2) change of the image per pupil diameter of shear; None without shear.
        """
        self._optics = optics
        self._mirror = mirror
        self._evaluator = Evaluator(optics)
        self._detector = detector
        self._electrons = np.float32(electrons)
        self._rng = np.random.Generator(np.random.SFC64(np.random.SeedSequence([seed, 3])))  # stream 3: noise
        self._noise = noise
        self._pixels = pixels
        self._basis = zernikes(disturbance.noll, *node_radii(optics)).astype(np.float32)
        self._screen = self._static_screen(disturbance.screen_nm, seed)
        self._screen_modes = np.asarray(self._project(self._screen), dtype=np.float32)
        self._mirror_to_modes = self._project(poke_wavefronts_nm(mirror)).astype(np.float32)  # (modes, actuators)
        self.instants = (np.arange(instants) + 0.5) / instants if instants > 1 else np.zeros(0)
        nodes, weights = np.zeros(0), np.ones(1)
        if instants > 1:
            nodes, weights = exposure_nodes(highest_hz(disturbance) * exposure / rate_hz)
        self._image_weights = weights.astype(np.float32)
        self._image_electrons = self._electrons * self._image_weights
        fields_nm = np.vstack([self._basis, self._screen]).astype(np.float64)
        fields_nm -= (fields_nm @ optics.area_weights)[:, None]
        self._weighted = np.ascontiguousarray((fields_nm * optics.area_weights).T)
        self._products_nm2 = fields_nm @ self._weighted  # products of modes and screen over the open pupil
        self._wavefronts: deque[tuple[Single, Single]] = deque(maxlen=2 * MAX_TRUTHS)
        self._sampler = Sampler(disturbance, np.concatenate([[0.0], exposure * nodes, self.instants]), rate_hz)
        self._disturbance, self._rate_hz, self._exposure = disturbance, rate_hz, exposure
        self._shear_slopes = None if shear_slopes is None else shear_slopes.astype(np.float32)
        noise_table_of(detector)  # computed here, so that the first frame is not late

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of a frame."""
        pixels = len(self._optics.to_pixels)
        return pixels, pixels

    def expose(self, index: int, actuators_nm: Single) -> npt.NDArray[np.uint16]:
        """Expose a frame (rows, columns) with the mirror's actuators (rows, columns) at this shape."""
        modes = self._sampler.at(index)
        static_nm = self._screen + self._mirror_nm(actuators_nm)
        end = len(modes) - len(self.instants)
        opds_nm = modes[end - self._image_weights.size : end] @ self._basis
        opds_nm += static_nm
        electrons = self._evaluator.image(opds_nm, self._image_electrons)
        if self._shear_slopes is not None:
            sheared = self._shear_slopes @ self._shear(index).astype(np.float32)
            electrons += (self._electrons * sheared).reshape(electrons.shape)
        if self._pixels is not None:
            electrons = electrons * self._pixels.gain + self._pixels.hot_e
        frame = expose(self._detector, electrons, self._rng) if self._noise else self._noiseless(electrons)
        return frame if self._pixels is None else self._pixels.response_dn[frame]

    def truth(self, index: int, actuators_nm: Single, path: MirrorMotion | None = None) -> Truth:
        """The true wavefront of a frame and of its period; arguments as for `truths`."""
        return self.truths([(index, actuators_nm, path)])[0]

    def truths(self, frames: Sequence[tuple[int, Single, MirrorMotion | None]]) -> list[Truth]:
        """The true wavefronts of frames and of their periods; many frames in one call take less time than one by one.

        Args:
            frames: for each frame its index; the shape (rows, columns) of the mirror at the start of its exposure; and
                the shapes (rows, columns) of the mirror in its period with the weight of each at each of the instants
                (instants, shapes), or None if the mirror does not move.
        """
        modes, count = np.array([self._sampler.at(index) for index, *_ in frames]), len(self.instants)
        # Axes of these arrays: frames, times (the start of the exposure, then the instants), modes or shapes.
        disturbance_nm = np.concatenate([modes[:, :1], modes[:, modes.shape[1] - count :]], axis=1)
        shapes_nm, weights = self._weighted_shapes(frames)
        mean_squares_nm2 = self._mean_squares_nm2(disturbance_nm, shapes_nm, weights)
        mirror_nm = weights @ (np.array(shapes_nm).reshape(len(shapes_nm), -1) @ self._mirror_to_modes.T)
        disturbance_nm += self._screen_modes
        both_nm = np.array([disturbance_nm, disturbance_nm + mirror_nm])
        start_rms_nm = np.sqrt(mean_squares_nm2[:, :, 0]).T.tolist()
        if count:
            image_nm = np.tensordot(modes[:, 1 : 1 + self._image_weights.size], self._image_weights, (1, 0))
            sensed_nm = image_nm - modes[:, 0] + both_nm[1, :, 0]
            modes_rms_nm = np.sqrt(np.square(both_nm[:, :, 1:]).mean(axis=2))
            pupil_rms_nm = np.sqrt(mean_squares_nm2[:, :, 1:].mean(axis=2)).T.tolist()
        truths = []
        for row, (index, *_) in enumerate(frames):
            sampled = Wavefront(*both_nm[:, row, 0], *start_rms_nm[row])
            continuous, sensed, at_nm = None, sampled.residual_nm, both_nm[:, row]
            if count:
                continuous = Wavefront(*modes_rms_nm[:, row], *pupil_rms_nm[row])
                sensed, at_nm = sensed_nm[row], at_nm[:, 1:]
            speeds = speeds_hz(self._disturbance, index / self._rate_hz)
            truths.append(Truth(sampled, continuous, sensed, at_nm, speeds, self._shear(index)))
        return truths

    def _weighted_shapes(
        self, frames: Sequence[tuple[int, Single, MirrorMotion | None]]
    ) -> tuple[list[Single], Single]:
        """The shapes (rows, columns) of the mirror in these frames, and weights (frames, times, shapes) of each."""
        count, still_weights = len(self.instants), np.ones((len(self.instants), 1), np.float32)
        in_frames = [(actuators_nm, *(motion or ([actuators_nm], still_weights))) for _, actuators_nm, motion in frames]
        shapes = {id(shape): shape for start, moved, _ in in_frames for shape in (start, *moved)}
        columns = {identity: column for column, identity in enumerate(shapes)}
        weights = np.zeros((len(frames), 1 + count, len(shapes)), np.float32)
        for row, (start, moved, moved_weights) in enumerate(in_frames):
            weights[row, 0, columns[id(start)]] = 1
            for shape, weight in zip(moved, moved_weights.T, strict=True):
                weights[row, 1:, columns[id(shape)]] += weight
        return list(shapes.values()), weights

    def _shear(self, index: int) -> Array:
        """Shear of the beam (2,) at mid-exposure, pupil diameters; empty without shear."""
        return shear_at(self._disturbance, (index + self._exposure / 2) / self._rate_hz)

    def _mirror_nm(self, actuators_nm: Single) -> Single:
        """Wavefront (used,) of a shape on the twin's used nodes, nm; the last wavefronts are cached."""
        for shape_nm, opd_nm in self._wavefronts:
            if shape_nm is actuators_nm:
                return opd_nm
        new_nm = wavefront_nm(self._mirror, actuators_nm)
        self._wavefronts.appendleft((actuators_nm, new_nm))
        return new_nm

    def _mean_squares_nm2(self, disturbance_nm: Single, shapes_nm: list[Single], weights: Single) -> Array:
        """Mean squares (2, frames, times) over the open pupil, piston removed: without the mirror, and with it.

        They are quadratic forms of the integrated products of modes, screen and shapes, computed in double precision,
        as the mirror cancels most of the disturbance.

        Args:
            disturbance_nm: (frames, times, modes) modes without the screen's.
            shapes_nm: shapes (rows, columns) of the mirror.
            weights: (frames, times, shapes) weight of each shape.
        """
        mirror_nm = np.array([self._mirror_nm(shape) for shape in shapes_nm], dtype=np.float64)
        fixed, area = len(self._products_nm2), self._optics.area_weights
        products_nm2 = np.empty((fixed + len(mirror_nm),) * 2)
        products_nm2[:fixed, :fixed] = self._products_nm2
        products_nm2[fixed:, :fixed] = mirror_nm @ self._weighted
        products_nm2[:fixed, fixed:] = products_nm2[fixed:, :fixed].T
        mirror_nm -= (mirror_nm @ area)[:, None]
        products_nm2[fixed:, fixed:] = (mirror_nm * area) @ mirror_nm.T
        amounts = np.zeros((2, *weights.shape[:2], len(products_nm2)))
        amounts[..., : fixed - 1], amounts[..., fixed - 1], amounts[1, ..., fixed:] = disturbance_nm, 1, weights
        # Guard nodes of the interpolation have weights below zero, so a sum may be below zero too.
        return np.asarray(np.maximum((amounts @ products_nm2 * amounts).sum(axis=-1), 0))

    def _noiseless(self, electrons: Single) -> npt.NDArray[np.uint16]:
        """A frame (rows, columns) in DN, as by `expose` but without noise."""
        detector = self._detector
        charge_e = (np.maximum(electrons, 0) + detector.clock_induced_charge_e) * detector.em_gain
        values = np.minimum(charge_e, detector.full_well_e) / detector.gain_e_per_dn + detector.bias_dn
        return np.asarray(np.rint(np.clip(values, 0, saturation_dn(detector))), dtype=np.uint16)

    def _static_screen(self, rms_nm: float, seed: int) -> Single:
        """The static screen (used,) at the nodes, nm, scaled to this rms over the open pupil, piston removed."""
        axis = self._optics.axis
        if not rms_nm:
            return np.zeros(self._optics.used.size, np.float32)
        opd = screen(seed, axis.size, float(axis[1] - axis[0])).reshape(-1)[self._optics.used]
        opd -= self._optics.area_weights @ opd
        return (opd * (rms_nm / wavefront_rms_nm(self._optics, opd))).astype(np.float32)

    def _project(self, opd_nm: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Modes of wavefronts (used,) or (used, n), from a fit of modes and piston over the circular aperture."""
        x, y = node_radii(self._optics)
        inside = np.hypot(x, y) <= 1
        basis = np.vstack([np.ones(inside.sum()), self._basis[:, inside]]).astype(np.float64)
        return np.asarray(np.linalg.lstsq(basis.T, opd_nm[inside].astype(np.float64), rcond=None)[0][1:])
