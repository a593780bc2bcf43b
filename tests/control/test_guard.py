"""The guard of a law: when the integrator takes over, when the law returns, and what must not mislead it."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from lowfc.adapters.files.factory import frame_noise_nm2
from lowfc.arrays import Array
from lowfc.contract.codecs.state_codec import controller_state, decode_state
from lowfc.contract.configuration import Configuration
from lowfc.control.laws.integrator import TIP_TILT
from lowfc.control.laws.kalman import lqg
from lowfc.control.laws.linear_law import LinearLaw, integrator
from lowfc.control.laws.stability import LOWEST_GAIN, highest_gain
from lowfc.control.laws.vibration import Line, Model
from lowfc.control.loop.advance import advance
from lowfc.control.loop.guard import LAW_RETURNS, MAX_TAKEOVERS, WORSE_BLOCKS, Group, Spans
from lowfc.control.loop.inputs import MirrorReport, Request
from lowfc.control.loop.safety import Limit
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES, Settings, State
from lowfc.programs.cli import status
from sim_camera.disturbance import LINE_WIDTH, LINES_HZ, LINES_MAS
from tests.support.in_process_loop import SMALL_MIRROR
from tests.support.toy import NOLL, calibration, feed, frame, loaded, run_toy, settings
from tools.guard import MOVED, SEEDS, Case, identified_law, tilt_after_move, times_overruled
from tools.law_bench import Bench, calibrated, configured, timing_of
from tools.modal_bench import ModalBench

RATE_HZ = 1000.0
SETUP = settings(guard=True, gain=(0.5, 0.3), rate_hz=RATE_HZ)
BEFORE = SETTLING_FRAMES + FADING_FRAMES - 1
"""Number of frames before the first frame in which the guard compares."""
SPANS = Spans.at(RATE_HZ)
NOISE_NM = 2 * np.random.default_rng(1).standard_normal((3_000, len(NOLL)))
SWAY_NM = 20 * np.sin(2 * np.pi * 7 / RATE_HZ * np.arange(3_000)[:, None] + [0, 1, 2])


def law_from_exact_lines(config: Configuration, covariance_nm2: Array, bench: ModalBench) -> tuple[LinearLaw, Array]:
    """LQG law and integrator gains from the simulation's exact lines, without identification."""
    width = LINE_WIDTH if config.disturbance.preset == "reaction-wheel" else LINE_WIDTH / 1000
    variances_nm2 = (np.array(LINES_MAS) * bench.nm_per_mas) ** 2
    lines = tuple(Line(hz, width * hz, nm2) for hz, nm2 in zip(LINES_HZ, variances_nm2.tolist(), strict=True))
    models, gains = [], []
    for mode, noise_nm2 in zip(config.noll, np.diag(covariance_nm2).tolist(), strict=True):
        tilt = mode in TIP_TILT
        models.append(Model(0.01 if tilt else 1e-4, 5.0 if tilt else np.inf, lines if tilt else (), noise_nm2, RATE_HZ))
        gains.append(highest_gain(config.camera.delay_frames) if tilt else LOWEST_GAIN)
    return lqg(models, config.noll, timing_of(config)), np.array(gains)


def law_with_gains(*gain: float) -> LinearLaw:
    """An integrator as a linear law, with these gains of tip, tilt and focus."""
    return integrator(gain, (0.0, 0.0, 0.0), NOLL, 1.0, RATE_HZ)


GOOD, BAD_TILT, BAD_FOCUS = (law_with_gains(*gain) for gain in ((0.6, 0.6, 0.4), (0.05, 0.05, 0.3), (0.5, 0.5, 0.05)))


def with_law(law: LinearLaw, setup: Settings = SETUP) -> State:
    state, _ = advance(setup, loaded(setup), Request(0, "law", law=law))
    return state


def run(
    state: State, frames: int, first: int = 1, setup: Settings = SETUP, **changes: object
) -> tuple[list[str], State]:
    """Names of the reasons of the last step, and the state, after some frames of a slow wave."""
    rows = slice(first, first + frames)
    steps, _, state = run_toy(setup, SWAY_NM[rows], state=state, first=first, **changes)
    return [reason.name for reason in steps[-1].reasons], state


def overruled(state: State) -> list[bool]:
    return [group.overruled for group in state.loop.law_runner.guard.groups]


@pytest.mark.parametrize(
    ("law", "expected"), [(GOOD, [False, False]), (BAD_TILT, [True, False]), (BAD_FOCUS, [False, True])]
)
def test_the_integrator_takes_over_the_group_with_a_worse_law(law: LinearLaw, expected: list[bool]) -> None:
    reasons, state = run(with_law(law), BEFORE + (WORSE_BLOCKS + 1) * SPANS.block)
    assert overruled(state) == expected
    assert reasons == (["LAW_OVERRULED"] if any(expected) else [])
    assert state.counts.get(Limit.LAW_OVERRULED, 0) == (SPANS.block + 1 if any(expected) else 0)
    assert Limit.LAW_OVERRULED not in state.limits_hit


def test_there_is_no_guard_without_a_law_or_if_guard_is_off() -> None:
    setup = replace(SETUP, guard=False)
    reasons, state = run(with_law(BAD_TILT, setup), 1000, setup=setup)
    assert (reasons, state.loop.law_runner.guard) == ([], None)
    assert run(loaded(SETUP), 5)[1].loop.law_runner is None


@pytest.mark.parametrize(("rate_hz", "wait_s"), [(RATE_HZ, 10), (1.0, 100)])  # at 1 Hz a block takes 100 s
def test_a_takeover_raises_an_event_and_the_command_does_not_jump(rate_hz: float, wait_s: int) -> None:
    setup, faded = replace(SETUP, rate_hz=rate_hz), Spans.at(rate_hz).cross_fade
    state = with_law(replace(BAD_TILT, rate_hz=rate_hz), setup)
    _, state = run(state, BEFORE + WORSE_BLOCKS * SPANS.block - 1)
    assert not any(overruled(state))
    first, moves_nm, events = BEFORE + WORSE_BLOCKS * SPANS.block, [], []
    for number in range(first, first + 3):  # the cross-fade begins in the frame after the event
        before = state.loop.history_nm[0]
        state, all_outputs = feed(SETUP, state, frame(number, SWAY_NM[number] + before))
        moves_nm.append(np.abs(state.loop.history_nm[0] - before).max())
        events += all_outputs[0].events
    assert [event.name for event in events] == ["LAW_OVERRULED"]
    event = events[0].details
    assert event["modes"] == "tip and tilt"
    assert event["until"] == f"until the law would be far better for {wait_s} s"
    assert max(moves_nm) < 200 / faded
    _, state = run(state, faded, first + 3)
    shown = status.json_object(controller_state(state, SETUP, 1))
    assert shown["law"]["overruled"] == ["tip and tilt"]
    assert "overruled: the integrator drives tip and tilt" in status.text(shown)
    weight = state.loop.law_runner.weight
    np.testing.assert_array_equal(weight, [0, 0, 1])


def test_the_waiting_time_doubles_until_a_takeover_is_final() -> None:
    group, waited = Group(usual_nm2=100.0), []
    for _ in range(MAX_TAKEOVERS):
        for _ in range(WORSE_BLOCKS):
            group, why = group.judged((10.0, 5.0, 100.0), SPANS, void=False)
        assert group.overruled
        assert "leaves 3.16 nm rms, the integrator would leave 2.24" in why
        for blocks in range(1, 10 * SPANS.waiting):
            group, why = group.judged((10.0, 2.0, 100.0), SPANS, void=False)
            if why == LAW_RETURNS:
                waited.append(blocks)
                break
    assert waited == [SPANS.waiting, 2 * SPANS.waiting, 4 * SPANS.waiting]
    assert group.overruled


@pytest.mark.parametrize(("pol_nm2", "final"), [(39.0, True), (41.0, False)], ids=["amplified", "larger disturbance"])
def test_a_loop_is_judged_to_amplify_if_its_error_is_large_and_not_due_to_a_larger_disturbance(
    pol_nm2: float, final: bool
) -> None:
    group = Group(usual_nm2=1.0, blocks=WORSE_BLOCKS - 1)
    group, why = group.judged((10.0, 20.0, pol_nm2), SPANS, void=True)
    assert (group.overruled, group.final, "without correction" in why) == (final, final, final)


@pytest.mark.parametrize(("law_nm2", "void"), [(3.0, False), (2.0, True)], ids=["not better", "comparison void"])
def test_one_block_in_which_the_law_is_not_better_restarts_the_waiting_time(law_nm2: float, void: bool) -> None:
    group = Group(overruled=True, takeovers=1, blocks=SPANS.waiting - 1, usual_nm2=100.0)
    group, _ = group.judged((10.0, law_nm2, 100.0), SPANS, void=void)
    assert (group.overruled, group.blocks) == (True, 0)


def test_the_law_returns_once_it_would_be_far_better() -> None:
    """A law that hardly corrects is worse for a slow wave and better for white noise; at 200 Hz few frames suffice."""
    setup = replace(SETUP, rate_hz=RATE_HZ / 5)
    spans = Spans.at(setup.rate_hz)
    law = integrator((0.01, 0.01, 0.3), (0.05, 0.05, 0.0), NOLL, 1.0, setup.rate_hz)
    frames = BEFORE + WORSE_BLOCKS * spans.block + spans.cross_fade
    _, state = run(with_law(law, setup), frames, setup=setup)
    assert overruled(state) == [True, False]
    noisy = replace(state.loop.integrator, gain=np.array([1.9, 1.9, 0.3], np.float32))
    state = state._replace(loop=state.loop._replace(integrator=noisy))
    quiet = np.zeros(((spans.waiting + 3) * spans.block, len(NOLL)))
    steps, _, state = run_toy(setup, quiet, NOISE_NM[: len(quiet)], state, frames + 1)
    assert [group.takeovers for group in state.loop.law_runner.guard.groups] == [1, 0]
    assert state.loop.law_runner.alone()
    overruled_steps = [step.reasons for step in steps].count((Limit.LAW_OVERRULED,))
    assert spans.waiting * spans.block <= overruled_steps < len(steps)


def test_closing_the_loop_and_loading_a_law_reset_the_guard() -> None:
    _, state = run(with_law(BAD_TILT), BEFORE + (WORSE_BLOCKS + 2) * SPANS.block)
    assert overruled(state)[0]
    for requests in ([Request(0, "open"), Request(0, "close")], [Request(0, "law", law=BAD_TILT)]):
        reset, _ = feed(SETUP, state, *requests)
        assert [group.takeovers for group in reset.loop.law_runner.guard.groups] == [0, 0]
    assert overruled(feed(SETUP, state, MirrorReport(0, "does not answer"))[0])[0]


def test_missing_and_refused_frames_hold_the_virtual_command() -> None:
    frames, lost = BEFORE + 90, {"missing": {250, 251, 260}, "dark": {270}}
    setup = replace(SETUP, delay_frames=1.5)
    law = replace(law_with_gains(0.2, 0.2, 0.2), delay_frames=1.5)
    _, guarded = run(with_law(law, setup), frames, setup=setup, **lost)
    _, unguarded = run(loaded(setup), frames, setup=setup, **lost)
    virtual_nm = guarded.loop.law_runner.guard.virtual_nm
    np.testing.assert_allclose(virtual_nm, unguarded.loop.history_nm, atol=0.3)  # rounding to DN
    assert np.abs(guarded.loop.history_nm[0] - unguarded.loop.history_nm[0]).max() > 1


def test_a_law_that_is_only_computed_has_the_command_of_a_law_that_drives_the_mirror() -> None:
    frames = BEFORE + (WORSE_BLOCKS + 3) * SPANS.block
    _, state = run(with_law(BAD_TILT), frames)
    setup = replace(SETUP, guard=False)
    _, unguarded = run(with_law(BAD_TILT, setup), frames, setup=setup)
    virtual_nm = state.loop.law_runner.guard.virtual_nm[0]
    np.testing.assert_allclose(virtual_nm[:2], unguarded.loop.history_nm[0][:2], atol=0.3)


def test_probe_sequences_resets_and_limits_suspend_the_comparison() -> None:
    _, state = run(with_law(BAD_TILT), BEFORE + SPANS.block + 50)
    guard, first = state.loop.law_runner.guard, BEFORE + SPANS.block + 51
    assert (guard.frames, guard.groups[0].blocks) == (50, 1)
    play = Request(0, "play", text="offset", table=np.zeros((5, len(NOLL)), np.float32))
    for request in (play, Request(0, "reset")):
        requested, _ = advance(SETUP, state, request)
        after = run(requested, 1, first)[1].loop.law_runner.guard
        assert (after.frames, after.virtual_nm, after.groups[0].blocks) == (0, (), 0)
    limited = state._replace(limits_hit=(Limit.SLEW,))
    after = run(limited, 1, first)[1].loop.law_runner.guard
    assert (after.frames, after.void, after.virtual_nm) == (51, True, ())
    bounded = state._replace(limits_hit=(Limit.MODAL_LIMIT,))
    assert run(bounded, 1, first)[1].loop.law_runner.guard.void is False


def test_a_decoded_guard_continues_identically() -> None:
    """It is decoded in each phase: while it compares, in the cross-fade, and while the integrator drives."""
    state, frames_done = with_law(BAD_TILT), 0
    for until in (
        BEFORE + 150,
        BEFORE + WORSE_BLOCKS * SPANS.block + 50,
        BEFORE + (WORSE_BLOCKS + 3) * SPANS.block + 7,
    ):
        _, state = run(state, until - frames_done, frames_done + 1)
        frames_done = until
        message = controller_state(state, SETUP, 1)
        decoded, resumed = decode_state(message, calibration(), {BAD_TILT.id: BAD_TILT})
        assert decoded == SETUP
        message.guard.groups[0].overruled, message.guard.groups[0].takeovers = True, 0
        with pytest.raises(ValueError, match="the guard of the controller's state does not fit"):
            decode_state(message, calibration(), {BAD_TILT.id: BAD_TILT})
        later, later_resumed = (
            controller_state(run(start, 130, frames_done + 1)[1], SETUP, 1) for start in (state, resumed)
        )
        assert later == later_resumed


@lru_cache
def case(preset: str, magnitude: float = 0.0, *, exact_lines: bool = False) -> Case:
    return Case(preset, magnitude, law_from_exact_lines if exact_lines else identified_law)


@pytest.fixture
def short_settling(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop closes after 1 s, and the lines move 1 s later."""
    monkeypatch.setattr("tools.guard._SETTLE", 1_000)
    monkeypatch.setattr("tools.guard._BEFORE", 1_000)


def test_a_simulation_of_modes_agrees_with_a_simulation_of_images() -> None:
    """They agree in the noise of an open loop, and in the residual tilt of the integrator with the reaction wheel."""
    config = configured(**{"disturbance.preset": "quiet"}, **SMALL_MIRROR)
    calibration_ = calibrated(config)
    bench = Bench(config, calibration_)
    bench.run(600)
    expected = frame_noise_nm2(config, calibration_)
    measured = np.cov(np.array([step.error_nm for step in bench.steps]).T)
    assert np.linalg.norm(measured - expected) < 0.2 * np.linalg.norm(expected)
    wheel = configured(**SMALL_MIRROR)
    tilt_mas: list[float] = []
    for loop in (Bench(wheel, calibration_), ModalBench(wheel, expected)):
        loop.ask("close")
        loop.run(150, record=False)
        loop.run(350)
        tilt_mas.append(loop.tilt_mas(350))
    assert tilt_mas[1] == pytest.approx(tilt_mas[0], rel=0.03)


def test_with_shifted_lines_the_residual_is_at_most_a_tenth_above_the_integrators(short_settling: None) -> None:
    preset, factor = MOVED[0]
    residual_mas, overruled_s = tilt_after_move(case(preset, exact_lines=True), factor, 1)
    assert len(overruled_s) == 1
    assert residual_mas < 1.1 * tilt_after_move(case(preset, exact_lines=True), factor, 1, with_law=False)[0]


def test_steps_of_the_disturbance_do_not_overrule_the_law(short_settling: None) -> None:
    assert times_overruled(case("reaction-wheel", exact_lines=True), 1, minutes=0.07) == 0


def test_a_wrong_delay_is_detected_as_amplification() -> None:
    """The law and the pseudo-open-loop modes assume one frame of delay; the true delay is two."""
    wheel = case("reaction-wheel", exact_lines=True)
    config = wheel.configured(1, **{"control.delay_frames": 1.0, "camera.delay_frames": 2.0})
    bench = ModalBench(config, wheel.covariance_nm2, watch=False)
    bench.settle(1000)
    bench.ask("law", law=wheel.law)
    bench.run(2500)
    event = next(event for _, event in bench.events if event.name == "LAW_OVERRULED")
    assert "without correction there would be" in event.details["why"]
    assert event.details["until"] == "until the law is loaded again or the loop is closed again"
    assert bench.tilt_mas(1500) < 10


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "factor"), MOVED)
def test_with_shifted_lines_the_residual_is_at_most_a_tenth_above_the_integrators_for_all_seeds(
    preset: str, factor: float
) -> None:
    ratios: Array = np.array(
        [
            tilt_after_move(case(preset), factor, seed)[0]
            / tilt_after_move(case(preset), factor, seed, with_law=False)[0]
            for seed in SEEDS
        ]
    )
    assert ratios.max() < 1.1


@pytest.mark.slow
@pytest.mark.parametrize("magnitude", [0.0, 2.0, 5.0])
def test_a_good_law_is_never_overruled(magnitude: float) -> None:
    """One seed is simulated for ten minutes; `python -m tools.measure guard` simulates twenty seeds in some hours."""
    assert times_overruled(case("reaction-wheel", magnitude), 21) == 0
