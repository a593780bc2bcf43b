"""One mode poked in a pseudo-random sequence: the delay, and the image of the poke."""

from lowfc.contract.errors import CalibrationError
from lowfc.control import poke_plan
from lowfc.control.calibration import Calibration
from lowfc.control.delay_fit import Delay, NotSeenError, measure_delay
from lowfc.control.response_fit import normalised
from lowfc.programs.calibrate.frame_count import Say
from lowfc.programs.calibrate.recording import Loop, PlayInterruptedError, play


class PokesNotSeenError(CalibrationError):
    """Pokes have no answer in the frames: they may be too small."""


FRAMES = 600
ATTEMPTS = 5


def sequence(amplitude_nm: float, seed: int = 1) -> poke_plan.Plan:
    """The sequence of pokes of one mode, of this amplitude (wavefront rms)."""
    return poke_plan.dither(1, amplitude_nm, FRAMES, 1, seed)


def first_poke(
    loop: Loop, before: Calibration, mode: int, plan: poke_plan.Plan, say: Say, *, closed: bool = False
) -> Delay:
    """Poke one mode.

    Args:
        loop: To play on.
        before: Has dark, good pixels, reference and the mirror's commands; its response is not needed.
        mode: Place of the mode.
        plan: As from `sequence`.
        say: For people.
        closed: The loop works against the pokes.

    Raises:
        CalibrationError: no poke is seen, or there was no run without a lost frame.
    """
    for _ in range(ATTEMPTS):
        try:
            recording = play(loop, before.modes_to_actuators.T[mode : mode + 1], plan.table)
        except PlayInterruptedError as error:
            say(f"once more: {error}")
            continue
        if recording.whole:
            break
        say("frames were lost or refused while the delay was measured: once more")
    else:
        raise CalibrationError(
            f"in {ATTEMPTS} attempts there was no run of {len(plan)} frames without a lost or refused one: "
            "`lowfc doctor` looks for why"
        )
    command = recording.command_nm[: len(plan), mode] if closed else None
    try:
        fractions, _ = normalised(recording.pixels, before.dark.astype(float), before.good.astype(float))
        return measure_delay(fractions[: len(plan)], before.reference.astype(float), plan.table[:, 0], command)
    except NotSeenError as error:
        raise PokesNotSeenError(str(error)) from None
    except ValueError as error:
        raise CalibrationError(str(error)) from None
