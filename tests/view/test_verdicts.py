"""The verdict on a run as text, levels and picture: each state by itself, and the conditions for a good loop."""

from collections import Counter
from collections.abc import Callable

import numpy as np
import pytest

from lowfc.contract.events import EVENTS
from lowfc.contract.messages import CAMERA_STATE, CONTROLLER_STATE, EVENT, FRAME, wire
from lowfc.control.loop.safety import Limit, LoopMode, Rejection
from lowfc.control.loop.wording import CAMERA_MISFIT, MEASURED_FIRST
from lowfc.programs.view.panels.tiles import FILL, GROUND, HEIGHT, TILES, WIDTH, Tiles, picture, png, tile_boxes
from lowfc.programs.view.snapshot import Accumulator
from lowfc.programs.view.verdicts.camera_verdict import REFUSED
from lowfc.programs.view.verdicts.facts import facts
from lowfc.programs.view.verdicts.steady import ResidualComparison
from lowfc.programs.view.verdicts.tile import Level, Tile, Verdict
from lowfc.programs.view.verdicts.verdict import judge
from lowfc.programs.view.verdicts.watcher import Watcher
from lowfc.programs.view.verdicts.wavefront_verdict import level_and_reason, reduction_of
from tests.support.report_log import SyntheticLog
from tests.support.stage import NM_PER_MAS, Stage, Tape, tile
from tests.support.toy import START
from tests.support.viewers import Pixels, pixels

NO_WARNING = {Level.NEUTRAL, Level.GOOD}


def levels(verdict: Verdict) -> dict[str, Level]:
    return {one.title: one.level for one in verdict.tiles}


def begun(seconds: float = 0.0, **values: object) -> Stage:
    """A scripted run with these attributes, after so many seconds."""
    stage = Stage()
    setting(**values)(stage)
    stage.begin()
    stage.run(seconds)
    return stage


def verdict_after(change: Callable[[Stage], object], after_s: float = 4.0) -> Verdict:
    """Verdict on a run that is healthy for a second, then changed for `after_s`."""
    stage = begun(1)
    change(stage)
    return stage.run(after_s)


def setting(**values: object) -> Callable[[Stage], None]:
    return lambda stage: stage.__dict__.update(values)


def silence(*names: str) -> Callable[[Stage], None]:
    return lambda stage: stage.silent.update(names)


def stop(*names: str) -> Callable[[Stage], None]:
    return lambda stage: stage.states.update(dict.fromkeys(names, "stopped"))


def health(name: str, **fields: object) -> Callable[[Stage], None]:
    return lambda stage: stage.health.__setitem__(name, fields)


def recording(**fields: object) -> Callable[[Stage], None]:
    return health("recorder", recording=wire.Recording(**fields))


def counting(**counts: int) -> Callable[[Stage], None]:
    return health("controller", topics=[wire.TopicCount(topic=FRAME.key, **counts)])


def to_mode(mode: LoopMode, why: str) -> Callable[[Stage], None]:
    def change(stage: Stage) -> None:
        stage.mode = mode
        details = {"before": "closed", "after": mode.in_words, "why": why}
        stage.send(EVENT, EVENTS["MODE_CHANGED"].log("controller", stage.data_ns, **details))

    return change


def holding(reason: Rejection, **state: object) -> Callable[[Stage], None]:
    def change(stage: Stage) -> None:
        stage.reasons = (reason,)
        stage.send(CONTROLLER_STATE, wire.ControllerState(mode=stage.mode.value, **state))

    return change


def relaxing_camera_dead(stage: Stage) -> None:
    settings = wire.ControllerSettings(on_frame_timeout="flat")
    stage.send(CONTROLLER_STATE, wire.ControllerState(mode=stage.mode.value, settings=settings))
    stage.silent.add("camera")


MISFIT = f"{CAMERA_MISFIT}: bias_dn is 260"
OTHER_SIZE = "the computed calibration is for frames of 32 x 32 pixels, the camera's are 64 x 64"
LEASE = wire.Lease(holds=True, holder="calibrate")
ALL_PROCESSES = ("camera", "controller", "mirror-dm", "recorder")
HARMFUL = "worse than a flat mirror: `lowfc ctl safe` relaxes it to flat"
STATES: dict[str, tuple[Callable[[Stage], object], str, str]] = {
    # name: the change; title, value and level of the tile that shows it; a part of the headline
    "healthy": (setting(), "LOOP CLOSED GOOD", "nothing is wrong"),
    "open": (setting(mode=LoopMode.OPEN), "LOOP OPEN NEUTRAL", "lowfc ctl close"),
    "open, worse than flat": (setting(mode=LoopMode.OPEN, residual_nm=60.0), "LOOP OPEN NEUTRAL", HARMFUL),
    "gains measured first": (to_mode(LoopMode.OPEN, MEASURED_FIRST), "LOOP OPEN NEUTRAL", "then closes by itself"),
    "camera changed": (to_mode(LoopMode.OPEN, MISFIT), "LOOP OPEN WARNING", "opened by itself"),
    "safe": (setting(mode=LoopMode.SAFE), "LOOP SAFE BAD", "lowfc ctl clear"),
    "idle": (setting(mode=LoopMode.IDLE, reasons=(Rejection.NO_CALIBRATION,)), "FRAMES REFUSED BAD", "no calibration"),
    "idle, other size": (to_mode(LoopMode.IDLE, OTHER_SIZE), "LOOP IDLE WARNING", "no calibration for these frames"),
    "controller dead": (silence("controller"), "LOOP DEAD BAD", "Controller silent for 4 s"),
    "camera dead": (silence("camera"), "FRAMES NO FRAMES BAD", "No frame for 4 s, camera silent: the loop holds"),
    "camera dead, mirror relaxes": (relaxing_camera_dead, "FRAMES NO FRAMES BAD", "silent: the mirror relaxes to flat"),
    "mirror dead": (silence("mirror-dm"), "MIRROR DEAD BAD", "Mirror silent for 4 s"),
    "recorder dead": (silence("recorder"), "RECORDER DEAD BAD", "Recorder silent"),
    "all dead": (silence(*ALL_PROCESSES), "LOOP NO MESSAGES BAD", "No message from any process for 4 s"),
    "ended": (stop(*ALL_PROCESSES), "LOOP ENDED NEUTRAL", "The run has ended"),
    "controller stopped": (stop("controller"), "LOOP STOPPED NEUTRAL", "The controller was stopped"),
    "camera stopped": (stop("camera"), "LOOP HOLDING NEUTRAL", "The camera was stopped"),
    "skipped": (counting(skipped=12), "FRAMES 12 LOST WARNING", "12 skipped (controller busy)"),
    "missing": (counting(missing=90), "FRAMES 90 LOST BAD", "90 never arrived"),
    "late frames": (setting(reasons=(Rejection.LATE,)), "FRAMES REFUSED BAD", "too late"),
    "wrong size": (setting(reasons=(Rejection.WRONG_SIZE,)), "FRAMES REFUSED BAD", "wrong size"),
    "frames out of order": (setting(reasons=(Rejection.OUT_OF_ORDER,)), "FRAMES REFUSED BAD", "`lowfc ctl safe` and"),
    "frames ahead": (setting(reasons=(Rejection.AHEAD,)), "FRAMES REFUSED BAD", "clock"),
    "camera unknown": (setting(reasons=(Rejection.CAMERA_UNKNOWN,)), "FRAMES REFUSED BAD", "settings"),
    "mirror lost": (holding(Rejection.NO_MIRROR, mirror_fault="is silent"), "LOOP HOLDING WARNING", "mirror is silent"),
    "reserved": (holding(Rejection.HELD, lease=LEASE), "LOOP HOLDING WARNING", "reserved for calibrate"),
    "held, no state": (setting(reasons=(Rejection.HELD,)), "LOOP HOLDING WARNING", "Every frame is refused"),
    "saturated": (
        setting(reasons=(Rejection.SATURATED,), saturated_pixels=20),
        "STAR SATURATED BAD",
        "Every frame is refused, detector saturated",
    ),
    # The percentage is the flux: the three full pixels add 83 %.
    "nearly saturated": (setting(saturated_pixels=3), "STAR 183 % WARNING", "3 pixels at full well"),
    "star gone": (setting(reasons=(Rejection.DARK,), flux=0.01), "STAR GONE BAD", "the star is gone"),
    "dim": (setting(flux=0.4), "STAR 40 % WARNING", "The star is dim"),
    "stroke": (setting(reasons=(Limit.STROKE,)), "MIRROR AT LIMIT BAD", "actuator stroke"),
    "mirror's limit": (setting(limits_hit=(Limit.SLEW,)), "MIRROR AT LIMIT WARNING", "slew), by its own limits:"),
    "law overruled": (setting(reasons=(Limit.LAW_OVERRULED,)), "LOOP CLOSED WARNING", "Tune again"),
    "modal limit": (setting(reasons=(Limit.MODAL_LIMIT,)), "MIRROR AT LIMIT BAD", "modal limit"),
    "little stroke left": (setting(stroke_nm=650.0), "MIRROR 93 % WARNING", "little is left"),
    "expired": (setting(status=wire.MIRROR_STATUS_EXPIRED), "MIRROR EXPIRED BAD", "receives no commands"),
    "refusing": (
        setting(status=wire.MIRROR_STATUS_EXPIRED, refused=Rejection.AHEAD),
        "MIRROR REFUSES BAD",
        "refuses the commands (AHEAD)",
    ),
    "never followed": (
        setting(status=wire.MIRROR_STATUS_WAITING, refused=Limit.WRONG_GRID),
        "MIRROR REFUSES BAD",
        "refuses the commands (WRONG_GRID)",
    ),
    "mirror's driver failed": (
        setting(status=wire.MIRROR_STATUS_EXPIRED, refused=Rejection.NO_MIRROR),
        "MIRROR REFUSES BAD",
        "Its driver failed",
    ),
    "harmful": (setting(residual_nm=60.0), "WAVEFRONT 60.0 nm rms WARNING", "The loop does harm"),
    "diverging": (setting(residual_nm=400.0), "WAVEFRONT 400 nm rms BAD", "40.0 nm with a flat mirror"),
    "late commands": (health("camera", commands_late=80), "LATENCY 80 LATE WARNING", "80 commands, "),
    "slow": (setting(latency_us=30_000), "LATENCY 30000 us WARNING", "longer than a frame"),
    "recorder failed": (recording(failure="no space left"), "RECORDER FAILED BAD", "no space left"),
    "recorder's folder gone": (
        recording(failure="logs is gone"),
        "RECORDER FAILED BAD",
        "gone. Remove the cause, such as",
    ),
    "control characters": (recording(failure="\x1b[2J"), "RECORDER FAILED BAD", "goes on: \\x1b[2J."),
    "recording stopped": (recording(file="a", stopped=True), "RECORDER STOPPED WARNING", "stopped by an operator"),
    "recorder stopped": (stop("recorder"), "RECORDER STOPPED WARNING", "The recorder was stopped"),
    "recorder losing": (recording(file="a", lost=5), "RECORDER LOSING BAD", "lost 5 messages"),
    "view behind": (setting(behind_s=3.0), "VIEW 3 s WARNING", "This view is 3 s behind"),
}


@pytest.fixture(scope="module")
def verdicts() -> dict[str, Verdict]:
    return {name: verdict_after(change, 4 if "dead" in name else 2) for name, (change, *_) in STATES.items()}


@pytest.mark.parametrize("name", STATES)
def test_each_state_has_its_tile_level_and_headline(verdicts: dict[str, Verdict], name: str) -> None:
    _, expected, part_of_headline = STATES[name]
    verdict = verdicts[name]
    found = tile(verdict, expected.split()[0])
    assert f"{found.title} {found.value} {found.level.name}" == expected, verdict
    assert part_of_headline in verdict.headline
    assert all(one.advice for one in verdict.tiles if one.level is verdict.level >= Level.WARNING)
    assert verdict.level is (found.level if found.level >= Level.WARNING else tile(verdict, "LOOP").level)


def test_no_two_states_have_the_same_headline(verdicts: dict[str, Verdict]) -> None:
    assert [line for line, count in Counter(one.headline for one in verdicts.values()).items() if count > 1] == []


@pytest.mark.parametrize(
    ("limit", "remedy"),
    [
        (Limit.MODAL_LIMIT, "`lowfc ctl limit`"),
        (Limit.STROKE, "smaller channels"),
        (Limit.SLEW, "nothing to do if the loop has just been closed or reset"),
        (Limit.NEIGHBOUR, "stuck actuator"),
        (Limit.NOT_FINITE, "check calibration and law"),
    ],
)
def test_each_limit_has_its_own_advice(limit: Limit, remedy: str) -> None:
    headline = verdict_after(setting(reasons=(limit,)), 2).headline
    assert remedy in headline
    assert limit is Limit.MODAL_LIMIT or "raise" not in headline  # the others protect the mirror


def test_a_few_frames_out_of_order_are_no_reason_to_flatten_the_mirror() -> None:
    stage = begun(1)
    stage.reasons = (Rejection.OUT_OF_ORDER,)
    stage.run(0.2)
    stage.reasons = ()
    headline = stage.run(0.3).headline
    assert "second camera" in headline
    assert "lowfc ctl safe" not in headline


def test_a_harmful_linear_law_has_no_gain_to_lower() -> None:
    stage = begun(1, residual_nm=60.0)
    assert "Lower the gain or open the loop" in stage.run(1).headline
    stage.send(CONTROLLER_STATE, wire.ControllerState(mode=stage.mode.value, law=wire.LinearLaw(name="lqg")))
    headline = stage.run(1).headline
    assert "`lowfc ctl law integrator`" in headline
    assert "gain" not in headline


def test_a_contrast_from_the_sensor_is_called_estimated() -> None:
    figures = {"recent_wavefront": wire.WavefrontFigures(costliest_modes="tip and tilt", added_contrast_flat=1e-8)}
    assert "estimated" not in tile(verdict_after(health("camera", **figures), 2), "CONTRAST").detail
    assert "estimated from the sensor" in tile(verdict_after(health("controller", **figures), 2), "CONTRAST").detail


def test_a_closed_loop_without_usable_frames_is_shown_as_holding(verdicts: dict[str, Verdict]) -> None:
    assert tile(verdicts["camera dead"], "LOOP").value == tile(verdicts["star gone"], "LOOP").value == "HOLDING"


def test_every_reason_to_refuse_a_frame_is_counted() -> None:
    assert REFUSED.keys() == set(Rejection) - {Rejection.NO_FRAME}


@pytest.mark.parametrize("name", ["mirror lost", "reserved", "held, no state"])
def test_a_loop_that_holds_raises_no_second_alarm_about_its_frames(verdicts: dict[str, Verdict], name: str) -> None:
    frames = tile(verdicts[name], "FRAMES")
    assert (frames.value, frames.level) == ("50 Hz", Level.GOOD)
    assert frames.detail.endswith("frames refused in the last 5 s")


@pytest.mark.parametrize("name", ["open", "safe", "idle, other size", "controller dead", "star gone", "ended"])
def test_the_wavefront_is_called_not_corrected_only_if_no_loop_corrects_it(
    verdicts: dict[str, Verdict], name: str
) -> None:
    found = tile(verdicts[name], "WAVEFRONT")
    compared = "of" if name in ("star gone", "ended") else "not corrected;"
    assert found.detail.startswith(f"{compared} 40.0 nm with a flat mirror")
    assert found.level is Level.NEUTRAL


@pytest.mark.parametrize("after_s", [0.5, 20.0])
def test_values_of_an_ended_run_are_labelled_last_and_are_neutral(after_s: float) -> None:
    verdict = verdict_after(stop(*ALL_PROCESSES), after_s=after_s)
    last = [tile(verdict, title).value for title in ("WAVEFRONT", "STAR", "LATENCY")]
    assert last == ["last: 5.0 nm", "last: 100 %", "last: 500 us"]
    assert set(levels(verdict).values()) == {Level.NEUTRAL}


def test_few_unused_frames_are_reported_for_five_seconds_without_a_warning() -> None:
    stage = begun(3)
    counting(skipped=1)(stage)
    stage.reasons = (Rejection.LATE,)
    stage.run(0.02)
    stage.reasons = ()
    frames = tile(stage.run(0.98), "FRAMES")
    detail = "1 frame skipped, 1 frame refused in the last 5 s"
    assert (frames.value, frames.level, frames.detail) == ("50 Hz", Level.GOOD, detail)
    counting(skipped=2)(stage)  # 2 of 250 are more than 0.5 %
    verdict = stage.run(1)
    assert (tile(verdict, "FRAMES").value, verdict.level) == ("2 LOST", Level.WARNING)
    assert verdict.headline.startswith("2 frames lost in the last 5 s")
    assert tile(stage.run(2.5), "FRAMES").value == "2 LOST"
    assert tile(stage.run(3), "FRAMES").detail == "none lost, none refused"


def test_incidents_of_a_slow_camera_are_shown_for_ten_frame_periods() -> None:
    stage = begun(3)
    stage.send(CAMERA_STATE, wire.CameraState(period_ns=2_000_000_000))
    counting(skipped=2)(stage)
    assert tile(stage.run(8), "FRAMES").detail == "2 frames skipped in the last 20 s"


def test_a_camera_restart_does_not_change_the_frame_rate() -> None:
    stage = begun(3)
    stage.start_s += 100
    assert {tile(stage.run(0.1), "FRAMES").value for _ in range(15)} == {"50 Hz"}


def test_a_dead_mirror_is_shown_even_if_another_runs_or_was_stopped() -> None:
    stage = begun()
    stage.states |= {"mirror-dm": "running", "mirror-tt": "running", "mirror-old": "stopped"}
    stage.run(1)
    stage.silent = {"mirror-old"}
    assert tile(stage.run(3), "MIRROR").level is Level.GOOD
    stage.silent.add("mirror-tt")
    assert (tile(stage.run(3), "MIRROR").value, tile(stage.run(3), "LOOP").level) == ("DEAD", Level.WARNING)


def test_without_truth_the_wavefront_tile_is_labelled_measured() -> None:
    found = tile(begun(truth=False).run(3), "WAVEFRONT")
    tilt = f"tilt {5 / np.sqrt(2) / NM_PER_MAS:.1f} of {40 / np.sqrt(2) / NM_PER_MAS:.1f} mas per axis"
    assert found.value == "5.0 nm rms"
    assert found.detail == f"8.0 x better than 40.0 nm with a flat mirror; {tilt}; measured, with noise"


def test_simulated_time_is_not_reported_as_silence_or_latency() -> None:
    stage = Stage(data_ns=10**18)
    stage.latency_us = 30_000
    stage.begin()
    verdict = stage.run(5)
    assert verdict.level is Level.GOOD
    assert set(levels(verdict).values()) == NO_WARNING


def test_absent_processes_are_reported_only_after_a_grace_time() -> None:
    watcher = Watcher()
    watcher.feed(Accumulator().snapshot(START * 10**9))
    nothing = judge(watcher.state())
    assert (nothing.level, nothing.headline) == (Level.NEUTRAL, "Waiting for the controller.")
    stage = begun(silent={"camera", "mirror-dm", "recorder"}, states={"controller": "ready"})
    assert stage.run(5).level is Level.NEUTRAL
    late = stage.run(10)
    assert (tile(late, "FRAMES").value, tile(late, "MIRROR").value) == ("NO CAMERA", "NO MIRROR")
    assert late.level is Level.WARNING


def test_steps_are_judged_without_a_state_of_the_camera() -> None:
    stage = Stage()
    stage.states = {"controller": "running", "camera": "running"}
    assert tile(stage.run(0.1), "FRAMES").value == "50 Hz"
    assert levels(stage.run(3))["FRAMES"] is Level.GOOD


def test_a_view_that_is_behind_does_not_report_the_run_as_dead() -> None:
    stage = begun(3)
    stage.behind_s = 30.0
    stage.silent = set(ALL_PROCESSES)  # nothing newer has arrived yet
    assert [one.title for one in stage.run(20).tiles if one.level >= Level.WARNING] == ["VIEW"]


# Conditions for a good loop.


@pytest.mark.parametrize(
    ("improvement", "comparison", "level"),
    [
        (1.5, None, Level.NEUTRAL),
        (2.5, None, Level.GOOD),
        (2.5, ResidualComparison(2.0, 1.9, 0.5), Level.GOOD),
        (2.5, ResidualComparison(4.0, 1.9, 0.5), Level.NEUTRAL),  # the best gains would leave half the residual
        (1.5, ResidualComparison(2.0, 1.9, 0.5), Level.NEUTRAL),
        (5.0, ResidualComparison(2.0, 1.0, 8.0), Level.GOOD),  # within the uncertainty of the noise
    ],
)
def test_a_loop_is_good_if_it_corrects_and_other_gains_would_not_do_better(
    improvement: float, comparison: ResidualComparison | None, level: Level
) -> None:
    assert level_and_reason(improvement, comparison)[0] is level


def test_noise_is_subtracted_before_a_measured_wavefront_is_judged() -> None:
    assert reduction_of(5.0, 13.0, 0.0) == pytest.approx(2.6)
    assert reduction_of(5.0, 13.0, 4.0) == pytest.approx(np.sqrt(13**2 - 4**2) / 3)


def test_a_loop_that_corrects_little_is_neutral_and_so_is_its_headline() -> None:
    stage = begun(residual_nm=20.0, open_nm=30.0)
    verdict = stage.run(3)
    assert tile(verdict, "WAVEFRONT").detail.startswith("1.5 x better")
    assert (tile(verdict, "WAVEFRONT").level, verdict.level) == (Level.NEUTRAL, Level.NEUTRAL)
    assert "little is corrected" in verdict.headline
    stage.residual_nm = 5.0
    assert stage.run(2).level is Level.GOOD


def test_the_residual_of_the_best_gains_is_computed_from_the_measured_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lowfc.programs.view.verdicts.watcher.COMPARISON_PERIOD_NS", 1_000_000_000)
    night = SyntheticLog(truth=False).frames(3000)
    accumulator, watcher = Accumulator(), Watcher()
    for number, one in enumerate(night.samples, 1):
        accumulator.add(one)
        if number % 2500 == 0 or number == len(night.samples):
            watcher.feed(accumulator.snapshot(one.publish_time_ns))
    found = watcher.state().comparison
    assert 0 < found.best_nm <= 1.05 * found.residual_nm
    assert found.noise_nm > 0
    assert tile(judge(watcher.state()), "WAVEFRONT").detail.endswith("without noise")


def test_a_shape_held_on_purpose_is_not_reported_as_harm() -> None:
    stage = begun(3)
    stage.residual_nm = 60.0
    channels = [wire.Channel(name="dark-hole")]
    stage.send(CONTROLLER_STATE, wire.ControllerState(mode=stage.mode.value, channels=channels))
    verdict = stage.run(4)
    assert verdict.level is Level.NEUTRAL
    assert "including the shapes of offset and channels" in verdict.headline


def test_an_idle_loop_names_the_cause(verdicts: dict[str, Verdict]) -> None:
    assert tile(verdicts["idle, other size"], "LOOP").detail == OTHER_SIZE
    assert tile(verdicts["idle"], "LOOP").detail == "no calibration"


@pytest.mark.parametrize(
    "reason", ["the camera's frames fit the calibration", "an interlock acts: camera_temp is 41", "camera exchange"]
)
def test_a_loop_that_opened_for_another_reason_is_not_blamed_on_the_camera(reason: str) -> None:
    verdict = verdict_after(to_mode(LoopMode.OPEN, reason), 2)
    assert tile(verdict, "LOOP").detail.startswith(reason)
    assert (tile(verdict, "LOOP").level, verdict.level) == (Level.NEUTRAL, Level.NEUTRAL)


def test_the_controllers_state_gives_the_cause_of_the_mode() -> None:
    stage = begun(1)
    to_mode(LoopMode.OPEN, "operator asked to pause")(stage)
    stage.send(CONTROLLER_STATE, wire.ControllerState(mode=wire.LOOP_MODE_OPEN, mode_cause="operator asked to open"))
    assert tile(stage.run(2), "LOOP").detail.startswith("operator asked to open")


def test_past_refusals_are_reported_as_ended() -> None:
    stage = begun(3)
    stage.reasons = (Rejection.DARK,)
    stage.run(2)
    stage.reasons = ()
    assert "too dark: it has ended" in stage.run(2).headline


# The facts.


def test_the_facts_are_run_host_law_offset_channels_and_note() -> None:
    stage = begun(1, health={"controller": {"run_id": "night-7", "host": "bench"}})
    shape = np.full(4, 2.0, "<f4").tobytes()
    state = wire.ControllerState(
        mode=LoopMode.CLOSED.value,
        gain=[0.5, 0.5, 0.25],
        leak=[0.0] * 3,
        delay_frames=1,
        offset_nm=[0.0, 0.0, 5.0],
        channels=[wire.Channel(name="dark-hole", actuators=shape, reached=shape)],
    )
    stage.send(CONTROLLER_STATE, state)
    for at_s, text in ((5, "later"), (1, "earlier")):  # a note from before the view began comes after a newer one
        stage.send(EVENT, EVENTS["NOTE"].log("controller", (START + at_s) * 10**9, text=text))
    found = stage.run(1).facts
    assert found["RUN"] == "night-7 on bench"
    assert found["CONTROL LAW"] == "integrator, gain 0.5 0.5 0.25; delay 1 frame"
    assert found["OFFSET AND CHANNELS"].endswith("5 nm; dark-hole 2 nm rms of surface, zero point not shifted")
    assert found["LAST NOTE"].endswith("later")
    state.law.name, state.law_frames, state.offset_nm[:] = "lqg", 10**6, [0.0] * 3
    stage.send(CONTROLLER_STATE, state)
    found = stage.run(1).facts
    assert found["CONTROL LAW"] == "lqg; delay 1 frame"
    assert found["OFFSET AND CHANNELS"] == "no offset; dark-hole 2 nm rms of surface, zero point not shifted"
    assert set(facts(Watcher().state()).values()) == {"not known", "none known"}


NOON_NS = 43_200 * 10**9
LONG = "neighbouring/actuators/in/a/very/long/path/without/any/blank " + "and more words than a tile has room for " * 3


def picture_of(verdict: Verdict, time_ns: int = NOON_NS) -> Pixels:
    return pixels(png(picture(verdict, time_ns)))


@pytest.mark.parametrize("tiles", [7, 8])
@pytest.mark.parametrize("level", Level)
def test_text_stays_inside_its_tile_and_off_its_border(level: Level, tiles: int) -> None:
    verdict = Verdict(LONG, level, (Tile("RECORDER", "NO MESSAGES FROM IT", LONG, level),) * tiles, {})
    shown = picture_of(verdict)
    outside = np.ones((HEIGHT, WIDTH), bool)
    for x0, y0, x1, y1 in tile_boxes(tiles):
        inside = shown[y0:y1, x0:x1]
        border = np.ones(inside.shape[:2], bool)
        border[2:-2, 2:-2] = False
        assert (inside[border] == FILL[level]).all()
        assert (inside != FILL[level]).any(axis=2).mean() > 0.03  # the tile has text
        outside[y0:y1, x0:x1] = False
    assert (shown[outside] == GROUND).all()


def test_the_picture_shows_the_whole_text_and_the_time_of_day_at_its_right_edge() -> None:
    noon, longer, second = (
        picture_of(Verdict(LONG, Level.GOOD, (Tile("A", "B", LONG + end, Level.BAD),) * 7, {}), at_ns)
        for end, at_ns in (("a", NOON_NS), ("ab", NOON_NS), ("a", NOON_NS + 86_401 * 10**9))
    )
    assert (noon != longer).any(), "a longer text is drawn smaller and not truncated"
    differs = np.argwhere((noon != second).any(axis=2))
    (top, left), (bottom, right) = differs.min(axis=0), differs.max(axis=0)
    assert 0 < top < bottom < tile_boxes(7)[0][3]
    assert WIDTH - 190 < left < right < WIDTH  # the time of day takes less than 190 pixels


def test_levels_differ_in_lightness() -> None:
    lightness = sorted(float(np.dot(FILL[level], (0.2126, 0.7152, 0.0722))) for level in Level)
    assert min(np.diff(lightness)) > 8  # of 255


def test_a_picture_is_drawn_each_second_and_when_the_verdict_changes() -> None:
    tape, panel, stage = Tape(), Tiles(NM_PER_MAS), Stage()
    stage.on_snapshot = lambda snapshot: panel.draw(tape, snapshot)
    stage.begin()
    stage.run(3)
    assert 1 <= len(tape.logged[TILES]) <= 4 * 3
    tape.logged.clear()
    stage.run(3)
    assert len(tape.logged[TILES]) == 3
    stage.mode = LoopMode.SAFE
    stage.run(0.5)
    assert len(tape.logged[TILES]) > 3
