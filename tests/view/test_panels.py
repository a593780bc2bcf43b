"""The panels of the view draw the right numbers under the right names."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.files.sensors import load_pupil
from lowfc.adapters.logs.columns import STAGES, StepRows, Steps, TruthRows, Truths
from lowfc.contract.codecs.codec import actuators
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import (
    CONTROLLER_STATE,
    EVENT,
    FRAME,
    MIRROR_STATE,
    STEP,
    TRUTH,
    Log,
    Role,
    Topic,
    image,
    timestamp,
    wire,
)
from lowfc.control.laws.spectra import spectrum, time_series
from lowfc.control.loop.safety import LoopMode
from lowfc.optics.chain.coronagraph import Coronagraph, Wedge, mean_contrast
from lowfc.optics.chain.grid import pupil_axis
from lowfc.optics.chain.zernike import mode_name, zernikes
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.view.draw.pictures import Scale
from lowfc.programs.view.draw.plots import BOX_HEIGHT, Plot
from lowfc.programs.view.panels import latency, loop, mirror, pointing, science, sensor, spectra, wavefront
from lowfc.programs.view.panels.panel import Panel
from lowfc.programs.view.renderer import RETRY_NS, Renderer
from lowfc.programs.view.snapshot import Accumulator, LastHealth, LogEnd, Snapshot
from lowfc.programs.view.verdicts import steady
from lowfc.programs.view.verdicts.steady import LawInForce
from tests.support.report_log import SyntheticLog
from tests.support.stage import Tape, accumulated, pixels, snapshot_of, values_of
from tests.support.theory import rejection
from tests.support.toy import FLUX_DN, NOLL, calibration

FRAMES = 120


def synthetic_log(*, truth: bool = True) -> SyntheticLog:
    return SyntheticLog(truth=truth).frames(FRAMES)


def rendered(snapshot: Snapshot) -> Tape:
    tape = Tape()
    renderer = Renderer(Configuration(), tape)
    renderer.draw(snapshot)
    assert None not in renderer._panels, tape.logged["log/view"]
    return tape


def test_every_step_and_truth_is_drawn_under_its_name() -> None:
    night = synthetic_log()
    tape = rendered(snapshot_of(night.samples))
    steps, truths = night.messages(STEP), night.messages(TRUTH)
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
    assert tape.names(wavefront.RMS.path) == ["with a flat mirror, true", "residual, true"]  # the last one is on top
    mas = residual_nm[:, :2] / tilt_nm_per_mas(Configuration().star.diameter_m)
    np.testing.assert_allclose(tape.column(wavefront.TILT.path)[1], mas, rtol=1e-6)
    groups_nm = tape.column(wavefront.GROUPS.path)[1]
    assert tape.names(wavefront.GROUPS.path) == ["tip and tilt", "focus, astigmatism"]
    np.testing.assert_allclose(np.sum(groups_nm**2, axis=1), np.sum(residual_nm**2, axis=1), rtol=1e-5)


def test_without_truth_the_wavefront_is_labelled_measured() -> None:
    night = synthetic_log(truth=False)
    tape = rendered(snapshot_of(night.samples))
    rms_nm = [[np.hypot.reduce(step.pol_nm), np.hypot.reduce(step.error_nm)] for step in night.messages(STEP)]
    np.testing.assert_allclose(tape.column(wavefront.RMS.path)[1], rms_nm, rtol=1e-5)
    assert tape.names(wavefront.RMS.path) == ["with a flat mirror, pseudo-open-loop", "residual, measured"]
    assert wavefront.TRUTH.path not in tape.rows


def test_pictures_of_the_sensor_show_the_newest_frame() -> None:
    snapshot = snapshot_of(synthetic_log().samples)
    tape = rendered(snapshot)
    frame, calibration = snapshot.frame, snapshot.calibration
    brightness = pixels(tape, sensor.FRAME).sum(axis=2).astype(float)
    order = np.argsort(frame.ravel(), kind="stable")  # the dark is the same in every pixel
    assert np.all(np.diff(brightness.ravel()[order]) >= 0), "a pixel with more light is never darker"
    change = (frame.ravel() - calibration.dark) / FLUX_DN - calibration.reference
    shown = pixels(tape, sensor.DIFFERENCE).reshape(-1, 3).astype(int)
    strong = np.abs(change) > 0.5 * np.abs(change).max()
    assert strong.sum() > 2
    assert np.all((shown[strong, 0] > shown[strong, 2]) == (change[strong] > 0)), "orange above zero, blue below"
    assert values_of(tape.last(sensor.RAW).format)[0]["width"] == frame.shape[1]


def test_a_hot_pixel_of_the_dark_does_not_darken_the_picture() -> None:
    snapshot = snapshot_of(synthetic_log().samples)
    dark = snapshot.calibration.dark.copy()
    dark[0] += 10_000
    hot = dataclasses.replace(snapshot, calibration=dataclasses.replace(snapshot.calibration, dark=dark))
    expected, shown = (pixels(rendered(each), sensor.FRAME).reshape(-1, 3) for each in (snapshot, hot))
    assert (shown[1:] == expected[1:]).all()
    assert shown[0].sum() <= expected[0].sum()


def test_actuators_at_their_limit_are_marked() -> None:
    snapshot = snapshot_of(synthetic_log().samples)
    marks = f"{mirror.ACTUATORS}/at_limit"
    assert marks not in rendered(snapshot).logged
    surface_nm = actuators(snapshot.mirror).copy()
    surface_nm[1, 3] = -snapshot.stroke_nm
    snapshot.mirror.actuators = surface_nm.tobytes()
    tape = rendered(snapshot)
    assert values_of(tape.last(marks).positions) == [[3.5, 1.5]]
    assert tape.column(mirror.STROKE.path)[1][-1, 0] == pytest.approx(100)


def test_the_loop_mode_is_a_band_and_events_have_their_level() -> None:
    night = synthetic_log()
    night.request("open")
    night.frames(10)
    night.event("RECORDING_FAILED", why="disk full")
    tape = rendered(snapshot_of(night.samples))
    assert [values_of(change.state) for _, (change,) in tape.logged[loop.MODE][1:]] == [["CLOSED"], ["OPEN"]]
    lines = [found for path, lines in tape.logged.items() if path.startswith("log/") for _, (found,) in lines]
    levels = {values_of(line.text)[0].split()[2]: values_of(line.level) for line in lines}
    assert levels["RECORDING_FAILED"] == ["ERROR"]


def test_the_mode_band_begins_at_the_last_change_before_the_view() -> None:
    tape, accumulator = Tape(), Accumulator()
    state = wire.ControllerState(mode=LoopMode.CLOSED.value, mode_timestamp=timestamp(5))
    accumulator.add(Sample(CONTROLLER_STATE.key, state.SerializeToString(), 1, 9, 9))
    loop.Loop().draw(tape, accumulator.snapshot(10))
    ((at_ns, (change,)),) = tape.logged[loop.MODE]
    assert (at_ns, values_of(change.state)) == (5, ["CLOSED"])


def test_the_flux_of_refused_frames_is_a_gap() -> None:
    night = SyntheticLog().frames(100, dark=range(40, 60))
    tape = Tape()
    loop.Loop().draw(tape, snapshot_of(night.samples))
    for plot in (loop.FLUX, loop.SATURATED):
        _, values = tape.column(plot.path)
        assert np.isnan(values).sum() == 1  # one row breaks the line
        assert len(values) == 81
    assert np.nanmin(tape.column(loop.FLUX.path)[1]) > 50


def test_unreadable_messages_and_unknown_values_do_not_affect_other_panels() -> None:
    samples, steps = [], itertools.count()
    for sample in synthetic_log().samples:
        payload = sample.payload
        if sample.key == EVENT.key:
            log = Log.FromString(payload)
            log.level = 77
            payload = log.SerializeToString()
        elif sample.key == STEP.key and next(steps) % 3 == 0:
            step = wire.ControlStep.FromString(payload)
            step.mode = 200
            payload = step.SerializeToString()
        elif sample.key in (FRAME.key, MIRROR_STATE.at("dm")):
            payload = b"\xff" + payload
        samples.append(sample._replace(payload=payload))
    accumulator = accumulated(samples)
    tape = rendered(accumulator.snapshot(samples[-1].publish_time_ns))
    assert accumulator.unreadable == 2, "only the newest picture of a topic is decoded"
    assert len(tape.column(wavefront.ERROR.path)[0]) == FRAMES


@pytest.mark.parametrize("seconds", [10**12, -(10**12), 6 * 10**9])
@pytest.mark.parametrize("topic", [EVENT, CONTROLLER_STATE, STEP, TRUTH])
def test_a_message_with_a_time_out_of_range_is_left_out(topic: Topic, seconds: int) -> None:
    samples = synthetic_log().samples
    last = next(one for one in reversed(samples) if topic.matches(one.key))
    message = topic.message.FromString(last.payload)
    time = message.mode_timestamp if topic is CONTROLLER_STATE else message.timestamp
    time.seconds = seconds
    wrong = last._replace(sequence=last.sequence + 1, payload=message.SerializeToString())
    accumulator = accumulated([*samples, wrong])
    assert accumulator.unreadable == 1
    rendered(accumulator.snapshot(samples[-1].publish_time_ns))


def test_a_panel_that_fails_is_left_out_for_a_while() -> None:
    snapshot = snapshot_of(synthetic_log().samples)
    tape = Tape()
    renderer = Renderer(Configuration(), tape)
    renderer.draw(dataclasses.replace(snapshot, frame=np.zeros((2, 3, 4), np.uint16)))
    assert renderer._panels.count(None) == 1
    assert "Sensor is left out" in tape.texts("log/view")[-1]
    assert wavefront.ERROR.path in tape.rows
    for later_ns, missing in ((RETRY_NS - 1, 1), (RETRY_NS, 0)):
        renderer.draw(dataclasses.replace(snapshot, time_ns=snapshot.time_ns + later_ns))
        assert renderer._panels.count(None) == missing
    assert sensor.DIFFERENCE in tape.logged


def test_without_a_model_of_the_science_camera_the_other_panels_are_drawn() -> None:
    tape, config = Tape(), Configuration()
    section = config.sensor.model_copy(update={"pupil": "nosuch"})
    renderer = Renderer(config.model_copy(update={"sensor": section}), tape)
    renderer.draw(Accumulator().snapshot(0))
    assert len(renderer._panels) == 9
    assert None not in renderer._panels
    assert "no science camera" in tape.texts("log/view")[0]


def test_an_older_state_does_not_replace_a_newer_one() -> None:
    old = next(one for one in synthetic_log().samples if one.key == CONTROLLER_STATE.key)
    new = old._replace(sequence=old.sequence + 1, payload=b"")
    assert accumulated([new, old]).snapshot(0).controller == wire.ControllerState()


def test_a_complete_snapshot_has_the_newest_pictures_even_if_an_incomplete_one_had_them() -> None:
    accumulator = accumulated(synthetic_log().samples)
    incomplete = accumulator.snapshot(0, complete=False)
    assert incomplete.frame is not None
    assert accumulator.snapshot(0, complete=False).frame is None
    complete = accumulator.snapshot(0)
    np.testing.assert_array_equal(complete.frame, incomplete.frame)
    assert (complete.frame_ns, complete.mirror) == (incomplete.frame_ns, incomplete.mirror)
    assert accumulator.snapshot(0).frame is None


def test_a_frame_of_a_camera_whose_clock_is_ahead_is_drawn_at_the_time_of_the_view() -> None:
    night = synthetic_log()
    night.put(FRAME, image(np.zeros((6, 7), np.uint16), night.now_ns + 3600 * 10**9, "sensor"))
    snapshot = snapshot_of(night.samples)
    assert snapshot.frame_ns == snapshot.time_ns < night.now_ns + 10**9


def test_a_malformed_step_is_left_out_and_counted() -> None:
    steps = [one for one in synthetic_log().samples if one.key == STEP.key]
    malformed = wire.ControlStep.FromString(steps[0].payload)
    del malformed.error_nm[1:]
    accumulator = accumulated([*steps, steps[0]._replace(payload=malformed.SerializeToString())])
    assert len(accumulator.snapshot(2).steps.sequence) == FRAMES
    assert accumulator.unreadable == 1


def test_before_the_first_frame_a_lockstep_run_has_simulated_time() -> None:
    assert Accumulator(simulated_ns=5).snapshot(10**18).time_ns == 5
    assert Accumulator().snapshot(10**18).time_ns == 10**18


def test_rows_that_are_not_finite_are_a_gap() -> None:
    tape = Tape()
    Plot("x").add(tape, np.arange(6), np.array([1.0, np.nan, np.nan, 2.0, np.inf, 3.0]))
    times, values = tape.column("x")
    assert times.tolist() == [0, 1, 3, 4, 5]
    assert np.isfinite(values[:, 0]).tolist() == [True, False, True, False, True]


def test_a_scale_grows_at_once_and_shrinks_after_two_seconds() -> None:
    scale = Scale(1.0)
    fits = [(0.1, 0, True, 1.0), (-33.0, 1, True, 50.0), (1.1, 10**9, False, 50.0), (1.1, 3 * 10**9, True, 1.5)]
    for value, time_ns, changed, limit in fits:
        assert scale.fit(np.array([value, np.nan]), time_ns) == changed
        assert scale.limit == limit


START_NS = 1_795_000_000_000_000_000
WAVELENGTH_NM = 550.0
RATE_HZ = 500.0
CALIBRATION = calibration()
MODES = len(NOLL)
TICK_NS = 33_333_333  # between two snapshots at 30 Hz


def steps(first: int, error_nm: Any, pol_nm: Any, mode: int = LoopMode.CLOSED) -> Steps:
    rows = StepRows(MODES)
    for number, (error, pol) in enumerate(zip(error_nm, pol_nm, strict=True), first):
        time = timestamp(START_NS + round(number * 1e9 / RATE_HZ))
        measured = {"error_nm": error, "pol_nm": pol, "command_nm": [0.0] * MODES}
        rows.add(wire.ControlStep(timestamp=time, frame_sequence=number, mode=mode, **measured))
    return rows.values()


def truths(residual_nm: Any, disturbance_nm: Any) -> Truths:
    rows = TruthRows(MODES)
    for residual, disturbance in zip(residual_nm, disturbance_nm, strict=True):
        rows.add(wire.Truth(timestamp=timestamp(START_NS), residual_nm=residual, disturbance_nm=disturbance))
    return rows.values()


def draw(panel: Panel, tape: Tape, after_ns: int, **changes: Any) -> None:
    """Draw a snapshot that has nothing new but the changes."""
    empty = Accumulator().snapshot(0)
    fields = {"time_ns": START_NS + after_ns, "calibration": CALIBRATION} | changes
    panel.draw(tape, dataclasses.replace(empty, **fields))


def contrast_of(pupil: Any, modes_nm: Any) -> float:
    radii = 2 * pupil_axis(len(pupil))
    opd_nm = np.tensordot(modes_nm, zernikes(NOLL, radii, radii[:, None]), 1)
    return mean_contrast(Coronagraph(pupil), opd_nm, WAVELENGTH_NM, Wedge(4.0, 6.0))


def test_contrast_is_the_mean_over_the_newest_wavefronts() -> None:
    pupil, rng = load_pupil(), np.random.default_rng(3)
    residual_nm, open_nm = rng.normal(0, 30.0, (4, MODES)), rng.normal(0, 80.0, (4, MODES))
    refused = np.full((1, MODES), np.nan)
    tape, panel = Tape(), science.Science(Coronagraph(pupil), WAVELENGTH_NM)
    panel.begin(tape)
    measured = steps(0, np.vstack([residual_nm[:2], refused]), np.vstack([open_nm[:2], refused]))
    draw(panel, tape, 0, steps=measured, calibration=None)
    assert not tape.rows
    draw(panel, tape, 0, steps=measured)  # the first snapshot is drawn at once
    draw(panel, tape, TICK_NS, steps=measured, truths=truths(residual_nm[2:3], open_nm[2:3]))
    draw(panel, tape, science.Science.period_ns, truths=truths(residual_nm[3:4], open_nm[3:4]))
    times_ns, found = tape.column(science.CONTRAST.path)
    np.testing.assert_array_equal(times_ns - START_NS, [0, science.Science.period_ns])
    flat = contrast_of(pupil, np.zeros(MODES))
    expected = [
        [contrast_of(pupil, open_nm[1]), contrast_of(pupil, residual_nm[1]), flat],  # the last row was refused
        [*(np.mean([contrast_of(pupil, each_nm[row]) for row in (2, 3)]) for each_nm in (open_nm, residual_nm)), flat],
    ]
    np.testing.assert_allclose(10**found, expected, rtol=3e-3)
    assert np.ptp(np.unique(found)) > 1
    names = [values_of(style.names) for _, (style,) in tape.logged[science.CONTRAST.path]]
    assert [("measured" in now, "true" in as_open) for as_open, now, _ in names] == [(True, False), (False, True)]


def test_a_brighter_dark_zone_is_brighter_in_the_picture() -> None:
    tape, panel = Tape(), science.Science(Coronagraph(load_pupil()), WAVELENGTH_NM)
    open_nm = np.full((1, MODES), 90.0)
    draw(panel, tape, 0, truths=truths(0 * open_nm, open_nm))
    shown = pixels(tape, f"{science.IMAGE}/contrast").astype(float).sum(axis=2)
    star, second = science._SAMPLES // 2, science._SECOND
    zone = slice(star + 20, star + 44)  # 5 to 11 lambda/D right of the star, at 4 samples per lambda/D
    now, flat = (shown[star - 4 : star + 4, start:][:, zone].mean() for start in (0, second))
    assert flat > 2 * now
    assert shown[star, star] == shown[star, second + star] == shown.max()  # both stars
    draw(panel, tape, science.Science.period_ns)  # nothing new, nothing drawn
    assert len(tape.rows[science.CONTRAST.path]) == 1
    further_out = science.Science(Coronagraph(load_pupil(), Wedge(11.0, 16.0)), WAVELENGTH_NM)
    draw(further_out, tape, 0, truths=truths(0 * open_nm, open_nm))
    assert len(tape.rows[science.CONTRAST.path]) == 2


def test_the_trail_has_at_most_400_points_and_ends_at_the_newest() -> None:
    tape, residual_nm = Tape(), np.outer(np.arange(1.0, 800.0), np.ones(MODES))
    draw(pointing.Pointing(1.0), tape, 0, truths=truths(residual_nm, residual_nm))
    points = values_of(tape.last(f"{pointing.TRAIL}/points").positions)
    assert (len(points), points[-1]) == (400, pytest.approx([0.799, -0.799]))  # 1 is the outer ring, 1000 mas


TONE_HZ, TONE_NM = 20.0, 3.0
LAW = LawInForce((0.4,) * MODES, (0.01,) * MODES, 2.0, "")
CAMERA = wire.CameraState(period_ns=round(1e9 / RATE_HZ))


@pytest.fixture(scope="module")
def tone() -> tuple[Any, Any]:
    """Pseudo-open-loop (frames, modes), a tone in the first mode and white noise, and the error under `LAW`; nm."""
    frames = 3000
    pol_nm = np.random.default_rng(1).normal(0, 0.2, (frames, MODES))
    pol_nm[:, 0] += TONE_NM * np.sqrt(2) * np.sin(2 * np.pi * TONE_HZ / RATE_HZ * np.arange(frames))
    error_nm, command_nm = np.zeros((frames, MODES)), np.zeros((frames + 1, MODES))
    for k in range(frames):  # a delay of two frames: the command computed from frame k - 2 is seen
        error_nm[k] = pol_nm[k] + command_nm[max(k - 1, 0)]
        command_nm[k + 1] = 0.99 * command_nm[k] - 0.4 * error_nm[k]
    return pol_nm, error_nm


def test_a_tone_has_its_frequency_and_power_in_the_spectrum(tone: tuple[Any, Any]) -> None:
    pol_nm, error_nm = tone
    signals = np.concatenate([error_nm, pol_nm], axis=1).astype(np.float32)
    found = spectrum(time_series(np.arange(len(signals), dtype=np.uint64), signals), RATE_HZ)
    tilts = np.array(NOLL) <= 3
    hz, (pol, error, theory) = spectra.power_curves(found, tilts, LAW, RATE_HZ)
    tone_at = int(pol.argmax())
    assert hz[tone_at] == pytest.approx(TONE_HZ, rel=0.05)
    noise = 2 * 0.2**2 * 2 / RATE_HZ  # one-sided density of both tilts, nm^2/Hz
    widths_hz = np.diff(np.sqrt(hz[1:] * hz[:-1]))[tone_at - 3 : tone_at + 2]
    power = np.sum((pol[tone_at - 2 : tone_at + 3] - noise) * widths_hz)
    assert power == pytest.approx(TONE_NM**2, rel=0.15)
    expected = rejection(np.array([TONE_HZ]), RATE_HZ, 0.4, 0.01, 2.0)[0] ** 2
    assert error[tone_at] / pol[tone_at] == pytest.approx(expected, rel=0.1)
    np.testing.assert_allclose(np.log10(error[2:]), np.log10(theory[2:]), atol=0.15)
    hz, (others, _, predicted) = spectra.power_curves(found, ~tilts, LAW, RATE_HZ)
    high = hz > 50
    assert np.median(others[high]) == pytest.approx(noise / 2 * (MODES - 2), rel=0.1)
    np.testing.assert_allclose(
        predicted[high] / others[high], rejection(hz[high], RATE_HZ, 0.4, 0.01, 2.0) ** 2, rtol=0.15
    )
    for law in (None, LAW._replace(linear="lqg")):  # only an integrator has a predicted spectrum
        assert len(spectra.power_curves(found, tilts, law, RATE_HZ)[1]) == 2


def test_spectra_stay_in_their_box_and_restart_when_the_mode_changes(tone: tuple[Any, Any]) -> None:
    tape, panel = Tape(), spectra.Spectra()
    panel.begin(tape)
    controller = wire.ControllerState(gain=LAW.gain, leak=LAW.leak, delay_frames=LAW.delay_frames)
    state, shown = f"{spectra.TILTS}/state", f"{spectra.TILTS}/curves"
    for first in range(0, 3000, 50):
        new = steps(first, *(one[first : first + 50] for one in reversed(tone)))
        draw(panel, tape, round((first + 50) * 1e9 / RATE_HZ), steps=new, camera=CAMERA, controller=controller)
    strips = [np.array(strip) for strip in values_of(tape.last(shown).strips)]
    assert len(strips) == 3
    for strip in strips:
        assert ((strip > -0.01) & (strip < [spectra.WIDTH + 0.01, BOX_HEIGHT + 0.01])).all()
    assert values_of(tape.last(state).labels)[0].startswith("loop closed, last ")
    few = np.ones((20, MODES))
    draw(panel, tape, round(9e9), steps=steps(3000, few, few, LoopMode.OPEN), camera=CAMERA, controller=controller)
    assert not values_of(tape.last(shown).strips)
    assert values_of(tape.last(state).labels) == ["loop open: fewer than 64 steady frames"]
    draw(panel, tape, round(9.5e9), camera=CAMERA, controller=controller, ended=LogEnd(*[""] * 4, 0, 0, 0, None))
    assert len(values_of(tape.last(shown).strips)) == 3, "the end of a log shows its last spectra"
    assert values_of(tape.last(state).labels) == ["loop closed, last 4.1 s before a change"]
    draw(panel, tape, round(9.6e9), controller=controller, ended=LogEnd(*[""] * 4, 0, 0, 0, None))
    assert len(values_of(tape.last(shown).strips)) == 3, (
        "also without the state of the camera, which has the frame rate"
    )


def test_a_constant_wavefront_has_no_spectrum() -> None:
    tape, constant = Tape(), np.zeros((2000, MODES))
    draw(spectra.Spectra(), tape, 0, steps=steps(0, constant, constant))
    assert not values_of(tape.last(f"{spectra.OTHERS}/curves").strips)


def test_spectra_of_a_loop_with_tip_and_tilt_alone_state_that_it_has_no_other_modes() -> None:
    tape, tilts = Tape(), dataclasses.replace(CALIBRATION, noll=(2, 3, 3))
    draw(spectra.Spectra(), tape, 0, steps=steps(0, *np.ones((2, 9, MODES))), calibration=tilts)
    assert values_of(tape.last(f"{spectra.OTHERS}/state").labels) == ["loop closed: no such modes"]


def test_memory_of_the_spectra_is_bounded() -> None:
    tape, panel, constant = Tape(), spectra.Spectra(), np.ones((500, MODES))
    for first in range(0, 2 * steady.FRAMES, 500):
        draw(panel, tape, first, steps=steps(first, constant, constant))
    kept = len(panel._steady.rows()[0])
    assert steady.FRAMES <= kept < steady.FRAMES + 500


def test_the_raw_frame_is_drawn_twice_a_second() -> None:
    panel, tape, frame = sensor.Sensor(), Tape(), np.full(CALIBRATION.shape, 100, np.uint16)
    for number in range(30):
        draw(panel, tape, number * TICK_NS, frame=frame, frame_ns=START_NS + number * TICK_NS)
    assert len(tape.logged[sensor.RAW]) == 2


def test_latencies_are_those_of_the_last_second() -> None:
    rng = np.random.default_rng(2)
    tape, panel = Tape(), latency.Latency()
    panel.begin(tape)
    batches = [
        {stage: rng.integers(100_000, 900_000, 100) * (1 + number) for number, stage in enumerate(STAGES)}
        for _ in range(16)
    ]
    controller = wire.Health(topics=[wire.TopicCount(topic=FRAME.key, received=90, skipped=7, missing=3)])
    recorder = wire.Health(recording=wire.Recording(lost=5))
    reported = {Role.CONTROLLER: controller, Role.RECORDER: recorder}
    health = {role: LastHealth(0, one, one, 0) for role, one in reported.items()}
    for number, timings in enumerate(batches):
        draw(panel, tape, number * 100_000_000, timings=timings, health=health)
    times_ns, found = tape.column(latency.TOTAL.path)
    np.testing.assert_array_equal(times_ns - START_NS, np.arange(4) * latency.Latency.period_ns)
    last_us = {stage: np.concatenate([one[stage] for one in batches[6:]]) / 1e3 for stage in STAGES}
    whole_us = last_us["frame_to_command"]
    np.testing.assert_allclose(found[-1], [*np.percentile(whole_us, [50, 99]), whole_us.max()])
    stages_us = [np.percentile(last_us[stage], 99) for stage in tape.names(latency.STAGE_DURATIONS.path)]
    np.testing.assert_allclose(tape.column(latency.STAGE_DURATIONS.path)[1][-1], stages_us)
    bars = tape.last(latency.HISTOGRAM)
    counts, middles = (np.array(values_of(one)[0]["buffer"]) for one in (bars.values, bars.abscissa))
    widths = np.array(values_of(bars.widths)).ravel()
    assert counts.sum() == 1000
    assert np.average(middles, weights=counts) == pytest.approx(whole_us.mean(), abs=widths[0] / 2)
    np.testing.assert_allclose(np.diff(middles), widths[1:], rtol=1e-6)
    assert tape.column(latency.COUNTS.path)[1][-1].tolist() == [7, 3, 5]
    del health[Role.RECORDER]
    draw(panel, tape, 2_000_000_000, health=health)
    np.testing.assert_array_equal(tape.column(latency.COUNTS.path)[1][-1], [7, 3, np.nan], "unknown without a recorder")


def test_a_silent_controller_has_no_latency() -> None:
    tape, panel = Tape(), latency.Latency()
    draw(panel, tape, 0, timings={stage: np.full(10, 400_000) for stage in STAGES})
    draw(panel, tape, 5_000_000_000)
    assert len(tape.rows[latency.TOTAL.path]) == 1
    assert not any(values_of(tape.last(latency.HISTOGRAM).values)[0]["buffer"])
    assert not tape.rows[latency.COUNTS.path], "no Health has arrived"
