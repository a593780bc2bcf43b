"""A calibration taken into use: the mirror stays where it is, whatever changes."""

from lowfc.control.calibration import Calibration
from lowfc.control.inputs import Raised
from lowfc.control.safety import LoopMode
from lowfc.control.state import Drive, Settings, State


def loaded(settings: Settings, state: State, calibration: Calibration, source: str) -> tuple[State, list[Raised]]:
    """The state under another calibration, and what there is to say of it.

    Where the mirror has the same grid, its shape stays: the channels as they are, and the rest as a command of the new
    modes. Offset, play and a law of other modes are of no meaning any more.
    """
    drive, before = Drive.at_rest(settings, calibration), state.drive
    if before is not None and before.actuators_nm.shape == calibration.grid:
        shape_nm = before.actuators_nm
        same = before.calibration.noll == calibration.noll
        if before.additions is not None:
            shape_nm = shape_nm - before.additions.sum_nm
            additions = drive.added().at(before.additions.channels, drive.to_modes)
            if same:
                additions = additions._replace(offset_nm=before.additions.offset_nm)
            additions = additions.passed(len(additions.shifts_nm))
            drive = drive._replace(additions=additions)
        command_nm = drive.inverse @ shape_nm.reshape(-1)
        drive = drive._replace(
            law=before.law if same else drive.law,
            following=before.following if same else None,
            actuators_nm=before.actuators_nm,
            history_nm=(command_nm,) * len(drive.history_nm),
        )
    mode = settings.start_mode if state.mode is LoopMode.IDLE else state.mode
    details: dict[str, object] = {
        "id": calibration.id[:12],
        "modes": len(calibration.noll),
        "estimator": calibration.estimator,
        "source": source,
    }
    events = [Raised("CALIBRATION_LOADED", details)]
    if mode is not state.mode:
        events.append(mode_event(state.mode, mode, "a calibration was loaded"))
    return state._replace(mode=mode, drive=drive), events


def mode_event(before: LoopMode, after: LoopMode, why: str) -> Raised:
    """The event of a loop mode that changed."""
    return Raised("MODE_CHANGED", {"before": before.name.lower(), "after": after.name.lower(), "why": why})
