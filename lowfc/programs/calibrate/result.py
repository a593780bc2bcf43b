"""What a measured calibration is: the file's content, its figures, and the text about them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lowfc.adapters import instrument
from lowfc.contract.calibration_codec import identified
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import CalibrationError
from lowfc.control.actuator_response import actuators_to_modes, of_commands
from lowfc.control.calibration import Calibration, comparable
from lowfc.control.delay_fit import Delay
from lowfc.control.regularised import Reconstruction, reconstruct
from lowfc.control.response_fit import LinearRange, Measured, cross_talk
from lowfc.optics.twin import reference as twin_reference
from lowfc.optics.twin import response as twin_response
from lowfc.optics.twin_mirror import wavefront_nm
from lowfc.programs.calibrate.verdict import Verdict

Array = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]


def measured_calibration(
    config: Configuration,
    before: Calibration,
    taken: Measured,
    method: str,
    truncate: float,
    tikhonov: float,
) -> tuple[Calibration, Reconstruction]:
    """The calibration that cycles of pokes give, with the dark, the mask and the commands of the one before.

    Raises:
        CalibrationError: H is not above its noise.
    """
    camera = instrument.detector(config)
    I0 = taken.reference if taken.reference is not None else before.reference.astype(np.float64)
    try:
        made = reconstruct(
            I0,
            taken.response,
            taken.initial.matrix,
            before.good.astype(np.float64),
            taken.flux_dn * camera.gain_e_per_dn / camera.em_gain,
            instrument.equivalent_read_noise_e(camera),
            truncate=truncate,
            tikhonov=tikhonov,
        )
    except ValueError as error:
        raise CalibrationError(str(error)) from None
    names = dict.fromkeys([*taken.initial.estimator.split("+"), method])
    calibration = replace(
        before,
        reference=_single(I0),
        response=_single(taken.response),
        reconstructor=_single(made.matrix),
        flux_dn=taken.flux_dn,
        estimator="+".join(names),
        operator_hash="",
        actuators_to_modes=_single(_seen_of_actuators(config, before, made.matrix)),
    )
    return identified(calibration), made


def computed_noise_nm(config: Configuration, calibration: Calibration, computed: Calibration) -> Array | None:
    """Noise (modes,) that a computed reconstructor has on the light of a calibration, nm; None for another sensor's."""
    if not comparable(calibration, computed):
        return None
    return instrument.frame_noise_nm(
        config, replace(calibration, reconstructor=computed.reconstructor * calibration.good)
    )


def figures(
    config: Configuration,
    calibration: Calibration,
    made: Reconstruction,
    method: str,
    taken: Measured | None,
    delay: Delay | None,
    linear: LinearRange | None,
    computed: Calibration | None,
    verdict: Verdict | None,
    file: Path,
) -> dict[str, Any]:
    """What `--json` prints; figures of each mode are in the order of `noll`."""
    found: dict[str, Any] = {
        "method": method,
        "modes": len(calibration.noll),
        "noll": list(calibration.noll),
        "condition_number": made.condition_number,
        "singular_values": made.singular_values.tolist(),
        "kept": made.kept.tolist(),
        "delay_frames": delay.delay_frames if delay is not None else configured_delay(config),
        "delay_error_frames": delay.error_frames if delay is not None else 0.0,
        "frame_to_effect_ms": (delay.delay_frames if delay is not None else configured_delay(config))
        * config.period_ns
        * 1e-6,
        "noise_gain_nm": instrument.frame_noise_nm(config, calibration).tolist(),
        "bad_pixels": int(np.count_nonzero(calibration.good == 0)),
        "flux_dn": calibration.flux_dn,
        "cycles": taken.cycles if taken is not None else 0,
        "file": str(file),
    }
    noise = None if computed is None else computed_noise_nm(config, calibration, computed)
    if taken is not None and computed is not None and noise is not None:
        found["cross_talk"] = float(np.abs(cross_talk(calibration.reconstructor, computed.response)).max())
        found["cross_talk_error"] = float(taken.error.max())
        found["computed_noise_nm"] = noise.tolist()
    if verdict is not None:
        found |= verdict.figures()
    if linear is not None:
        found["linear_range_nm"] = linear.range_nm.tolist()
    return found


def configured_delay(config: Configuration) -> float:
    """The delay that the loop counts with."""
    return config.control.delay_frames or config.camera.delay_frames


def text_of(found: dict[str, Any]) -> str:
    """Figures for people."""
    lines = [
        f"{found['method']}: {found['modes']} modes, condition number {found['condition_number']:.3g}",
        f"delay {found['delay_frames']:.3f} frames"
        + (f" +- {found['delay_error_frames']:.3f}" if found["delay_error_frames"] else " (configured)")
        + f": {found['frame_to_effect_ms']:.3g} ms from a frame to the one that shows its effect",
    ]
    if "cross_talk" in found:
        lines.append(
            f"cross-talk against the computed H: at most {found['cross_talk']:.4f} (standard error "
            f"{found['cross_talk_error']:.4f}); where the wavefront is not flat, H is another one"
        )
    lines.append("singular values " + " ".join(f"{value:.3g}" for value in found["singular_values"]))
    computed, ranges = found.get("computed_noise_nm"), found.get("linear_range_nm")
    lines.append(
        f"{'mode':>5} {'noise of a frame, nm':>22}"
        + (f" {'computed, nm':>14}" if computed else "")
        + (f" {'linear up to, nm':>18}" if ranges else "")
    )
    for place, (index, noise) in enumerate(zip(found["noll"], found["noise_gain_nm"], strict=True)):
        expected = f" {computed[place]:14.3g}" if computed else ""
        reach = f" {ranges[place]:18.1f}" if ranges else ""
        lines.append(f"{'Z' + str(index):>5} {noise:22.3g}{expected}{reach}")
    lines.append(f"written: {found['file']}")
    return "\n".join(lines)


def comparison(one: Calibration, other: Calibration) -> dict[str, Any]:
    """How two calibrations differ; what is of each mode is in the order of `noll`.

    Raises:
        CalibrationError: they are of different sensors or modes.
    """
    if not comparable(one, other):
        raise CalibrationError(
            f"they cannot be compared: {one.shape[0]} x {one.shape[1]} pixels and modes {_span(one)} against "
            f"{other.shape[0]} x {other.shape[1]} and {_span(other)}"
        )
    both = (one.good * other.good).astype(np.float64)
    R = one.reconstructor.astype(np.float64)
    talk = cross_talk(R, other.response)
    shift = R @ ((other.reference - one.reference) * both)
    commands = one.modes_to_actuators, other.modes_to_actuators
    return {
        "modes": len(one.noll),
        "noll": list(one.noll),
        "cross_talk": float(np.abs(talk).max()),
        "gain": (1 + np.diag(talk)).tolist(),
        "reference_shift_nm": shift.tolist(),
        "flux_ratio": other.flux_dn / one.flux_dn,
        "dark_shift_dn": float(np.median(other.dark - one.dark)),
        "bad_pixels": [int(np.count_nonzero(each.good == 0)) for each in (one, other)],
        "same_commands": bool(commands[0].shape == commands[1].shape and np.array_equal(*commands)),
        "estimators": [one.estimator, other.estimator],
    }


def comparison_text(found: dict[str, Any], names: tuple[str, str]) -> str:
    """A comparison for people."""
    lines = [
        f"{names[0]} ({found['estimators'][0]}) reads the modes of {names[1]} ({found['estimators'][1]}):",
        f"largest cross-talk {found['cross_talk']:.4f}",
        f"{'mode':>5} {'gain':>8} {'zero point, nm':>15}",
    ]
    for index, gain, shift in zip(found["noll"], found["gain"], found["reference_shift_nm"], strict=True):
        lines.append(f"{'Z' + str(index):>5} {gain:8.4f} {shift:15.3f}")
    lines.append(
        f"flux {found['flux_ratio']:.4f} times, dark {found['dark_shift_dn']:+.2f} DN, bad pixels "
        f"{found['bad_pixels'][0]} and {found['bad_pixels'][1]}, commands "
        + ("the same" if found["same_commands"] else "different")
    )
    return "\n".join(lines)


def _seen_of_actuators(config: Configuration, before: Calibration, matrix: Array) -> Array:
    """Z (modes, actuators): of the commands what was measured, of other shapes what the optical model says."""
    commands = before.modes_to_actuators.astype(np.float64)
    measured = of_commands(commands)
    optics = instrument.twin(config, None, lambda _: None)
    light = twin_reference(optics)
    if light.shape != before.shape:
        return measured
    on_nodes = instrument.mirror_on_twin(config, optics, lambda _: None)
    pokes = np.eye(len(commands), dtype=np.float32).reshape(-1, *before.grid)
    wavefronts = np.array([wavefront_nm(on_nodes, poke) for poke in pokes])
    good = before.good.astype(np.float64)
    modelled = actuators_to_modes(
        matrix, light.reshape(-1), good, lambda shapes: twin_response(optics, shapes), wavefronts
    )
    if before.actuators_to_modes.size:
        modelled[:, ~before.actuators_to_modes.any(axis=0)] = 0  # actuators that are not active
    return np.asarray(measured + modelled - (modelled @ commands) @ measured)


def _span(calibration: Calibration) -> str:
    return f"Z{calibration.noll[0]} to Z{calibration.noll[-1]}"


def _single(array: Array) -> Single:
    return np.ascontiguousarray(array, dtype=np.float32)
