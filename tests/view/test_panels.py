"""What is drawn of a run: the right numbers under the right names, and nothing of what cannot be read."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import report_log
import rerun.blueprint as rrb
from report_log import Night
from tape import Tape, pixels
from toy import FLUX_DN, NOLL

from lowfc.adapters.log_reader import LogReader
from lowfc.contract.codec import actuators
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import (
    CONTROLLER_STATE,
    EVENT,
    FRAME,
    MIRROR_STATE,
    STEP,
    SURFACE,
    TRUTH,
    Log,
    image,
    topic_of,
    wire,
)
from lowfc.optics.photometry import tilt_nm_per_mas
from lowfc.optics.zernike import mode_name
from lowfc.programs.view import marks, mirror, sensor, wavefront
from lowfc.programs.view.layout import layout
from lowfc.programs.view.moment import Gatherer, Moment
from lowfc.programs.view.painter import RETRY_NS, Painter
from lowfc.programs.view.recorded import draw_logs
from lowfc.programs.view.scale import Scale, round_up

FRAMES = 120


def night(*, truth: bool = True) -> Night:
    made = Night(truth=truth)
    made.frames(FRAMES)
    return made


def whole(made: Night) -> Moment:
    """Everything of a run as one moment."""
    gatherer = Gatherer()
    for sample in made.samples:
        gatherer.take(topic_of(sample.key), sample.key, sample.payload, sample.publish_time_ns)
    assert gatherer.unreadable == 0
    return gatherer.moment(made.samples[-1].publish_time_ns)


def painted(moment: Moment) -> Tape:
    tape = Tape()
    painter = Painter(Configuration(), tape)  # type: ignore[arg-type]  # it keeps what is drawn
    panels = len(painter.panels)
    painter.draw(moment)
    assert len(painter.panels) == panels, tape.logged["log/view"]
    return tape


def test_every_step_and_truth_is_drawn_under_its_name() -> None:
    made = night()
    tape = painted(whole(made))
    steps = [wire.ControlStep.FromString(one.payload) for one in made.samples if one.key == STEP.key]
    truths = [wire.Truth.FromString(one.payload) for one in made.samples if one.key == TRUTH.key]
    assert len(steps) == len(truths) == FRAMES
    measured = {wavefront.ERROR: "error_nm", wavefront.POL: "pol_nm", wavefront.COMMAND: "command_nm"}
    for path, field in measured.items():
        times_ns, values = tape.column(path)
        np.testing.assert_array_equal(values, np.array([getattr(step, field) for step in steps]))
        assert times_ns.tolist() == [step.timestamp.ToNanoseconds() for step in steps]
    np.testing.assert_array_equal(tape.column(wavefront.TRUTH)[1], np.array([one.residual_nm for one in truths]))
    assert tape.names(wavefront.ERROR) == [mode_name(index) for index in NOLL]
    np.testing.assert_allclose(
        tape.column(wavefront.RMS)[1], [[one.disturbance_rms_nm, one.residual_rms_nm] for one in truths], rtol=1e-6
    )
    assert tape.names(wavefront.RMS) == ["with a flat mirror, true", "residual, true"]  # the last lies on top
    mas = np.array([one.residual_nm[:2] for one in truths]) / tilt_nm_per_mas(Configuration().star.diameter_m)
    np.testing.assert_allclose(tape.column(wavefront.TILT)[1], mas, rtol=1e-6)


def test_without_truth_it_is_measured_and_says_so() -> None:
    made = night(truth=False)
    tape = painted(whole(made))
    steps = [wire.ControlStep.FromString(one.payload) for one in made.samples if one.key == STEP.key]
    rms_nm = [[np.hypot.reduce(step.pol_nm), np.hypot.reduce(step.error_nm)] for step in steps]
    np.testing.assert_allclose(tape.column(wavefront.RMS)[1], rms_nm, rtol=1e-5)
    assert tape.names(wavefront.RMS) == ["with a flat mirror, pseudo-open-loop", "residual, measured"]
    assert wavefront.TRUTH not in tape.rows


def test_groups_add_up_to_the_modes() -> None:
    tape = painted(whole(night()))
    groups, modes = tape.column(wavefront.GROUPS)[1], tape.column(wavefront.TRUTH)[1]
    assert tape.names(wavefront.GROUPS) == ["tip and tilt", "focus, astigmatism"]
    np.testing.assert_allclose(np.sum(groups**2, axis=1), np.sum(modes**2, axis=1), rtol=1e-5)


def test_the_pictures_are_those_of_the_newest_messages() -> None:
    made = night()
    moment = whole(made)
    tape = painted(moment)
    assert moment.frame is not None
    assert moment.calibration is not None
    brightness = pixels(tape, sensor.FRAME).sum(axis=2).astype(float)
    order = np.argsort(moment.frame.ravel(), kind="stable")
    assert np.all(np.diff(brightness.ravel()[order]) >= 0), "more light is never darker"
    change = (moment.frame.ravel() - moment.calibration.dark) / FLUX_DN - moment.calibration.reference
    shown = pixels(tape, sensor.DIFFERENCE).reshape(-1, 3).astype(int)
    strong = np.abs(change) > 0.5 * np.abs(change).max()
    assert strong.sum() > 2
    assert np.all((shown[strong, 0] > shown[strong, 2]) == (change[strong] > 0)), "orange above zero, blue below"
    raw = tape.last(sensor.RAW)
    assert raw.format.as_arrow_array().to_pylist()[0]["width"] == moment.frame.shape[1]


def test_actuators_at_their_limit_are_marked() -> None:
    made = night()
    moment = whole(made)
    assert moment.controller is not None
    assert moment.mirror is not None
    surface = actuators(moment.mirror)
    assert surface is not None
    stroke_nm = moment.controller.settings.stroke_nm
    marks = f"{mirror.COMMAND}/at_limit"
    assert marks not in painted(moment).logged
    pushed = surface.copy()
    pushed[1, 3] = -stroke_nm
    moment.mirror.actuators = pushed.tobytes()
    tape = painted(moment)
    assert tape.last(marks).positions.as_arrow_array().to_pylist() == [[3.5, 1.5]]
    assert tape.column(mirror.STROKE)[1][-1, 0] == pytest.approx(100)


def test_the_mode_is_a_band_and_events_have_their_level() -> None:
    made = night()
    made.request("open")
    made.frames(10)
    made.event("RECORDING_FAILED", why="disk full")
    tape = painted(whole(made))
    states = [archetype.state.as_arrow_array().to_pylist() for _, (archetype,) in tape.logged["loop/mode"][1:]]
    assert states == [["CLOSED"], ["OPEN"]]
    lines = [found for path, lines in tape.logged.items() if path.startswith("log/") for _, (found,) in lines]
    levels = {text(line.text).split()[2]: text(line.level) for line in lines}
    assert levels["RECORDING_FAILED"] == "ERROR"


def test_what_nobody_foresaw_costs_one_message_not_the_view() -> None:
    made = night()
    gatherer = Gatherer()
    for number, sample in enumerate(made.samples):
        payload = sample.payload
        if sample.key == EVENT.key:
            log = Log.FromString(payload)
            log.level = 77  # type: ignore[assignment]
            payload = log.SerializeToString()
        elif sample.key == STEP.key and number % 3 == 0:
            step = wire.ControlStep.FromString(payload)
            step.mode = 200  # type: ignore[assignment]
            payload = step.SerializeToString()
        elif sample.key in (FRAME.key, MIRROR_STATE.at("dm")):
            payload = b"\xff" + payload
        gatherer.take(topic_of(sample.key), sample.key, payload, sample.publish_time_ns)
    tape = painted(gatherer.moment(made.samples[-1].publish_time_ns))
    assert gatherer.unreadable == 2, "of pictures only the newest is looked at"
    assert wavefront.ERROR in tape.rows


def test_a_panel_that_fails_is_left_out_for_a_while_and_said_so() -> None:
    moment = whole(night())
    broken = dataclasses.replace(moment, frame=np.zeros((2, 3, 4), np.uint16))
    tape = Tape()
    painter = Painter(Configuration(), tape)  # type: ignore[arg-type]
    before = len(painter.panels)
    painter.draw(broken)
    assert len(painter.panels) == before - 1
    assert "Sensor is left out" in text(tape.last("log/view").text)
    assert wavefront.ERROR in tape.rows
    painter.draw(dataclasses.replace(moment, time_ns=moment.time_ns + RETRY_NS - 1))
    assert len(painter.panels) == before - 1
    painter.draw(dataclasses.replace(moment, time_ns=moment.time_ns + RETRY_NS))
    assert len(painter.panels) == before
    assert sensor.DIFFERENCE in tape.logged


def test_an_older_state_does_not_replace_a_newer_one() -> None:
    made = night()
    gatherer = Gatherer()
    states = [one for one in made.samples if one.key == CONTROLLER_STATE.key]
    old, new = states[0], states[0]._replace(sequence=states[0].sequence + 1, payload=b"")
    for sample in (new, old):
        gatherer.take(CONTROLLER_STATE, sample.key, sample.payload, sample.publish_time_ns, sample.sequence)
    assert gatherer.moment(0).controller == wire.ControllerState()


def test_an_odd_step_costs_itself_alone() -> None:
    gatherer, payloads = Gatherer(), [one.payload for one in night().samples if one.key == STEP.key]
    odd = wire.ControlStep.FromString(payloads[0])
    del odd.error_nm[1:]
    for payload in (*payloads, odd.SerializeToString()):
        gatherer.take(STEP, STEP.key, payload, 1)
    assert len(gatherer.moment(2).steps.sequence) == FRAMES
    assert gatherer.unreadable == 1


def test_before_the_first_frame_of_a_run_in_lockstep_its_own_time_holds() -> None:
    moment = Gatherer(simulated_ns=5).moment(host_ns=10**18)
    assert moment.time_ns == 5
    assert Gatherer().moment(host_ns=10**18).time_ns == 10**18


def test_refused_frames_are_a_gap() -> None:
    tape = Tape()
    marks.curves(tape, "x", np.arange(6), np.array([1.0, np.nan, np.nan, 2.0, np.inf, 3.0]))  # type: ignore[arg-type]
    times, values = tape.column("x")
    assert times.tolist() == [0, 1, 3, 4, 5]
    assert np.isfinite(values[:, 0]).tolist() == [True, False, True, False, True]


def test_logs_of_two_runs_are_not_laid_over_each_other(tmp_path: Path) -> None:
    logs = [night().write(tmp_path / f"{name}.mcap") for name in "ab"]
    paint = lambda config: Painter(config, Tape())  # type: ignore[arg-type]  # noqa: E731
    assert draw_logs(logs, Configuration(), paint).moments > 0
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(report_log.METADATA["lowfc"], "run", "another")
        night().write(logs[1].with_name("c.mcap"))
    with pytest.raises(DataFileError, match="one at a time"):
        draw_logs([logs[0], logs[1].with_name("c.mcap")], Configuration(), paint)


def test_a_log_is_drawn_moment_by_moment_and_every_view_of_the_layout_has_something(tmp_path: Path) -> None:
    made = night()
    made.put(SURFACE, image(np.eye(8, dtype=np.float32), made.now_ns, "dm"))
    made.frames(1400)
    log = made.write(tmp_path / "night.mcap")
    tape = Tape()
    drawn = draw_logs([log], Configuration(), lambda config: Painter(config, tape))  # type: ignore[arg-type]
    assert drawn.remarks == []
    assert drawn.moments > 5
    times_ns, _ = tape.column(wavefront.ERROR)
    assert len(times_ns) == FRAMES + 1400
    assert np.all(np.diff(times_ns) > 0)
    origins = {str(view.origin) for view in views(layout())}
    empty = [origin for origin in origins if not any(path.startswith(origin) for path in tape.paths)]
    assert not empty


def test_a_log_without_an_end_is_drawn_as_far_as_it_goes(tmp_path: Path) -> None:
    made = night()
    log = made.write(tmp_path / "night.mcap")
    log.write_bytes(log.read_bytes()[: int(log.stat().st_size * 0.6)])
    tape = Tape()
    drawn = draw_logs([log], Configuration(), lambda config: Painter(config, tape))  # type: ignore[arg-type]
    assert any("no end" in remark for remark in drawn.remarks)
    assert not LogReader(log).complete


def text(component: Any) -> str:
    """The one string of a component."""
    (found,) = component.as_arrow_array().to_pylist()
    return str(found)


def views(blueprint: rrb.Blueprint) -> list[rrb.View]:
    """Every view of a layout."""

    def inside(part: rrb.Container | rrb.View) -> list[rrb.View]:
        if isinstance(part, rrb.View):
            return [part]
        return [view for one in part.contents for view in inside(one)]

    return inside(blueprint.root_container)


def test_a_scale_grows_at_once_and_shrinks_after_a_while() -> None:
    scale = Scale(1.0)
    assert scale.fit(np.array([0.1]), 0)
    assert scale.limit == 1.0
    assert scale.fit(np.array([-33.0]), 1)
    assert scale.limit == 50.0
    assert not scale.fit(np.array([3.0]), 1_000_000_000)
    assert scale.fit(np.array([3.0]), 3_000_000_000)
    assert scale.limit == 3.0


@pytest.mark.parametrize(
    ("value", "limit"), [(1.0, 1.0), (1.1, 1.5), (2.0, 2.0), (0.021, 0.03), (999.0, 1000.0), (0.2, 0.2)]
)
def test_scales_are_round(value: float, limit: float) -> None:
    assert round_up(value) == pytest.approx(limit)
