"""What a view says of more than the last seconds: what is set, what was before it began, how a whole night was."""

import platform
from pathlib import Path

import numpy as np
import pytest
import rerun.blueprint as rrb
from report_log import Night
from tape import Tape
from test_tiles import Stage, setting, tile
from toy import START

from lowfc.adapters.log_reader import LogReader
from lowfc.contract.configuration import Configuration
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import CONTROLLER_STATE, EVENT, Log, timestamp, topic_of, wire
from lowfc.control.safety import LoopMode
from lowfc.programs.view import attainable, course, loop, mirror, pointing, sensor, tiles, trend
from lowfc.programs.view.attainable import Attained
from lowfc.programs.view.course import Course, round_125
from lowfc.programs.view.earlier import earlier_events
from lowfc.programs.view.facts import facts
from lowfc.programs.view.layout import layout
from lowfc.programs.view.moment import Gatherer
from lowfc.programs.view.painter import Painter
from lowfc.programs.view.recorded import draw_logs
from lowfc.programs.view.tile import Level
from lowfc.programs.view.verdict import Verdict
from lowfc.programs.view.watcher import Rms
from lowfc.programs.view.wavefront_verdict import factor, merit


def drawn(log: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Tape, list[Verdict]]:
    """A log as it is drawn, and the verdicts that were shown."""
    tape, shown = Tape(), list[Verdict]()
    picture = tiles.picture
    monkeypatch.setattr(
        tiles, "picture", lambda verdict, time_ns: (shown.append(verdict), picture(verdict, time_ns))[1]
    )
    draw_logs([log], Configuration(), lambda config: Painter(config, tape))  # type: ignore[arg-type]
    return tape, shown


# Recording.


@pytest.mark.parametrize(
    ("finish", "value", "level"), [(True, "FINISHED", Level.GOOD), (False, "NO END", Level.WARNING)]
)
def test_the_end_of_a_log_is_no_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, finish: bool, value: str, level: Level
) -> None:
    night = Night()
    for _ in range(10):
        night.frames(50)
        night.health("recorder", state="running", recording=wire.Recording(file="logs/a.mcap"))
    log = night.write(tmp_path / "night.mcap", finish=finish)
    _, shown = drawn(log, monkeypatch)
    assert tile(shown[-2], "RECORDER").value == "RECORDING"  # so it was
    end = shown[-1]
    assert (tile(end, "LOG").value, tile(end, "LOG").level) == (value, level)
    assert [one.title for one in end.tiles if "RECORD" in one.value] == []


def test_a_view_that_begins_after_the_recording_was_stopped_says_so() -> None:
    stage = Stage()
    stage.health["recorder"] = {"recording": wire.Recording(file="logs/a.mcap", stopped=True)}
    stage.begin()
    verdict = stage.run(3)
    assert (tile(verdict, "RECORDER").value, verdict.level) == ("STOPPED", Level.WARNING)
    assert "lowfc ctl record start" in verdict.headline


# A whole log.


def test_the_verdict_at_the_end_of_a_log_is_on_all_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    night = Night()
    night.frames(1500)
    night.frames(100, dark=range(100))
    night.request("open")
    night.frames(400)
    _, shown = drawn(night.write(tmp_path / "night.mcap"), monkeypatch)
    instant, end = shown[-2], shown[-1]
    assert tile(instant, "LOOP").value == "OPEN"
    assert tile(end, "LOOP").value == "80 % CLOSED"
    assert tile(end, "FRAMES").value == "100 UNUSED"
    assert "of 2000 frames: 0 lost, 100 refused (100 too dark)" in tile(end, "FRAMES").detail
    assert "0 frames lost, 100 refused" in end.headline
    truths = [wire.Truth.FromString(one.payload) for one in night.samples if one.key == "lowfc/sim/truth"][:1600]
    rms_nm = float(np.sqrt(np.mean([one.residual_rms_nm**2 for one in truths])))
    assert float(tile(end, "WAVEFRONT").value.split()[0]) == pytest.approx(rms_nm, rel=0.05)


def test_a_night_in_safe_mode_is_pointed_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    night = Night()
    night.frames(500)
    night.request("safe")
    night.frames(100)
    _, shown = drawn(night.write(tmp_path / "night.mcap"), monkeypatch)
    assert shown[-1].level is Level.WARNING
    assert "in safe mode for" in shown[-1].headline


def test_the_trend_holds_a_night_in_so_many_spans() -> None:
    kept, night = Course(), Night()
    night.frames(2 * 100)
    gatherer = Gatherer()
    for sample in night.samples:
        if sample.key.startswith(("lowfc/calibration", "lowfc/control/step", "lowfc/sim")):
            gatherer.take(topic_of(sample.key), sample.key, sample.payload, sample.publish_time_ns, sample.sequence)
    moment = gatherer.moment(night.now_ns)
    kept.feed(moment)
    _, rms_nm = kept.wavefront()
    squares = np.stack([moment.truths.residual_rms_nm, moment.truths.disturbance_rms_nm], axis=1).astype(float) ** 2
    np.testing.assert_allclose(rms_nm[0], np.sqrt(squares.mean(axis=0)), rtol=1e-6)
    kept._add(np.array([moment.truths.time_ns[0] + 10 * 3600 * 10**9]), slice(0, 3), np.ones(1), np.ones(1))
    after_ns, rms_nm = kept.wavefront()
    assert course.MOST / 2 <= len(after_ns) <= course.MOST
    np.testing.assert_allclose(rms_nm[0], np.sqrt(squares.mean(axis=0)), rtol=1e-6)
    assert np.isnan(rms_nm[1:-1]).all()  # nothing in between: a gap


def test_the_trend_is_drawn_with_the_residual_on_top(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    night = Night()
    night.frames(3000)
    tape, _ = drawn(night.write(tmp_path / "night.mcap"), monkeypatch)
    flat, residual = tape.last(f"{trend.TREND}/lines").strips.as_arrow_array().to_pylist()
    assert np.mean([y for _, y in flat]) < np.mean([y for _, y in residual])  # upwards is less
    assert len(residual) == len(flat) > 1


@pytest.mark.parametrize(
    ("value", "up", "down"), [(1.0, 1.0, 1.0), (3.0, 5.0, 2.0), (0.7, 1.0, 0.5), (70.0, 100.0, 50.0)]
)
def test_ticks_are_one_two_or_five(value: float, up: float, down: float) -> None:
    assert round_125(value, up=True) == pytest.approx(up)
    assert round_125(value, up=False) == pytest.approx(down)


def test_the_plots_of_a_log_show_all_of_it_and_a_picture_nothing_of_its_last_instant_alone(tmp_path: Path) -> None:
    night = Night()
    night.frames(1500)
    log = night.write(tmp_path / "night.mcap")
    drawn_log = draw_logs([log], Configuration(), lambda config: Painter(config, Tape()))  # type: ignore[arg-type]
    assert drawn_log.span_ns is not None
    begin_ns, end_ns = drawn_log.span_ns
    assert (end_ns - begin_ns) * 1e-9 == pytest.approx(drawn_log.log_s, abs=0.1)
    blueprint = layout(window_s=None, span_ns=drawn_log.span_ns, still=True)
    operator = inside(blueprint.root_container.contents[0])
    ranges = [str(view.properties["TimeAxis"]) for view in operator if isinstance(view, rrb.TimeSeriesView)]
    assert len(ranges) > 4
    assert all(str(end_ns) in one for one in ranges)
    assert not {sensor.FRAME, mirror.COMMAND, pointing.TRAIL} & {str(view.origin) for view in operator}


def inside(part: rrb.Container | rrb.View) -> list[rrb.View]:
    """Every view of a part of a layout."""
    return [part] if isinstance(part, rrb.View) else [view for one in part.contents for view in inside(one)]


# What is set.


def test_the_facts_say_run_host_law_offset_channels_and_note() -> None:
    stage = Stage()
    stage.health["controller"] = {"run_id": "night-7", "host": "bench"}
    stage.begin()
    stage.run(1)
    shape = np.full(4, 2.0, "<f4").tobytes()
    state = wire.ControllerState(
        mode=LoopMode.CLOSED.value,
        gain=[0.5, 0.5, 0.25],
        leak=[0.0] * 3,
        delay_frames=1,
        offset_nm=[0.0, 0.0, 5.0],
        channels=[wire.Channel(name="dark-hole", actuators=shape, reached=shape)],
    )
    stage.say(CONTROLLER_STATE, state)
    for at_s, text in ((5, "later"), (1, "earlier")):  # a note from before the view began comes after a newer one
        stage.say(EVENT, EVENTS["NOTE"].log("controller", (START + at_s) * 10**9, text=text))
    verdict = stage.run(1)
    found = {fact.title: fact.text for fact in verdict.facts}
    assert found["RUN"] == "night-7 on bench"
    assert found["CONTROL LAW"] == "integrator, gain 0.5 (2 modes), 0.25 (1 mode); delay 1 frame"
    assert found["OFFSET AND CHANNELS"].endswith("5 nm; channel dark-hole 2 nm")
    assert found["LAST NOTE"].endswith("later")
    state.law.name, state.law_frames, state.offset_nm[:] = "lqg", 10**6, [0.0] * 3
    stage.say(CONTROLLER_STATE, state)
    found = {fact.title: fact.text for fact in stage.run(1).facts}
    assert found["CONTROL LAW"] == "lqg; delay 1 frame"
    assert found["OFFSET AND CHANNELS"] == "no offset; channel dark-hole 2 nm"


def test_facts_that_are_not_known_are_said_to_be_unknown() -> None:
    assert {fact.text for fact in facts(Stage().watcher)} == {"not known", "none known"}


# From before the view began.


def recorder_of(log: Path, host: str = "") -> wire.Health:
    return wire.Health(host=host, recording=wire.Recording(files=[log.name], folder=str(log.parent)))


@pytest.mark.parametrize("finish", [True, False])
def test_events_from_before_come_from_the_log_finished_or_not(tmp_path: Path, finish: bool) -> None:
    night = Night()
    night.frames(100)
    night.request("note", text="new star")
    night.frames(100)
    night.event("RECORDING_STOPPED", why="operator asked")
    night.write(tmp_path / "night.mcap", finish=finish)
    wanted = [one for one in night.samples if one.key == EVENT.key]
    found = earlier_events(recorder_of(tmp_path / "night.mcap", platform.node()), 0)
    assert [(one.sequence, one.payload) for one in found] == [(one.sequence, one.payload) for one in wanted]
    gatherer = Gatherer()
    for one in (*wanted[-1:], *found):  # the last one came by the bus, too
        gatherer.take(EVENT, one.key, one.payload, one.publish_time_ns, one.sequence)
    assert len(gatherer.moment(1).events) == len(wanted)


@pytest.mark.parametrize(
    ("recorder", "said"),
    [
        (None, "no recorder has kept them"),
        (recorder_of(Path("/nowhere/a.mcap"), "another"), "in the log on another"),
        (recorder_of(Path("/nowhere/a.mcap")), "/nowhere/a.mcap cannot be read"),
    ],
)
def test_a_view_without_the_log_says_that_it_does_not_know(recorder: wire.Health | None, said: str) -> None:
    (line,) = earlier_events(recorder, 7)
    assert said in Log.FromString(line.payload).message


def test_only_chunks_with_events_are_read(tmp_path: Path) -> None:
    night = Night()
    night.frames(3000)
    log = night.write(tmp_path / "night.mcap")
    whole, sparse = (LogReader(log, topics=(EVENT,), sparse=sparse) for sparse in (False, True))
    assert list(whole) == list(sparse)
    assert len(sparse._chunks) < len(whole._chunks) / 2


def test_the_band_of_the_mode_begins_before_the_view() -> None:
    tape, gatherer = Tape(), Gatherer()
    state = wire.ControllerState(mode=LoopMode.CLOSED.value, mode_timestamp=timestamp(5))
    gatherer.take(CONTROLLER_STATE, CONTROLLER_STATE.key, state.SerializeToString(), 9, 1)
    loop.Loop().draw(tape, gatherer.moment(10))  # type: ignore[arg-type]
    ((at_ns, (change,)),) = tape.logged[loop.MODE]
    assert (at_ns, change.state.as_arrow_array().to_pylist()) == (5, ["CLOSED"])


# What deserves green.


@pytest.mark.parametrize(
    ("better", "attained", "level"),
    [
        (1.5, None, Level.NEUTRAL),
        (2.5, None, Level.GOOD),
        (2.5, Attained(2.0, 1.9, 0.5), Level.GOOD),
        (2.5, Attained(4.0, 1.9, 0.5), Level.NEUTRAL),  # other gains would leave half
        (1.5, Attained(2.0, 1.9, 0.5), Level.NEUTRAL),
        (5.0, Attained(2.0, 1.0, 8.0), Level.GOOD),  # within what is known of the noise
    ],
)
def test_green_is_a_loop_that_corrects_and_does_what_it_could(
    better: float, attained: Attained | None, level: Level
) -> None:
    assert merit(better, attained)[0] is level


def test_noise_is_taken_off_before_a_measured_wavefront_is_judged() -> None:
    found = Rms(5.0, 13.0, 0.0, 0.0)
    assert factor(found, False, None) == pytest.approx(2.6)
    assert factor(found, False, Attained(3.0, 3.0, 4.0)) == pytest.approx(np.sqrt(13**2 - 4**2) / 3)
    assert factor(found, True, Attained(3.0, 3.0, 4.0)) == pytest.approx(2.6)


def test_a_loop_that_corrects_little_is_grey_and_so_is_its_headline() -> None:
    stage = Stage()
    stage.residual_nm, stage.open_nm = 20.0, 30.0
    stage.begin()
    verdict = stage.run(3)
    assert tile(verdict, "WAVEFRONT").detail.startswith("1.5 x better")
    assert (tile(verdict, "WAVEFRONT").level, verdict.level) == (Level.NEUTRAL, Level.NEUTRAL)
    assert "little is corrected" in verdict.headline
    setting(residual_nm=5.0)(stage)
    assert stage.run(2).level is Level.GOOD


def test_what_the_gains_could_leave_is_computed_from_the_loop_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attainable, "PERIOD_NS", 1_000_000_000)
    night = Night(truth=False)
    night.frames(6000)
    gatherer, watcher = Gatherer(), Stage().watcher
    for number, sample in enumerate(night.samples):
        gatherer.take(topic_of(sample.key), sample.key, sample.payload, sample.publish_time_ns, sample.sequence)
        if number % 5000 == 0:
            watcher.feed(gatherer.moment(sample.publish_time_ns))
    watcher.feed(gatherer.moment(night.now_ns))
    found = watcher.attainable.found
    assert found is not None
    assert 0 < found.best_nm <= 1.05 * found.left_nm
    assert found.noise_nm > 0


# Light.


def test_the_light_of_refused_frames_is_a_gap() -> None:
    night = Night()
    night.frames(100, dark=range(40, 60))
    gatherer = Gatherer()
    for sample in night.samples:
        gatherer.take(topic_of(sample.key), sample.key, sample.payload, sample.publish_time_ns, sample.sequence)
    tape = Tape()
    loop.Loop().draw(tape, gatherer.moment(night.now_ns))  # type: ignore[arg-type]
    for path in (loop.FLUX, loop.SATURATED):
        _, values = tape.column(path)
        assert np.isnan(values).sum() == 1  # one row, so that the line is broken
        assert len(values) == 81
    light = tape.column(loop.FLUX)[1]
    assert np.nanmin(light) > 50
