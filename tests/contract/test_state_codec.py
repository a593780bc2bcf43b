"""Encoded states, inputs and calibrations are decoded without loss."""

from dataclasses import fields, replace

import numpy as np
import pytest

from lowfc.contract.codecs import codec
from lowfc.contract.codecs.calibration_codec import decode_calibration, encode_calibration, with_identity
from lowfc.contract.codecs.state_codec import controller_state, decode_state
from lowfc.contract.messages import wire
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import CameraSettings, Load, MirrorReport, MirrorShape, Report, Request, Tick
from lowfc.control.loop.interlocks import BenchReport
from lowfc.control.loop.state import State
from lowfc.control.loop.wording import AUTO
from tests.support.controller_inputs import CALIBRATION
from tests.support.toy import CAMERA, feed, frame, loaded, settings


def test_a_state_without_a_calibration_round_trips() -> None:
    setup = settings()
    state, _ = advance(setup, State(), frame(3))
    decoded_settings, decoded_state = decode_state(controller_state(state, setup, 1), None)
    assert (decoded_settings, decoded_state) == (setup, state._replace(counts=dict(state.counts)))


def test_a_state_with_the_wrong_calibration_is_refused() -> None:
    message = controller_state(loaded(settings()), settings(), 1)
    with pytest.raises(ValueError, match="calibration toy of the controller's state is missing"):
        decode_state(message, None)
    with pytest.raises(ValueError, match="is missing"):
        decode_state(message, CALIBRATION)


@pytest.mark.parametrize("field", ["gain", "prior_nm2", "automatic"])
def test_a_state_with_too_few_modes_is_refused(field: str) -> None:
    calibration = with_identity(replace(CALIBRATION, camera=CAMERA))
    setup = settings(auto_gain=(True, True))
    gains = Request(0, "gain", values=(0.1, 0.1, 0.0), text=AUTO, prior_nm2=(0.0, 0.0, 4.0), flux_dn=1e5)
    state, _ = feed(setup, State(), Load(0, calibration, "a file"), gains)
    message = controller_state(state, setup, 1)
    del getattr(message, field)[0]
    with pytest.raises(ValueError, match=r"must have the same length|does not have 3 modes"):
        decode_state(message, calibration)


@pytest.mark.parametrize("field", ["gain", "leak", "limit_nm", "auto_gain"])
def test_settings_with_three_values_in_place_of_a_pair_are_refused(field: str) -> None:
    message = controller_state(State(), settings(auto_gain=(True, False)), 1)
    getattr(message.settings, field).append(1)
    with pytest.raises(ValueError, match="two gains"):
        decode_state(message, None)


@pytest.mark.parametrize(
    "input_",
    [
        Tick(5, 7),
        CameraSettings(5, (3, 4), 100.0, 65535.0),
        MirrorShape(5, np.arange(6, dtype=np.float32).reshape(2, 3), np.ones(2, np.float32)),
        MirrorReport(5, "does not answer"),
        Load(5, CALIBRATION, "a file"),
        *(BenchReport(5, "mask", value, 3) for value in (True, False, 2.5, "parked", None)),
    ],
    ids=lambda input_: type(input_).__name__,
)
def test_inputs_round_trip(input_: Report) -> None:
    message = wire.ControlInput.FromString(codec.encode_input(input_, 9))
    assert message.input_number == 9
    decoded = codec.decode_input(message, {CALIBRATION.id: CALIBRATION})
    assert type(decoded) is type(input_)
    for field in fields(input_):
        assert np.array_equal(getattr(decoded, field.name), getattr(input_, field.name)), field.name
    with pytest.raises(ValueError, match="input 0 of the controller cannot be read"):
        codec.decode_input(wire.ControlInput(), {})


def test_a_calibration_round_trips() -> None:
    calibration = with_identity(replace(CALIBRATION, camera=CAMERA))
    message = wire.Calibration.FromString(encode_calibration(calibration, 5_000_000_001))
    assert message.timestamp.ToNanoseconds() == 5_000_000_001
    assert list(message.mode_names) == ["tilt x", "tilt y", "focus"]
    decoded = decode_calibration(message)
    for field in fields(calibration):
        assert np.array_equal(getattr(decoded, field.name), getattr(calibration, field.name)), field.name
    message.flux_dn += 1
    with pytest.raises(ValueError, match="is damaged: its content has another identity"):
        decode_calibration(message)


def test_only_inputs_with_an_effect_are_counted() -> None:
    setup = settings()
    state = loaded(setup)
    camera = CameraSettings(1, CALIBRATION.shape, 100.0, CALIBRATION.saturation_dn)
    bad = frame(2)._replace(pixels=None)
    for input_, count in ((camera, 2), (camera, 2), (Tick(1, 1), 2), (frame(1), 3), (Tick(1, 1), 4), (bad, 5)):
        state, _ = advance(setup, state, input_)
        assert state.input_number == count
