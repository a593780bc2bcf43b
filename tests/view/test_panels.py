"""What is drawn of a run: the right numbers under the right names, and nothing of what cannot be read."""

import dataclasses

import numpy as np
import pytest

from lowfc.contract.codecs.codec import actuators
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import CONTROLLER_STATE, EVENT, FRAME, MIRROR_STATE, STEP, TRUTH, Log, timestamp, wire
from lowfc.control.loop.safety import LoopMode
from lowfc.optics.chain.zernike import mode_name
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.view.draw.pictures import Scale, round_up
from lowfc.programs.view.draw.plots import Plot
from lowfc.programs.view.panels import loop, mirror, sensor, wavefront
from lowfc.programs.view.renderer import RETRY_NS, Renderer
from lowfc.programs.view.snapshot import Accumulator, Snapshot
from tests.support.report_log import Night
from tests.support.stage import Tape, accumulated, pixels, snapshot_of, values_of
from tests.support.toy import FLUX_DN, NOLL

FRAMES = 120


def night(*, truth: bool = True) -> Night:
    made = Night(truth=truth)
    made.frames(FRAMES)
    return made


def rendered(snapshot: Snapshot) -> Tape:
    tape = Tape()
    renderer = Renderer(Configuration(), tape)
    panels = len(renderer.panels)
    renderer.draw(snapshot)
    assert len(renderer.panels) == panels, tape.logged["log/view"]
    return tape


def test_every_step_and_truth_is_drawn_under_its_name() -> None:
    made = night()
    tape = rendered(snapshot_of(made.samples))
    steps = [wire.ControlStep.FromString(one.payload) for one in made.samples if one.key == STEP.key]
    truths = [wire.Truth.FromString(one.payload) for one in made.samples if one.key == TRUTH.key]
    assert len(steps) == len(truths) == FRAMES
    measured = ((wavefront.ERROR, "error_nm"), (wavefront.POL, "pol_nm"), (wavefront.COMMAND, "command_nm"))
    for plot, field in measured:
        times_ns, values = tape.column(plot.path)
        np.testing.assert_array_equal(values, np.array([getattr(step, field) for step in steps]))
        assert times_ns.tolist() == [step.timestamp.ToNanoseconds() for step in steps]
    residual_nm = tape.column(wavefront.TRUTH.path)[1]
    np.testing.assert_array_equal(residual_nm, np.array([one.residual_nm for one in truths]))
    assert tape.names(wavefront.ERROR.path) == [mode_name(index) for index in NOLL]
    rms_nm = [[one.disturbance_rms_nm, one.residual_rms_nm] for one in truths]
    np.testing.assert_allclose(tape.column(wavefront.RMS.path)[1], rms_nm, rtol=1e-6)
    assert tape.names(wavefront.RMS.path) == ["with a flat mirror, true", "residual, true"]  # the last lies on top
    mas = residual_nm[:, :2] / tilt_nm_per_mas(Configuration().star.diameter_m)
    np.testing.assert_allclose(tape.column(wavefront.TILT.path)[1], mas, rtol=1e-6)
    groups_nm = tape.column(wavefront.GROUPS.path)[1]
    assert tape.names(wavefront.GROUPS.path) == ["tip and tilt", "focus, astigmatism"]
    np.testing.assert_allclose(np.sum(groups_nm**2, axis=1), np.sum(residual_nm**2, axis=1), rtol=1e-5)


def test_without_truth_the_wavefront_is_measured_and_named_so() -> None:
    made = night(truth=False)
    tape = rendered(snapshot_of(made.samples))
    steps = [wire.ControlStep.FromString(one.payload) for one in made.samples if one.key == STEP.key]
    rms_nm = [[np.hypot.reduce(step.pol_nm), np.hypot.reduce(step.error_nm)] for step in steps]
    np.testing.assert_allclose(tape.column(wavefront.RMS.path)[1], rms_nm, rtol=1e-5)
    assert tape.names(wavefront.RMS.path) == ["with a flat mirror, pseudo-open-loop", "residual, measured"]
    assert wavefront.TRUTH.path not in tape.rows


def test_the_pictures_are_those_of_the_newest_messages() -> None:
    snapshot = snapshot_of(night().samples)
    tape = rendered(snapshot)
    frame, calibration = snapshot.frame, snapshot.calibration
    brightness = pixels(tape, sensor.FRAME).sum(axis=2).astype(float)
    order = np.argsort(frame.ravel(), kind="stable")
    assert np.all(np.diff(brightness.ravel()[order]) >= 0), "more light is never darker"
    change = (frame.ravel() - calibration.dark) / FLUX_DN - calibration.reference
    shown = pixels(tape, sensor.DIFFERENCE).reshape(-1, 3).astype(int)
    strong = np.abs(change) > 0.5 * np.abs(change).max()
    assert strong.sum() > 2
    assert np.all((shown[strong, 0] > shown[strong, 2]) == (change[strong] > 0)), "orange above zero, blue below"
    assert values_of(tape.last(sensor.RAW).format)[0]["width"] == frame.shape[1]


def test_actuators_at_their_limit_are_marked() -> None:
    snapshot = snapshot_of(night().samples)
    marks = f"{mirror.COMMAND}/at_limit"
    assert marks not in rendered(snapshot).logged
    pushed = actuators(snapshot.mirror).copy()
    pushed[1, 3] = -snapshot.stroke_nm
    snapshot.mirror.actuators = pushed.tobytes()
    tape = rendered(snapshot)
    assert values_of(tape.last(marks).positions) == [[3.5, 1.5]]
    assert tape.column(mirror.STROKE.path)[1][-1, 0] == pytest.approx(100)


def test_the_mode_is_a_band_and_events_have_their_level() -> None:
    made = night()
    made.request("open")
    made.frames(10)
    made.event("RECORDING_FAILED", why="disk full")
    tape = rendered(snapshot_of(made.samples))
    assert [values_of(change.state) for _, (change,) in tape.logged[loop.MODE][1:]] == [["CLOSED"], ["OPEN"]]
    lines = [found for path, lines in tape.logged.items() if path.startswith("log/") for _, (found,) in lines]
    levels = {values_of(line.text)[0].split()[2]: values_of(line.level) for line in lines}
    assert levels["RECORDING_FAILED"] == ["ERROR"]


def test_the_band_of_the_mode_begins_before_the_view() -> None:
    tape, accumulator = Tape(), Accumulator()
    state = wire.ControllerState(mode=LoopMode.CLOSED.value, mode_timestamp=timestamp(5))
    accumulator.add(CONTROLLER_STATE, CONTROLLER_STATE.key, state.SerializeToString(), 9, 1)
    loop.Loop().draw(tape, accumulator.snapshot(10))
    ((at_ns, (change,)),) = tape.logged[loop.MODE]
    assert (at_ns, values_of(change.state)) == (5, ["CLOSED"])


def test_the_light_of_refused_frames_is_a_gap() -> None:
    made = Night()
    made.frames(100, dark=range(40, 60))
    tape = Tape()
    loop.Loop().draw(tape, snapshot_of(made.samples))
    for plot in (loop.FLUX, loop.SATURATED):
        _, values = tape.column(plot.path)
        assert np.isnan(values).sum() == 1  # one row, so that the line is broken
        assert len(values) == 81
    assert np.nanmin(tape.column(loop.FLUX.path)[1]) > 50


def test_an_unforeseen_message_costs_itself_alone() -> None:
    samples = []
    for number, sample in enumerate(night().samples):
        payload = sample.payload
        if sample.key == EVENT.key:
            log = Log.FromString(payload)
            log.level = 77
            payload = log.SerializeToString()
        elif sample.key == STEP.key and number % 3 == 0:
            step = wire.ControlStep.FromString(payload)
            step.mode = 200
            payload = step.SerializeToString()
        elif sample.key in (FRAME.key, MIRROR_STATE.at("dm")):
            payload = b"\xff" + payload
        samples.append(sample._replace(payload=payload))
    accumulator = accumulated(samples)
    tape = rendered(accumulator.snapshot(samples[-1].publish_time_ns))
    assert accumulator.unreadable == 2, "of pictures only the newest is looked at"
    assert wavefront.ERROR.path in tape.rows


def test_a_panel_that_fails_is_left_out_for_a_while() -> None:
    snapshot = snapshot_of(night().samples)
    tape = Tape()
    renderer = Renderer(Configuration(), tape)
    panels = len(renderer.panels)
    renderer.draw(dataclasses.replace(snapshot, frame=np.zeros((2, 3, 4), np.uint16)))
    assert len(renderer.panels) == panels - 1
    assert "Sensor is left out" in tape.texts("log/view")[-1]
    assert wavefront.ERROR.path in tape.rows
    for later_ns, missing in ((RETRY_NS - 1, 1), (RETRY_NS, 0)):
        renderer.draw(dataclasses.replace(snapshot, time_ns=snapshot.time_ns + later_ns))
        assert len(renderer.panels) == panels - missing
    assert sensor.DIFFERENCE in tape.logged


@pytest.mark.parametrize("pupil", ["circle", "nosuch"])
def test_without_a_model_of_the_science_camera_the_view_has_the_rest(pupil: str) -> None:
    tape, config = Tape(), Configuration()
    section = config.sensor.model_copy(update={"pupil": pupil})
    renderer = Renderer(config.model_copy(update={"sensor": section}), tape)
    renderer.draw(Accumulator().snapshot(0))
    assert len(renderer.panels) == 9
    assert "no science camera" in tape.texts("log/view")[0]


def test_an_older_state_does_not_replace_a_newer_one() -> None:
    old = next(one for one in night().samples if one.key == CONTROLLER_STATE.key)
    new = old._replace(sequence=old.sequence + 1, payload=b"")
    assert accumulated([new, old]).snapshot(0).controller == wire.ControllerState()


def test_an_odd_step_costs_itself_alone() -> None:
    steps = [one for one in night().samples if one.key == STEP.key]
    odd = wire.ControlStep.FromString(steps[0].payload)
    del odd.error_nm[1:]
    accumulator = accumulated([*steps, steps[0]._replace(payload=odd.SerializeToString())])
    assert len(accumulator.snapshot(2).steps.sequence) == FRAMES
    assert accumulator.unreadable == 1


def test_before_the_first_frame_of_a_run_in_lockstep_its_own_time_holds() -> None:
    assert Accumulator(simulated_ns=5).snapshot(10**18).time_ns == 5
    assert Accumulator().snapshot(10**18).time_ns == 10**18


def test_rows_that_are_not_finite_are_a_gap() -> None:
    tape = Tape()
    Plot("x").add(tape, np.arange(6), np.array([1.0, np.nan, np.nan, 2.0, np.inf, 3.0]))
    times, values = tape.column("x")
    assert times.tolist() == [0, 1, 3, 4, 5]
    assert np.isfinite(values[:, 0]).tolist() == [True, False, True, False, True]


def test_a_scale_grows_at_once_and_shrinks_after_a_while() -> None:
    scale = Scale(1.0)
    steps = [(0.1, 0, True, 1.0), (-33.0, 1, True, 50.0), (3.0, 10**9, False, 50.0), (3.0, 3 * 10**9, True, 3.0)]
    for value, time_ns, changed, limit in steps:
        assert scale.fit(np.array([value, np.nan]), time_ns) == changed
        assert scale.limit == limit


@pytest.mark.parametrize(
    ("value", "limit"), [(1.0, 1.0), (1.1, 1.5), (2.0, 2.0), (0.021, 0.03), (999.0, 1000.0), (0.2, 0.2)]
)
def test_scales_are_round(value: float, limit: float) -> None:
    assert round_up(value) == pytest.approx(limit)
