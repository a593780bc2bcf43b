"""Factory of the instrument's parts from the configuration: optics, star, detector, mirror, calibration.

Processes and commands use it, so that all of them interpret the keys in the same way.
"""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lowfc.adapters.files.mirror_maps import active_actuators
from lowfc.adapters.files.sensors import coronagraph_from, sensor_from
from lowfc.adapters.files.twin_cache import load_or_build, load_or_compute_form, load_or_fit_mirror
from lowfc.arrays import Array, single
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError, ConfigurationError, LowfcError, raised_as
from lowfc.contract.messages import fields_of
from lowfc.contract.sections import InterlockSection
from lowfc.control.calibration.calibration import (
    Calibration,
    for_unnormalised_images,
    noise_nm2,
    normalise_flux,
    reconstructor,
)
from lowfc.control.loop.camera import CameraSettings
from lowfc.control.loop.interlocks import Action, Interlock
from lowfc.control.loop.safety import Limits, LoopMode
from lowfc.control.loop.state import Settings
from lowfc.optics.chain.added_contrast import ModalContrast
from lowfc.optics.chain.band import Band, gauss_legendre, monochromatic, uniform
from lowfc.optics.chain.mirror import Mirror, modes_to_actuators
from lowfc.optics.chain.sensor import Sensor, shear_response
from lowfc.optics.chain.zernike import zernikes
from lowfc.optics.detector.detector import Detector, saturation_dn
from lowfc.optics.detector.photometry import Photometry, electrons
from lowfc.optics.twin.twin import ACCURATE, FAST, Twin, node_radii, projected_response, reference, response
from lowfc.optics.twin.twin_mirror import TwinMirror, poke_wavefronts_nm

Progress = Callable[[int, int], None]

_log = logging.getLogger(__name__)
_SHARED = ("bias_dn", "gain_e_per_dn", "em_gain", "read_noise_e")  # attributes of both Detector and CameraSettings
_TWINS = {spec.nodes: spec for spec in (FAST, ACCURATE)}


def sensor(config: Configuration, warn: Callable[[str], None]) -> Sensor:
    """The wavefront sensor's optics."""
    return sensor_from(config.sensor, config.star.wavelength_nm, warn)


def band(config: Configuration) -> Band:
    """Wavelengths that sample the star's band, with their weights."""
    if config.sensor.wavelengths == 1:
        return monochromatic(config.star.wavelength_nm)
    quadrature = gauss_legendre if config.sensor.quadrature == "gauss-legendre" else uniform
    return quadrature(config.star.wavelength_nm, config.star.bandwidth, config.sensor.wavelengths)


def twin(config: Configuration, progress: Progress | None, warn: Callable[[str], None]) -> Twin:
    """Real-time digital twin of the sensor, from the cache or built.

    Raises:
        ConfigurationError: the optics have fewer modes than `sensor.rank`.
    """
    spec = replace(_TWINS[config.sensor.nodes], rank=config.sensor.rank)
    with raised_as(ConfigurationError, ValueError, "sensor"):
        return load_or_build(sensor(config, warn), spec, band(config), progress, notice=warn)


def contrast_of(config: Configuration) -> ModalContrast:
    """Contrast that the modes add to the dark zone, from the cache or computed in 0.3 s (2 s with a Lyot stop)."""
    optics = coronagraph_from(config.sensor), config.noll, config.star.wavelength_nm
    return ModalContrast(*optics, load_or_compute_form(*optics))


def contrast_or_none(config: Configuration | None) -> ModalContrast | None:
    """Result of `contrast_of` for a log or running loop; None without `config` or, with a warning, if it fails."""
    try:
        return None if config is None else contrast_of(config)
    except LowfcError as error:
        _log.warning("the contrast added to the dark zone is not computed: %s", error)
        return None


def electrons_per_exposure(config: Configuration) -> float:
    """Electrons per exposure of all light that enters the open circular pupil; a twin's images are fractions of it."""
    star = config.star
    photometry = Photometry(
        star.magnitude,
        star.diameter_m,
        star.wavelength_nm * star.bandwidth,
        star.throughput,
        config.camera.quantum_efficiency,
    )
    return electrons(photometry, config.exposure_ns * 1e-9)


def detector(config: Configuration) -> Detector:
    """The camera's detector."""
    camera = config.camera
    with raised_as(ConfigurationError, ValueError, "camera"):
        return Detector(
            camera.gain_e_per_dn,
            camera.read_noise_e,
            camera.bias_dn,
            camera.full_well_e,
            camera.bit_depth,
            camera.em_gain,
            config.dark_e,
            camera.photon_noise == "exact",
        )


def mirror(config: Configuration) -> Mirror:
    """Nominal geometry of the mirror."""
    section = config.mirror
    return Mirror(section.rows, section.columns, section.pitches_per_pupil, section.coupling)


def true_mirror(config: Configuration) -> Mirror:
    """Geometry of the simulated mirror, with its registration errors."""
    section = config.mirror
    pitches_per_pupil = section.pitches_per_pupil / section.magnification
    return replace(mirror(config), pitches_per_pupil=pitches_per_pupil, shift_pitches=section.shift_pitches)


def mirror_on_twin(config: Configuration, optics: Twin, warn: Callable[[str], None]) -> TwinMirror:
    """Wavefront of the nominal mirror at the twin's nodes, from the cache or fitted."""
    return load_or_fit_mirror(sensor(config, warn), optics, mirror(config), notice=warn)


def mirror_limits(config: Configuration) -> Limits:
    """The mirror's own limits, nm of surface."""
    return Limits(config.mirror.stroke_nm / 2, config.mirror.slew_nm, config.mirror.neighbour_nm)


def settings(config: Configuration) -> Settings:
    """Settings of the controller, constant during a run."""
    control, safety = config.control, config.safety
    return Settings(
        limits=Limits(safety.stroke_nm, safety.slew_nm, safety.neighbour_nm),
        delay_frames=control.delay_frames or config.camera.delay_frames,
        start_mode=LoopMode[control.start_mode.upper()],
        max_frame_age_ns=config.max_frame_age_ns,
        frame_timeout_ns=config.frame_timeout_ns,
        on_frame_timeout=control.on_frame_timeout,
        min_flux_fraction=control.min_flux_fraction,
        max_saturated_pixels=control.max_saturated_pixels,
        gain=(
            0.0 if control.tilt_gain == "auto" else control.tilt_gain,
            0.0 if control.gain == "auto" else control.gain,
        ),
        auto_gain=(control.tilt_gain == "auto", control.gain == "auto"),
        leak=(control.tilt_leak, control.leak),
        limit_nm=(control.tilt_limit_nm, control.limit_nm),
        # Without simulated noise, images of a working camera may be identical.
        max_identical_frames=control.max_identical_frames if config.camera.noise else 0,
        rate_hz=config.camera.rate_hz,
        guard=control.guard,
        interlocks=tuple(map(_interlock, config.interlocks)),
    )


def _interlock(section: InterlockSection) -> Interlock:
    max_age_ns, acts_when_old = round(section.max_age_s * 1e9), section.when_old == "acts"
    return Interlock(section.name, section.test, section.value, Action(section.action), max_age_ns, acts_when_old)


def analytic_calibration(
    config: Configuration, optics: Twin, on_nodes: TwinMirror, opd_nm: Array | None = None
) -> Calibration:
    """Calibration from the sensor's digital twin: I0 and H (the paper's eqs. (6) to (12)), R, and modes to actuators.

    The modes are fitted with the influence functions, then mixed slightly so that the sensor measures each modal
    command as itself: through the shaped pupil, the mirror's print-through looks like low-order modes of up to 0.3 % of
    the command. No mode moves an inactive actuator, and the sensor's response to these actuators is set to 0.

    Args:
        config: Configuration of the instrument.
        optics: Digital twin of the instrument's sensor.
        on_nodes: Wavefront of the nominal mirror at the twin's nodes.
        opd_nm: (used nodes,) wavefront for which I0 and H are computed, at the twin's used nodes; flat when None.

    Raises:
        CalibrationError: the sensor cannot distinguish the modes, gets no light or is saturated; or shear is a fitted
            nuisance and `opd_nm` is given.
        ConfigurationError: the map of active actuators cannot be used, or there are fewer actuators than modes.
    """
    if opd_nm is not None and "shear" in config.control.nuisance:
        raise CalibrationError(
            "the response to beam shear is known at a flat wavefront only: remove shear from control.nuisance"
        )
    camera = detector(config)
    highest_dn = float(saturation_dn(camera))
    nolls = config.noll
    I0, H = reference(optics, opd_nm), response(optics, zernikes(nolls, *node_radii(optics)), opd_nm)
    shape = I0.shape
    good = np.ones(I0.size)
    flux_e = electrons_per_exposure(config) * float(I0.sum())
    if not flux_e > 0:
        raise CalibrationError(
            "no light reaches the sensor in an exposure: raise camera.exposure_fraction or quantum_efficiency, or "
            "star.diameter_m, bandwidth or throughput"
        )
    light = I0.reshape(-1)
    I0, H = normalise_flux(light, H, good)
    nuisance = _nuisance(config, light, good)
    with raised_as(CalibrationError, ValueError, f"sensor.kind = {config.sensor.kind!r}, {len(nolls)} modes"):
        R = reconstructor(I0, H, good, flux_e, equivalent_read_noise_e(camera), config.control.estimator, nuisance)
    _check_exposure(config, light)

    active = active_actuators(config)
    with raised_as(ConfigurationError, ValueError, "mirror"):
        shapes = modes_to_actuators(mirror(config), nolls, active)
    sensed = actuators_to_modes(R, light, good, optics, on_nodes, opd_nm)
    if active is not None:
        sensed[:, ~active.reshape(-1)] = 0
    shapes = shapes @ np.linalg.inv(sensed @ shapes)

    return with_identity(
        Calibration(
            noll=nolls,
            reference=single(I0),
            response=single(H),
            reconstructor=single(R),
            good=single(good),
            dark=np.full(I0.size, _dark_dn(camera), np.float32),
            modes_to_actuators=single(shapes),
            shape=(shape[0], shape[1]),
            grid=(config.mirror.rows, config.mirror.columns),
            flux_dn=flux_e * camera.em_gain / camera.gain_e_per_dn,
            saturation_dn=highest_dn,
            estimator="+".join((config.control.estimator, *config.control.nuisance)),
            wavelength_nm=config.star.wavelength_nm,
            operator_hash=optics.operator_hash,
            id="",
            actuators_to_modes=single(sensed),
            camera=CameraSettings(0, (shape[0], shape[1]), saturation_dn=highest_dn, **fields_of(camera, _SHARED)),
        )
    )


def actuators_to_modes(
    reconstructor: Array, reference: Array, good: Array, optics: Twin, on_nodes: TwinMirror, opd_nm: Array | None = None
) -> Array:
    """Matrix (modes, actuators) of the nm rms of wavefront that R measures per nm of surface of each actuator.

    Args:
        reconstructor: (modes, pixels) R, nm per flux fraction.
        reference: (pixels,) I0 of the twin, not divided by its flux.
        good: (pixels,) 1 for a used pixel, else 0.
        optics: Digital twin of the sensor.
        on_nodes: Wavefront of the mirror at the twin's nodes.
        opd_nm: (used nodes,) wavefront for which R was computed, at the twin's used nodes; flat when None.
    """
    sensed = projected_response(optics, for_unnormalised_images(reconstructor, reference, good), opd_nm)
    return np.asarray(sensed @ poke_wavefronts_nm(on_nodes))


def frame_noise_nm(config: Configuration, calibration: Calibration) -> Array:
    """Standard deviation (modes,) of the noise of each mode in one frame, nm of wavefront, from `frame_noise_nm2`."""
    return np.asarray(np.sqrt(np.diag(frame_noise_nm2(config, calibration))))


def frame_noise_nm2(config: Configuration, calibration: Calibration) -> Array:
    """Covariance (modes, modes) of one frame's noise, nm^2 of wavefront: photons, read-out and rounding, through R."""
    camera = detector(config)
    flux_e = calibration.flux_dn * camera.gain_e_per_dn / camera.em_gain
    reference, matrix = calibration.reference.astype(float), calibration.reconstructor.astype(float)
    excess = 2.0 if camera.em_gain > 1 else 1.0
    rounding_e = camera.gain_e_per_dn / camera.em_gain / np.sqrt(12 * excess)
    return excess * noise_nm2(matrix, reference, flux_e, float(np.hypot(equivalent_read_noise_e(camera), rounding_e)))


def _check_exposure(config: Configuration, light: Array) -> None:
    """Raise CalibrationError if a pixel of the reference image saturates: its response is then not linear."""
    camera = detector(config)
    charge_e = float(light.max()) * electrons_per_exposure(config) * camera.em_gain
    dark_dn, full_dn = _dark_dn(camera), float(saturation_dn(camera))
    if dark_dn >= full_dn:
        raise CalibrationError(
            f"the sensor saturates without light: a pixel has {dark_dn:.0f} DN in an exposure, its largest value is "
            f"{full_dn:.0f} DN; check bias, dark current, clock-induced charge, gains and full well in [camera]"
        )
    if dark_dn + charge_e / camera.gain_e_per_dn >= full_dn:
        raise CalibrationError(
            f"the star saturates the sensor: {charge_e:.0f} e- in the brightest pixel of the reference image, which "
            f"holds {(full_dn - dark_dn) * camera.gain_e_per_dn:.0f} e-; shorten camera.exposure_fraction or raise "
            "camera.rate_hz"
        )


def _nuisance(config: Configuration, light: Array, good: Array) -> Array | None:
    """Change of the normalised image (pixels, parameters) per unit of each nuisance parameter; None without any."""
    columns = [
        np.ones((light.size, 1)) if name == "background" else shear_slopes(config) for name in config.control.nuisance
    ]
    return normalise_flux(light, np.hstack(columns), good)[1] if columns else None


def shear_slopes(config: Configuration) -> Array:
    """Change of the image (pixels, 2) per pupil diameter of shear of the beam along x and y."""
    return shear_response(sensor(config, lambda _: None), band(config))


def _dark_dn(camera: Detector) -> float:
    return camera.bias_dn + camera.clock_induced_charge_e * camera.em_gain / camera.gain_e_per_dn


def equivalent_read_noise_e(camera: Detector) -> float:
    """Read noise equivalent to all noise except photon noise, electrons before multiplication, for the weights of R.

    With EM gain a pixel's variance is 2 (I0 + read_noise^2 / (2 gain^2)), as the multiplication register doubles the
    variance of the photons. Clock-induced charge and dark current add noise as light does.
    """
    read_noise_e = camera.read_noise_e
    if camera.em_gain > 1:
        read_noise_e /= camera.em_gain * np.sqrt(2)
    return float(np.hypot(read_noise_e, np.sqrt(camera.clock_induced_charge_e)))
