"""One mode poked in a pseudo-random sequence: the delay, and the image of the poke."""

from lowfc.contract.errors import CalibrationError
from lowfc.control import poke_plan
from lowfc.control.calibration import Calibration
from lowfc.control.delay_fit import Delay, measure_delay
from lowfc.control.response_fit import normalised
from lowfc.programs.calibrate.recording import Loop, PlayInterruptedError, play

FRAMES = 600
ATTEMPTS = 5


def first_poke(loop: Loop, before: Calibration, mode: int, amplitude_nm: float, seed: int = 1) -> Delay:
    """Poke one mode of an open loop.

    Args:
        loop: To play on.
        before: Has dark, good pixels, reference and the mirror's commands; its response is not needed.
        mode: Place of the mode.
        amplitude_nm: Of wavefront, rms.
        seed: Of the sequence.

    Raises:
        CalibrationError: no poke is seen, or there was no run without a lost frame.
    """
    plan = poke_plan.dither(1, amplitude_nm, FRAMES, 1, seed)
    why = "frames were lost or refused"
    for _ in range(ATTEMPTS):
        try:
            recording = play(loop, before.modes_to_actuators.T[mode : mode + 1], plan.table)
        except PlayInterruptedError as error:
            why = str(error)
            continue
        if recording.whole:
            break
    else:
        raise CalibrationError(
            f"in {ATTEMPTS} attempts there was no run of {FRAMES} frames without a lost or refused one ({why}): "
            "`lowfc doctor` looks for why"
        )
    try:
        fractions, _ = normalised(recording.pixels, before.dark.astype(float), before.good.astype(float))
        return measure_delay(fractions[:FRAMES], before.reference.astype(float), plan.table[:, 0])
    except ValueError as error:
        raise CalibrationError(str(error)) from None
