"""The measured rejection of a loop is the theory's; sensor gains and captures are what was put in."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from lowfc.control.calibration.excitation import FEWEST_CYCLES, climb, led_in, lines, multisine
from lowfc.control.calibration.linearity import captured, gains, levels
from lowfc.control.laws import margins
from lowfc.control.laws.law import Law
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.laws.stability import delay_weights, settling_frames
from lowfc.control.laws.transfer_function import departure, measured, seen_of_mirror
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Frame, Request
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.state import FADING_FRAMES, SETTLING_FRAMES, Settings, State
from tests.support.theory import linear
from tests.support.toy import NOLL, TOY, calibration, frame, frame_sequence, live, loaded, settings

Array = npt.NDArray[np.float64]

PERIOD = 3000
GAIN = (0.4, 0.1)
TOLERANCE_DB = 1.0


def law(gain: tuple[float, float] = GAIN) -> Law:
    return settings(gain=gain).law(NOLL)


def theory_of(one: Law, delay_frames: float) -> LinearLaw:
    return linear(one, NOLL, delay_frames, 1.0)


def through(what: Settings, requests: Iterable[Request], frames: int) -> tuple[Array, Array, State]:
    """Errors and commands (frames, modes) of the toy's loop, after what was asked; and the state after them.

    Beside white noise there is a slow sine that is no line of the multisine.
    """
    state, _ = advance(what, loaded(what), frame(1))
    for request in requests:
        state, outputs = advance(what, state, request)
        assert outputs.reply.accepted, outputs.reply.text
    slow = 3 * np.sin(2e-4 * np.arange(frames))[:, None]
    noise = 0.3 * np.random.default_rng(3).standard_normal((frames, len(NOLL)))
    steps, _, state = live(what, slow + noise, state=state, first=2)
    error_nm, command_nm = (
        np.array([getattr(step, name) for step in steps], float) for name in ("error_nm", "command_nm")
    )
    return error_nm, command_nm, state


@pytest.mark.parametrize("delay_frames", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("target", ["offset", "mirror"])
def test_the_measured_rejection_is_the_theorys(delay_frames: float, target: str) -> None:
    what = settings(delay_frames=delay_frames, gain=GAIN)
    places = lines(PERIOD, len(NOLL), 12, FEWEST_CYCLES / PERIOD, 0.3)
    period = multisine(PERIOD, places, 3.0, 1)
    lead = settling_frames(law().gain, law().leak)
    table = led_in(period, lead)
    shapes = np.zeros(0) if target == "offset" else calibration().modes_to_actuators.T.reshape(-1)
    request = Request(0, "play", text=target, table=table, actuators_nm=shapes.astype(np.float32))
    error_nm, _, _ = through(what, [request], len(table))
    weights = delay_weights(delay_frames)
    added = -period.astype(float) if target == "offset" else seen_of_mirror(period.astype(float), weights)
    found = measured(error_nm[lead:], added)

    assert [np.sort(np.round(found.frequency[found.mode == mode] * PERIOD)).tolist() for mode in range(3)] == [
        one.tolist() for one in places
    ]
    theory, rows = theory_of(law(), delay_frames), np.arange(found.mode.size)
    S, T = (of(theory, found.frequency)[rows, found.mode] for of in (margins.rejection, margins.noise_transfer))
    of_s = departure(found.rejection, S, found.error, TOLERANCE_DB)
    of_t = departure(found.noise_transfer, T, found.error, TOLERANCE_DB)
    assert of_s.judged.sum() > 0.8 * rows.size
    assert of_t.judged.sum() > 0.5 * rows.size
    for one in (of_s, of_t):
        assert np.array_equal(one.judged, one.within)
        assert 0.6 < np.sqrt(np.mean((one.db[one.judged] / one.error_db[one.judged]) ** 2)) < 1.6
    assert (np.abs(of_s.db[of_s.judged & (found.frequency > 0.02)]) < 0.5).all()

    wrong = margins.rejection(theory_of(law((0.6, 0.15)), delay_frames), found.frequency)[rows, found.mode]
    other = departure(found.rejection, wrong, found.error, TOLERANCE_DB)
    assert not other.within[other.judged].all()


def test_a_linear_laws_too() -> None:
    what = settings(gain=GAIN)
    other = theory_of(law((0.3, 0.2)), 1.0)
    places = lines(PERIOD, len(NOLL), 10, FEWEST_CYCLES / PERIOD, 0.3)
    period = multisine(PERIOD, places, 3.0, 2)
    lead = SETTLING_FRAMES + FADING_FRAMES + 200
    requests = [Request(0, "law", law=other), Request(0, "play", text="offset", table=led_in(period, lead))]
    error_nm, _, _ = through(what, requests, lead + PERIOD)
    found = measured(error_nm[lead:], -period.astype(float))
    theory = margins.rejection(other, found.frequency, 1.0)[np.arange(found.mode.size), found.mode]
    of = departure(found.rejection, theory, found.error, TOLERANCE_DB)
    assert of.judged.sum() > 0.8 * found.mode.size
    assert of.within[of.judged].all()


def test_lines_are_odd_ascending_and_of_one_mode_each() -> None:
    for modes in (1, 2, 3, 14):
        places = lines(15_000, modes, 12, 0.1 / 250, 0.3)
        every = np.sort(np.concatenate(places))
        assert every.size == np.unique(every).size == 12 * modes
        assert (every % 2 == 1).all()
        assert every[0] >= 0.1 / 250 * 15_000
        assert every[-1] <= 0.3 * 15_000
        assert every[-1] > 0.28 * 15_000
        for one in places:
            assert (np.diff(one) >= 6).all()


@pytest.mark.parametrize(
    ("arguments", "why"),
    [
        ((1000, 3, 12, 0.001, 0.3), "cycles"),
        ((100, 14, 12, 0.05, 0.3), "room"),
        ((1000, 3, 12, 0.3, 0.1), "ascend"),
        ((1000, 3, 12, 0.1, 0.6), "ascend"),
    ],
)
def test_a_multisine_that_cannot_be_is_refused(arguments: tuple[int, int, int, float, float], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        lines(*arguments)


def test_a_multisine_has_its_rms_its_lines_and_a_low_crest() -> None:
    places = lines(4000, 4, 15, 0.001, 0.3)
    table = multisine(4000, places, 2.0, 5)
    assert np.std(table, axis=0) == pytest.approx(2.0, rel=1e-5)
    assert (np.abs(table).max(axis=0) < 3.3 * 2.0).all()
    spectrum = np.abs(np.fft.rfft(table, axis=0))
    for mode, one in enumerate(places):
        assert np.array_equal(np.flatnonzero(spectrum[:, mode] > 1e-3 * spectrum[:, mode].max()), one)
    led = led_in(table, 4500)
    assert np.array_equal(led[500:4500], table)
    assert np.array_equal(led[4500:], table)


def test_a_vibration_on_a_line_makes_it_uncertain() -> None:
    rng = np.random.default_rng(2)
    period = multisine(PERIOD, lines(PERIOD, 1, 10, 0.005, 0.3), 2.0, 1).astype(float)
    place = int(lines(PERIOD, 1, 10, 0.005, 0.3)[0][4])
    time = np.arange(PERIOD)
    error = 0.5 * period + 0.01 * rng.standard_normal(period.shape)
    quiet = measured(error, period)
    shaken = measured(error + np.sin(2 * np.pi * (place + 0.4) / PERIOD * time)[:, None], period)
    assert np.abs(quiet.rejection - 0.5).max() < 0.02
    assert shaken.error[4] > 10 * quiet.error[4]
    assert abs(shaken.rejection[4] - 0.5) < 5 * shaken.error[4]


def test_nothing_played_is_nothing_measured() -> None:
    with pytest.raises(ValueError, match="nothing was added"):
        measured(np.zeros((100, 3)), np.zeros((100, 3)))
    with pytest.raises(ValueError, match="same frames"):
        measured(np.zeros((100, 3)), np.zeros((99, 3)))


def test_a_staircase_keeps_its_step_and_holds_its_levels() -> None:
    wanted = levels([2.0, 5.0], 2)
    assert wanted.tolist() == [2, -2, -2, 2] * 2 + [5, -5, -5, 5] * 2
    stairs, starts = climb(wanted, 6, 3.0)
    assert np.abs(np.diff(stairs, prepend=0.0)).max() <= 3.0
    assert stairs[-1] == 0
    for start, level in zip(starts, wanted, strict=True):
        assert (stairs[start : start + 6] == level).all()
        assert (
            start == 0 or stairs[start - 1] != level or level == wanted[max(np.flatnonzero(starts == start)[0] - 1, 0)]
        )


def test_gain_and_crosstalk_are_what_was_put_in() -> None:
    rng = np.random.default_rng(8)
    wanted = levels([4.0, 8.0, 16.0], 8)
    stairs, starts = climb(wanted, 8, 10.0)
    true = np.stack([0.1 * stairs, stairs * (1 - (stairs / 50) ** 2), np.zeros_like(stairs)], axis=1)
    drift = np.linspace(0, 20, len(stairs))[:, None]
    found = gains(true + drift + 0.2 * rng.standard_normal(true.shape), 1, wanted, starts + 2, 6)
    assert found.amplitude_nm.tolist() == [4, 8, 16]
    truth = np.stack([np.full(3, 0.1), 1 - (found.amplitude_nm / 50) ** 2, np.zeros(3)], axis=1)
    assert (np.abs(found.gain - truth) < 4 * found.error).all()
    assert found.error.max() < 0.02
    assert found.within(0.05, 0.2) == [True, True, False]
    assert found.within(0.5, 0.05) == [False] * 3
    assert gains(true + 30 * rng.standard_normal(true.shape), 1, wanted, starts + 2, 6).within(0.05, 0.2)[0] is None


@pytest.mark.parametrize(("gain", "expected"), [((0.4, 0.3), True), ((0.0, 0.0), False)])
def test_a_shape_is_captured_where_the_loop_takes_it_away(gain: tuple[float, float], expected: bool) -> None:
    what = replace(settings(gain=gain), start_mode=LoopMode.CLOSED)
    shape = calibration().modes_to_actuators[:, 1][None]
    stairs, starts = climb([0.0, 30.0], 40, 20.0)
    table = stairs.astype(np.float32)[:, None]
    request = Request(0, "play", text="mirror", table=table, actuators_nm=shape.reshape(-1))
    error_nm, command_nm, state = through(what, [request], len(table))
    assert state.mode is LoopMode.CLOSED
    before, after = slice(20, 40), slice(int(starts[1]) + 30, int(starts[1]) + 40)
    assert captured(error_nm, command_nm, 1, 30.0, before, after) is expected
    assert not captured(np.zeros_like(error_nm), np.zeros_like(command_nm), 1, 30.0, before, after)


def test_a_frame_of_the_play_is_the_one_it_was_answered_with() -> None:
    what = settings()
    state, _ = advance(what, loaded(what), frame(1))
    state, outputs = advance(what, state, Request(0, "play", text="offset", table=np.full((3, 3), 5.0, np.float32)))
    assert outputs.reply.frame_sequence == frame_sequence(2)
    _, outputs = advance(what, state, Frame(frame_sequence(2), 0, 0, TOY.pixels((0, 0, 0))))
    assert outputs.step.error_nm == pytest.approx(-5.0, abs=0.05)
