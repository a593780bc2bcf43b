"""Drawing of a log: the verdict on the whole log and the trend; and events from before the start of a live view."""

import platform
import re
from pathlib import Path

import numpy as np
import pytest
import rerun.blueprint as rrb

from lowfc.adapters.logs.reader import LogReader
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import (
    CALIBRATION,
    EVENT,
    FRAME,
    MIRROR_STATE,
    STEP,
    SURFACE,
    TRUTH,
    Log,
    Topic,
    image,
    timestamp,
    wire,
)
from lowfc.control.loop.safety import Limit, Rejection
from lowfc.programs.logs.report.results import report_of
from lowfc.programs.logs.report.source import read_run
from lowfc.programs.view.layout import layout
from lowfc.programs.view.live_view import earlier_events
from lowfc.programs.view.panels import mirror, pointing, sensor, tiles, trend, wavefront
from lowfc.programs.view.recorded import DrawnLogs, draw_logs
from lowfc.programs.view.session import memory_remarks, show_logs
from lowfc.programs.view.snapshot import Accumulator
from lowfc.programs.view.target import Target
from lowfc.programs.view.verdicts import span_means
from lowfc.programs.view.verdicts.log_verdict import LogVerdict
from lowfc.programs.view.verdicts.span_means import SpanMeans
from lowfc.programs.view.verdicts.tile import Level, Verdict
from tests.support import report_log
from tests.support.mutated_logs import chunks_of, flipped
from tests.support.report_log import SyntheticLog
from tests.support.stage import Tape, accumulated, snapshot_of, tile, values_of
from tests.support.toy import GRID
from tests.support.viewers import views

Shown = list[Verdict]


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> Shown:
    """The verdicts drawn in the test, in order."""
    verdicts, picture = Shown(), tiles.picture

    def keep(verdict: Verdict, time_ns: int) -> object:
        verdicts.append(verdict)
        return picture(verdict, time_ns)

    monkeypatch.setattr(tiles, "picture", keep)
    return verdicts


def drawn(*logs: Path, config: Configuration | None = None) -> tuple[DrawnLogs, Tape]:
    tape = Tape()
    return draw_logs(logs, config or Configuration(), tape), tape


@pytest.mark.parametrize(
    ("finish", "value", "level"), [(True, "FINISHED", Level.GOOD), (False, "NO END", Level.WARNING)]
)
def test_the_final_verdict_judges_the_log_and_no_longer_its_recording(
    tmp_path: Path, shown: Shown, finish: bool, value: str, level: Level
) -> None:
    night = SyntheticLog()
    for _ in range(10):
        night.frames(50)
        night.health("recorder", state="running", recording=wire.Recording(file="logs/a.mcap"))
    drawn(night.write(tmp_path / "night.mcap", finish=finish))
    assert tile(shown[-2], "RECORDER").value == "RECORDING"  # while it was recorded
    end = shown[-1]
    assert (tile(end, "LOG").value, tile(end, "LOG").level) == (value, level)
    assert [one.title for one in end.tiles if "RECORD" in one.value] == []


@pytest.mark.parametrize(
    ("in_health", "at_the_end", "detail"),
    [((0, 0), 3, "night, 3 messages lost"), ((2, 2), 0, "night, nothing lost"), ((2, 7), 0, "night, 5 messages lost")],
)
def test_the_verdict_counts_losses_during_the_log_but_not_earlier_losses_of_the_recorder(
    tmp_path: Path, shown: Shown, in_health: tuple[int, int], at_the_end: int, detail: str
) -> None:
    night = SyntheticLog()
    for lost in in_health:
        night.frames(50)
        night.health("recorder", state="running", pid=7, recording=wire.Recording(lost=lost))
    drawn(night.write(tmp_path / "night.mcap", messages_lost=str(at_the_end)))
    log = tile(shown[-1], "LOG")
    assert (log.detail, log.level) == (detail, Level.GOOD if "nothing" in detail else Level.WARNING)


def test_the_verdict_says_that_a_file_of_the_log_is_missing(
    tmp_path: Path, shown: Shown, monkeypatch: pytest.MonkeyPatch
) -> None:
    night, logs = SyntheticLog(), []
    for number in ("1", "3"):
        monkeypatch.setitem(report_log.METADATA, "part", {"of": "night", "number": number})
        logs.append(night.frames(50).write(tmp_path / f"night-{number}.mcap"))
        night.samples.clear()
    drawn(*logs)
    log = tile(shown[-1], "LOG")
    assert (log.value, log.level) == ("INCOMPLETE", Level.WARNING)
    assert log.detail.startswith("1 file missing between the first and the last; night-3, ")


def test_the_verdict_on_a_log_of_a_fraction_of_a_second_counts_its_lost_frames(shown: Shown) -> None:
    drawn(Path(__file__).parents[1] / "golden" / "0.1" / "night.mcap")
    assert tile(shown[-1], "FRAMES").detail.startswith("of 164 frames: 1 lost, ")


def test_the_final_verdict_covers_the_whole_log(tmp_path: Path, shown: Shown) -> None:
    night = SyntheticLog().frames(750)
    night.frames(50, dark=range(50))
    night.request("safe")
    night.frames(200)
    drawn(night.write(tmp_path / "night.mcap"))
    instant, end = shown[-2], shown[-1]
    assert tile(instant, "LOOP").value == "SAFE"
    assert "safe 0.2 s" in tile(end, "LOOP").detail
    assert tile(end, "LOOP").value == "80 % CLOSED"
    assert tile(end, "FRAMES").value == "50 UNUSED"
    assert "of 1000 frames: 0 lost, 50 refused (50 too dark)" in tile(end, "FRAMES").detail
    assert (end.level, "in safe mode for 0.2 s" in end.headline) == (Level.WARNING, True)
    rms_nm = float(np.sqrt(np.mean([one.residual_rms_nm**2 for one in night.messages(TRUTH)[:800]])))
    assert float(tile(end, "WAVEFRONT").value.split()[0]) == pytest.approx(rms_nm, rel=0.05)
    assert f"worst 1 s: {tile(end, 'WAVEFRONT').value.split()[0]} nm" in tile(end, "WAVEFRONT").detail


@pytest.mark.parametrize(
    ("gain", "in_view", "in_report"),
    [(0.5, Level.GOOD, "good"), (0.02, Level.NEUTRAL, "unknown"), (1.95, Level.WARNING, "look")],
)
def test_view_and_report_judge_the_residual_of_a_log_alike(
    tmp_path: Path, shown: Shown, gain: float, in_view: Level, in_report: str
) -> None:
    log = SyntheticLog(gain=(gain, gain)).frames(500).write(tmp_path / "night.mcap")
    drawn(log)
    check = next(one for one in report_of(read_run(log)).results["verdict"]["checks"] if one["name"] == "residual")
    assert (shown[-1].level, tile(shown[-1], "WAVEFRONT").level, check["level"]) == (in_view, in_view, in_report)
    harm = r"residual while closed \S+ nm rms, worse than \S+ nm with a flat mirror"
    assert bool(re.search(harm, shown[-1].headline)) is (in_view is Level.WARNING)


def test_the_verdict_on_a_log_says_that_its_residual_includes_offset_and_channels(tmp_path: Path, shown: Shown) -> None:
    log = SyntheticLog().frames(200).request("offset", values=(30.0, 0.0, 0.0)).frames(800)
    drawn(log.write(tmp_path / "shape.mcap"))
    assert tile(shown[-1], "WAVEFRONT").detail.startswith("while closed, with offset and channels, worse than ")
    assert "with offset and channels" in shown[-1].headline


def test_frames_two_seconds_apart_leave_no_gap_and_a_frame_with_a_wrong_time_adds_no_gap(
    tmp_path: Path, shown: Shown, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report_log, "PERIOD_NS", 2_000_000_000)
    night = SyntheticLog().frames(10)
    step = night.messages(STEP)[0]
    step.timestamp.CopyFrom(timestamp(0))
    step.reasons.append(Rejection.OUT_OF_ORDER.value)
    night.put(STEP, step)
    night.frames(10)
    drawn(night.write(tmp_path / "night.mcap"))
    assert (tile(shown[-1], "LOOP").value, tile(shown[-1], "LOOP").detail) == ("CLOSED", "closed 38 s")
    assert tile(shown[-1], "FRAMES").detail == "of 21 frames: 0 lost, 1 refused (1 out of order)"
    night = SyntheticLog().frames(1)
    drawn(night.write(tmp_path / "frame.mcap"))
    assert tile(shown[-1], "FRAMES").value == "0.5 Hz"
    night = SyntheticLog()
    night.put(STEP, step)
    drawn(night.write(tmp_path / "step.mcap"))
    assert shown[-1].headline.startswith("Log without a step of the controller with a valid time")


@pytest.mark.parametrize(
    ("delay_ns", "late", "value", "advice"),
    [
        (300_000, 15, "324 us", ""),  # exactly `MANY_LATE`
        (2_000_000, 0, "2043 us", "us, longer than a frame"),
        (300_000, 16, "16 LATE", "16 commands, 5.3 %, came after the start of the next exposure"),
    ],
)
def test_a_log_with_late_or_slow_commands_needs_attention(
    tmp_path: Path, shown: Shown, monkeypatch: pytest.MonkeyPatch, delay_ns: int, late: int, value: str, advice: str
) -> None:
    monkeypatch.setattr(report_log, "DELAY_NS", delay_ns)
    night = SyntheticLog()
    for count in (0, late):
        night.health("camera", state="running", pid=7, commands_late=count)
        night.frames(150)
    drawn(night.write(tmp_path / "night.mcap"))
    latency = tile(shown[-1], "LATENCY")
    assert (latency.value, latency.level) == (value, Level.WARNING if advice else Level.GOOD)
    assert advice in latency.advice


def test_a_log_without_steps_has_no_verdict_on_the_loop(tmp_path: Path, shown: Shown) -> None:
    night = SyntheticLog().health("recorder", state="running")
    drawn(night.write(tmp_path / "night.mcap", messages_lost="3"))
    assert shown[-1].headline.startswith("Log without a step of the controller. The recorder lost 3 messages")
    done, tape = drawn(night.without(EVENT).write(tmp_path / "states.mcap"))
    assert (done.log_s, tape.logged[tiles.TILES][-1][0]) == (0, night.samples[-1].receive_time_ns)
    assert [one.value for one in shown[-1].tiles] == ["NOT CLOSED", "?", "1000 Hz", "?", "?", "?", "FINISHED"]


@pytest.mark.parametrize("late", [STEP, TRUTH])
def test_the_residual_in_closed_loop_includes_wavefronts_that_were_recorded_apart_from_their_steps(late: Topic) -> None:
    night = SyntheticLog().frames(200).request("open").frames(100)
    verdict, accumulator = LogVerdict(), Accumulator()
    for is_late in (False, True):
        for one in night.samples:
            if late.matches(one.key) is is_late:
                accumulator.add(one)
        verdict.feed(accumulator.snapshot(night.samples[-1].publish_time_ns))
    closed = {one.frame_sequence for one in night.messages(STEP) if one.mode == wire.LOOP_MODE_CLOSED}
    truths = [one for one in night.messages(TRUTH) if one.frame_sequence in closed]
    assert 150 < len(truths) < 300
    rms_nm = np.sqrt(np.mean([[one.residual_rms_nm**2, one.disturbance_rms_nm**2] for one in truths], axis=0))
    assert verdict._closed.rms_nm() == pytest.approx(rms_nm, rel=1e-6)


def test_the_trend_of_a_night_has_a_limited_number_of_spans() -> None:
    averages, snapshot = SpanMeans(), snapshot_of(SyntheticLog().frames(200).samples)
    averages.feed(snapshot)
    _, rms_nm = averages.wavefront()
    squares = np.stack([snapshot.truths.residual_rms_nm, snapshot.truths.disturbance_rms_nm], axis=1).astype(float) ** 2
    np.testing.assert_allclose(rms_nm[0], np.sqrt(squares.mean(axis=0)), rtol=1e-6)
    averages.add(np.array([snapshot.truths.time_ns[0] + 10 * 3600 * 10**9]), slice(0, 3), np.ones((1, 2)))
    begin_ns, rms_nm = averages.wavefront()
    assert span_means.MAX_SPANS / 2 <= len(begin_ns) <= span_means.MAX_SPANS
    np.testing.assert_allclose(rms_nm[0], np.sqrt(squares.mean(axis=0)), rtol=1e-6)
    assert np.isnan(rms_nm[1:-1]).all()  # spans without a wavefront are a gap
    for days in (6, 12, 100):  # a view may run for weeks; 100 days are an error of the clock
        averages.add(np.array([averages.begin_ns + days * 86_400 * 10**9]), slice(0, 3), np.ones((1, 2)))
    begin_ns, _ = averages.wavefront()
    assert begin_ns[-1] == pytest.approx(12 * 86_400e9, rel=0.02)


@pytest.mark.parametrize(
    ("days", "labels"),
    [(0.2, ["23:00", "00:00", "01:00"]), (3, ["11-15", "11-16", "11-17"]), (12, ["11-15", "11-17", "11-19"])],
)
def test_the_trend_of_hours_has_times_of_day_and_the_trend_of_days_has_dates(days: float, labels: list[str]) -> None:
    ticks = [label for _, label in trend._clock_ticks(1_700_000_000 * 10**9, days * 86_400)]
    assert ticks[:3] == labels
    assert len(ticks) <= 7


def test_a_log_larger_than_the_memory_of_the_viewer_gives_a_remark() -> None:
    target = Target(picture=Path("night.png"))
    assert memory_remarks(511_000_000, target) == []
    [remark] = memory_remarks(1_652_000_000, target)
    assert remark.startswith(
        "the log has 1652 MB, the viewer keeps 512 MB (--memory-mb): curves with a point for every frame may begin late"
    )


def test_a_file_that_is_not_a_log_is_refused_before_a_viewer_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "notes.txt"
    file.write_text("nothing recorded")
    monkeypatch.setattr(Target, "viewer", lambda _: pytest.fail("a viewer was started"))
    with pytest.raises(DataFileError, match="is not an MCAP file"):
        show_logs([file], None, Target(web=True))


def test_every_view_of_the_layout_has_data_and_the_plots_span_the_whole_log(tmp_path: Path) -> None:
    night = SyntheticLog().frames(120)
    night.health("controller")
    night.put(SURFACE, image(np.eye(8, dtype=np.float32), night.now_ns, "dm"))
    night.frames(1380)
    done, tape = drawn(night.write(tmp_path / "night.mcap"))
    assert done.remarks == []
    assert done.snapshots > 5
    times_ns, _ = tape.column(wavefront.ERROR.path)
    assert len(times_ns) == 1500
    assert np.all(np.diff(times_ns) > 0)
    origins = {str(view.origin) for view in views(layout().root_container)}
    assert not [origin for origin in origins if not any(path.startswith(origin) for path in tape.paths)]
    flat, residual = values_of(tape.last(f"{trend.TREND}/curves").strips)  # in the order of drawing
    assert np.mean([y for _, y in flat]) < np.mean([y for _, y in residual])  # y points down: the flat mirror is higher
    assert len(residual) == len(flat) > 1
    names = tape.last(f"{trend.TREND}/names").labels.as_arrow_array().to_pylist()
    assert names == ["flat mirror", "residual", "true, 1 s mean"]
    begin_ns, end_ns = done.span_ns
    assert (end_ns - begin_ns) * 1e-9 == pytest.approx(done.log_s, abs=0.1)
    blueprint = layout(window_s=None, span_ns=done.span_ns, still=True)
    operator = views(blueprint.root_container.contents[0])
    ranges = [str(view.properties["TimeAxis"]) for view in operator if isinstance(view, rrb.TimeSeriesView)]
    assert len(ranges) > 4
    assert all(str(end_ns) in one for one in ranges)
    assert not {sensor.FRAME, mirror.ACTUATORS, pointing.TRAIL} & {str(view.origin) for view in operator}


def test_a_damaged_log_is_drawn_and_the_remark_names_the_position_the_reason_and_the_lost_time(
    tmp_path: Path, shown: Shown
) -> None:
    log = SyntheticLog().frames(800).write(tmp_path / "night.mcap")
    _, (begin, end), *_ = chunks_of(log)
    flipped(log, (begin + end) // 2)
    [remark] = drawn(log)[0].remarks
    assert (tile(shown[-1], "LOG").value, tile(shown[-1], "LOG").level) == ("DAMAGED", Level.WARNING)
    position = rf"left out at byte {begin}, \d+ bytes"
    reason = "(the checksum of a chunk is wrong|a chunk cannot be decompressed)"
    assert re.fullmatch(rf"night\.mcap: {position}: {reason}; 0\.\d+ s between the messages around it", remark)


def test_a_log_begins_with_its_first_frame_and_not_with_an_older_calibration(tmp_path: Path) -> None:
    night = SyntheticLog().frames(100)
    calibration = night.samples[night.indices(CALIBRATION)[0]]
    earlier_ns = calibration.receive_time_ns - 3600 * 10**9
    night.samples = [calibration._replace(receive_time_ns=ns) for ns in (earlier_ns, night.now_ns)] + night.samples
    done, tape = drawn(night.write(tmp_path / "night.mcap"))
    assert done.log_s == pytest.approx(0.1, abs=0.01)
    assert min(tape.logged[tiles.TILES])[0] > earlier_ns + 3599 * 10**9


def test_a_frame_of_a_camera_whose_clock_is_ahead_does_not_move_the_time_line(tmp_path: Path) -> None:
    night = SyntheticLog().frames(100)
    ahead_ns = night.now_ns + 3600 * 10**9
    step = night.messages(STEP)[0]
    step.timestamp.CopyFrom(timestamp(ahead_ns))
    step.reasons.append(Rejection.AHEAD.value)
    night.put(FRAME, image(np.zeros((8, 8), np.uint16), ahead_ns, "sensor"))
    night.put(STEP, step)
    night.frames(100)
    done, tape = drawn(night.write(tmp_path / "night.mcap"))
    begin_ns, end_ns = done.span_ns
    assert (end_ns - begin_ns) * 1e-9 == pytest.approx(done.log_s, abs=0.1)
    drawn_ns = [time_ns or 0 for logged in tape.logged.values() for time_ns, _ in logged]
    drawn_ns += [int(times_ns.max(initial=0)) for rows in tape.rows.values() for times_ns, _ in rows]
    assert max(drawn_ns) < end_ns + 10**9  # no picture or row at the time of the camera's clock


def test_the_stroke_of_a_log_is_the_largest_of_all_its_mirror_states(tmp_path: Path, shown: Shown) -> None:
    night = SyntheticLog().frames(120)
    night.change(MIRROR_STATE, 101, lambda state: setattr(state, "actuators", np.full(GRID, -350, "<f4").tobytes()))
    drawn(night.write(tmp_path / "night.mcap"))
    assert tile(shown[-1], "MIRROR").value == "50 %"


def test_a_log_that_used_nearly_all_the_stroke_needs_attention_as_in_its_report(tmp_path: Path, shown: Shown) -> None:
    night = SyntheticLog().frames(120)
    night.change(MIRROR_STATE, 101, lambda state: setattr(state, "actuators", np.full(GRID, -650, "<f4").tobytes()))
    log = night.write(tmp_path / "night.mcap")
    drawn(log)
    mirror = tile(shown[-1], "MIRROR")
    assert (mirror.value, mirror.level) == ("93 %", Level.WARNING)
    assert "93 % of its stroke" in shown[-1].headline
    check = next(one for one in report_of(read_run(log)).results["verdict"]["checks"] if one["name"] == "mirror")
    assert check["level"] == "look"


def test_a_limit_in_a_log_is_not_blamed_on_the_disturbance(tmp_path: Path, shown: Shown) -> None:
    night = SyntheticLog().frames(120)
    night.change(STEP, 101, lambda step: step.reasons.append(Limit.SLEW.value))  # as after a request `reset`
    drawn(night.write(tmp_path / "night.mcap"))
    assert tile(shown[-1], "MIRROR").advice == "The mirror was at a limit (actuator slew: 1 time): see the events."


def test_a_message_with_an_impossible_time_is_left_out(tmp_path: Path) -> None:
    night = SyntheticLog().frames(10)
    night.samples.append(night.samples[-1]._replace(receive_time_ns=1 << 63))
    done, _ = drawn(night.write(tmp_path / "night.mcap"))
    assert (done.remarks, done.log_s < 1) == (["1 message could not be read"], True)


def test_a_log_of_a_simulated_run_is_drawn_without_a_runtime_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "missing"))
    done, _ = drawn(SyntheticLog().frames(30).write(tmp_path / "night.mcap"), config=Configuration(lockstep=True))
    assert done.snapshots > 0


def test_logs_of_two_runs_are_not_drawn_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    logs = [SyntheticLog().frames(30).write(tmp_path / f"{name}.mcap") for name in "ab"]
    assert drawn(*logs)[0].snapshots > 0
    repetition = SyntheticLog().frames(30)
    repetition.samples = [one._replace(publish_time_ns=one.publish_time_ns + 10**9) for one in repetition.samples]
    others = [repetition.write(tmp_path / "c.mcap")]
    monkeypatch.setitem(report_log.METADATA["lowfc"], "run", "another")
    others.append(SyntheticLog().frames(30).write(tmp_path / "d.mcap"))
    for other in others:
        with pytest.raises(DataFileError, match="one run at a time"):
            drawn(logs[0], other)
    repetition.samples = [one._replace(receive_time_ns=one.receive_time_ns - 3 * 10**9) for one in repetition.samples]
    with pytest.raises(DataFileError, match="order of recording"):
        drawn(others[1], repetition.write(tmp_path / "earlier.mcap"))


# Events from before the start of the view.


def recorder_of(log: Path, host: str = "") -> wire.Health:
    return wire.Health(host=host, recording=wire.Recording(files=[log.name], folder=str(log.parent)))


@pytest.mark.parametrize("finish", [True, False])
def test_earlier_events_are_read_from_the_log_finished_or_not(tmp_path: Path, finish: bool) -> None:
    night = SyntheticLog().frames(100)
    night.request("note", text="new star")
    night.frames(100)
    night.event("RECORDING_STOPPED", why="operator asked")
    night.write(tmp_path / "night.mcap", finish=finish)
    expected = [night.samples[index] for index in night.indices(EVENT)]
    found = earlier_events(recorder_of(tmp_path / "night.mcap", platform.node()), 0)
    assert [(one.sequence, one.payload) for one in found] == [(one.sequence, one.payload) for one in expected]
    accumulator = accumulated([*expected[-1:], *found])  # the last event also arrived on the bus
    assert len(accumulator.snapshot(1).events) == len(expected)


@pytest.mark.parametrize(
    ("recorder", "text"),
    [
        (None, "there is no recorder"),
        (recorder_of(Path("/nowhere/a.mcap"), "another"), "in the log on another"),
        (recorder_of(Path("/nowhere/a.mcap")), "/nowhere/a.mcap cannot be read"),
    ],
)
def test_a_view_without_the_log_reports_that_events_are_missing(recorder: wire.Health | None, text: str) -> None:
    (line,) = earlier_events(recorder, 7)
    assert text in Log.FromString(line.payload).message


def test_only_chunks_with_events_are_read(tmp_path: Path) -> None:
    log = SyntheticLog().frames(1000).write(tmp_path / "night.mcap")
    complete, sparse = (LogReader(log, topics=(EVENT,), sparse=sparse) for sparse in (False, True))
    assert list(complete) == list(sparse)
    assert len(sparse._chunks) < len(complete._chunks) / 2
