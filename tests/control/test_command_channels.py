"""Channels, offset, probe sequences, steps, reset and laws: their effect on the command and on the wavefront."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from lowfc.arrays import Array, Single
from lowfc.contract.codecs.codec import decode_request, encode_request
from lowfc.control.laws.linear_law import LinearLaw, Signal
from lowfc.control.laws.stability import delay_weights
from lowfc.control.loop.advance import advance
from lowfc.control.loop.command_channels import ADOPTED, EXTERNAL, FLAT, MAX_CHANNELS, MIRROR, OFFSET
from lowfc.control.loop.inputs import Frame, Input, Load, MirrorShape, Outputs, Reply, Request
from lowfc.control.loop.safety import Limits, LoopMode
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES, Settings, Weighting
from tests.support.theory import law_of, linear
from tests.support.toy import CAMERA, GRID, NOLL, START, TOY, calibration, frame, frame_sequence, loaded, settings

DEFAULTS = settings()
DISTURBANCE_NM = np.array([10.0, -5.0, 3.0])
ACTUATORS = GRID[0] * GRID[1]
STEP_NM = DEFAULTS.limits.kept_slew_nm / 2
"""Largest move of a channel in a frame: half the slew limit with its margin."""
UNIT = np.eye(3, dtype=np.float32)
SMOOTH = LinearLaw("pol", 0.6 * UNIT, 0.4 * UNIT, 0 * UNIT, UNIT, -UNIT, "smooth", NOLL, 1.0, 1000.0)
"""A law that removes the smoothed disturbance."""
LOAD_OTHER = Request(0, "load", calibration=replace(calibration(scale=1.01), id="other"))


class ToyLoop:
    """A loop with the sensor and the mirror of `TOY`; the sensor sees a command after the delay of the settings."""

    def __init__(self, setup: Settings = DEFAULTS, mode: LoopMode = LoopMode.CLOSED) -> None:
        self.setup = replace(setup, start_mode=mode)
        self.state = loaded(self.setup)
        self.count = 0
        self.surfaces: list[Single] = [np.zeros(GRID, np.float32)]
        self.wavefronts: list[Array] = []
        self.outputs: list[Outputs] = []
        self.to_modes, self.weights = np.linalg.pinv(TOY.modes_to_actuators), delay_weights(setup.delay_frames)

    def process_input(self, input_: Input) -> Outputs:
        self.state, outputs = advance(self.setup, self.state, input_)
        self.outputs.append(outputs)
        if outputs.command is not None:
            self.surfaces.append(outputs.command.actuators_nm)
        return outputs

    def run(self, frames: int, disturbance_nm: npt.ArrayLike = DISTURBANCE_NM) -> None:
        """Run frames whose wavefront is this disturbance (modes,), nm rms, plus the shape of the mirror."""
        for _ in range(frames):
            self.count += 1
            indices = [max(-1 - lag, -len(self.surfaces)) for lag in range(len(self.weights))]
            shape_nm = np.tensordot(self.weights, [self.surfaces[index] for index in indices], 1)
            seen_nm = np.asarray(disturbance_nm) + self.to_modes @ shape_nm.reshape(-1)
            self.wavefronts.append(seen_nm)
            self.process_input(frame(self.count, seen_nm))

    def ask(self, name: str, **fields: object) -> Reply:
        """Send a request encoded and decoded, as over the bus."""
        request = Request(0, name, **fields)
        payload = encode_request(request, Reply(False, "", 0), 0, None)
        return self.process_input(decode_request(payload, name, 0)).reply

    @property
    def events(self) -> list[str]:
        return [event.name for outputs in self.outputs for event in outputs.events]


def dark_hole(scale_nm: float = 20.0, seed: int = 5) -> Single:
    """A random shape of the mirror, nm of surface."""
    return (scale_nm * np.random.default_rng(seed).standard_normal(GRID)).astype(np.float32)


def test_a_channel_is_applied_within_the_slew_limit_and_the_loop_does_not_undo_it() -> None:
    loop, shape = ToyLoop(), dark_hole(60.0)
    loop.run(40)
    before = loop.surfaces[-1]
    assert loop.ask("channel", text="dark-hole", actuators_nm=shape).accepted
    loop.run(60)
    moves = np.abs(np.diff(loop.surfaces, axis=0)).max(axis=(1, 2))
    frames = int(np.ceil(np.abs(shape).max() / STEP_NM))
    assert frames > 1
    assert moves.max() <= STEP_NM * 1.001 + 0.01
    assert np.allclose(loop.surfaces[-1], before + shape, atol=0.02)
    undone = loop.to_modes @ (loop.surfaces[-1] - before - shape).reshape(-1)
    assert np.abs(undone).max() < 0.01 * np.abs(loop.to_modes @ shape.reshape(-1)).max()
    loop.ask("channel", text="dark-hole")
    loop.run(60)
    assert np.allclose(loop.surfaces[-1], before, atol=0.02)
    assert loop.state.loop.command_channels.channels == ()


@pytest.mark.parametrize("delay_frames", [1.0, 1.5, 2.0])
def test_the_shift_of_the_zero_point_is_delayed_like_the_mirror(delay_frames: float) -> None:
    """While the mirror moves to a channel's shape, no frame measures an error, whatever the delay."""
    loop = ToyLoop(replace(DEFAULTS, delay_frames=delay_frames), LoopMode.OPEN)
    loop.ask("channel", text="dark-hole", actuators_nm=dark_hole(60.0))
    loop.run(30, np.zeros(3))
    for outputs in loop.outputs[1:]:
        assert np.abs(outputs.step.error_nm).max() < 0.05


def test_an_external_shape_is_neither_undone_nor_commanded() -> None:
    """The loop's limits do not apply to the external shape and safe mode does not end it, since others applied it."""
    loop, external = ToyLoop(), dark_hole(60.0)
    unseen = dark_hole(2 * DEFAULTS.limits.stroke_nm, seed=6)  # beyond the loop's limits
    external += unseen - (TOY.modes_to_actuators @ (loop.to_modes @ unseen.reshape(-1))).reshape(GRID)
    loop.run(40)
    before = loop.surfaces[-1]
    assert loop.ask("channel", text=EXTERNAL, actuators_nm=external).accepted
    seen_nm = DISTURBANCE_NM + loop.to_modes @ external.reshape(-1)
    loop.run(20, seen_nm)
    assert np.allclose(loop.surfaces[-1], before, atol=0.02)
    assert max(np.abs(surface - before).max() for surface in loop.surfaces[-20:]) < 0.02  # no transient
    loop.ask("safe")
    loop.run(40, seen_nm)
    assert not loop.surfaces[-1].any()
    assert loop.ask("channel", text=EXTERNAL, actuators_nm=2 * external).accepted
    loop.ask("clear")
    loop.ask("close")
    loop.run(60, seen_nm + loop.to_modes @ external.reshape(-1))
    assert np.allclose(loop.surfaces[-1], before, atol=0.02)
    assert loop.ask("channel", text=EXTERNAL).accepted
    loop.run(60)
    assert np.allclose(loop.surfaces[-1], before, atol=0.02)
    assert loop.state.loop.command_channels.channels == ()


def test_the_flat_map_does_not_shift_the_zero_point() -> None:
    loop = ToyLoop()
    loop.run(30)
    loop.ask("channel", text=FLAT, actuators_nm=dark_hole(20.0))
    loop.run(60)
    assert np.abs(loop.wavefronts[-1]).max() < 0.05  # the loop has corrected its modes


@pytest.mark.parametrize("mode", [LoopMode.OPEN, LoopMode.CLOSED])
def test_a_probe_sequence_plays_one_row_per_frame_and_ends(mode: LoopMode) -> None:
    loop = ToyLoop(replace(DEFAULTS, gain=(0.0, 0.0)), mode)
    loop.run(3)
    held = loop.surfaces[-1]
    table = np.array([[1, 0], [0, 2], [-1, 1]], np.float32)
    basis = np.stack([dark_hole(5.0, 1), dark_hole(5.0, 2)]).reshape(2, -1)
    reply = loop.ask("play", text=MIRROR, table=table, actuators_nm=basis)
    assert (reply.accepted, reply.frame_sequence) == (True, frame_sequence(4))
    assert not loop.ask("play", text=MIRROR, table=table, actuators_nm=basis).accepted
    loop.run(2)
    loop.count += 1  # a frame is lost: the table advances with frames, not commands
    loop.run(2)
    played = [surface - held for surface in loop.surfaces[-4:]]
    expected = [*(row @ basis for row in table[:2]), np.zeros(ACTUATORS), np.zeros(ACTUATORS)]
    for surface, shape in zip(played, expected, strict=True):
        assert np.allclose(surface.reshape(-1), shape, atol=1e-3)
    assert np.allclose(loop.outputs[-3].step.command_nm, 0)  # the modal command excludes the played shapes


def test_a_probe_sequence_whose_end_exceeds_the_slew_limit_leaves_nothing_on_the_mirror() -> None:
    loop = ToyLoop(mode=LoopMode.OPEN)
    loop.run(2)
    held = loop.surfaces[-1]
    table = np.linspace(0, 1, 30, dtype=np.float32)[:, None]
    basis = np.full(ACTUATORS, 300.0, np.float32)
    assert loop.ask("play", text=MIRROR, table=table, actuators_nm=basis).accepted
    loop.run(30)
    assert loop.surfaces[-1].min() > 290
    loop.run(10)
    assert np.array_equal(loop.surfaces[-1], held)
    assert np.abs(np.diff(loop.surfaces, axis=0)).max() <= DEFAULTS.limits.slew_nm
    assert loop.state.limits_hit == ()


def test_a_probe_sequence_ends_with_the_last_frame_of_a_step_request() -> None:
    loop = ToyLoop(mode=LoopMode.OPEN)
    play = {"text": MIRROR, "table": np.ones((50, 1), np.float32), "actuators_nm": dark_hole(5.0).reshape(-1)}
    assert not loop.ask("play", **play).accepted, "no frame has arrived"
    loop.run(2, np.zeros(3))
    loop.ask("step", values=(5,))
    assert loop.ask("play", **play).accepted
    loop.run(8, np.zeros(3))
    assert loop.state.loop.command_channels.play is None


def test_channels_whose_sum_exceeds_the_stroke_are_refused() -> None:
    loop, shape = ToyLoop(), np.full(ACTUATORS, 0.6 * DEFAULTS.limits.stroke_nm, np.float32)
    assert loop.ask("channel", text="a", actuators_nm=shape).accepted
    assert not loop.ask("channel", text="b", actuators_nm=shape).accepted
    assert loop.ask("channel", text="b", actuators_nm=-shape).accepted


@pytest.mark.parametrize("end", ["stop", "safe", "close", "limit", "restart", "load"])
def test_a_request_a_limit_a_camera_restart_or_another_calibration_ends_a_probe_sequence(end: str) -> None:
    loop = ToyLoop(mode=LoopMode.OPEN)
    loop.run(2)
    table = np.ones((50, 1), np.float32)
    table[10] = 20 if end == "limit" else 1
    basis = np.full(ACTUATORS, 6.0, np.float32)
    assert loop.ask("play", text=MIRROR, table=table, actuators_nm=basis).accepted
    loop.run(5, np.zeros(3))
    assert np.allclose(loop.surfaces[-1], 6.0)
    if end == "restart":
        loop.process_input(Frame(frame_sequence(1, START + 5), 0, 0, TOY.pixels((0, 0, 0))))
    elif end == "load":
        assert loop.process_input(LOAD_OTHER).reply.accepted
    elif end != "limit":
        assert loop.ask(end).accepted
    loop.run(1 if end == "restart" else 12, np.zeros(3))
    assert ("PLAY_ENDED" in loop.events) is (end in ("limit", "restart", "load"))
    assert loop.state.loop.command_channels.play is None
    if end != "close":
        assert np.allclose(loop.surfaces[-1], 0, atol=1e-3)


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"text": "nothing"}, "target"),
        ({"text": MIRROR, "table": np.ones((3, 1), np.float32)}, "actuators"),
        ({"text": MIRROR, "table": np.ones((3, 2), np.float32), "actuators_nm": np.ones(ACTUATORS)}, "per column"),
        ({"text": MIRROR, "table": np.zeros((0, 1), np.float32), "actuators_nm": np.ones(ACTUATORS)}, "row"),
        ({"text": MIRROR, "table": np.full((3, 1), 1e3), "actuators_nm": np.ones(ACTUATORS)}, "to 1000 nm"),
        ({"text": MIRROR, "table": np.full((3, 1), np.nan), "actuators_nm": np.ones(ACTUATORS)}, "finite"),
        ({"text": OFFSET, "table": np.ones((3, 2), np.float32)}, "columns"),
    ],
)
def test_an_inconsistent_probe_sequence_is_refused(fields: dict[str, object], why: str) -> None:
    loop = ToyLoop()
    loop.run(2)
    float32_fields = {
        name: value.astype(np.float32) if isinstance(value, np.ndarray) else value for name, value in fields.items()
    }
    before = loop.state
    reply = loop.ask("play", **float32_fields)
    assert not reply.accepted
    assert why in reply.text
    assert loop.state.loop is before.loop


def test_the_stroke_limits_each_actuator_of_a_probe_sequence_and_not_the_sum_of_all_pokes() -> None:
    loop = ToyLoop(mode=LoopMode.OPEN)
    loop.run(2)
    one_each = np.eye(ACTUATORS, dtype=np.float32)
    assert loop.ask("play", text=MIRROR, table=300 * one_each, actuators_nm=one_each.ravel()).accepted


@pytest.mark.parametrize(
    ("text", "shape_nm", "why"),
    [
        ("Dark", np.ones(GRID), "name"),
        ("", np.ones(GRID), "name"),
        ("x" * 33, np.ones(GRID), "name"),
        ("a", np.ones((3, 3)), "actuators"),
        ("a", np.full(GRID, 701.0), "limit"),
        ("a", np.full(GRID, np.nan), "finite"),
        ("external", np.full(GRID, 1e38), "at most 1e+09 nm"),
        ("a", np.indices(GRID).sum(axis=0) % 2 * 500.0, "neighbours"),
    ],
)
def test_an_invalid_channel_is_refused(text: str, shape_nm: Array, why: str) -> None:
    loop = ToyLoop()
    reply = loop.ask("channel", text=text, actuators_nm=shape_nm.astype(np.float32))
    assert not reply.accepted
    assert why in reply.text


def test_the_number_of_channels_is_limited() -> None:
    loop, shape = ToyLoop(), dark_hole(1.0).reshape(-1)
    for number in range(MAX_CHANNELS):
        assert loop.ask("channel", text=f"c{number}", actuators_nm=shape).accepted
    assert not loop.ask("channel", text="one-more", actuators_nm=shape).accepted
    assert "no channel 'one-more' to remove" in loop.ask("channel", text="one-more").text
    assert loop.ask("channel", text="c3", actuators_nm=2 * shape).accepted


def test_safe_mode_removes_all_channels_but_the_flat_map_which_returns_after_clear() -> None:
    loop, flat = ToyLoop(), dark_hole(10.0, 3)
    loop.ask("channel", text=FLAT, actuators_nm=flat)
    loop.ask("channel", text="dark-hole", actuators_nm=dark_hole(30.0))
    loop.run(30, np.zeros(3))
    loop.ask("safe")
    loop.run(10, np.zeros(3))
    assert not loop.surfaces[-1].any()
    assert not loop.ask("channel", text="dark-hole", actuators_nm=flat).accepted
    loop.ask("clear")
    loop.run(10, np.zeros(3))
    assert np.allclose(loop.surfaces[-1], flat, atol=1e-3)


def test_the_loop_opens_after_the_last_step() -> None:
    loop = ToyLoop(mode=LoopMode.OPEN)
    loop.run(3)
    assert loop.ask("step", values=(4,)).accepted
    loop.run(6)
    modes = [outputs.step.mode for outputs in loop.outputs[-6:]]
    assert modes == [LoopMode.CLOSED] * 4 + [LoopMode.OPEN] * 2
    assert loop.events[-3:] == ["MODE_CHANGED", "LOOP_STEPPED", "MODE_CHANGED"]
    assert not np.array_equal(loop.surfaces[-6], loop.surfaces[-7])
    assert np.array_equal(loop.surfaces[-1], loop.surfaces[-2])
    for wrong in ((), (0,), (-1,), (1.5,), (1, 2), (float("nan"),)):
        assert not loop.ask("step", values=wrong).accepted


@pytest.mark.parametrize("mode", [LoopMode.OPEN, LoopMode.CLOSED])
def test_reset_removes_the_modal_command_within_the_slew_limit(mode: LoopMode) -> None:
    loop = ToyLoop(replace(DEFAULTS, limits=Limits(700.0, 2.0, 400.0)))
    loop.run(100, 3 * DISTURBANCE_NM)
    channel = dark_hole(10.0)
    loop.ask("channel", text="dark-hole", actuators_nm=channel)
    loop.run(100, 3 * DISTURBANCE_NM)
    if mode is LoopMode.OPEN:
        loop.ask("open")
    assert loop.ask("reset").accepted
    assert loop.state.returning_to_zero
    start = len(loop.surfaces)
    while loop.state.returning_to_zero:
        assert len(loop.surfaces) < start + 100
        loop.run(1, 3 * DISTURBANCE_NM)
    assert len(loop.surfaces) > start + 3  # the slew limit is small
    assert np.allclose(loop.surfaces[-1], channel, atol=0.01)
    assert np.abs(np.diff(loop.surfaces, axis=0)).max() <= 2.0
    loop.run(5, 3 * DISTURBANCE_NM)
    assert np.allclose(loop.surfaces[-1], channel, atol=0.01) is (mode is LoopMode.OPEN)


def test_a_shape_that_the_loop_did_not_command_is_adopted_as_a_channel() -> None:
    loop = ToyLoop()
    shape_nm = dark_hole(30.0) + (TOY.modes_to_actuators @ DISTURBANCE_NM).reshape(GRID).astype(np.float32)
    loop.process_input(MirrorShape(0, shape_nm, np.zeros(0, np.float32)))
    assert "SHAPE_ADOPTED" in loop.events
    loop.surfaces = [shape_nm]
    seen = loop.to_modes @ shape_nm.reshape(-1)
    loop.run(40, -seen + DISTURBANCE_NM)  # the mirror's shape corrects all of the wavefront but DISTURBANCE_NM
    assert np.abs(np.diff(loop.surfaces, axis=0)).max() < 20
    assert [channel.name for channel in loop.state.loop.command_channels.channels] == [ADOPTED]
    moved_nm = loop.surfaces[-1] - shape_nm
    outside = moved_nm.reshape(-1) - TOY.modes_to_actuators @ (loop.to_modes @ moved_nm.reshape(-1))
    assert np.abs(outside).max() < 0.01


def test_a_law_takes_over_and_returns_control_without_a_jump() -> None:
    """The linear law equals the integrator: with and without it, the mirror's shapes agree within 0.5 nm."""
    loop, without_law = ToyLoop(), ToyLoop()
    for each in (loop, without_law):
        each.ask("gain", values=(0.4,))
        each.ask("limit", values=(50.0,))
    assert loop.ask("law", law=linear(law_of(0.4))).accepted
    assert not loop.ask("gain", values=(0.3,)).accepted
    frames = SETTLING_FRAMES + FADING_FRAMES + 50
    for each in (loop, without_law):
        each.run(frames)
    assert np.allclose(loop.surfaces[-1], without_law.surfaces[-1], atol=0.01)
    assert np.abs(np.subtract(loop.surfaces, without_law.surfaces)).max() < 0.5
    assert loop.ask("law").accepted
    loop.run(5)
    assert np.allclose(loop.surfaces[-1], without_law.surfaces[-1], atol=0.05)


def test_in_safe_mode_no_shape_of_the_mirror_is_adopted() -> None:
    loop = ToyLoop(mode=LoopMode.SAFE)
    shape_nm = dark_hole(30.0)
    loop.process_input(MirrorShape(0, shape_nm, np.zeros(0, np.float32)))
    loop.surfaces = [shape_nm]
    loop.run(10, np.zeros(3))
    assert not loop.surfaces[-1].any()
    assert loop.ask("clear").accepted
    loop.run(10, np.zeros(3))
    assert not loop.surfaces[-1].any()


def test_safe_mode_of_a_mirror_that_reports_late_removes_the_channels() -> None:
    loop = ToyLoop()
    assert loop.ask("channel", text="dark-hole", actuators_nm=dark_hole()).accepted
    loop.process_input(MirrorShape(0, np.zeros(GRID, np.float32), np.zeros(0, np.float32), safe=True))
    assert loop.state.mode is LoopMode.SAFE
    loop.run(10, np.zeros(3))
    assert loop.ask("clear").accepted
    loop.run(10, np.zeros(3))
    assert not loop.surfaces[-1].any()
    assert not loop.state.loop.command_channels.channels


def test_a_calibration_loaded_in_safe_mode_leaves_nothing_on_the_mirror() -> None:
    loop = ToyLoop(replace(DEFAULTS, limits=Limits(700.0, 10.0, 400.0)))
    assert loop.ask("channel", text="dark-hole", actuators_nm=dark_hole(60.0)).accepted
    loop.run(60)
    assert loop.ask("safe").accepted
    assert loop.process_input(LOAD_OTHER).reply.accepted
    assert loop.surfaces[-1].any(), "the mirror has not reached flat yet"
    loop.run(60)
    assert loop.ask("clear").accepted
    loop.run(60)
    assert not loop.surfaces[-1].any()


@pytest.mark.parametrize("signal", [None, "error", "pol"])
def test_an_offset_moves_the_wavefront_but_not_the_pseudo_open_loop_modes(signal: Signal | None) -> None:
    """This holds for the integrator, for a law of the error, and for a law of pseudo-open-loop modes."""
    loop, target = ToyLoop(), (4.0, 0.0, -2.0)
    if signal is not None:
        assert loop.ask("law", law=linear(law_of(0.4)) if signal == "error" else SMOOTH).accepted
    for values, expected in ((target, target), ((), (0, 0, 0))):
        assert loop.ask("offset", values=values).accepted
        loop.run(SETTLING_FRAMES + FADING_FRAMES + 50)
        assert np.allclose(loop.wavefronts[-1], expected, atol=0.1)
        assert np.allclose(loop.outputs[-1].step.pol_nm, DISTURBANCE_NM, atol=0.1)


def test_a_law_for_another_loop_is_refused() -> None:
    loop = ToyLoop()
    law = law_of(1.2)
    linear_law = linear(law)
    assert loop.ask("law", law=linear_law).accepted
    delayed = ToyLoop(replace(DEFAULTS, delay_frames=2.0))
    assert "delay" in delayed.ask("law", law=SMOOTH).text
    assert not delayed.ask("law", law=linear_law).accepted
    assert not loop.ask("law", law=linear(law, (2, 3, 5))).accepted
    slow = ToyLoop(replace(DEFAULTS, rate_hz=500.0))
    assert "1000 Hz" in slow.ask("law", law=linear_law).text
    assert slow.ask("law", law=linear(law, rate_hz=501.0)).accepted


def test_another_calibration_does_not_move_the_mirror() -> None:
    loop = ToyLoop()
    loop.ask("channel", text="dark-hole", actuators_nm=dark_hole(20.0))
    loop.run(60)
    refused = loop.process_input(LOAD_OTHER).reply
    assert not refused.accepted  # while the loop is closed
    loop.ask("open")
    before = loop.surfaces[-1]
    loading = loop.process_input(LOAD_OTHER)
    assert loading.reply.accepted
    assert "CALIBRATION_LOADED" in [event.name for event in loading.events]
    loop.run(5)
    assert np.allclose(loop.surfaces[-1], before, atol=0.01)
    loop.ask("close")
    loop.run(40)
    assert np.allclose(loop.surfaces[-1], before, atol=0.5)  # frames are rounded to DN
    loop.ask("open")
    before = loop.surfaces[-1]
    loop.process_input(Load(0, calibration((2, 3)), "test"))  # the part outside these modes becomes a channel
    loop.ask("channel", text="other", actuators_nm=dark_hole(1.0))
    loop.run(10)
    assert np.allclose(loop.surfaces[-1], before + dark_hole(1.0), atol=0.01)


def test_another_weighting_of_r_changes_the_shift_of_a_settled_channel_at_once() -> None:
    loop = ToyLoop()
    loop.ask("channel", text="dark-hole", actuators_nm=dark_hole(20.0))
    loop.run(60)
    active_loop = loop.state.loop._replace(camera=CAMERA)
    channels = active_loop.with_weighting(Weighting(np.float32([0, 0, 100]), 2e3)).command_channels
    assert np.abs(channels.shift_nm - loop.state.loop.command_channels.shift_nm).max() > 0.5
    np.testing.assert_allclose(channels.shifts_nm, [channels.shift_nm] * len(channels.shifts_nm), atol=1e-4)
