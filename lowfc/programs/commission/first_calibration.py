"""A first calibration, from the image of one poke and the computed response, or from pokes of all modes."""

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.adapters import instrument
from lowfc.contract.calibration_codec import identified
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError
from lowfc.control import poke_plan
from lowfc.control.alignment import align
from lowfc.control.calibration import Calibration
from lowfc.control.delay_fit import Delay
from lowfc.control.regularised import reconstruct
from lowfc.control.response_fit import cycle_response, normalised
from lowfc.programs.calibrate.align import computed_scale, on_sensor
from lowfc.programs.calibrate.first_poke import PokesNotSeenError, first_poke, sequence
from lowfc.programs.calibrate.recording import AFTERWARDS, Loop, PlayInterruptedError, play
from lowfc.programs.commission.first_light import Say

Array = npt.NDArray[np.float64]

FIRST_NM = 8.0
MAX_FIRST_NM = 32.0
"""Amplitude of the first pokes, wavefront rms: doubled until they are seen, up to this."""
MAX_MISFIT = 0.35
"""Part of the image that the computed one may leave; more is another sensor."""
MIN_LIKENESS = 0.5
"""Correlation of a poke's image with the computed one; less is another sensor."""
CYCLES = 12
HOLD, SETTLE = 4, 2
MAX_NOT_LINEAR = 0.1
_SURE = 3.0
_OF_THE_SLEW = 0.8
_FAILURES = 5


class First(NamedTuple):
    """A calibration to begin with, and how it was found."""

    calibration: Calibration
    figures: dict[str, Any]


def first_delay(loop: Loop, config: Configuration, before: Calibration, say: Say) -> Delay:
    """The delay, and the image of a poke of the first mode: pokes that grow until they are seen.

    Raises:
        CalibrationError: no poke is seen, or frames are lost.
    """
    amplitude_nm, largest_nm = FIRST_NM, largest_poke_nm(config, before, 0)
    while True:
        amplitude_nm = min(amplitude_nm, largest_nm)
        try:
            found = first_poke(loop, before, 0, sequence(amplitude_nm), say)
            break
        except PokesNotSeenError:
            if amplitude_nm >= min(MAX_FIRST_NM, largest_nm):
                raise
            say(f"pokes of {amplitude_nm:g} nm are not seen: twice as large")
            amplitude_nm *= 2
    say(
        f"pokes of Z{before.noll[0]} of {amplitude_nm:g} nm are seen after {found.delay_frames:.3f} +- "
        f"{found.error_frames:.3f} frames, {found.delay_frames * config.period_ns * 1e-6:.3g} ms"
    )
    return found


def largest_poke_nm(config: Configuration, before: Calibration, mode: int) -> float:
    """Amplitude at which the mirror goes from push to pull within its slew limit, wavefront rms."""
    slew_nm = min(config.safety.slew_nm, config.mirror.slew_nm)
    steepest = float(np.abs(before.modes_to_actuators[:, mode]).max())
    return _OF_THE_SLEW * slew_nm / (2 * max(steepest, 1e-9))


def aligned(config: Configuration, computed: Calibration, before: Calibration, poke: Delay, say: Say) -> First | None:
    """The computed calibration on the sensor's pixels, with the sign that the poke shows; None for another sensor.

    Args:
        config: The loop's.
        computed: Of the optical model.
        before: Has dark, good pixels and reference.
        poke: Of the first mode.
        say: For people.
    """
    image = (before.reference * before.flux_dn).reshape(before.shape).astype(np.float64)
    model = computed.reference.astype(np.float64).reshape(computed.shape)
    try:
        found = align(image, model)
        made = on_sensor(config, computed, found.geometry, before.flux_dn, before.shape, before)
    except (ValueError, CalibrationError) as error:
        say(f"the image is not compared with the computed one: {error}")
        return None
    like = _likeness(poke.picture, made.response[:, 0])
    geometry = found.geometry
    if like < 0:
        geometry = geometry.turned()
        made = on_sensor(config, computed, geometry, before.flux_dn, before.shape, before)
        like = _likeness(poke.picture, made.response[:, 0])
    scale = geometry.scale * computed_scale(config)
    say(
        f"{scale:.3f} pixels per lambda/D, centre at row {geometry.row:.1f}, column {geometry.column:.1f}, rotation "
        f"{geometry.rotation_deg:.1f} degrees, {'reflected' if geometry.parity < 0 else 'not reflected'}; "
        f"{found.residual:.0%} of the image is left, the poke's image correlates by {like:.2f} with the computed one"
    )
    if found.residual > MAX_MISFIT or like < MIN_LIKENESS:
        say("this is not the configured sensor: the response is measured without the optical model")
        return None
    found_figures = {
        "pixels_per_lambda_d": scale,
        "rotation_deg": geometry.rotation_deg,
        "parity": geometry.parity,
        "image_residual": found.residual,
        "poke_correlation": like,
    }
    return First(identified(replace(made, reference=before.reference)), found_figures)


def poked(loop: Loop, config: Configuration, before: Calibration, poke: Delay, say: Say) -> First:
    """A calibration of each mode's own pokes, without an optical model.

    Raises:
        CalibrationError: frames are lost, or the sensor cannot tell the modes apart.
    """
    modes = len(before.noll)
    amplitude_nm = min(FIRST_NM, *(largest_poke_nm(config, before, mode) for mode in range(modes)))
    response = np.zeros_like(before.response, dtype=np.float64)
    _say_time(config, modes, CYCLES, say)
    for number in range(CYCLES):
        response += _response(loop, before, _poke_cycle(modes, amplitude_nm, number), poke.delay_frames) / CYCLES
    camera = instrument.detector(config)
    good, reference = before.good.astype(np.float64), before.reference.astype(np.float64)
    try:
        matrix = reconstruct(
            reference,
            response,
            None,
            good,
            before.flux_dn * camera.gain_e_per_dn / camera.em_gain,
            instrument.equivalent_read_noise_e(camera),
        ).matrix
    except ValueError as error:
        raise CalibrationError(str(error)) from None
    say(f"{CYCLES} pokes of each mode by {amplitude_nm:.3g} nm")
    made = replace(
        before,
        response=response.astype(np.float32),
        reconstructor=np.ascontiguousarray(matrix, np.float32),
        estimator=f"{config.control.estimator}+poke",
    )
    return First(identified(made), {})


def linear_nm(loop: Loop, config: Configuration, first: Calibration, delay: Delay, usual_nm: float, say: Say) -> float:
    """Amplitude at which all modes may be poked at once, nm rms of each.

    It is the usual one, halved where single pokes and those of half their amplitude show a sensor that is not linear.

    Raises:
        CalibrationError: frames are lost.
    """
    R, modes = first.reconstructor.astype(np.float64), len(first.noll)
    largest_nm = min(FIRST_NM, *(largest_poke_nm(config, first, mode) for mode in range(modes)))
    gains = np.empty((2, 2, modes))
    _say_time(config, modes, gains[..., 0].size, say)
    for level, amplitude_nm in enumerate((largest_nm, largest_nm / 2)):
        for again in range(2):
            plan = _poke_cycle(modes, amplitude_nm, again)
            gains[level, again] = np.diag(R @ _response(loop, first, plan, delay.delay_frames))
    off = np.abs(gains[0].mean(axis=0) / gains[1].mean(axis=0) - 1)
    error = float(np.sqrt(np.mean(np.diff(gains, axis=1) ** 2) / 2))  # of the mean of two, doubled: two amplitudes
    worst = int(off.argmax())
    chosen_nm = usual_nm / 2 if off[worst] > MAX_NOT_LINEAR + _SURE * error else usual_nm
    say(
        f"pokes of {largest_nm:.3g} nm and of half of it answer alike within {off[worst]:.1%} (+- {error:.1%}; "
        f"Z{first.noll[worst]}): {chosen_nm:.3g} nm in each mode"
    )
    return chosen_nm


def _say_time(config: Configuration, modes: int, cycles: int, say: Say) -> None:
    frames = len(_poke_cycle(modes, 1.0, 0)) + AFTERWARDS
    say(f"{cycles} cycles of {frames} frames; about {cycles * frames / config.camera.rate_hz:.0f} s to go")


def _poke_cycle(modes: int, amplitude_nm: float, number: int) -> poke_plan.Plan:
    """Pokes of each mode by itself; every other cycle backwards."""
    return poke_plan.cycle(poke_plan.poke_patterns(modes, amplitude_nm), HOLD, SETTLE, 16, backwards=number % 2 == 1)


def _response(loop: Loop, before: Calibration, plan: poke_plan.Plan, delay_frames: float) -> Array:
    for failures in range(1, _FAILURES + 1):
        try:
            recording = play(loop, before.modes_to_actuators.T, plan.table)
            fractions, flux = normalised(recording.pixels, before.dark.astype(float), before.good.astype(float))
            seen = recording.played(plan.table, delay_frames)
            used = recording.usable(plan, delay_frames).astype(np.float64)
            return cycle_response(fractions, flux, seen, seen, used).response
        except (PlayInterruptedError, ValueError) as error:
            if failures == _FAILURES:
                raise CalibrationError(f"{failures} cycles in a row were of no use: {error}") from None
    raise AssertionError


def _likeness(picture: Array, response: npt.NDArray[np.floating]) -> float:
    norms = float(np.linalg.norm(picture) * np.linalg.norm(response))
    return float(picture @ response) / max(norms, 1e-300)
