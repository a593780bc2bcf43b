"""Whoever reads a controller's state from the wire goes on as the controller does, to the bit."""

from dataclasses import fields

import numpy as np
import pytest
from happenings import CALIBRATION, TIGHT, inputs
from hypothesis import given
from hypothesis import settings as effort
from hypothesis import strategies as st
from toy import frame, loaded, settings

from lowfc.contract import codec
from lowfc.contract.calibration_codec import decode_calibration, encode_calibration
from lowfc.contract.messages import wire
from lowfc.contract.state_codec import controller_state, decode_state
from lowfc.control.inputs import CameraSettings, Frame, Input, Load, MirrorShape, Outputs, Request, Tick
from lowfc.control.loop import advance
from lowfc.control.state import Settings, State


def said(outputs: Outputs, taken: int) -> tuple[object, ...]:
    """Everything that an input gave rise to, as bytes."""
    step = codec.encode_step(outputs.step, taken) if outputs.step else b""
    command = codec.encode_command(outputs.command, 1, "c", taken) if outputs.command else b""
    return step, command, outputs.reply, outputs.events


def fold(what: Settings, state: State, taken: list[Input]) -> tuple[State, list[tuple[object, ...]]]:
    heard = []
    for one in taken:
        state, outputs = advance(what, state, one)
        heard.append(said(outputs, state.taken))
    return state, heard


@effort(deadline=None)
@given(inputs(), inputs(), st.sampled_from(["hold", "flat"]), st.sampled_from([1.0, 1.4, 3.0]))
def test_a_state_from_the_wire_goes_on_as_the_one_that_was_sent(
    before: list[Input], after: list[Input], silence: str, delay_frames: float
) -> None:
    what = settings(silence=silence, delay_frames=delay_frames, **TIGHT)
    state, _ = advance(what, State(), Load(0, CALIBRATION, "a test"))
    state, _ = fold(what, state, before)
    sent = controller_state(state, what, 77).SerializeToString()
    again, resumed = decode_state(wire.ControllerState.FromString(sent), CALIBRATION)
    assert again == what
    assert controller_state(resumed, again, 77).SerializeToString() == sent
    there, heard = fold(what, state, after)
    here, heard_here = fold(again, resumed, after)
    assert heard_here == heard
    assert (
        controller_state(here, again, 78).SerializeToString() == controller_state(there, what, 78).SerializeToString()
    )


def test_a_state_without_a_calibration_survives() -> None:
    what = settings()
    state, _ = advance(what, State(), frame(3))
    again, resumed = decode_state(controller_state(state, what, 1), None)
    assert (again, resumed) == (what, state._replace(counts=dict(state.counts)))


def test_a_state_of_another_calibration_is_refused() -> None:
    message = controller_state(loaded(settings()), settings(), 1)
    with pytest.raises(ValueError, match="calibration toy of the controller's state is not there"):
        decode_state(message, None)
    with pytest.raises(ValueError, match="is not there"):
        decode_state(message, CALIBRATION)
    message.calibration_id = CALIBRATION.id
    del message.gain[0]
    with pytest.raises(ValueError, match=r"as long as each other|is not of 3 modes"):
        decode_state(message, CALIBRATION)


@pytest.mark.parametrize(
    "taken",
    [
        Tick(5, 7),
        CameraSettings(5, (3, 4), 100.0, 65535.0),
        MirrorShape(5, np.arange(6, dtype=np.float32).reshape(2, 3), np.ones(2, np.float32)),
        Load(5, CALIBRATION, "a file"),
    ],
    ids=lambda one: type(one).__name__,
)
def test_an_input_survives(taken: MirrorShape | CameraSettings | Load | Tick) -> None:
    message = wire.ControlInput.FromString(codec.encode_input(taken, 9))
    assert message.taken == 9
    found = codec.decode_input(message, {CALIBRATION.id: CALIBRATION})
    assert type(found) is type(taken)
    for field in fields(taken):
        assert np.array_equal(getattr(found, field.name), getattr(taken, field.name)), field.name
    with pytest.raises(ValueError, match="input 0 of the controller cannot be read"):
        codec.decode_input(wire.ControlInput(), {})


def test_a_calibration_survives() -> None:
    message = wire.Calibration.FromString(encode_calibration(CALIBRATION, 5))
    found = decode_calibration(message)
    for field in fields(CALIBRATION):
        assert np.array_equal(getattr(found, field.name), getattr(CALIBRATION, field.name)), field.name
    message.flux_dn += 1
    with pytest.raises(ValueError, match="is not whole: its content has another identity"):
        decode_calibration(message)


def test_only_what_makes_a_difference_is_counted() -> None:
    what = settings()
    state = loaded(what)
    camera = CameraSettings(1, CALIBRATION.shape, 100.0, CALIBRATION.saturation_dn)
    state, _ = fold(what, state, [Tick(1, 1), camera])
    assert state.taken == 2
    state, _ = fold(what, state, [Tick(1, 1), camera])
    assert state.taken == 2
    different: list[Input] = [frame(1), Tick(1, 1), Request(1, "open"), frame(2)._replace(pixels=None)]
    assert fold(what, state, different)[0].taken == 6
    assert isinstance(different[0], Frame)
