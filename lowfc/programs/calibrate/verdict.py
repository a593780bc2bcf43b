"""Whether a measured reconstructor is recommended."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from lowfc.control.response_fit import MOST_LARGEST, MOST_RMS, Check
from lowfc.programs.calibrate.pokes import cycles_for

Array = npt.NDArray[np.float64]

MOST_NOISE = 1.5
"""Times the noise of the computed reconstructor on the same light; farther from flat the sensor sees less."""


class Verdict(NamedTuple):
    """What is wrong with a reconstructor.

    Attributes:
        asked_snr: what it is judged by.
        reached_snr: of the noisiest mode, from the scatter of the cycles.
        check: its cross-talk on frames that were not used for it.
        faults: sentences; none where it is recommended.
    """

    asked_snr: float
    reached_snr: float
    check: Check
    faults: tuple[str, ...]

    def figures(self) -> dict[str, Any]:
        """What `--json` prints."""
        return {
            "snr": self.asked_snr,
            "snr_reached": self.reached_snr,
            "check_cycles": self.check.cycles,
            "check_cross_talk_rms": self.check.rms,
            "check_cross_talk_max": self.check.largest,
            "check_error": float(self.check.error.max()),
            "promised_cross_talk_rms": MOST_RMS / self.asked_snr,
            "promised_cross_talk_max": MOST_LARGEST / self.asked_snr,
            "recommended": not self.faults,
            "faults": list(self.faults),
        }


def judge(
    asked_snr: float, cycles: int, error: Array, check: Check, noise_ratio: Array | None, noll: tuple[int, ...]
) -> Verdict:
    """Judge a reconstructor.

    Args:
        asked_snr: signal-to-noise ratio that it must have.
        cycles: that it was made from.
        error: (modes,) standard error of the elements of each row of R H.
        check: its cross-talk on other frames.
        noise_ratio: (modes,) its noise in a frame over that of the computed one; None where there is none to compare.
        noll: Noll index of each mode.
    """
    reached = 1 / max(float(error.max()), 1e-300)
    rms, largest = MOST_RMS / asked_snr, MOST_LARGEST / asked_snr
    faults = []
    if reached < asked_snr:
        needed = cycles_for(asked_snr, cycles, float(error.max()))
        faults.append(
            f"signal-to-noise ratio {reached:.3g} in Z{noll[int(error.argmax())]}, {asked_snr:g} was to be reached: "
            f"find what shakes this mode, or take about {needed} cycles (the same command with --resume --cycles "
            f"{needed})"
        )
    if not check.within(rms, largest):
        faults.append(
            f"cross-talk on frames that were not used for it: rms {check.rms:.3g} and at most {check.largest:.3g}, "
            f"where {rms:.3g} and {largest:.3g} is expected; did the wavefront, the light or the sensor change "
            "meanwhile?"
        )
    if noise_ratio is not None and noise_ratio.max() > MOST_NOISE:
        faults.append(
            f"Z{noll[int(noise_ratio.argmax())]} has {noise_ratio.max():.2g} times the noise of the computed "
            f"reconstructor, at most {MOST_NOISE:g} is expected: is the sensor aligned (`lowfc calibrate align`), the "
            "wavefront near its zero point?"
        )
    return Verdict(asked_snr, reached, check, tuple(faults))


def text_of(found: dict[str, Any]) -> str:
    """The verdict in figures, for people."""
    checked = (
        f"signal-to-noise ratio {found['snr_reached']:.3g}; cross-talk on {found['check_cycles']} cycles that were not "
        f"used for it: rms {found['check_cross_talk_rms']:.3g}, at most {found['check_cross_talk_max']:.3g} (noise "
        f"{found['check_error']:.2g}); promised: rms {found['promised_cross_talk_rms']:.3g}, at most "
        f"{found['promised_cross_talk_max']:.3g}"
    )
    if found["recommended"]:
        return f"{checked}\nverdict: good"
    return "\n".join([checked, "verdict: NOT RECOMMENDED", *(f"  {fault}" for fault in found["faults"])])
