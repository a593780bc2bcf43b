"""`lowfc acceptance noise-floor`: the white noise of each mode compared with photon and read noise."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from lowfc.adapters.files.factory import contrast_or_none, frame_noise_nm2
from lowfc.arrays import Array
from lowfc.contract.configuration import Configuration
from lowfc.control.laws import margins
from lowfc.control.laws.spectra import SHORTEST, TimeSeries, floor_nm2_hz, spectrum
from lowfc.control.loop.safety import LoopMode
from lowfc.optics.chain.zernike import mode_name
from lowfc.programs.cli.contrast import added_contrast, added_contrast_in_words
from lowfc.programs.cli.result import result_field
from lowfc.programs.commissioning.acceptance.live import Live
from lowfc.programs.commissioning.acceptance.probe import (
    AcceptanceError,
    AcceptanceResult,
    Kind,
    ModeResult,
    ProbeResponse,
)

KIND: Kind = "noise-floor"
_LOOPS = {"open": LoopMode.OPEN, "closed": LoopMode.CLOSED}


class NoiseMode(ModeResult):
    """White noise of a mode per frame, and the residual that this noise causes in closed loop, nm rms of wavefront."""

    expected_nm: float = result_field("expected", "nm", ".3f")
    open_nm: float = result_field("open", "nm", ".3f")
    closed_nm: float = result_field("closed", "nm", ".3f")
    residual_floor_nm: float = result_field("residual from noise", "nm", ".3f")
    open_rms_nm: float = result_field("error open", "nm", ".3f")
    closed_rms_nm: float = result_field("error closed", "nm", ".3f")


class NoiseResult(AcceptanceResult):
    """Noise floor of every mode."""

    noise_ratio: float = result_field("limit of noise / expected", form="g")
    law: str = result_field("law")
    frames: dict[str, int] = result_field()
    added_contrast: dict[str, Any] | None = result_field()
    modes: list[NoiseMode] = result_field("modes")

    def remarks(self) -> Sequence[str]:
        """Added contrast, and the verdict."""
        contrast = [] if self.added_contrast is None else [added_contrast_in_words(self.added_contrast)]
        return [*contrast, *super().remarks()]


def play(live: Live, *, duration_s: float) -> list[ProbeResponse]:
    """Record the loop without a probe: open, then closed, each for `duration_s` or at least `SHORTEST` frames."""
    frames = max(round(duration_s * live.loop.rate_hz), SHORTEST)
    live.expect(frames * len(_LOOPS))
    no_probe = np.zeros((frames, 0), np.float32)
    return [live.play(KIND, {"loop": name}, mode, no_probe) for name, mode in _LOOPS.items()]


def judge(responses: Sequence[ProbeResponse], configuration: Configuration) -> NoiseResult:
    """Evaluate the noise of both recordings; AcceptanceError if one is missing, too short or disturbed."""
    by_loop = {response.parameters["loop"]: response for response in responses}
    if set(by_loop) != set(_LOOPS):
        raise AcceptanceError(
            f"an open-loop and a closed-loop recording are needed, found {', '.join(by_loop) or 'none'}; the test was "
            "ended, or the log begins or ends within it: give all files of the log, or measure again"
        )
    noise_ratio = configuration.acceptance.noise_ratio
    floors, rms, expected = {}, {}, {}
    residual_nm2: dict[str, Array | None] = {}
    for name, response in by_loop.items():
        response.check(_LOOPS[name])
        error_nm = response.filled(response.error_nm)
        noise_nm2 = frame_noise_nm2(configuration, response.loop.calibration)
        expected[name] = np.sqrt(np.diag(noise_nm2))
        residual_nm2[name] = error_nm.T @ error_nm / len(error_nm) - noise_nm2
        floors[name] = _floor_nm(response)
        rms[name] = np.nanstd(response.error_nm, axis=0)
    loop = by_loop["closed"].loop
    gain = np.sqrt(margins.noise_gain(loop.linear, loop.delay_frames, continuous=True))
    modes = [
        NoiseMode(
            noll=noll,
            name=mode_name(noll),
            passed=all(floors[name][k] <= noise_ratio * expected[name][k] for name in _LOOPS),
            expected_nm=float(expected["closed"][k]),
            open_nm=float(floors["open"][k]),
            closed_nm=float(floors["closed"][k]),
            open_rms_nm=float(rms["open"][k]),
            closed_rms_nm=float(rms["closed"][k]),
            residual_floor_nm=float(floors["closed"][k] * gain[k]),
        )
        for k, noll in enumerate(loop.noll)
    ]
    return NoiseResult(
        test=KIND,
        passed=all(mode.passed for mode in modes),
        noise_ratio=noise_ratio,
        law=loop.name,
        frames={name: len(response.error_nm) for name, response in by_loop.items()},
        added_contrast=added_contrast(contrast_or_none(configuration), residual_nm2),
        modes=modes,
    )


def draw(result: dict[str, Any], figure: Any) -> None:
    """Draw measured and expected noise of each mode, and the residual that the noise causes."""
    ax = figure.subplots()
    x = np.arange(len(result["modes"]))
    for name, label, marker in (
        ("expected_nm", "expected per frame", "k_"),
        ("open_nm", "open per frame", "C0o"),
        ("closed_nm", "closed per frame", "C1s"),
        ("residual_floor_nm", "residual from noise", "C2^"),
    ):
        ax.semilogy(x, [mode[name] for mode in result["modes"]], marker, label=label)
    ax.set_xticks(x, [f"Z{mode['noll']}" for mode in result["modes"]])
    ax.set_ylabel("nm rms of wavefront")
    ax.grid(alpha=0.3)
    ax.legend()


def _floor_nm(response: ProbeResponse) -> Array:
    """White noise (modes,) per frame, nm, from the pseudo-open-loop modes, which the loop does not filter."""
    power = spectrum(TimeSeries((response.filled(response.pol_nm),), 0), response.loop.rate_hz)
    if power is None:
        raise AcceptanceError(f"{len(response.pol_nm)} frames are too few for a spectrum, {SHORTEST} are needed")
    return np.asarray(np.sqrt(floor_nm2_hz(power) * response.loop.rate_hz / 2))
