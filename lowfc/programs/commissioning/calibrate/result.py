"""The result of a calibration: the calibration for the file, its properties and the verdict."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lowfc.adapters.files import calibration_file, factory
from lowfc.arrays import Array, single
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError, raised_as
from lowfc.control.calibration.adapted import on_pixels
from lowfc.control.calibration.calibration import FIRST_SUFFIX, Calibration, same_frames_and_modes
from lowfc.control.calibration.regularised import Reconstruction, advice, reconstruct
from lowfc.control.calibration.response_fit import MAX_ELEMENT, MAX_ELEMENT_RMS, Check, Measured, cross_talk
from lowfc.control.loop.wording import counted
from lowfc.optics.chain.zernike import noll_to_orders
from lowfc.optics.twin.twin import reference as twin_reference
from lowfc.programs.cli.result import Result, result_field
from lowfc.programs.commissioning.calibrate.pokes import CalibrationRequest, cycles_for
from lowfc.programs.commissioning.calibrate.run import CalibrationData, Calibrator

MAX_NOISE_RATIO = 1.5
"""Largest accepted ratio of the noise of the measured R to that of the computed R, at the same flux. It is exceeded
if the sensor is misaligned, or the wavefront far from the zero point."""
_MAX_MODEL_ERROR = 0.5  # largest error of an element of R H if the model is of this sensor and orientation
DELAY_TOLERANCE_FRAMES = 0.1
"""Largest difference between measured and configured delay without a warning, frames."""


class Verdict(Result):
    """Verdict on a measured reconstructor; the cross-talk is measured with separate frames."""

    snr: float = result_field("signal-to-noise ratio requested", form=".3g")
    snr_reached: float = result_field("signal-to-noise ratio reached", form=".3g")
    check_cycles: int = result_field("check cycles")
    check_cross_talk_rms: float = result_field("check frames: cross-talk, rms", form=".3g")
    check_cross_talk_max: float = result_field("check frames: largest cross-talk, with noise", form=".3g")
    check_cross_talk_bound: float = result_field("limit of this cross-talk, with noise", form=".3g")
    check_error: float = result_field("standard error of an element of R H", form=".2g")
    promised_cross_talk_rms: float = result_field("limit of the cross-talk, rms", form=".3g")
    promised_cross_talk_max: float = result_field("limit of the largest cross-talk", form=".3g")
    recommended: bool = result_field()
    faults: list[str] = result_field()


class CalibrationProperties(Result):
    """Properties of a calibration; `singular_values` and `kept` are by combination of modes, other lists by mode."""

    method: str = result_field("method")
    modes: int = result_field("modes")
    noll: list[int] = result_field("mode", form="Z{}", column=True)
    condition_number: float = result_field("condition number", form=".3g")
    singular_values: list[float] = result_field("singular values", form=".3g")
    kept: list[float] = result_field()
    delay_frames: float = result_field("delay", "frames", ".3f")
    delay_error_frames: float | None = result_field("standard error of the delay", "frames", ".3f", default=None)
    frame_to_effect_ms: float = result_field("frame to effect", "ms", ".3g")
    noise_gain_nm: list[float] = result_field("noise per frame", "nm", ".3g", column=True)
    computed_noise_nm: list[float] | None = result_field("noise of computed R", "nm", ".3g", column=True, default=None)
    bad_pixels: int = result_field("bad pixels")
    flux_dn: float = result_field("light", "DN", ".4g")
    cycles: int | None = result_field("cycles", default=None)
    cross_talk: float | None = result_field("largest cross-talk relative to the computed H", form=".4f", default=None)
    cross_talk_error: float | None = result_field("standard error of this cross-talk", form=".4f", default=None)
    file: str = result_field("written")


class CalibrationResult(Verdict, CalibrationProperties):
    """A measured calibration with its verdict, or a computed one without a verdict."""

    advice: list[str] = result_field(exclude=True, default=[])
    not_loaded: bool = result_field(exclude=True, default=False)

    def remarks(self) -> Sequence[str]:
        """Advice and verdict."""
        if "recommended" not in self.model_fields_set:
            return self.advice
        verdict = [
            "verdict: good" if self.recommended else "verdict: NOT RECOMMENDED",
            *(f"  {fault}" for fault in self.faults),
        ]
        return [*self.advice, *verdict, *(["not loaded"] if self.not_loaded else [])]


class Comparison(Result):
    """Differences of two calibrations; `estimators` and `bad_pixels` are by calibration, the other lists by mode."""

    modes: int = result_field("modes")
    noll: list[int] = result_field("mode", form="Z{}", column=True)
    estimators: list[str] = result_field("estimators")
    cross_talk: float = result_field("largest cross-talk", form=".4f")
    gain: list[float] = result_field("gain", form=".4f", column=True)
    reference_shift_nm: list[float] = result_field("zero-point shift", "nm", ".3f", column=True)
    flux_ratio: float = result_field("flux ratio", form=".4f")
    dark_shift_dn: float = result_field("shift of the dark", "DN", "+.2f")
    bad_pixels: list[int] = result_field("bad pixels")
    same_commands: bool = result_field("same commands")


def finish_calibration(calibrator: Calibrator, data: CalibrationData) -> tuple[Calibration, CalibrationResult]:
    """Compute R, check it with separate frames, and write the file, under another name if R is not recommended."""
    config, request, computed, measured = calibrator.config, calibrator.request, calibrator.computed, data.measured
    calibration, reconstruction = measured_calibration(config, calibrator.in_use, measured, request)
    check = calibrator.check(calibration, data)
    delay_frames, delay_error_frames = data.delay[:2]
    fields: dict[str, Any] = {
        "delay_frames": delay_frames,
        "delay_error_frames": delay_error_frames,
        "cycles": measured.cycles,
    }
    noise_nm, ratio = computed_noise_nm(config, calibration, computed), None
    if noise_nm is not None:
        ratio = factory.frame_noise_nm(config, calibration) / noise_nm
        fields["cross_talk"] = float(np.abs(cross_talk(calibration.reconstructor, computed.response)).max())
        fields["cross_talk_error"] = float(measured.error.max())
        fields["computed_noise_nm"] = noise_nm.tolist()
    verdict = judge(request.snr, measured.cycles, measured.error, check, ratio, calibration.noll)
    out = request.out  # not replaced by a calibration that is not recommended
    file = out.with_name(f"{out.stem}.rejected{out.suffix}") if verdict.faults else out
    result = result_of(config, calibration, reconstruction, request.method, file, **fields, **verdict.json_object())
    calibration_file.save(calibration, file)
    configured = configured_delay(config)
    if abs(delay_frames - configured) > DELAY_TOLERANCE_FRAMES:
        result.advice.append(
            f"warning: the configured delay is {counted(float(configured), 'frame')}: set control.delay_frames = "
            f"{max(delay_frames, 1):.2f}"
        )
    return calibration, result


def compute_reconstructor(
    config: Configuration, calibration: Calibration, initial: Array | None, **options: Any
) -> Reconstruction:
    """R for I0, H and flux of a calibration and the configured camera; `initial` and `options` as for `reconstruct`."""
    camera = factory.detector(config)
    flux_e = calibration.flux_dn * camera.gain_e_per_dn / camera.em_gain
    arrays = calibration.reference, calibration.response, calibration.good
    I0, H, good = (array.astype(np.float64) for array in arrays)
    with raised_as(CalibrationError, ValueError):
        return reconstruct(I0, H, initial, good, flux_e, factory.equivalent_read_noise_e(camera), **options)


def measured_calibration(
    config: Configuration, in_use: Calibration, measured: Measured, request: CalibrationRequest
) -> tuple[Calibration, Reconstruction]:
    """The calibration from cycles of pokes, with the dark, good pixels and mirror commands of `in_use`."""
    estimators = dict.fromkeys([*measured.initial.estimator.removesuffix(FIRST_SUFFIX).split("+"), request.method])
    calibration = replace(
        in_use,
        reference=in_use.reference if measured.reference is None else single(measured.reference),
        response=single(measured.response),
        flux_dn=measured.flux_dn,
        estimator="+".join(estimators),
        operator_hash="",
    )
    reconstruction = compute_reconstructor(
        config, calibration, measured.initial.matrix, truncate=request.truncate, tikhonov=request.tikhonov
    )
    actuators = single(_actuators_to_modes(config, in_use, reconstruction.matrix, measured.response))
    calibration = replace(calibration, reconstructor=single(reconstruction.matrix), actuators_to_modes=actuators)
    return with_identity(calibration), reconstruction


def computed_noise_nm(config: Configuration, calibration: Calibration, computed: Calibration) -> Array | None:
    """Noise (modes,) of the computed R at the flux of a calibration, nm; None if that R has other pixels or modes."""
    if not same_frames_and_modes(calibration, computed):
        return None
    return factory.frame_noise_nm(config, replace(calibration, reconstructor=computed.reconstructor * calibration.good))


def result_of(
    config: Configuration,
    calibration: Calibration,
    reconstruction: Reconstruction,
    method: str,
    file: Path,
    **measured: Any,
) -> CalibrationResult:
    """The result of a calibration; `measured` has the fields of a measured one, such as its delay and verdict."""
    limit_nm = factory.settings(config).integrator(calibration.noll).limit_nm
    # set for a computed calibration, too, so that --json always has these fields
    fields = {"delay_frames": configured_delay(config), "delay_error_frames": None, "cycles": None, **measured}
    return CalibrationResult.model_construct(
        method=method,
        modes=len(calibration.noll),
        noll=list(calibration.noll),
        condition_number=reconstruction.condition_number,
        singular_values=reconstruction.singular_values.tolist(),
        kept=reconstruction.kept.tolist(),
        frame_to_effect_ms=fields["delay_frames"] * config.period_ns * 1e-6,
        noise_gain_nm=factory.frame_noise_nm(config, calibration).tolist(),
        bad_pixels=int(np.count_nonzero(calibration.good == 0)),
        flux_dn=calibration.flux_dn,
        file=str(file),
        advice=[advice(reconstruction, calibration.noll, limit_nm)],
        **fields,
    )


def configured_delay(config: Configuration) -> float:
    """The configured delay, frames."""
    return config.control.delay_frames or config.camera.delay_frames


def judge(
    required_snr: float, cycles: int, error: Array, check: Check, noise_ratio: Array | None, noll: tuple[int, ...]
) -> Verdict:
    """Judge a reconstructor.

    Args:
        required_snr: Required signal-to-noise ratio.
        cycles: Number of cycles that the reconstructor was computed from.
        error: Standard error of the elements of each row of R H (modes,).
        check: Cross-talk from separate frames.
        noise_ratio: Noise per frame relative to the computed reconstructor (modes,); None without a computed one.
        noll: Noll index of each mode.
    """
    reached = 1 / max(float(error.max()), 1e-300)
    rms_limit, largest_limit = MAX_ELEMENT_RMS / required_snr, MAX_ELEMENT / required_snr
    faults = []
    if reached < required_snr:
        needed = cycles_for(required_snr, cycles, float(error.max()))
        faults.append(
            f"signal-to-noise ratio {reached:.3g} in Z{noll[int(error.argmax())]}, {required_snr:g} required: find "
            f"what disturbs this mode, or measure about {needed} cycles (repeat the command with --resume --snr "
            f"{required_snr:g} --cycles {needed})"
        )
    if not check.within(rms_limit, largest_limit):
        faults.append(
            f"cross-talk on separate frames: rms {check.rms:.3g} (limit {rms_limit:.3g}), largest {check.largest:.3g} "
            f"(limit {check.bound(largest_limit):.3g}, with noise): did the wavefront, the flux or the sensor "
            "change during the calibration?"
        )
    if noise_ratio is not None and noise_ratio.max() > MAX_NOISE_RATIO:
        faults.append(
            f"Z{noll[int(noise_ratio.argmax())]} has {noise_ratio.max():.2g} times the noise of the computed "
            f"reconstructor, expected at most {MAX_NOISE_RATIO:g}: is the sensor aligned (`lowfc calibrate align`), "
            "and the wavefront near its zero point?"
        )
    return Verdict(
        snr=required_snr,
        snr_reached=reached,
        check_cycles=check.cycles,
        check_cross_talk_rms=check.rms,
        check_cross_talk_max=check.largest,
        check_cross_talk_bound=check.bound(largest_limit),
        check_error=float(check.error.max()),
        promised_cross_talk_rms=rms_limit,
        promised_cross_talk_max=largest_limit,
        recommended=not faults,
        faults=faults,
    )


def comparison(first: Calibration, second: Calibration) -> Comparison:
    """Differences of two calibrations on their common good pixels: R of the first measures I0 and H of the second."""
    if not same_frames_and_modes(first, second):
        raise CalibrationError(
            "calibrations with different sensors or modes cannot be compared: the first has "
            f"{first.shape[0]} x {first.shape[1]} pixels and modes {_span(first)}, the second {second.shape[0]} x "
            f"{second.shape[1]} pixels and modes {_span(second)}"
        )
    bad_pixels = [int(np.count_nonzero(each.good == 0)) for each in (first, second)]
    with raised_as(CalibrationError, ValueError, "on the pixels that are good in both"):
        good = (first.good * second.good).astype(np.float64)
        first, second = on_pixels(first, good), on_pixels(second, good)
    R = first.reconstructor.astype(np.float64)
    talk = cross_talk(R, second.response)
    shift = R @ (second.reference - first.reference)
    return Comparison(
        modes=len(first.noll),
        noll=list(first.noll),
        estimators=[first.estimator, second.estimator],
        cross_talk=float(np.abs(talk).max()),
        gain=(1 + np.diag(talk)).tolist(),
        reference_shift_nm=shift.tolist(),
        flux_ratio=second.flux_dn / first.flux_dn,
        dark_shift_dn=float(np.median(second.dark - first.dark)),
        bad_pixels=bad_pixels,
        same_commands=np.array_equal(first.modes_to_actuators, second.modes_to_actuators),
    )


def _actuators_to_modes(config: Configuration, in_use: Calibration, matrix: Array, response: Array) -> Array:
    """Modes (modes, actuators) that R measures per nm of each actuator.

    The result agrees with the measurement for the mirror's modal shapes, and with the optical model for other shapes.

    A common factor between measurement and model, from the mirror's stroke or sign for example, also applies to other
    shapes. A negative factor is accepted only if focus or spherical is among the modes: a mirror of the opposite sign
    reverses all modes, but half a turn of most sensors reverses only odd modes, such as tip and tilt. If the sensor has
    another size or orientation than the model, the result for other shapes is that of the calibration in use, if it has
    such a matrix; otherwise other shapes are projected onto the modal shapes.
    """
    commands, previous = in_use.modes_to_actuators.astype(np.float64), in_use.actuators_to_modes.astype(np.float64)
    inverse, product = np.linalg.pinv(commands), matrix @ response  # R H is the identity unless R is regularised
    optics = factory.twin(config, None, lambda _: None)
    twin_image = twin_reference(optics)
    candidates = []
    if twin_image.shape == in_use.shape:
        on_nodes = factory.mirror_on_twin(config, optics, lambda _: None)
        modelled = factory.actuators_to_modes(
            matrix, twin_image.reshape(-1), in_use.good.astype(float), optics, on_nodes
        )
        if previous.size:
            modelled[:, ~previous.any(axis=0)] = 0  # actuators that are not active
        candidates.append(modelled)
    if previous.size:
        candidates.append(matrix @ np.linalg.pinv(in_use.reconstructor.astype(np.float64)) @ previous)
    symmetric = any(noll_to_orders(index)[1] == 0 for index in in_use.noll)
    for candidate in candidates:
        modes = candidate @ commands
        factor = float(np.vdot(modes, product)) / (float(np.vdot(modes, modes)) or 1.0)
        error = factor * modes - product
        if (factor > 0 or symmetric) and np.abs(error).max() < _MAX_MODEL_ERROR:
            return np.asarray(factor * candidate - error @ inverse)
    return np.asarray(product @ inverse)


def _span(calibration: Calibration) -> str:
    return f"Z{calibration.noll[0]} to Z{calibration.noll[-1]}"
