"""The report of a run: its results against a log whose content is known, and a page for every kind of log."""

import json
import re
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.logs.recovery import recover
from lowfc.contract.codecs.calibration_codec import encode_calibration, with_identity
from lowfc.contract.configuration import load
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.messages import (
    CALIBRATION,
    COMMAND,
    CONTROLLER_STATE,
    EVENT,
    FRAME,
    REQUEST,
    STEP,
    TRUTH,
    Log,
    wire,
)
from lowfc.control.laws.error_budget import sensor_noise
from lowfc.control.loop.state import State
from lowfc.optics.detector.photometry import tilt_nm_per_mas
from lowfc.programs.logs.report import closed_loop, drawings
from lowfc.programs.logs.report.page import NOT_IN_LOG, page
from lowfc.programs.logs.report.results import report_of
from lowfc.programs.logs.report.source import read_run
from lowfc.programs.logs.report.verdict import verdict
from tests.support import report_log
from tests.support.loops import json_of, lowfc, refusal
from tests.support.mutated_logs import flipped
from tests.support.report_log import READ_NOISE_E, TOY_CALIBRATION, SyntheticLog
from tests.support.theory import noise_gain, rejection
from tests.support.toy import NOLL, calibration

RATE_HZ = 1000.0
GOLDEN = Path(__file__).parents[1] / "golden" / "0.1" / "night.mcap"


def results_of(log: Path) -> dict[str, Any]:
    results = report_of(read_run(log)).results
    json.dumps(results, allow_nan=False)  # raises if a value is not finite
    return results


def check_of(results: dict[str, Any], name: str) -> dict[str, str]:
    """A check of the verdict by its name."""
    return next(check for check in results["verdict"]["checks"] if check["name"] == name)


@pytest.fixture(scope="module")
def eventful(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Results of a log with the loop open and closed, frames lost and dark, gains changed, and two restarts.

    The controller and the camera restart. Of the 2250 frames 6 are lost, so that there are 2244 steps.
    """
    night = SyntheticLog().health("camera", commands_late=40, state="ready").request("open").frames(300)
    night.request("close")
    night.frames(1500, lost={200, 201, 202, 203, 204, 700}, dark={800})
    night.request("gain", (0.2,))
    for name in ("renew", "configuration"):
        night.put(REQUEST, wire.Request(name=name, accepted=True))
    night.frames(200)
    night.request("gain", (9.0,))
    night.frames(100)
    night.start_controller()
    night.frames(50)
    night.start_camera()
    night.frames(100)
    counts = [wire.TopicCount(topic=FRAME.key, received=2244, skipped=4, missing=2)]
    night.health("controller", topics=counts, state="stopped")
    night.health("camera", commands_late=43, state="stopped")
    return results_of(night.write(tmp_path_factory.mktemp("eventful") / "night.mcap"))


def test_modes_laws_and_requests_are_listed(eventful: dict[str, Any]) -> None:
    assert eventful["mode_steps"] == {"open": 300, "closed": 1944}
    assert [span["mode"] for span in eventful["mode_spans"]] == ["open", "closed"]
    assert eventful["mode_spans"][1]["from_s"] == pytest.approx(0.3)
    assert [(one["from_s"], one["gain"]) for one in eventful["laws"]] == [
        (0.0, [0.4, 0.4, 0.2]),
        (pytest.approx(1.8), [0.2, 0.2, 0.2]),
        (pytest.approx(2.1), [0.4, 0.4, 0.2]),
    ]
    requests = eventful["requests"]
    assert [one["name"] for one in requests] == ["open", "close", "gain", "gain"]
    assert [one["accepted"] for one in requests] == [True, True, True, False]
    assert [one["time_s"] for one in requests] == pytest.approx([0, 0.3, 1.8, 2.0], abs=1e-3)
    assert eventful["run"]["steps"] == 2244
    assert eventful["run"]["host"] == "bench"
    assert eventful["run"]["versions"] == {"lowfc": "0.1.0", "numpy": "2.0"}


def test_frames_are_accounted_for(eventful: dict[str, Any]) -> None:
    assert eventful["timing"]["frames"] == {
        "recorded": 2250,
        "without_command": 6,
        "at_the_end": 0,
        "skipped_by_controller": 4,
        "missing_at_controller": 2,
        "commands_late": 3,
        "camera_starts": 2,
    }
    assert eventful["light"]["refused"] == {"dark": 1}
    assert eventful["timing"]["rate_hz"] == RATE_HZ


def test_without_a_count_of_late_commands_the_commands_are_not_called_in_time(tmp_path: Path) -> None:
    results = results_of(uneventful(SyntheticLog(truth=False)).write(tmp_path / "log.mcap"))
    assert results["timing"]["frames"]["commands_late"] is None
    assert check_of(results, "delay")["level"] == "unknown"


@pytest.mark.parametrize(("late", "level"), [(15, "good"), (16, "look")])
def test_more_than_one_late_command_in_twenty_needs_attention_as_in_the_view(
    tmp_path: Path, late: int, level: str
) -> None:
    night = SyntheticLog().health("camera", state="ready").frames(300)
    night.health("camera", commands_late=late, state="stopped")
    assert check_of(results_of(night.write(tmp_path / "log.mcap")), "delay")["level"] == level


def test_latencies_agree_with_the_times_in_the_messages(eventful: dict[str, Any]) -> None:
    latency = eventful["timing"]["latency_us"]
    assert latency["transport"] == {"count": 2244, **dict.fromkeys(("p50", "p90", "p99", "p99_9", "max"), 90.0)}
    assert latency["frame_to_command"]["max"] == 349
    assert 320 < latency["frame_to_command"]["p50"] < 330
    assert latency["frame_to_mirror"]["max"] == 549
    assert latency["frame_to_mirror"]["count"] == 2244
    assert eventful["timing"]["interval_us"]["frames"]["max"] == 1000
    assert eventful["timing"]["interval_us"]["commands"]["max"] == pytest.approx(6006)  # five frames lost in a row


def test_a_message_that_the_log_lacks_is_not_a_pause_of_its_sender(tmp_path: Path) -> None:
    night = uneventful(SyntheticLog())
    lost = {index for topic in (FRAME, COMMAND) for index in night.indices(topic)[100:120]}
    night.samples = [one for index, one in enumerate(night.samples) if index not in lost]
    intervals = results_of(night.write(tmp_path / "log.mcap"))["timing"]["interval_us"]
    assert intervals["frames"]["count"] == len(night.indices(FRAME)) - 2
    assert intervals["frames"]["max"] == 1000
    assert intervals["commands"]["max"] < 1100


def test_an_event_has_the_time_of_its_sending_however_late_it_was_recorded(tmp_path: Path) -> None:
    night = uneventful(SyntheticLog(), 100)
    night.event("RECORDING_FAILED", why="disk full")
    night.frames(10).event("RECORDING")
    uneventful(night, 700)
    late = night.samples.pop(night.indices(EVENT)[-2])
    night.samples.append(late._replace(receive_time_ns=late.receive_time_ns + 400_000_000))
    *_, event, last = results_of(night.write(tmp_path / "log.mcap"))["events"]
    assert (event["name"], last["name"]) == ("RECORDING_FAILED", "RECORDING")
    assert (event["time_s"], last["time_s"]) == pytest.approx((0.099, 0.109))


def test_the_longest_stretch_under_one_law_is_analysed(eventful: dict[str, Any]) -> None:
    stretch = eventful["closed_stretch"]
    assert stretch["gain"] == [0.4, 0.4, 0.2]
    assert stretch["steps_settling"] == 25
    assert stretch["from_s"] == pytest.approx(0.325)
    assert stretch["to_s"] == pytest.approx(1.799)
    # One lost and one dark frame are bridged; five lost in a row divide the stretch.
    assert (stretch["pieces"], stretch["frames_bridged"]) == (2, 2)
    assert stretch["frames"] == 1475 - 5


def test_the_error_budget_agrees_with_the_known_noise_and_disturbance(eventful: dict[str, Any]) -> None:
    used, noise_dn = SyntheticLog().calibration, np.hypot(READ_NOISE_E, 12**-0.5)  # 1 e/DN; with rounding to whole DN
    noise = sensor_noise(used.reconstructor.astype(float), used.reference.astype(float), used.flux_dn, noise_dn)
    terms = {term["name"]: term for term in eventful["error_budget"]["terms"]}
    noise_to_residual = np.sqrt([noise_gain(gain, 0.0, 1.0) for gain in (0.4, 0.4, 0.2)])
    groups = ("tilt x", "tilt y", "other modes")
    for name, expected in (("photon noise", noise.photon_nm), ("read noise", noise.read_nm)):
        rms_nm = [terms[name]["rms_nm"][group] for group in groups]
        assert rms_nm == pytest.approx((expected * noise_to_residual).tolist(), rel=0.01)
    expected_nm = 12 / np.sqrt(2) * rejection(np.array([7.0]), RATE_HZ, 0.4, 0.0, 1.0)[0]
    assert terms["lag"]["rms_nm"]["tilt x"] == pytest.approx(expected_nm, rel=0.1)
    assert terms["lag"]["rms_nm"]["tilt y"] < 0.01
    assert "all modes" in terms["nonlinearity"]["upper_limit"]
    for group in (*groups, "all modes"):
        assert eventful["error_budget"]["sum_over_true"][group] == pytest.approx(1, abs=0.1)
    assert eventful["error_budget"]["sum_lacks"] == []


def test_the_residual_is_given_before_and_after_correction(eventful: dict[str, Any]) -> None:
    tilt_x = eventful["residual"]["modes"][0]
    assert tilt_x["name"] == "tilt x"
    assert tilt_x["disturbance_rms_nm"] == pytest.approx(12 / np.sqrt(2), rel=0.05)
    assert tilt_x["residual_rms_nm"] < 0.15 * tilt_x["disturbance_rms_nm"]
    assert tilt_x["pseudo_open_loop_rms_nm"] == pytest.approx(tilt_x["disturbance_rms_nm"], rel=0.05)
    assert tilt_x["open_residual_rms_nm"] == pytest.approx(12 / np.sqrt(2), rel=0.15)
    x_mas = tilt_x["residual_rms_nm"] / tilt_nm_per_mas(2.0)
    tilt = eventful["residual"]["tilt_mas"]["residual"]
    assert tilt["x"] == pytest.approx(x_mas)
    assert tilt["per_axis"] == pytest.approx(np.sqrt((tilt["x"] ** 2 + tilt["y"] ** 2) / 2))


def test_spectra_are_compared_with_theory(eventful: dict[str, Any]) -> None:
    tilt_x = eventful["spectra"]["groups"][0]
    assert tilt_x["measured_over_theory"]["median"] == pytest.approx(1, abs=0.02)
    assert tilt_x["true_over_theory"]["median"] == pytest.approx(1, abs=0.15)
    assert sum(band["disturbance_rms_nm"] ** 2 for band in tilt_x["bands"]) == pytest.approx(72, rel=0.1)
    assert tilt_x["bands"][0]["from_hz"] == eventful["spectra"]["resolution_hz"], "slower drift is not in the spectrum"
    loudest = int(np.argmax(tilt_x["power_nm2_hz"]["disturbance"]))
    assert tilt_x["frequency_hz"][loudest] == pytest.approx(7, abs=eventful["spectra"]["resolution_hz"])


@pytest.mark.usefixtures("without_drawings")
def test_the_bands_of_a_slow_loop_end_at_half_its_rate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(report_log, "PERIOD_NS", 200_000_000)
    slow = report_of(read_run((SyntheticLog().frames(600).write(tmp_path / "slow.mcap"),)))
    assert "<td>1</td><td>2.5</td>" in page(slow)


def test_the_verdict_names_what_was_wrong(eventful: dict[str, Any]) -> None:
    found = eventful["verdict"]
    levels = {check["name"]: check["level"] for check in found["checks"]}
    assert found["level"] == "look"
    assert {name for name, level in levels.items() if level == "look"} == {"commands", "light", "events"}
    assert {name for name, level in levels.items() if level == "good"} == {"log", "loop", "residual", "delay", "mirror"}
    assert found["because"] == "6 of 2250 frames (0.27%) were not processed"
    before_nm = eventful["residual"]["open_pupil"]["disturbance_open_pupil_rms_nm"]
    text = check_of(eventful, "residual")["text"]
    assert text.startswith(f"{before_nm:.3g} nm before")
    assert "nm after correction over the open pupil, in the longest stretch under one law;" in text


def uneventful(night: SyntheticLog, frames: int = 300) -> SyntheticLog:
    """Add frames without a fault between two Healths of the camera, and return the log."""
    return night.health("camera", state="ready").frames(frames).health("camera", state="stopped")


@pytest.fixture(scope="module")
def good_night() -> SyntheticLog:
    return uneventful(SyntheticLog(), 1500)


@pytest.fixture(scope="module")
def good(good_night: SyntheticLog, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return good_night.write(tmp_path_factory.mktemp("good") / "x.mcap")


@pytest.fixture(scope="module")
def good_results(good: Path) -> dict[str, Any]:
    return results_of(good)


def damaged(good: Path, folder: Path) -> Path:
    return flipped(Path(shutil.copy(good, folder)), good.stat().st_size // 2)


def cut_off(good: Path, folder: Path) -> Path:
    content = good.read_bytes()
    (folder / "x.mcap.part").write_bytes(content[: int(0.7 * len(content))])
    return folder / "x.mcap.part"


def recovered(good: Path, folder: Path) -> Path:
    recover(cut_off(good, folder), folder / "y.mcap")
    return folder / "y.mcap"


def stopped(good: Path, folder: Path) -> Path:
    return uneventful(SyntheticLog()).write(folder / "x.mcap", stopped="the disk is full")


@pytest.mark.parametrize(
    ("make", "level", "text", "complete"),
    [
        (lambda good, folder: good, "good", "complete, no message lost", True),
        (damaged, "look", "1 damaged part left out", False),
        (cut_off, "look", "truncated: the recorder did not finish it", False),
        (recovered, "look", "recovered from x.mcap.part, which was incomplete; left out: damaged parts 0", True),
        (stopped, "bad", "recording stopped: the disk is full", True),
    ],
)
def test_the_state_of_the_log_is_in_the_verdict(
    good: Path, tmp_path: Path, make: Callable[[Path, Path], Path], level: str, text: str, complete: bool
) -> None:
    log = make(good, tmp_path)
    report = report_of(read_run(log))
    check = check_of(report.results, "log")
    assert (check["level"], check["text"].partition(", unreadable")[0]) == (level, text)
    assert (report.results["log"]["complete"], report.results["log"]["finished"]) == (complete, make is not cut_off)
    assert 0 < report.results["run"]["steps"] <= 1500
    assert report.results["verdict"]["level"] == level
    assert report.results["verdict"]["because"] == ("" if level == "good" else check["text"])


def test_the_noise_is_that_of_the_reconstructor_in_use(tmp_path: Path) -> None:
    run = read_run(uneventful(SyntheticLog(), 600).write(tmp_path / "x.mcap"))
    before, state = closed_loop.noise_of(run.history, slice(None)), run.history.controllers[-1]
    state.prior_nm2.extend([0.0, 0.0, 0.01])  # automatic gains leave the last mode uncorrected
    state.weighting_flux_dn = TOY_CALIBRATION.flux_dn
    state.camera_expected.gain_e_per_dn = 1.0
    after = closed_loop.noise_of(run.history, slice(None))
    assert before is not None
    assert after is not None
    assert (after.total_nm[:2] < 0.99 * before.total_nm[:2]).any()
    assert after.total_nm[2] == before.total_nm[2]
    run.history.controllers.append(wire.ControllerState())  # restarted afterwards
    assert np.array_equal(closed_loop.noise_of(run.history, slice(None)).total_nm, after.total_nm)


def test_a_limit_that_acted_at_mirror_and_controller_has_the_larger_count(good_results: dict[str, Any]) -> None:
    limits = {"limits_at_mirror": {"stroke": 50, "slew": 2}, "limits_at_controller": {"stroke": 1, "slew": 3}}
    results = good_results | {"mirror": good_results["mirror"] | limits}
    assert check_of({"verdict": verdict(results)}, "mirror")["text"] == "limits acted: stroke 50, slew 3"


def test_only_the_end_of_a_very_long_stretch_is_analysed(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(closed_loop, "MAX_STEPS", 400)
    stretch = results_of(good)["closed_stretch"]
    assert stretch["frames"] == 400
    assert stretch["steps_settling"] + stretch["steps_earlier"] == 1100
    assert stretch["to_s"] == pytest.approx(1.499)


@pytest.mark.parametrize("empty", [True, False])
def test_a_log_without_a_step_still_has_a_page(tmp_path: Path, empty: bool) -> None:
    night = SyntheticLog()
    if empty:
        night.samples.clear()
    report = report_of(read_run(night.write(tmp_path / "x.mcap", config=not empty)))
    assert report.results["verdict"]["level"] == "bad"
    assert report.results["verdict"]["because"] == "this log has no control steps"
    assert "Without control steps that can be read" in page(report)


@pytest.mark.usefixtures("without_drawings")
def test_a_report_of_a_log_without_calibration_says_that_the_steps_cannot_be_read(tmp_path: Path) -> None:
    night = SyntheticLog().frames(20).without(CALIBRATION)
    report = report_of(read_run(night.write(tmp_path / "x.mcap")))
    texts = {check["name"]: check["text"] for check in report.results["verdict"]["checks"]}
    assert texts["loop"] == "this log has no calibration, without which its 20 control steps cannot be read"
    assert texts["commands"] == "this log has no calibration, without which its steps cannot be read"
    assert "has no control steps" not in page(report)


@pytest.mark.usefixtures("without_drawings")
def test_imperfections_of_the_simulated_world_are_named(tmp_path: Path) -> None:
    night, imperfect = uneventful(SyntheticLog()), {"disturbance.wheel_hz": 40.0, "camera.hot_pixels": 0.01}
    report = report_of(read_run(night.write(tmp_path / "x.mcap", toml=load(None, imperfect).to_toml())))
    assert report.results["run"]["imperfections"] == imperfect
    assert "simulated with disturbance.wheel_hz = 40.0, camera.hot_pixels = 0.01;" in page(report)


@pytest.mark.parametrize(
    ("events", "level"),
    [
        ("camera NO_FRAMES, camera STOPPED", "good"),
        ("camera NO_FRAMES, camera FRAMES_BACK, camera STOPPED", "look"),
        ("camera NO_FRAMES, controller STOPPED", "look"),
    ],
)
def test_the_silence_of_a_camera_that_stopped_for_good_is_no_warning(
    events: str, level: str, good_results: dict[str, Any]
) -> None:
    named = [(*event.split(), "warning" if "NO_FRAMES" in event else "info") for event in events.split(", ")]
    results = good_results | {"events": [dict(zip(("process", "name", "level"), one, strict=True)) for one in named]}
    assert check_of({"verdict": verdict(results)}, "events")["level"] == level


def test_a_loop_in_safe_mode_is_not_a_good_run(tmp_path: Path) -> None:
    night = uneventful(SyntheticLog())
    night.request("safe").frames(50).request("clear")
    results = results_of(night.request("note", text="camera off").write(tmp_path / "x.mcap"))
    assert [one["time_s"] for one in results["requests"]] == pytest.approx([0.3, 0.349, 0.349])
    assert results["verdict"]["level"] == "bad"
    assert {check["name"] for check in results["verdict"]["checks"] if check["level"] == "bad"} == {"loop", "events"}
    assert [event["name"] for event in results["events"] if event["level"] == "error"] == ["SAFED"]


def test_without_truth_the_terms_that_need_it_are_missing_and_not_zero(
    good_night: SyntheticLog, tmp_path: Path
) -> None:
    night = SyntheticLog()
    night.samples = good_night.samples
    results = results_of(night.without(TRUTH).write(tmp_path / "x.mcap"))
    terms = {term["name"]: term for term in results["error_budget"]["terms"]}
    for name in ("cross-talk and aliasing", "nonlinearity"):
        assert terms[name]["missing"]
        assert set(terms[name]["rms_nm"].values()) == {None}
        assert "true wavefront" in terms[name]["how"]
    expected_nm = 12 / np.sqrt(2) * rejection(np.array([7.0]), RATE_HZ, 0.4, 0.0, 1.0)[0]
    assert terms["lag"]["rms_nm"]["tilt x"] == pytest.approx(expected_nm, rel=0.25)
    assert "noise floor" in terms["lag"]["how"]
    assert results["error_budget"]["sum_lacks"] == ["cross-talk and aliasing", "nonlinearity"]
    assert set(results["error_budget"]["true_residual"]["rms_nm"].values()) == {None}
    assert results["residual"]["total_rms_nm"]["residual"] is None
    assert "true_over_theory" not in results["spectra"]["groups"][0]
    assert results["run"]["simulated"] is False
    assert (
        "nm after correction in all modes over the circle, in the longest stretch under one law;"
        in check_of(results, "residual")["text"]
    )


def test_a_log_of_an_open_loop_has_neither_spectra_nor_budget(tmp_path: Path) -> None:
    night = SyntheticLog().request("open")
    results = results_of(uneventful(night, 300).write(tmp_path / "x.mcap"))
    assert results["closed_stretch"] is None
    assert results["spectra"] == results["error_budget"] == {"why_not": "the loop was not closed in this log"}
    assert results["residual"]["total_rms_nm"]["open_error"] > 5
    assert results["residual"]["total_rms_nm"]["error"] is None
    assert results["verdict"]["level"] == "unknown"


def test_a_loop_without_a_calibration_has_no_residual(tmp_path: Path) -> None:
    night = SyntheticLog().without(CALIBRATION)
    night._state = State()
    night.frames(300)
    results = results_of(night.write(tmp_path / "x.mcap"))
    assert (results["mode_steps"], results["run"]["simulated"]) == ({"idle": 300}, True)
    check = check_of(results, "residual")
    assert (check["level"], check["text"]) == ("unknown", "the loop was not closed in this log")
    assert check_of(results, "commands")["level"] == "unknown"
    night.start_controller()
    log = check_of(results_of(night.frames(10).write(tmp_path / "y.mcap")), "log")
    text = "300 messages with another number of modes than the calibration or with impossible values, left out"
    assert log["text"] == text


def test_a_calibration_of_other_modes_leaves_out_former_steps_only_if_it_is_the_last(tmp_path: Path) -> None:
    """Frames of steps that are left out still led to commands."""
    night = SyntheticLog().frames(100)
    two = encode_calibration(with_identity(calibration(NOLL[:2])), night.now_ns)
    night.put(CALIBRATION, two)  # refused: the controller publishes the calibration in use again
    night.put(CALIBRATION, encode_calibration(night.calibration, night.now_ns))
    night.frames(100)
    for steps in (200, 0):
        results = results_of(night.write(tmp_path / f"{steps}.mcap"))
        assert (results["run"]["steps"], results["log"]["steps_left_out"]) == (steps, 200 - steps)
        assert results["timing"]["frames"]["without_command"] == 0
        night.put(CALIBRATION, two)


def test_the_analysed_stretch_is_under_the_calibration_loaded_last(tmp_path: Path) -> None:
    night, other = SyntheticLog(), replace(TOY_CALIBRATION, reconstructor=0.9 * TOY_CALIBRATION.reconstructor)
    night.frames(500).request("open").frames(50).request("close")
    night.load(with_identity(other))
    why = results_of(night.write(tmp_path / "before.mcap"))["spectra"]["why_not"]
    assert why == "the loop was closed only under an earlier calibration than the last one of this log"
    night.frames(300)
    stretch = results_of(night.write(tmp_path / "x.mcap"))["closed_stretch"]
    assert stretch["from_s"] > 0.549
    assert stretch["frames"] + stretch["steps_settling"] == 300
    assert results_of(tmp_path / "x.mcap")["residual"]["steps_open"] == 0, "no open step under the last calibration"
    night.start_controller()  # with the first calibration; the first state that has a frame follows after 50 frames
    results = results_of(night.request("gain", (0.2,)).frames(300).write(tmp_path / "restarted.mcap"))
    assert results["requests"][-1]["time_s"] == pytest.approx(0.85)
    assert results["closed_stretch"]["frames"] + results["closed_stretch"]["steps_settling"] == 250


@pytest.mark.usefixtures("without_drawings")
def test_the_page_has_the_rounded_gain_of_each_mode_or_one_for_all(tmp_path: Path) -> None:
    night = SyntheticLog(gain=(1 / 0.9, 1 / 57.6)).frames(50).request("gain", (0.2,)).frames(50)
    text = page(report_of(read_run(night.write(tmp_path / "x.mcap"))))
    shown = re.findall(r'<td class="text">([\d., ]+(?: for all)?)</td>', text)[:4]
    assert shown == ["1.111, 1.111, 0.01736", "0 for all", "0.2 for all", "0 for all"]


def test_a_frame_ahead_or_an_earlier_camera_start_after_clear_shifts_no_law_and_no_request(tmp_path: Path) -> None:
    night = SyntheticLog()
    step = wire.ControlStep(frame_sequence=2 * report_log.START << 32, command_nm=[0] * 3, reasons=[wire.REASON_AHEAD])
    step.timestamp.seconds = report_log.START + 3600
    night.put(STEP, step)
    night.frames(50).request("gain", (0.2,)).frames(50).request("safe").request("clear")
    night._camera_start -= 60
    results = results_of(night.frames(10).request("gain", (0.1,)).frames(10).write(tmp_path / "x.mcap"))
    assert [one["from_s"] for one in results["laws"]] == pytest.approx([0, 0.05, 0.11])
    assert [one["time_s"] for one in results["requests"]] == pytest.approx([0.05, 0.099, 0.1, 0.11], abs=0.0011)
    assert (results["run"]["steps_s"], results["light"]["refused"]) == (pytest.approx(0.119), {"ahead": 1})


@pytest.mark.usefixtures("without_drawings")
def test_frames_refused_as_out_of_order_or_saturated_shift_no_times_and_do_not_count_as_used() -> None:
    run = read_run((GOLDEN,))  # the log has one of each; the frame out of order has the time 0
    report = report_of(run)
    assert np.diff(run.step_s).min() >= 0
    assert min(one["time_s"] for one in report.results["requests"] + report.results["events"]) > -1
    assert report.results["light"]["refused"]["saturated"] == 1
    assert "used frames with saturated pixels</th><td>0</td>" in page(report)


def test_the_start_of_a_law_is_found_if_its_step_is_lost_and_the_cameras_clock_differs(tmp_path: Path) -> None:
    night = SyntheticLog().frames(50).request("gain", (0.2,)).frames(50)
    del night.samples[night.indices(STEP)[49]]
    for number in range(len(night.indices(STEP))):
        night.change(STEP, number, lambda step: setattr(step.timestamp, "seconds", step.timestamp.seconds - 3600))
    results = results_of(night.write(tmp_path / "x.mcap"))
    assert (results["laws"][-1]["from_s"], results["requests"][-1]["time_s"]) == pytest.approx((0.05, 0.05))


def test_a_loop_closed_under_an_unknown_law_is_not_called_open(tmp_path: Path) -> None:
    night = SyntheticLog().frames(300).without(CONTROLLER_STATE)
    results = results_of(night.write(tmp_path / "x.mcap"))
    assert results["mode_steps"] == {"closed": 300}
    why = "the law with which the loop was closed is not in this log, or the integrator took over some of its modes"
    assert results["spectra"] == results["error_budget"] == {"why_not": why}
    assert check_of(results, "residual")["text"] == why


def test_a_closed_loop_without_a_good_frame_has_neither_spectra_nor_budget(tmp_path: Path) -> None:
    night = SyntheticLog().frames(200, dark=range(200))
    results = results_of(night.write(tmp_path / "x.mcap"))
    assert results["closed_stretch"]["frames"] == 0
    assert "has 0 frames" in results["spectra"]["why_not"]
    assert {term["missing"] for term in results["error_budget"]["terms"]} == {True}
    assert results["light"]["refused"] == {"dark": 200}
    assert check_of(results, "residual")["text"].endswith("; little is corrected")


@pytest.mark.parametrize(("frames", "shaped"), [((0, 400, 0), True), ((0, 200, 200), True), ((20, 20, 400), False)])
@pytest.mark.usefixtures("without_drawings")
def test_a_true_residual_with_an_offset_is_no_measure_of_the_loop(
    tmp_path: Path, frames: tuple[int, int, int], shaped: bool
) -> None:
    before, during, after = frames
    night = SyntheticLog().frames(before).request("offset", (20.0, 0.0, 0.0)).frames(during)
    night.request("offset", (0.0, 0.0, 0.0))
    if not shaped:
        night.request("gain", (0.2,))  # a new law, and so another stretch
    report = report_of(read_run(night.frames(after).write(tmp_path / "x.mcap")))
    results = report.results
    assert ("The true residual includes the shapes of offset or channels." in page(report)) is shaped
    check, after_nm = check_of(results, "residual"), results["residual"]["open_pupil"]["residual_open_pupil_rms_nm"]
    assert (check["level"], results["residual"]["shaped"], "(true)" in check["text"]) == ("good", shaped, not shaped)
    text = f"an offset or channels were in force, and their shapes are in the true residual of {after_nm:.3g} nm"
    assert (text in check["text"]) is shaped
    terms = {term["name"]: term for term in results["error_budget"]["terms"]}
    assert (terms["cross-talk and aliasing"]["missing"], terms["lag"]["missing"]) == (shaped, False)
    assert (results["error_budget"]["true_residual"]["rms_nm"]["all modes"] is None) is shaped


@pytest.mark.usefixtures("without_drawings")
def test_without_truth_a_report_mentions_no_offset_in_the_true_residual(tmp_path: Path) -> None:
    night = SyntheticLog(truth=False).request("offset", (20.0, 0.0, 0.0)).frames(400)
    report = report_of(read_run(night.write(tmp_path / "x.mcap")))
    assert not report.results["residual"]["shaped"]
    assert "shapes of offset or channels" not in page(report)


@pytest.mark.parametrize("logged", [True, False])
def test_theory_is_that_of_the_linear_law_in_use(tmp_path: Path, logged: bool) -> None:
    night = SyntheticLog().frames(300)
    night.law(0.05, logged=logged)
    night.frames(2000 if logged else 500)
    report = report_of(read_run(night.write(tmp_path / "x.mcap")))
    laws = [(one["law"], one["from_s"]) for one in report.results["laws"]]
    assert laws == [("integrator", 0.0), ("pi", pytest.approx(0.3))]
    stretch = report.results["closed_stretch"]
    assert stretch["law"] == ("pi" if logged else "integrator")
    assert stretch["to_s"] == pytest.approx(2.299 if logged else 0.299)
    if logged:
        assert (stretch["steps_settling"], stretch["frames"]) == (200, 1800)
        tilt_x = report.results["spectra"]["groups"][0]
        assert tilt_x["measured_over_theory"]["median"] == pytest.approx(1, abs=0.03)
        assert "linear law pi" in page(report)


def test_the_timing_of_a_live_log_is_that_of_the_mirrors_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(report_log, "DELAY_NS", 0)
    night = SyntheticLog()
    night.instants = 8
    stretch = closed_loop.longest_stretch(read_run(night.frames(300).write(tmp_path / "x.mcap")))
    assert stretch is not None
    # In periods of 1 ms; the mirror moves 0.2 ms after its command.
    assert stretch.timing == (1.0, pytest.approx(0.725, abs=0.026), 0.5, 1.0)


def test_the_stretch_of_a_law_ends_where_the_law_is_overruled(tmp_path: Path) -> None:
    night = SyntheticLog(guard=True, rate_hz=1000.0).frames(20)
    night.law(0.01)
    results = results_of(night.frames(700).write(tmp_path / "x.mcap"))
    stretch = results["closed_stretch"]
    assert (stretch["law"], stretch["to_s"], stretch["steps_limited"]) == ("pi", pytest.approx(0.617), 0)
    assert ("LAW_OVERRULED", pytest.approx(0.618, abs=1e-4)) in [
        (one["name"], one["time_s"]) for one in results["events"]
    ]


@pytest.mark.parametrize(("lost", "without", "at_the_end"), [(1, 0, 1), (50, 0, 50), (80, 30, 50)])
def test_the_last_frames_may_have_their_command_after_the_log(
    tmp_path: Path, lost: int, without: int, at_the_end: int
) -> None:
    night = SyntheticLog().frames(200, lost=range(200 - lost, 200))
    frames = results_of(night.write(tmp_path / "x.mcap"))["timing"]["frames"]
    assert (frames["without_command"], frames["at_the_end"]) == (without, at_the_end)


def test_the_command_prints_one_object_or_writes_one_page(tmp_path: Path) -> None:
    night = uneventful(SyntheticLog(), 3)
    night.put(REQUEST, wire.Request(name="gain", values=[np.nan, np.inf, 0.5]))
    log = night.write(tmp_path / "night.mcap")
    results = json_of("report", str(log))
    assert results["run"]["steps"] == 3
    assert results["requests"][-1]["values"] == [None, None, 0.5], "JSON has no NaN and no infinity"
    assert "has 3 frames" in results["spectra"]["why_not"]
    assert [term["missing"] for term in results["error_budget"]["terms"]] == [False, False, True, True, True]
    assert not log.with_name("night.html").exists()

    out = tmp_path / "page.html"
    written = lowfc("report", str(log), "--out", str(out))
    assert written.exit_code == 0, written.output
    heading, path = written.stdout.splitlines()
    assert (heading.split(":")[0], path) == ("No fault found, but not all checks are good", str(out))
    text = out.read_text()
    assert text.lstrip().startswith("<!DOCTYPE html>")
    assert "No spectra: the longest gap-free stretch has 3 frames" in text
    assert f'<td class="none">{NOT_IN_LOG}</td>' in text
    assert "gain nan inf" in text
    assert not re.search(r"""(src|href)=["'](?!#|data:)""", text)
    assert not re.search(r"url\((?!#)|@import|<script|<link|<iframe", text)
    identifiers = re.findall(r'\bid="([^"]+)"', text)
    assert len(identifiers) == len(set(identifiers))
    for target in re.findall(r'href="#([^"]+)"', text):
        assert target in identifiers


MARKUP = '<script>alert("x")</script>'


def test_text_of_a_log_is_escaped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    night = uneventful(SyntheticLog(), 30)
    for name in (f"1 {MARKUP}", r"2 $\foo{$", "3 $x^2$"):
        night.put(REQUEST, wire.Request(name=name, reply=f"4 {MARKUP}", accepted=False))
    night.put(EVENT, Log(name=f"5 {MARKUP}", message=f"6{MARKUP} 7 {MARKUP}", level=3))
    night.health("camera", realtime_refused=[f"8 {MARKUP}"])
    about = {name: f"{name} {MARKUP}" for name in (f"9 {MARKUP}", "host", "kernel", "processor", "git", "lowfc")}
    recording = {"messages_lost": MARKUP, f"lost {MARKUP}": MARKUP}
    monkeypatch.setattr(report_log, "METADATA", {"lowfc": about, "recording": recording})
    monkeypatch.setattr(drawings, "_DRAWINGS", {"timeline": drawings._DRAWINGS["timeline"]})
    text = page(report_of(read_run(night.write(tmp_path / "x.mcap", finish=False))))
    assert "<script" not in text
    for digit in "123456789":
        assert re.search(rf"{digit}( ?&lt;script&gt;| \$)", text), digit
    for name in ("host", "kernel", "processor", "lowfc"):
        assert f"{name} &lt;script&gt;" in text
    assert text.count("3 $x^2$") == 2, "the name is in the drawing and in the table"


@pytest.mark.usefixtures("without_drawings")
def test_a_page_says_how_many_events_it_leaves_out(tmp_path: Path) -> None:
    night = SyntheticLog()
    for number in range(2100):
        night.put(EVENT, Log(name="camera", message=f"E{number} x", level=3 if number < 300 else 2))
    report = report_of(read_run(night.write(tmp_path / "x.mcap")))
    left_out = ["100", str(len(report.results["events"]) - 2000)]
    assert re.findall(r"<p>(\d+) more are in the log", page(report)) == left_out


def test_the_timeline_has_requests_of_the_whole_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    night = uneventful(SyntheticLog(), 3)
    for number in range(601):
        night.put(REQUEST, wire.Request(name="gain", values=[number], accepted=True))
    monkeypatch.setattr(drawings, "_DRAWINGS", {"timeline": drawings._DRAWINGS["timeline"]})
    drawn = drawings.drawings(report_of(read_run(night.write(tmp_path / "x.mcap"))))["timeline"]
    shown = [int(number) for number in re.findall(r">\s*gain (\d+)<", drawn)]
    assert shown == list(range(0, 601, 3))


@pytest.mark.parametrize("module", ["jinja2", "matplotlib.figure"])
def test_missing_packages_are_reported_before_the_log_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, module: str
) -> None:
    log = uneventful(SyntheticLog(), 3).write(tmp_path / "x.mcap")
    monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr("lowfc.programs.logs.report.source.read_run", lambda *_: pytest.fail("the log was read"))
    assert re.search(r"-m pip install .*'jinja2", refusal("report", log, kind=ConfigurationError))
    monkeypatch.undo()
    monkeypatch.setitem(sys.modules, module, None)
    assert json_of("report", log)["log"]["file"] == "x.mcap", "--json needs neither package"


@pytest.mark.parametrize("name", ["night.mcap", "other.mcap.part", "link.html", "other.fits"])
def test_a_report_overwrites_no_log_and_must_have_the_suffix_of_a_page(tmp_path: Path, name: str) -> None:
    log = uneventful(SyntheticLog(), 3).write(tmp_path / "night.mcap")
    before = log.read_bytes()
    (tmp_path / "link.html").hardlink_to(log)
    assert refusal("report", log, "--out", tmp_path / name, kind=DataFileError)
    assert log.read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"night.mcap", "link.html"}
