"""For how long a loop was not closed, and why: in Health, in the summary and in the status."""

from dataclasses import replace

from toy import DARK_DN, SATURATION_DN, SHAPE, START, frame, loaded, settings

from lowfc.contract.messages import wire
from lowfc.contract.state_codec import controller_state
from lowfc.control.camera import CameraSettings
from lowfc.control.loop import advance
from lowfc.programs.controller_report import NotClosed
from lowfc.programs.ctl import status
from lowfc.programs.status import summary_text
from lowfc.programs.watch import Watch, summary

USUAL = settings()
CAMERA = CameraSettings(START * 10**9, SHAPE, DARK_DN, SATURATION_DN)
SECOND = 10**9


def test_the_time_not_closed_and_its_cause_add_up() -> None:
    account, state = NotClosed(), loaded(USUAL)
    assert account.note(state, 0) == (0, "")
    for one in (CAMERA, frame(1)):
        state, _ = advance(USUAL, state, one)
    assert account.note(state, 1 * SECOND) == (0, ""), "closed from its first frame on"
    state, _ = advance(USUAL, state, replace(CAMERA, bias_dn=DARK_DN + 300))
    assert account.note(state, 2 * SECOND)[0] == 0
    total_ns, cause = account.note(state, 5 * SECOND)
    assert (total_ns, "bias_dn is 400" in cause) == (3 * SECOND, True)


def test_the_summary_and_the_status_say_it() -> None:
    health = wire.Health(not_closed_ns=3 * SECOND, not_closed_cause="the camera does not fit")
    text = summary_text(summary(Watch({"controller": health}, []), record=False))
    assert text.splitlines()[0] == "loop               not closed for 3.0 s: the camera does not fit"
    assert "closed all the time" in summary_text(summary(Watch({}, []), record=False))
    state = loaded(USUAL)
    for one in (CAMERA, frame(1), replace(CAMERA, bias_dn=DARK_DN + 300)):
        state, _ = advance(USUAL, state, one)
    message = controller_state(state, USUAL, (START + 12) * SECOND)
    mirror = wire.Health(command_refused=wire.REASON_OUT_OF_ORDER)
    lines = status.text(message, {"mirror-dm": mirror}).splitlines()
    assert lines[0].split(maxsplit=1)[1].startswith("open for 12 s (the camera does not fit the calibration: bias_dn")
    assert lines[1].split(maxsplit=1)[1] == "refuses commands: OUT_OF_ORDER"
    assert status.figures(message, {"dm": wire.Health(command_expired=True)})["mirrors"]["dm"]["expired"]
