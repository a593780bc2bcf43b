"""Channels, offset, play, steps, reset and laws: what is added to the loop's command, and what it makes of it."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from lowfc.arrays import Array, Single
from lowfc.contract.codecs.codec import decode_request, encode_request
from lowfc.control.laws.linear_law import LinearLaw, Signal
from lowfc.control.loop.advance import advance
from lowfc.control.loop.command_channels import ADOPTED, EXTERNAL, FLAT, MIRROR, MOST_CHANNELS, OFFSET
from lowfc.control.loop.inputs import Frame, Input, Load, MirrorShape, Outputs, Reply, Request
from lowfc.control.loop.safety import Limits, LoopMode
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES, Settings
from tests.support.theory import law_of, linear
from tests.support.toy import GRID, NOLL, START, TOY, calibration, frame, frame_sequence, loaded, settings

USUAL = settings()
DISTURBED = np.array([10.0, -5.0, 3.0])
ACTUATORS = GRID[0] * GRID[1]
STEP_NM = USUAL.limits.kept_slew_nm / 2


class Night:
    """A loop on the toy's sensor and mirror: what is commanded is seen in the next frame."""

    def __init__(self, what: Settings = USUAL, mode: LoopMode = LoopMode.CLOSED) -> None:
        self.what = replace(what, start_mode=mode)
        self.state = loaded(self.what)
        self.count = 0
        self.surfaces: list[Single] = [np.zeros(GRID, np.float32)]
        self.wavefronts: list[Array] = []
        self.outputs: list[Outputs] = []
        self.to_modes = np.linalg.pinv(TOY.modes_to_actuators)

    def take(self, taken: Input) -> Outputs:
        self.state, outputs = advance(self.what, self.state, taken)
        self.outputs.append(outputs)
        if outputs.command is not None:
            self.surfaces.append(outputs.command.actuators_nm)
        return outputs

    def run(self, frames: int, disturbance_nm: npt.ArrayLike = DISTURBED) -> None:
        """Frames of this wavefront (modes,) and what the mirror has added to it."""
        for _ in range(frames):
            self.count += 1
            seen_nm = np.asarray(disturbance_nm) + self.to_modes @ self.surfaces[-1].reshape(-1)
            self.wavefronts.append(seen_nm)
            self.take(frame(self.count, seen_nm))

    def ask(self, name: str, **fields: object) -> Reply:
        """As an operator asks: through the messages, both ways."""
        asked = Request(0, name, **fields)  # type: ignore[arg-type]
        payload = encode_request(asked, Reply(False, "", 0), 0, None)
        return self.take(decode_request(payload, name, 0)).reply

    @property
    def events(self) -> list[str]:
        return [event.name for outputs in self.outputs for event in outputs.events]


def dark_hole(scale_nm: float = 20.0, seed: int = 5) -> Single:
    return (scale_nm * np.random.default_rng(seed).standard_normal(GRID)).astype(np.float32)


def test_a_channel_goes_to_the_mirror_within_the_slew_and_the_loop_does_not_undo_it() -> None:
    night, wanted = Night(), dark_hole(60.0)
    night.run(40)
    before = night.surfaces[-1]
    assert night.ask("channel", text="dark-hole", actuators_nm=wanted.reshape(-1)).accepted
    night.run(60)
    moves = np.abs(np.diff(night.surfaces, axis=0)).max(axis=(1, 2))
    frames = int(np.ceil(np.abs(wanted).max() / STEP_NM))
    assert frames > 1
    assert moves.max() <= STEP_NM * 1.001 + 0.01
    assert np.allclose(night.surfaces[-1], before + wanted, atol=0.02)
    undone = night.to_modes @ (night.surfaces[-1] - before - wanted).reshape(-1)
    assert np.abs(undone).max() < 0.01 * np.abs(night.to_modes @ wanted.reshape(-1)).max()
    night.ask("channel", text="dark-hole")
    night.run(60)
    assert np.allclose(night.surfaces[-1], before, atol=0.02)
    assert night.state.drive.command_channels.channels == ()


@pytest.mark.parametrize("delay_frames", [1.0, 1.5, 2.0])
def test_the_zero_point_moves_when_the_mirror_is_seen_to_move(delay_frames: float) -> None:
    """With a channel on its way, no error is measured at any frame, whatever the delay."""
    what = replace(USUAL, delay_frames=delay_frames)
    night = Night(what, LoopMode.OPEN)
    weights = {1.0: (1.0,), 1.5: (0.5, 0.5), 2.0: (0.0, 1.0)}[delay_frames]
    night.ask("channel", text="dark-hole", actuators_nm=dark_hole(60.0).reshape(-1))
    for _ in range(30):
        shapes = [night.surfaces[max(-1 - lag, -len(night.surfaces))] for lag in range(len(weights))]
        seen = sum(weight * shape for weight, shape in zip(weights, shapes, strict=True))
        night.count += 1
        outputs = night.take(frame(night.count, night.to_modes @ np.asarray(seen).reshape(-1)))
        assert outputs.step.error_nm is not None
        assert np.abs(outputs.step.error_nm).max() < 0.05


def test_what_others_have_on_the_mirror_is_neither_undone_nor_commanded() -> None:
    """Nor does it count for the loop's own limits, nor end with safe mode: it is there, whatever the loop does."""
    night, theirs = Night(), dark_hole(60.0)
    unseen = dark_hole(2 * USUAL.limits.stroke_nm, seed=6)  # beyond the own limits
    theirs += unseen - (TOY.modes_to_actuators @ (night.to_modes @ unseen.reshape(-1))).reshape(GRID)
    night.run(40)
    before = night.surfaces[-1]
    assert night.ask("channel", text=EXTERNAL, actuators_nm=theirs.reshape(-1)).accepted
    seen_nm = DISTURBED + night.to_modes @ theirs.reshape(-1)
    night.run(20, seen_nm)
    assert np.allclose(night.surfaces[-1], before, atol=0.02)
    assert max(np.abs(surface - before).max() for surface in night.surfaces[-20:]) < 0.02  # not for a frame either
    night.ask("safe")
    night.run(40, seen_nm)
    assert not night.surfaces[-1].any()
    assert night.ask("channel", text=EXTERNAL, actuators_nm=2 * theirs.reshape(-1)).accepted
    night.ask("clear")
    night.ask("close")
    night.run(60, seen_nm + night.to_modes @ theirs.reshape(-1))
    assert np.allclose(night.surfaces[-1], before, atol=0.02)
    assert night.ask("channel", text=EXTERNAL).accepted
    night.run(60)
    assert np.allclose(night.surfaces[-1], before, atol=0.02)
    assert night.state.drive.command_channels.channels == ()


def test_the_flat_map_does_not_move_the_zero_point() -> None:
    night = Night()
    night.run(30)
    night.ask("channel", text=FLAT, actuators_nm=dark_hole(20.0).reshape(-1))
    night.run(60)
    assert np.abs(night.wavefronts[-1]).max() < 0.05  # the loop has taken what the sensor sees of it away


@pytest.mark.parametrize("mode", [LoopMode.OPEN, LoopMode.CLOSED])
def test_a_play_is_on_the_mirror_frame_by_frame_and_ends_by_itself(mode: LoopMode) -> None:
    what = replace(USUAL, gain=(0.0, 0.0))
    night = Night(what, mode)
    night.run(3)
    held = night.surfaces[-1]
    table = np.array([[1, 0], [0, 2], [-1, 1]], np.float32)
    basis = np.stack([dark_hole(5.0, 1), dark_hole(5.0, 2)]).reshape(2, -1)
    reply = night.ask("play", text=MIRROR, table=table, actuators_nm=basis.reshape(-1))
    assert (reply.accepted, reply.frame_sequence) == (True, frame_sequence(4))
    assert not night.ask("play", text=MIRROR, table=table, actuators_nm=basis.reshape(-1)).accepted
    night.run(2)
    night.count += 1  # a frame is lost: the table goes on by frames, not by commands
    night.run(2)
    got = [surface - held for surface in night.surfaces[-4:]]
    want = [*(row @ basis for row in table[:2]), np.zeros(ACTUATORS), np.zeros(ACTUATORS)]
    for surface, shape in zip(got, want, strict=True):
        assert np.allclose(surface.reshape(-1), shape, atol=1e-3)
    step = night.outputs[-3].step
    assert np.allclose(step.command_nm, 0)  # the loop is not told


def test_a_play_beyond_one_slew_leaves_nothing_behind() -> None:
    night = Night(mode=LoopMode.OPEN)
    night.run(2)
    held = night.surfaces[-1]
    table = np.linspace(0, 1, 30, dtype=np.float32)[:, None]
    basis = np.full(ACTUATORS, 300.0, np.float32)
    assert night.ask("play", text=MIRROR, table=table, actuators_nm=basis).accepted
    night.run(30)
    assert night.surfaces[-1].min() > 290
    night.run(10)
    assert np.array_equal(night.surfaces[-1], held)
    assert np.abs(np.diff(night.surfaces, axis=0)).max() <= USUAL.limits.slew_nm
    assert night.state.limits_hit == ()


def test_the_last_step_ends_a_play() -> None:
    night = Night(mode=LoopMode.OPEN)
    night.run(2, np.zeros(3))
    night.ask("step", values=(5,))
    night.ask("play", text=MIRROR, table=np.ones((50, 1), np.float32), actuators_nm=dark_hole(5.0).reshape(-1))
    night.run(8, np.zeros(3))
    assert night.state.drive.command_channels.play is None


def test_two_channels_that_are_too_much_together_are_refused() -> None:
    night, shape = Night(), np.full(ACTUATORS, 0.6 * USUAL.limits.stroke_nm, np.float32)
    assert night.ask("channel", text="a", actuators_nm=shape).accepted
    assert not night.ask("channel", text="b", actuators_nm=shape).accepted
    assert night.ask("channel", text="b", actuators_nm=-shape).accepted


def test_before_the_first_frame_nothing_is_played() -> None:
    night = Night()
    table = np.ones((5, 1), np.float32)
    assert not night.ask("play", text=MIRROR, table=table, actuators_nm=dark_hole(5.0).reshape(-1)).accepted


@pytest.mark.parametrize("end", ["stop", "safe", "close", "limit", "restart"])
def test_what_ends_a_play(end: str) -> None:
    what = replace(USUAL, limits=Limits(700.0, 100.0, 400.0))
    night = Night(what, LoopMode.OPEN)
    night.run(2)
    table = np.ones((50, 1), np.float32)
    table[10] = 20 if end == "limit" else 1
    basis = np.full(ACTUATORS, 6.0, np.float32)
    assert night.ask("play", text=MIRROR, table=table, actuators_nm=basis).accepted
    night.run(5, np.zeros(3))
    assert np.allclose(night.surfaces[-1], 6.0)
    if end == "restart":
        night.take(Frame(frame_sequence(1, START + 5), 0, 0, TOY.pixels((0, 0, 0))))
    elif end != "limit":
        assert night.ask(end).accepted
    night.run(1 if end == "restart" else 12, np.zeros(3))
    assert ("PLAY_ENDED" in night.events) is (end in ("limit", "restart"))
    assert night.state.drive.command_channels.play is None
    if end != "close":
        assert np.allclose(night.surfaces[-1], 0, atol=1e-3)


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"text": "nothing"}, "target"),
        ({"text": MIRROR, "table": np.ones((3, 1), np.float32)}, "actuators"),
        ({"text": MIRROR, "table": np.ones((3, 2), np.float32), "actuators_nm": np.ones(ACTUATORS)}, "columns"),
        ({"text": MIRROR, "table": np.zeros((0, 1), np.float32), "actuators_nm": np.ones(ACTUATORS)}, "row"),
        ({"text": MIRROR, "table": np.full((3, 1), 1e3), "actuators_nm": np.ones(ACTUATORS)}, "stroke"),
        ({"text": MIRROR, "table": np.full((3, 1), np.nan), "actuators_nm": np.ones(ACTUATORS)}, "finite"),
        ({"text": OFFSET, "table": np.ones((3, 2), np.float32)}, "columns"),
    ],
)
def test_a_play_that_does_not_fit_is_refused(fields: dict[str, object], why: str) -> None:
    night = Night()
    night.run(2)
    single = {
        name: value.astype(np.float32) if isinstance(value, np.ndarray) else value for name, value in fields.items()
    }
    before = night.state
    reply = night.ask("play", **single)
    assert not reply.accepted
    assert why in reply.text
    assert night.state.drive is before.drive


@pytest.mark.parametrize(
    ("text", "shape_nm", "why"),
    [
        ("Dark", np.ones(GRID), "name"),
        ("", np.ones(GRID), "name"),
        ("x" * 33, np.ones(GRID), "name"),
        ("a", np.ones((3, 3)), "actuators"),
        ("a", np.full(GRID, 701.0), "limit"),
        ("a", np.full(GRID, np.nan), "finite"),
        ("a", np.indices(GRID).sum(axis=0) % 2 * 500.0, "neighbours"),
    ],
)
def test_a_channel_that_the_mirror_cannot_take_is_refused(text: str, shape_nm: Array, why: str) -> None:
    night = Night()
    reply = night.ask("channel", text=text, actuators_nm=shape_nm.astype(np.float32).reshape(-1))
    assert not reply.accepted
    assert why in reply.text


def test_there_are_not_endlessly_many_channels() -> None:
    night, shape = Night(), dark_hole(1.0).reshape(-1)
    for number in range(MOST_CHANNELS):
        assert night.ask("channel", text=f"c{number}", actuators_nm=shape).accepted
    assert not night.ask("channel", text="one-more", actuators_nm=shape).accepted
    assert night.ask("channel", text="c3", actuators_nm=2 * shape).accepted


def test_safed_all_channels_but_the_flat_map_are_gone_and_that_comes_back() -> None:
    night, flat = Night(), dark_hole(10.0, 3)
    night.ask("channel", text=FLAT, actuators_nm=flat.reshape(-1))
    night.ask("channel", text="dark-hole", actuators_nm=dark_hole(30.0).reshape(-1))
    night.run(30, np.zeros(3))
    night.ask("safe")
    night.run(10, np.zeros(3))
    assert not night.surfaces[-1].any()
    assert not night.ask("channel", text="dark-hole", actuators_nm=flat.reshape(-1)).accepted
    night.ask("clear")
    night.run(10, np.zeros(3))
    assert np.allclose(night.surfaces[-1], flat, atol=1e-3)


def test_steps_end_with_an_open_loop() -> None:
    night = Night(mode=LoopMode.OPEN)
    night.run(3)
    assert night.ask("step", values=(4,)).accepted
    night.run(6)
    modes = [outputs.step.mode for outputs in night.outputs[-6:] if outputs.step is not None]
    assert modes == [LoopMode.CLOSED] * 4 + [LoopMode.OPEN] * 2
    assert night.events.count("LOOP_STEPPED") == 1
    assert not np.array_equal(night.surfaces[-6], night.surfaces[-7])
    assert np.array_equal(night.surfaces[-1], night.surfaces[-2])
    for wrong in ((), (0,), (-1,), (1.5,), (1, 2), (float("nan"),)):
        assert not night.ask("step", values=wrong).accepted


@pytest.mark.parametrize("mode", [LoopMode.OPEN, LoopMode.CLOSED])
def test_reset_takes_the_modal_command_away_within_the_slew(mode: LoopMode) -> None:
    what = replace(USUAL, limits=Limits(700.0, 2.0, 400.0), gain=(0.5, 0.3))
    night = Night(what)
    night.run(100, 3 * DISTURBED)
    channel = dark_hole(10.0)
    night.ask("channel", text="dark-hole", actuators_nm=channel.reshape(-1))
    night.run(100, 3 * DISTURBED)
    if mode is LoopMode.OPEN:
        night.ask("open")
    assert night.ask("reset").accepted
    assert night.state.returning_to_zero
    begun = len(night.surfaces)
    while night.state.returning_to_zero:
        assert len(night.surfaces) < begun + 100
        night.run(1, 3 * DISTURBED)
    assert len(night.surfaces) > begun + 3  # the slew limit is small
    assert np.allclose(night.surfaces[-1], channel, atol=0.01)
    moves = np.abs(np.diff(night.surfaces, axis=0)).max()
    assert moves <= 2.0
    night.run(5, 3 * DISTURBED)
    assert np.allclose(night.surfaces[-1], channel, atol=0.01) is (mode is LoopMode.OPEN)


def test_a_mirror_with_somebody_elses_shape_keeps_it() -> None:
    night = Night()
    there = dark_hole(30.0) + (TOY.modes_to_actuators @ DISTURBED).reshape(GRID).astype(np.float32)
    night.take(MirrorShape(0, there, np.zeros(0, np.float32)))
    assert "SHAPE_ADOPTED" in night.events
    night.surfaces = [there]
    seen = night.to_modes @ there.reshape(-1)
    night.run(40, -seen + DISTURBED)  # it was well corrected, but for this
    assert np.abs(np.diff(night.surfaces, axis=0)).max() < 20
    assert [one.name for one in night.state.drive.command_channels.channels] == [ADOPTED]
    rest = night.surfaces[-1] - there
    outside = rest.reshape(-1) - TOY.modes_to_actuators @ (night.to_modes @ rest.reshape(-1))
    assert np.abs(outside).max() < 0.01


def test_a_law_takes_over_and_gives_back_without_a_jump() -> None:
    """A linear law that is the same integrator: nobody sees which of them drives the mirror."""
    night, plain = Night(), Night()
    law = law_of(0.4)
    for each in (night, plain):
        each.ask("gain", values=(0.4,))
        each.ask("limit", values=(50.0,))
    made = linear(law)
    assert night.ask("law", law=made).accepted
    assert not night.ask("gain", values=(0.3,)).accepted
    frames = SETTLING_FRAMES + FADING_FRAMES + 50
    for each in (night, plain):
        each.run(frames)
    assert np.allclose(night.surfaces[-1], plain.surfaces[-1], atol=0.01)
    assert np.abs(np.subtract(night.surfaces, plain.surfaces)).max() < 0.5
    assert night.ask("law").accepted
    night.run(5)
    assert np.allclose(night.surfaces[-1], plain.surfaces[-1], atol=0.05)


def test_a_mirror_that_is_safed_keeps_nobodys_shape() -> None:
    night = Night(mode=LoopMode.SAFE)
    there = dark_hole(30.0)
    night.take(MirrorShape(0, there, np.zeros(0, np.float32)))
    night.surfaces = [there]
    night.run(10, np.zeros(3))
    assert not night.surfaces[-1].any()
    assert night.ask("clear").accepted
    night.run(10, np.zeros(3))
    assert not night.surfaces[-1].any()


@pytest.mark.parametrize("signal", [None, "error", "pol"])
def test_an_offset_is_where_the_loop_goes_and_pol_does_not_know_of_it(signal: Signal | None) -> None:
    """Under the integrator, and under a law whatever it is fed with."""
    night, unit, target = Night(), np.eye(3, dtype=np.float32), (4.0, 0.0, -2.0)
    if signal is not None:  # the integrator, or the disturbance, smoothed and undone
        smooth = LinearLaw("pol", 0.6 * unit, 0.4 * unit, 0 * unit, unit, -unit, "smooth", NOLL, 1.0, 1000.0)
        assert night.ask("law", law=linear(law_of(0.4)) if signal == "error" else smooth).accepted
    for asked, expected in ((target, target), ((), (0, 0, 0))):
        assert night.ask("offset", values=asked).accepted
        night.run(SETTLING_FRAMES + FADING_FRAMES + 50)
        assert np.allclose(night.wavefronts[-1], expected, atol=0.1)
        assert np.allclose(night.outputs[-1].step.pol_nm, DISTURBED, atol=0.1)


def test_an_unstable_or_foreign_law_is_refused() -> None:
    night = Night()
    law = law_of(1.2)
    made = linear(law)
    assert night.ask("law", law=made).accepted
    unit = np.eye(3, dtype=np.float32)
    late = Night(replace(USUAL, delay_frames=2.0))
    for_one = LinearLaw("pol", 0.6 * unit, 0.4 * unit, 0 * unit, unit, -unit, "smooth", NOLL, 1.0, 1000.0)
    assert "delay" in late.ask("law", law=for_one).text
    reply = late.ask("law", law=made)
    assert not reply.accepted
    assert not night.ask("law", law=linear(law, (2, 3, 5))).accepted
    fast = Night(replace(USUAL, rate_hz=500.0))
    assert "1000 Hz" in fast.ask("law", law=made).text
    assert fast.ask("law", law=linear(law, rate_hz=501.0)).accepted


def test_another_calibration_moves_nothing() -> None:
    night = Night()
    night.ask("channel", text="dark-hole", actuators_nm=dark_hole(20.0).reshape(-1))
    night.run(60)
    asked = Request(0, "load", calibration=replace(calibration(scale=1.01), id="other"))
    refused = night.take(asked).reply
    assert not refused.accepted  # while the loop is closed
    night.ask("open")
    before = night.surfaces[-1]
    loaded_now = night.take(asked)
    assert loaded_now.reply.accepted
    assert "CALIBRATION_LOADED" in [event.name for event in loaded_now.events]
    night.run(5)
    assert np.allclose(night.surfaces[-1], before, atol=0.01)
    night.ask("close")
    night.run(40)
    assert np.allclose(night.surfaces[-1], before, atol=0.5)  # frames are rounded to DN
    night.ask("open")
    before = night.surfaces[-1]
    night.take(Load(0, calibration((2, 3)), "test"))  # what these cannot make is a channel now
    night.ask("channel", text="other", actuators_nm=dark_hole(1.0).reshape(-1))
    night.run(10)
    assert np.allclose(night.surfaces[-1], before + dark_hole(1.0), atol=1.1)


def test_nothing_added_costs_nothing_and_changes_nothing() -> None:
    night = Night()
    night.run(20)
    assert night.state.drive.command_channels is None
    night.ask("offset", values=(0.0,))
    plain = Night()
    plain.run(20)
    for each in (night, plain):
        each.run(20)
    assert all(np.array_equal(one, other) for one, other in zip(night.surfaces, plain.surfaces, strict=True))
