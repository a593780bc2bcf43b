"""The simulated optics in front of the detector: mirror and disturbance in, frame and true wavefront out.

Time is continuous: the star moves while the mirror holds. An image is the mean over its exposure. The true wavefront
is given at the start of the exposure, and as the root mean square over the period.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Array, Single
from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.detector.detector import Detector, expose, noise_table_of, saturation_dn
from lowfc.optics.twin.twin import Evaluator, Twin, node_radii, wavefront_rms_nm
from lowfc.optics.twin.twin_mirror import TwinMirror, poke_wavefronts_nm, wavefront_nm
from sim_camera.disturbance import Disturbance, Sampler, highest_hz, screen, shear_at, speeds_hz
from sim_camera.pixels import PixelErrors

GAUSS_LEGENDRE = (1 + np.array([-1, 1]) / np.sqrt(3)) / 2
"""The two Gauss-Legendre nodes in [0, 1], in exposure times: their mean is exact to third order in time."""
_MAX_NODES = 256
"""Largest number of nodes, which bounds the time to compute them and a frame; reached at frame rates below 1 Hz."""


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
    """Nodes in [0, 1], in exposure times, and weights of the mean over an exposure.

    The mean of a wave is exact to 0.5 % of its amplitude, up to 127 cycles.

    Args:
        cycles: Cycles of the fastest wave in an exposure.
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
        noise: bool = True,
        exposure: float = 0.0,
        instants: int = 1,
        pixels: PixelErrors | None = None,
        shear_slopes: Array | None = None,
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
        self._area = optics.area_weights.astype(np.float32)
        self._basis = zernikes(disturbance.noll, *node_radii(optics)).astype(np.float32)
        self._screen = self._static_screen(disturbance.screen_nm, seed)
        self._screen_modes = np.asarray(self._project(self._screen), dtype=np.float32)
        self._mirror_to_modes = self._project(poke_wavefronts_nm(mirror)).astype(np.float32)  # (modes, actuators)
        self.instants = (np.arange(instants) + 0.5) / instants if instants > 1 else np.zeros(0)
        nodes, weights = np.zeros(0), np.ones(1)
        if instants > 1:
            nodes, weights = exposure_nodes(highest_hz(disturbance) * exposure / rate_hz)
        self._image_weights = weights.astype(np.float32)
        self._wavefronts: list[tuple[Single, Single]] = []
        self._sampler = Sampler(disturbance, np.concatenate([[0.0], exposure * nodes, self.instants]), rate_hz)
        self._disturbance, self._rate_hz, self._exposure = disturbance, rate_hz, exposure
        self._shear_slopes = None if shear_slopes is None else shear_slopes.astype(np.float32)
        noise_table_of(detector)  # built here so that the first frame is not late

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
        shares = self._electrons * self._image_weights
        electrons = self._evaluator.image(opds_nm[0]) * shares[0]
        for opd_nm, share in zip(opds_nm[1:], shares[1:], strict=True):
            electrons += self._evaluator.image(opd_nm) * share
        if self._shear_slopes is not None:
            sheared = self._shear_slopes @ self._shear(index).astype(np.float32)
            electrons += (self._electrons * sheared).reshape(electrons.shape)
        if self._pixels is not None:
            electrons = electrons * self._pixels.gain + self._pixels.hot_e
        frame = expose(self._detector, electrons, self._rng) if self._noise else self._noiseless(electrons)
        return frame if self._pixels is None else self._pixels.response_dn[frame]

    def truth(self, index: int, actuators_nm: Single, path: tuple[list[Single], Single] | None = None) -> Truth:
        """The true wavefront of a frame and of its period.

        Args:
            index: index of the frame.
            actuators_nm: (rows, columns) shape of the mirror at the start of its exposure.
            path: shapes (rows, columns) of the mirror in the period, and the weight of each at each of the
                instants (instants, shapes); the mirror does not move if None.
        """
        modes = self._sampler.at(index)
        shapes_nm, weights = [actuators_nm], np.ones((len(self.instants), 1), np.float32)
        if path is not None and len(self.instants):
            shapes_nm, weights = [actuators_nm, *path[0]], np.hstack([0 * weights, path[1]])
        # Modes (1 + instants, modes): row 0 at the start of the exposure, then a row per instant; likewise `residual`.
        disturbance = np.concatenate([modes[:1], modes[len(modes) - len(self.instants) :]])
        shape_weights = np.vstack([np.eye(1, len(shapes_nm), dtype=np.float32), weights])
        opd_nm = disturbance @ self._basis
        opd_nm += self._screen
        mirror_nm = shape_weights @ np.array([self._mirror_nm(shape) for shape in shapes_nm])
        disturbance = disturbance + self._screen_modes
        residual = disturbance + shape_weights @ (
            np.array(shapes_nm).reshape(len(shapes_nm), -1) @ self._mirror_to_modes.T
        )
        mean_squares_nm2 = self._mean_squares_nm2(opd_nm), self._mean_squares_nm2(opd_nm + mirror_nm)
        disturbance_rms_nm, residual_rms_nm = (float(np.sqrt(each[0])) for each in mean_squares_nm2)
        sampled = Wavefront(disturbance[0], residual[0], disturbance_rms_nm, residual_rms_nm)
        speeds_and_shear = speeds_hz(self._disturbance, index / self._rate_hz), self._shear(index)
        if not len(self.instants):
            return Truth(sampled, None, sampled.residual_nm, np.array([disturbance, residual]), *speeds_and_shear)
        sensed_nm = self._image_weights @ modes[1 : 1 + self._image_weights.size] - modes[0] + residual[0]
        modes_rms = (np.sqrt(np.square(each[1:]).mean(axis=0)) for each in (disturbance, residual))
        pupil_rms = (float(np.sqrt(each[1:].mean())) for each in mean_squares_nm2)
        continuous = Wavefront(*modes_rms, *pupil_rms)
        return Truth(sampled, continuous, sensed_nm, np.array([disturbance[1:], residual[1:]]), *speeds_and_shear)

    def _shear(self, index: int) -> Array:
        """Shear of the beam (2,) at mid-exposure, pupil diameters; empty without shear."""
        return shear_at(self._disturbance, (index + self._exposure / 2) / self._rate_hz)

    def _mirror_nm(self, actuators_nm: Single) -> Single:
        """Wavefront (used,) of a shape; the last three are cached."""
        for shape_nm, opd_nm in self._wavefronts:
            if shape_nm is actuators_nm:
                return opd_nm
        new_nm = wavefront_nm(self._mirror, actuators_nm)
        self._wavefronts = [(actuators_nm, new_nm), *self._wavefronts[:2]]
        return new_nm

    def _mean_squares_nm2(self, opd_nm: Single) -> Single:
        """Mean square over the open pupil, piston removed, of wavefronts (many, used)."""
        from_mean = opd_nm - (opd_nm @ self._area)[:, None]
        return np.maximum(np.square(from_mean) @ self._area, 0)  # guard nodes of the interpolation have weights < 0

    def _noiseless(self, electrons: Single) -> npt.NDArray[np.uint16]:
        """A frame (rows, columns) in DN, as by `expose` but without noise."""
        detector = self._detector
        charge_e = (np.maximum(electrons, 0) + detector.clock_induced_charge_e) * detector.em_gain
        values = np.minimum(charge_e, detector.full_well_e) / detector.gain_e_per_dn + detector.bias_dn
        return np.asarray(np.rint(np.clip(values, 0, saturation_dn(detector))), dtype=np.uint16)

    def _static_screen(self, rms_nm: float, seed: int) -> Single:
        """The preset's screen at the nodes, scaled to this rms over the open pupil, piston removed."""
        axis = self._optics.axis
        if not rms_nm:
            return np.zeros(self._optics.used.size, np.float32)
        opd = screen(seed, axis.size, float(axis[1] - axis[0])).reshape(-1)[self._optics.used]
        opd -= self._optics.area_weights @ opd
        return (opd * (rms_nm / wavefront_rms_nm(self._optics, opd))).astype(np.float32)

    def _project(self, opd_nm: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Least-squares fit of modes and piston over the circular aperture to wavefronts (used,) or (used, many)."""
        x, y = node_radii(self._optics)
        inside = np.hypot(x, y) <= 1
        basis = np.vstack([np.ones(inside.sum()), self._basis[:, inside]]).astype(np.float64)
        return np.asarray(np.linalg.lstsq(basis.T, opd_nm[inside].astype(np.float64), rcond=None)[0][1:])
