"""Controller reports: time not closed and its causes, statistics of the last second, offload; status and summary."""

import io
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from lowfc.contract.codecs.state_codec import controller_state
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.messages import FRAME, Log, timestamp, wire
from lowfc.control.loop.camera import CameraSettings
from lowfc.control.loop.inputs import MirrorShape, Request, Step
from lowfc.control.loop.safety import LoopMode
from lowfc.programs.cli import status
from lowfc.programs.core.controller_report import Arrays, LastSecond, NotClosed, Offload
from lowfc.programs.launch.status import screen, status_line, summary_text
from lowfc.programs.launch.watch import Watch, summary
from lowfc.programs.view.verdicts import wavefront_verdict
from tests.support.toy import DARK_DN, GRID, SATURATION_DN, SHAPE, START, calibration, feed, frame, loaded, settings

SETTINGS = settings()
CAMERA = CameraSettings(START * 10**9, SHAPE, DARK_DN, SATURATION_DN)
SECOND_NS = 10**9
PROCESSES = {
    "controller": wire.Health(
        last_second=wire.LoopFigures(frames=250, residual_rms_nm=2.5, flux_fraction=0.97),
        topics=[wire.TopicCount(topic=FRAME.key, received=100, skipped=1, missing=2)],
    ),
    "camera": wire.Health(
        recent_wavefront=wire.WavefrontFigures(residual_rms_nm=2.0),
        last_warning="COMMANDS_LATE 9 % late",
        last_warning_timestamp=timestamp((START + 2) * SECOND_NS),
    ),
    "recorder": wire.Health(
        state="ready",
        recording=wire.Recording(file="logs/a.mcap"),
        last_warning="DISK_SLOW the disk took 2 s",
        last_warning_timestamp=timestamp((START + 1) * SECOND_NS),
    ),
}


def test_the_time_not_closed_is_summed_and_has_its_cause() -> None:
    account = NotClosed()
    assert account.note(loaded(SETTINGS), 0) == (0, "")
    state, _ = feed(SETTINGS, loaded(SETTINGS), CAMERA, frame(1))
    assert account.note(state, 1 * SECOND_NS) == (0, ""), "closed since its first frame"
    state, _ = feed(SETTINGS, state, replace(CAMERA, bias_dn=DARK_DN + 300))
    assert account.note(state, 2 * SECOND_NS)[0] == 0
    total_ns, cause = account.note(state, 5 * SECOND_NS)
    assert (total_ns, "bias_dn is 400" in cause) == (3 * SECOND_NS, True)


def test_every_cause_of_a_loop_that_was_not_closed_is_named() -> None:
    account, (state, _) = NotClosed(), feed(SETTINGS, loaded(SETTINGS), CAMERA, frame(1))
    account.note(state, 0)
    for number, name in enumerate(("open", "close", "pause", "close", "open", "close"), 1):
        state, _ = feed(SETTINGS, state, Request(number * SECOND_NS, name))
        account.note(state, number * SECOND_NS)
        cause = account.note(state, number * SECOND_NS + 1)[1]
    assert cause == "operator asked to open (2 times); operator asked to pause (1 time)"
    for number in range(50):
        conditions = state.conditions._replace(mode_cause=f"cause {number}")
        account.note(state._replace(mode=LoopMode.OPEN, conditions=conditions), (10 + number) * SECOND_NS)
    cause = account.note(state, 100 * SECOND_NS)[1]
    assert cause.startswith("cause 49 (1 time); operator asked to open (2 times); operator asked to pause (1 time); ")
    assert cause.endswith("; other causes (48 times)")


def test_the_causes_that_lasted_longest_are_named() -> None:
    account, (state, _) = NotClosed(), feed(SETTINGS, loaded(SETTINGS), CAMERA, frame(1))
    causes = ["open", "step", "pause", "step", "one", "two", "three", "open", "safe"]
    for time_s, cause in enumerate(causes):
        conditions = state.conditions._replace(mode_cause=cause)
        account.note(state._replace(mode=LoopMode.OPEN, conditions=conditions), time_s * SECOND_NS)
    cause = account.note(state, 100 * SECOND_NS)[1]
    assert cause == "safe (1 time); open (2 times); step (2 times); pause (1 time); other causes (3 times)"


@pytest.mark.parametrize(("not_closed_s", "fraction"), [(0, 1.0), (3, 0.7), (10, 0.0)])
def test_the_closed_fraction_is_that_of_the_time_between_first_and_last_frame(
    not_closed_s: int, fraction: float
) -> None:
    received = wire.TopicCount(topic=FRAME.key, received=1001)
    controller = wire.Health(topics=[received], not_closed_ns=not_closed_s * SECOND_NS)
    camera = wire.Health(mean_rate_hz=100.0)
    assert summary(Watch({"controller": controller, "camera": camera}, []), False)["closed_fraction"] == fraction
    camera.mean_rate_hz = 30.0  # in lockstep: frames per second of real time
    assert summary(Watch({"controller": controller, "camera": camera}, []), False, 100.0)["closed_fraction"] == fraction


def test_summary_and_status_show_the_time_not_closed() -> None:
    def first_line(**health: Any) -> str:
        received = wire.TopicCount(topic=FRAME.key, received=1001)
        controller, camera = wire.Health(topics=[received], **health), wire.Health(mean_rate_hz=100.0)
        watch = Watch({"controller": controller, "camera": camera}, [])
        return summary_text(summary(watch, record=False)).splitlines()[0].split(maxsplit=1)[1]

    without_frames = summary_text(summary(Watch({}, []), record=False))
    assert [line.split()[-1] for line in without_frames.splitlines()[-3:]] == ["frame", "-", "-"]
    camera = wire.Health(topics=[wire.TopicCount(topic=FRAME.key, published=1)])
    results = summary(Watch({"camera": camera}, []), record=False)
    assert "over the open pupil, second half of the run, sampled" in summary_text(results)
    assert "second half of the run, in part not closed, sampled" in summary_text(results | {"closed_fraction": 0.2})
    not_closed = {"not_closed_ns": 3 * SECOND_NS, "not_closed_cause": "the camera does not fit"}
    assert first_line(mode=wire.LOOP_MODE_CLOSED) == "closed"
    expected = "closed; not closed for 3.0 s in total: the camera does not fit"
    assert first_line(mode=wire.LOOP_MODE_CLOSED, **not_closed) == expected
    assert first_line(mode=wire.LOOP_MODE_OPEN, **not_closed) == expected.replace("closed;", "open;")
    assert first_line(mode=wire.LOOP_MODE_SAFE, **not_closed) == expected.replace("closed;", "in safe mode;")
    not_closed["not_closed_ns"] = 10 * SECOND_NS
    assert first_line(mode=wire.LOOP_MODE_OPEN, **not_closed) == "open; never closed: the camera does not fit"
    expected = "closed only at the end: the camera does not fit"
    assert first_line(mode=wire.LOOP_MODE_CLOSED, **not_closed) == expected
    short = first_line(mode=wire.LOOP_MODE_CLOSED, not_closed_ns=SECOND_NS // 25)
    assert short == "closed; not closed for 0.04 s in total"
    assert screen(Watch({}, [Log(message="without a level")]), Configuration(), None, 1.0), "shown without an error"
    assert first_line() == "no controller reported", "no time is shown before the controller reports a mode"
    state, _ = feed(SETTINGS, loaded(SETTINGS), CAMERA, frame(1), replace(CAMERA, bias_dn=DARK_DN + 300))
    message = controller_state(state, SETTINGS, (START + 12) * SECOND_NS)
    mirror = wire.Health(command_refused=wire.REASON_OUT_OF_ORDER)
    _, *lines = status.text(status.json_object(message, {"mirror-dm": mirror})).splitlines()
    assert lines[0].split(maxsplit=1)[1].startswith("open for 12 s (the camera does not fit the calibration: bias_dn")
    assert lines[1].split(maxsplit=1)[1] == "refuses commands: OUT_OF_ORDER"
    holding = {"controller": wire.Health(holding="no frame comes")}
    held = status.text(status.json_object(message, holding)).splitlines()[1]
    assert " open for 12 s (" in held
    assert held.endswith("), not correcting: no frame comes"), "12 s since the loop opened, not since the last frame"
    expired = {"mirror-x": wire.Health(command_expired=True)}
    assert status.json_object(message, expired)["mirrors"]["mirror-x"]["expired"]


def test_the_first_line_of_the_status_shows_loop_recording_and_warnings() -> None:
    state, _ = feed(SETTINGS, loaded(SETTINGS), CAMERA, frame(1))

    def first_line(**changes: Any) -> str:
        message = controller_state(state, SETTINGS, (START + 12) * SECOND_NS)
        return status.text(status.json_object(message, PROCESSES | changes, "night")).splitlines()[0]

    normal = (
        "closed · residual 2.50 nm rms, noise included (true 2.00 over 2 s) · light 97 % · 3 frames lost · recording "
        "logs/a.mcap"
    )
    warned = "10 s ago camera: COMMANDS_LATE 9 % late"
    assert first_line() == f"{normal} · run night · law integrator · {warned}"
    failed = wire.Health(command_refused=wire.REASON_NO_MIRROR, last_warning="DRIVER_FAILED: 1 / 0 (my.py, line 3)")
    assert first_line(**{"mirror-dm": failed}).endswith(" s ago mirror-dm: DRIVER_FAILED: 1 / 0 (my.py, line 3)")
    stopped = wire.Health(state="ready", recording=wire.Recording(file="logs/a.mcap", stopped=True))
    assert "· recording stopped ·" in first_line(recorder=stopped)
    failed = wire.Health(state="ready", recording=wire.Recording(failure="full"))
    assert "· recording failed ·" in first_line(recorder=failed)
    assert "· not recording ·" in first_line(recorder=wire.Health(state="stopped"))
    assert first_line(controller=wire.Health()).startswith(
        "closed · no frame used in the last second · 0 frames lost ·"
    )
    assert first_line(camera=wire.Health(), recorder=wire.Health()).endswith(" · no warning")
    before = state
    state, _ = feed(SETTINGS, state, Request((START + 2) * SECOND_NS, "offset", (2,), (20.0,)))
    assert "residual 2.50 nm rms, noise included (true 2.00 over 2 s, with offset and channels) ·" in first_line()
    state = before
    mode_texts = ("paused", "open", "open", "closed", "in safe mode")  # `pause` of an open loop leaves it open
    for name, mode_text in zip(("pause", "open", "pause", "close", "safe"), mode_texts, strict=True):
        state, (outputs,) = feed(SETTINGS, state, Request((START + 2) * SECOND_NS, name))
        assert outputs.reply.accepted
        assert first_line().startswith(f"{mode_text} ·")
        assert status.json_object(controller_state(state, SETTINGS, 0))["paused"] == (mode_text == "paused")


@pytest.mark.parametrize(("count", "names"), [(99, ("p50", "max")), (100, ("p50", "p99", "max"))])
def test_a_summary_omits_a_percentile_that_equals_the_maximum_of_few_values(count: int, names: tuple[str, ...]) -> None:
    latency = wire.Latency(count=count, p50_ns=1000, p99_ns=2000, p99_9_ns=2000, max_ns=2000)
    received = wire.TopicCount(topic=FRAME.key, received=count)
    controller = wire.Health(topics=[received], frame_to_command=latency)
    lines = summary_text(summary(Watch({"controller": controller}, []), False)).splitlines()
    shown = next(line for line in lines if line.startswith("frame to command")).split()[3:]
    assert tuple(word for word in shown if word[0] in "pm") == names


def test_in_lockstep_the_simulated_rate_and_the_speed_of_the_computation_are_both_shown() -> None:
    camera = wire.Health(rate_hz=830.0, mean_rate_hz=831.25)
    camera.recent_wavefront.SetInParent()
    watch, config = Watch({"camera": camera}, []), Configuration(lockstep=True)
    rate = "250 Hz in simulated time, computed at {} frames per second"
    assert rate.format("831.2") in summary_text(summary(watch, False, 250.0), 250.0)
    assert rate.format(830) in status_line(watch, 5.0, 250.0)
    with Console(width=160, file=io.StringIO(), record=True) as console:
        console.print(screen(watch, config, None, 5.0))
    assert rate.format(830) in console.export_text()
    assert "rate               831.2 Hz" in summary_text(summary(watch, False)).splitlines()
    assert "rate               -" in summary_text(summary(Watch({}, []), False)).splitlines()


def test_added_contrast_is_shown_for_a_flat_mirror_and_the_present_one() -> None:
    recent = wire.WavefrontFigures(added_contrast_flat=7e-10, added_contrast=-4e-11)
    published = wire.TopicCount(topic=FRAME.key, published=1)
    camera = wire.Health(recent_wavefront=recent, wavefront=recent, topics=[published])
    message = controller_state(loaded(SETTINGS), SETTINGS, (START + 12) * SECOND_NS)
    watch = Watch({"camera": camera}, [])
    expected = "added to the dark zone's contrast: flat mirror +7.0e-10, residual -4.0e-11"
    quadratic = f"{expected}; quadratic form, valid to 3 nm rms of a mode"
    assert quadratic in status.text(status.json_object(message, {"camera": camera}))
    assert quadratic in summary_text(summary(watch, record=False))
    assert "  contrast by quadratic form -4.0e-11 of +7.0e-10  " in status_line(watch, 5.0)
    assert quadratic.removeprefix(expected) in wavefront_verdict.contrast(recent, now=True, estimated=False).detail
    camera.wavefront.science_images = 200
    assert f"{expected}; computed from full images of the true wavefront" in summary_text(summary(watch, False))
    results = summary(watch, False) | {"costliest_modes": {"modes": "coma", "share": 0.7}}
    for beyond in (False, True):
        shown = summary_text(results | {"beyond_quadratic": beyond})
        assert ("; coma contributes most (70 %)" in shown) is not beyond, "the share is of the quadratic form only"
    for frames in (50, 0):  # without frames the controller's estimate is an old one
        controller = wire.Health(recent_wavefront=recent, last_second=wire.LoopFigures(frames=frames))
        assert (expected in status.text(status.json_object(message, {"controller": controller}))) == bool(frames)


def test_statistics_of_the_last_second_exclude_older_and_refused_frames() -> None:
    state, last = loaded(SETTINGS), LastSecond(SECOND_NS // 4)
    assert last.statistics(state, SECOND_NS) == wire.LoopFigures()
    flux_dn = state.loop.calibration.flux_dn

    def step(error_nm: float | None) -> Step:
        errors = None if error_nm is None else np.full(4, error_nm, np.float32)
        return Step(1, 0, LoopMode.CLOSED, np.zeros(4, np.float32), (), errors, None, flux_dn / 2)

    for quarter, error_nm in enumerate((9.0, 9.0, 9.0, 9.0, 9.0, 1.0, 1.0, None, 1.0, 1.0)):
        last.add(step(error_nm), quarter * SECOND_NS // 4)
    figures = last.statistics(state, 9 * SECOND_NS // 4)
    assert (figures.frames, figures.residual_rms_nm, figures.flux_fraction) == pytest.approx((3, 2.0, 0.5))
    assert last.statistics(state, 20 * SECOND_NS).frames == 0


def test_the_status_line_shows_recent_statistics_and_none_before_the_first_frame() -> None:
    watch = Watch({"controller": wire.Health(mode=wire.LOOP_MODE_CLOSED), "camera": wire.Health(process="camera")}, [])
    assert status_line(watch, 5.0) == "    5 s  no frame yet"
    whole_run = wire.WavefrontFigures(residual_rms_nm=27.0, disturbance_rms_nm=31.0)
    recent = wire.WavefrontFigures(residual_rms_nm=2.2, disturbance_rms_nm=30.0)
    watch.health["camera"] = wire.Health(process="camera", rate_hz=250, wavefront=whole_run, recent_wavefront=recent)
    watch.health["camera"].mean_rate_hz = 250
    assert "closed     250 Hz  residual 2.20 of 30.00 nm rms" in status_line(watch, 10.0)
    received = wire.TopicCount(topic=FRAME.key, received=900)
    controller = wire.Health(mode=wire.LOOP_MODE_CLOSED, topics=[received], not_closed_ns=2 * SECOND_NS)
    early = Watch(watch.health | {"controller": controller}, [])
    assert "closed for 1.6 s     250 Hz" in status_line(early, 5.0), "the residual includes open-loop frames"
    assert "closed for 2.0 s  225 Hz in simulated time" in status_line(early, 5.0, 225.0)
    controller.topics[0].received, controller.not_closed_ns = 250 * 3601, 3600 * SECOND_NS
    early.health["camera"].rate_hz = 250.4  # the rate of the last half second
    assert "closed for 1.0 s     250 Hz" in status_line(early, 5.0)
    with Console(width=120, file=io.StringIO(), record=True) as console:
        console.print(screen(watch, Configuration(), None, 10.0))
    assert "residual 2.20 of 30.00 nm rms" in console.export_text()
    for health, seconds in ((watch.health["camera"], 10), (watch.health["controller"], 17)):
        health.timestamp.FromSeconds(seconds)
    watch.health["controller"].frame_to_command.CopyFrom(wire.Latency(count=9, p50_ns=123_000))
    assert status_line(watch, 17.0) == "   17 s  closed  the camera has been silent for 7 s"
    hung = Watch(watch.health | {"controller": wire.Health(process="controller")}, [])
    assert status_line(hung, 17.0).endswith("the controller has been silent for 10 s")
    watch.health["controller"].holding = "reserved for [/b]"
    with Console(width=120, file=io.StringIO(), record=True) as console:
        console.print(screen(watch, load(None, {"sensor.kind": "zwfs"}), None, 17.0))
    shown = console.export_text()
    assert "2.20" not in shown, "statistics seven seconds old are not shown"
    assert "123 us" not in shown
    assert "bench, V = 2, zwfs; 17 s" in shown
    assert "closed (not correcting: reserved for [/b])" in shown, "an operator's text is not interpreted as markup"


@pytest.mark.parametrize(("received", "missing", "lost"), [(500, 0, 0), (371, 129, 129), (309, 0, 191), (0, 0, 0)])
def test_frames_published_after_the_last_received_one_count_as_lost(received: int, missing: int, lost: int) -> None:
    recorder = wire.Health(
        recording=wire.Recording(lost=missing),
        topics=[wire.TopicCount(topic=FRAME.key, received=received, missing=missing)],
    )
    camera = wire.Health(topics=[wire.TopicCount(topic=FRAME.key, published=500)])
    results = summary(Watch({"recorder": recorder, "camera": camera}, []), record=True)
    assert (results["messages_lost"], results["lost"].get(FRAME.key, 0)) == (lost, lost)


def test_a_refused_load_while_no_calibration_is_in_use_publishes_no_calibration() -> None:
    published: list[bytes] = []
    shape, arrays = np.zeros(GRID, np.float32), Arrays(*[SimpleNamespace(put=published.append)] * 3)
    state, _ = feed(SETTINGS, loaded(SETTINGS)._replace(loop=None), MirrorShape(1, shape, np.zeros(0, np.float32)))
    arrays.publish_in_use(Request(1, "load", calibration=calibration()), state)
    assert published == []


def test_the_mean_modal_command_is_published_for_offload() -> None:
    published: list[bytes] = []
    offload = Offload(SimpleNamespace(put=published.append), frames=2)
    for noll, command_nm in (((2, 3), 9.0), ((4, 5), 1.0), ((4, 5), 2.0), ((4, 5), 7.0)):
        offload.add(Step(8, 77, LoopMode.CLOSED, np.full(2, command_nm, np.float32), ()), noll)
    (message,) = map(wire.ModalOffload.FromString, published)
    assert (list(message.noll), list(message.command_nm), message.frames) == ([4, 5], [1.5, 1.5], 2)
