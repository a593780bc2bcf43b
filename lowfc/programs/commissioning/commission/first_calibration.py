"""The provisional calibration: from reference image, one or two pokes and computed response, or pokes of all modes."""

from dataclasses import replace
from typing import Any

import numpy as np

from lowfc.arrays import Array, single
from lowfc.contract.codecs.calibration_codec import with_identity
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError
from lowfc.control.calibration import poke_plan
from lowfc.control.calibration.alignment import align
from lowfc.control.calibration.calibration import FIRST_SUFFIX, Calibration
from lowfc.control.calibration.delay_fit import Delay
from lowfc.control.calibration.response_fit import correlation
from lowfc.programs.commissioning.calibrate.align import (
    MIN_CORRELATION,
    computed_scale,
    geometry_in_words,
    on_sensor,
    oriented,
)
from lowfc.programs.commissioning.calibrate.pokes import (
    AMPLITUDE_NM,
    HOLD,
    SETTLE,
    first_poke_plan,
    largest_amplitude_nm,
)
from lowfc.programs.commissioning.calibrate.recording import TRAILING_FRAMES, Player, PokesNotSeenError
from lowfc.programs.commissioning.calibrate.result import compute_reconstructor

FIRST_NM = AMPLITUDE_NM["poke"]
MAX_FIRST_NM = 32.0
"""Largest amplitude of the first pokes, nm rms of wavefront. The amplitude is doubled until pokes are detected."""
MAX_MISFIT = 0.35
"""Largest rms difference between the image and the fitted computed image at which the sensor counts as the configured
one, relative to the standard deviation of the image."""
CYCLES = 12  # cycles of pokes that measure the response without an optical model
MAX_NONLINEARITY = 0.1
"""Accepted relative difference of the gains at full and half amplitude, beyond `_STANDARD_ERRORS` of its errors."""
_STANDARD_ERRORS = 3.0  # number of standard errors


def first_delay(player: Player, config: Configuration, mode: int = 0) -> Delay:
    """Delay and image of a poke of one mode; the amplitude is increased until the poke is detected."""
    in_use, report = player.in_use, player.report
    amplitude_nm, max_nm = FIRST_NM, float(largest_amplitude_nm(config, in_use)[mode])
    while True:
        amplitude_nm = min(amplitude_nm, max_nm)
        try:
            delay = player.first_poke(mode, first_poke_plan(amplitude_nm))
            break
        except PokesNotSeenError:
            if amplitude_nm >= min(MAX_FIRST_NM, max_nm):
                raise
            report(f"pokes of {amplitude_nm:g} nm are not detected: amplitude doubled")
            amplitude_nm *= 2
    report(
        f"pokes of Z{in_use.noll[mode]} of {amplitude_nm:g} nm are detected after {delay.delay_frames:.3f} +- "
        f"{delay.error_frames:.3f} frames, {delay.delay_frames * config.period_ns * 1e-6:.3g} ms"
    )
    return delay


def aligned_calibration(
    player: Player, config: Configuration, computed: Calibration, first_poke: Delay, results: dict[str, Any]
) -> Calibration | None:
    """The computed calibration on the sensor's pixels, oriented by pokes of the first mode and, if needed, the second.

    None if the sensor is not the configured one; otherwise the sensor's geometry is added to `results`.
    """
    in_use, report = player.in_use, player.report
    image = (in_use.reference * in_use.flux_dn).reshape(in_use.shape).astype(np.float64)
    model = computed.reference.astype(np.float64).reshape(computed.shape)
    try:
        alignment = align(image, model, in_use.good.reshape(in_use.shape) > 0)
        calibration = on_sensor(config, computed, alignment.geometry, in_use)
    except (ValueError, CalibrationError) as error:
        report(f"the image cannot be compared with the computed one: {error}")
        return None
    poke_correlation = abs(correlation(first_poke.response, calibration.response[:, 0]))
    if alignment.residual <= MAX_MISFIT:  # otherwise another poke is of no use

        def poke(mode: int) -> Array:
            return (first_delay(player, config, mode) if mode else first_poke).response

        alignment, calibration, poke_correlation = oriented(config, computed, alignment, in_use, poke)
    scale = alignment.geometry.scale * computed_scale(config)
    report(
        f"{geometry_in_words(alignment, scale)}; correlation of the poke's image with the computed one: "
        f"{poke_correlation:.2f}"
    )
    if alignment.residual > MAX_MISFIT or poke_correlation < MIN_CORRELATION:
        report("this is not the configured sensor: the response is measured without the optical model")
        return None
    results |= {
        "pixels_per_lambda_d": scale,
        "rotation_deg": alignment.geometry.rotation_deg,
        "parity": alignment.geometry.parity,
        "image_residual": alignment.residual,
        "poke_correlation": poke_correlation,
    }
    calibration = replace(calibration, reference=in_use.reference, estimator=f"{calibration.estimator}{FIRST_SUFFIX}")
    return with_identity(calibration)


def poked_calibration(player: Player, config: Configuration, delay: Delay) -> Calibration:
    """A calibration from pokes of each mode, without an optical model."""
    in_use, modes = player.in_use, len(player.in_use.noll)
    amplitude_nm = min(FIRST_NM, float(largest_amplitude_nm(config, in_use).min()))
    response = np.zeros_like(in_use.response, dtype=np.float64)
    _report_time(player, config, CYCLES)
    for number in range(CYCLES):
        plan = _poke_cycle(modes, amplitude_nm, number)
        response += player.cycle(plan, delay.delay_frames).response / CYCLES
    calibration = replace(in_use, response=single(response), estimator=f"{config.control.estimator}+poke{FIRST_SUFFIX}")
    matrix = compute_reconstructor(config, calibration, None).matrix
    player.report(f"each mode was poked in {CYCLES} cycles, by {amplitude_nm:.3g} nm")
    return with_identity(replace(calibration, reconstructor=single(matrix)))


def linear_amplitude_nm(player: Player, config: Configuration, delay: Delay, default_nm: float) -> float:
    """Amplitude at which all modes may be poked at once, nm rms of each.

    It is `default_nm`, or half of it if pokes of single modes at two amplitudes show that the sensor is not linear.
    """
    provisional = player.in_use
    R, modes = provisional.reconstructor.astype(np.float64), len(provisional.noll)
    full_nm = min(FIRST_NM, float(largest_amplitude_nm(config, provisional).min()))
    gains = np.empty((2, 2, modes))
    _report_time(player, config, gains[..., 0].size)
    for level, amplitude_nm in enumerate((full_nm, full_nm / 2)):
        for repetition in range(2):
            plan = _poke_cycle(modes, amplitude_nm, repetition)
            gains[level, repetition] = np.diag(R @ player.cycle(plan, delay.delay_frames).response)
    difference = np.abs(gains[0].mean(axis=0) / gains[1].mean(axis=0) - 1)
    variance = gains.var(axis=1, ddof=1).mean(axis=0)  # of one gain; a difference of two means of two has the same
    error = np.sqrt(np.maximum(variance, variance.mean()))
    worst = int((difference - _STANDARD_ERRORS * error).argmax())
    chosen_nm = default_nm / 2 if difference[worst] > MAX_NONLINEARITY + _STANDARD_ERRORS * error[worst] else default_nm
    player.report(
        f"the gains at {full_nm:.3g} nm and at half of that differ by {difference[worst]:.1%} (+- {error[worst]:.1%}; "
        f"Z{provisional.noll[worst]}); amplitude of each mode: {chosen_nm:.3g} nm"
    )
    return chosen_nm


def _report_time(player: Player, config: Configuration, cycles: int) -> None:
    frames = len(_poke_cycle(len(player.in_use.noll), 1.0, 0)) + TRAILING_FRAMES
    player.report(f"{cycles} cycles of {frames} frames; about {cycles * frames / config.camera.rate_hz:.0f} s to go")


def _poke_cycle(modes: int, amplitude_nm: float, number: int) -> poke_plan.Plan:
    return poke_plan.cycle(poke_plan.poke_patterns(modes, amplitude_nm), HOLD, SETTLE, 16, backwards=number % 2 == 1)
