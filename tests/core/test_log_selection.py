"""Recordings and copies of logs with every Nth frame and mirror state: contents, and which commands accept them."""

from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.history import read_history
from lowfc.adapters.logs.parts import WholeLog
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.selection import EVERYTHING, Selection, selection
from lowfc.adapters.logs.thinning import thin
from lowfc.contract.configuration import load
from lowfc.contract.envelope import count_of
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.messages import (
    COMMAND,
    FRAME,
    MIRROR_STATE,
    STEP,
    SURFACE,
    TIMING,
    TOPICS,
    TRUTH,
    Topic,
    topic_of,
    wire,
)
from lowfc.programs.core.recording.volume import bytes_per_s, configured_selection, estimate
from lowfc.programs.logs.survey import survey
from lowfc.programs.logs.what_if.compare import what_if
from lowfc.programs.logs.what_if.options import WhatIf, requested_changes
from lowfc.programs.logs.what_if.run import LoggedRun
from tests.support.loops import json_of, refusal
from tests.support.recording import Bench, bodies_of, logged, put
from tests.support.report_log import SyntheticLog

pytestmark = pytest.mark.usefixtures("own_runtime")

EVERY, FRAMES = 10, 1200


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with all frames and mirror states."""
    night = SyntheticLog().request("close").frames(FRAMES)
    night.health("camera", topics=[wire.TopicCount(topic=FRAME.key, published=FRAMES)], state="stopped")
    return night.write(tmp_path_factory.mktemp("night") / "night.mcap")


@pytest.fixture(scope="module")
def small(whole: Path) -> Path:
    """A copy of the log `whole` with every tenth frame and mirror state."""
    out = whole.with_name("small.mcap")
    done = thin((whole,), out, Selection(EVERY))
    assert done["bytes"] < 0.8 * done["bytes_before"]
    return out


def messages_on(messages: list[Sample], topic: Topic) -> list[Sample]:
    return [message for message in messages if topic.matches(message.key)]


def test_steps_and_commands_are_never_left_out() -> None:
    chosen = selection(1, ["lowfc/sim/*"])
    assert chosen.excluded == {FRAME, MIRROR_STATE, SURFACE, TIMING}
    assert {topic.key for topic in TOPICS if topic.optional} == {topic.key for topic in (*chosen.excluded, TRUTH)}
    assert selection() == EVERYTHING == selection(1, ["lowfc/*"])
    assert selection(1, ["/lowfc/mirror/dm/state"]).excluded == {FRAME, SURFACE, TIMING, TRUTH}
    for pattern in ("lowfc/mirror/dm/*", "lowfc/mirror/*", "*/mirror/*/*"):
        assert selection(1, [pattern]).excluded == {FRAME, TIMING, TRUTH}
    assert Selection.of(chosen.metadata) == chosen
    assert Selection.of({"selection": {"every": "-3", "left_out": "nothing"}}) == EVERYTHING
    with pytest.raises(ConfigurationError, match="did you mean 'lowfc/camera/frame'"):
        selection(1, ["lowfc/camera/frames"])


def test_every_tenth_frame_is_recorded_and_the_others_do_not_count_as_lost(bench: Bench) -> None:
    """Mirror states are selected by the number of their frame. A frame not received counts as lost, selected or not."""
    frames, commands = bench.camera.publisher(FRAME), bench.controller.publisher(COMMAND, "dm")
    mirror = bench.service("mirror-dm")
    states, surfaces = mirror.publisher(MIRROR_STATE, "dm"), mirror.publisher(SURFACE, "dm")
    bench.hub.lose = lambda role, key, envelope: (
        role == "recorder" and key == FRAME.key and count_of(envelope.sequence) in (55, 60)
    )
    bench.start(selection=Selection(EVERY, frozenset({SURFACE})))
    put(surfaces, 5)
    put(commands, 95)
    for _ in range(95):
        sequence = frames.put(b"frame").sequence
        states.put(wire.MirrorState(frame_sequence=sequence).SerializeToString())
        states.put(wire.MirrorState(frame_sequence=sequence).SerializeToString())  # the mirror repeats its state
    mirror.finish()
    summary = bench.stop()
    messages = logged(summary)
    assert [count_of(sample.sequence) for sample in messages_on(messages, FRAME)] == [0, 10, 20, 30, 40, 50, 70, 80, 90]
    state_numbers = [
        count_of(wire.MirrorState.FromString(sample.payload).frame_sequence)
        for sample in messages_on(messages, MIRROR_STATE)
    ]
    assert state_numbers == [number for number in range(0, 100, 10) for _ in range(2)]
    assert len(messages_on(messages, COMMAND)) == 95
    assert not messages_on(messages, SURFACE)
    assert summary.lost == {FRAME.key: 2}
    (path,) = summary.files
    info = survey(path)
    assert info["selection"] == "1 in 10 frames and mirror states, without lowfc/mirror/{name}/surface"
    assert (info["messages_missing"], info["missing_topics"]) == (0, {})
    assert info["topics"][FRAME.key]["missing"] is None
    assert info["metadata"]["recording"]["messages_lost"] == "2"
    assert info["metadata"]["selection"] == {"every": "10", "left_out": "lowfc/mirror/{name}/surface"}


def test_a_smaller_copy_has_the_same_steps(whole: Path, small: Path) -> None:
    before, after = list(LogReader(whole)), list(LogReader(small))
    assert bodies_of(after, STEP) == bodies_of(before, STEP)
    assert len(messages_on(after, COMMAND)) == len(messages_on(before, COMMAND))
    all_frames, frames = ([sample.sequence for sample in messages_on(log, FRAME)] for log in (before, after))
    assert frames == all_frames[::EVERY]
    states = messages_on(after, MIRROR_STATE)
    assert {wire.MirrorState.FromString(sample.payload).frame_sequence for sample in states} == set(frames)
    info = survey(small)
    assert (info["messages_missing"], info["state"], "recovery" in info["metadata"]) == (0, "complete", False)
    again = thin((small,), small.with_name("again.mcap"), selection(4, ["lowfc/camera/*"]))
    expected = Selection(20, frozenset({MIRROR_STATE, SURFACE, TIMING, TRUTH}))
    assert again["selection"] == expected.description
    path = Path(again["file"])
    assert Selection.of(survey(path)["metadata"]) == expected
    assert len(messages_on(list(LogReader(path)), FRAME)) == FRAMES // 20
    with pytest.raises(DataFileError, match="already exists"):
        thin((whole,), small, Selection(2))


def test_a_smaller_copy_has_all_messages_of_an_unknown_topic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    night, newer = SyntheticLog(), "lowfc/newer/state"
    for _ in range(3):
        night.frames(10)
        night.samples.append(night.samples[-1]._replace(key=newer, payload=b"newer"))
    with monkeypatch.context() as patch:
        patch.setattr("lowfc.adapters.logs.writer.topic_of", lambda key: STEP if key == newer else topic_of(key))
        log = night.write(tmp_path / "night.mcap")
    done = thin((log,), tmp_path / "small.mcap", Selection(EVERY))
    messages = list(LogReader(Path(done["file"])))
    assert [message.payload for message in messages if message.key == newer] == [b"newer"] * 3
    assert len(messages_on(messages, FRAME)) == 3


def test_replay_refuses_a_log_without_all_frames_by_an_error_of_one_line(small: Path) -> None:
    for options in (["--jobs", "1"], ["--jobs", "2"]):
        error = refusal("replay", small, *options)
        assert "\n" not in error
        assert "1 in 10 frames and mirror states" in error


def test_replay_needs_frames_but_no_other_optional_topic(whole: Path) -> None:
    out = whole.with_name("frames.mcap")
    thin((whole,), out, selection(1, [FRAME.key]))
    assert json_of("replay", out)["frames"] == FRAMES


def test_what_if_gives_the_same_result_from_a_smaller_copy(whole: Path, small: Path) -> None:
    changes = requested_changes("gain=0.3", None, None, None)
    both_results = [what_if(LoggedRun(read_history(LogReader(log))), changes) for log in (whole, small)]
    for results in both_results:
        del results["log"]
    assert both_results[0] == both_results[1]
    other = {"pinv": "weighted", "weighted": "pinv"}[read_history(WholeLog(small)).calibration.estimator]
    with pytest.raises(DataFileError, match=r"reconstructor cannot be tried.*other gains, leaks and limits can"):
        what_if(LoggedRun(read_history(LogReader(small))), WhatIf(estimator=other))


@pytest.mark.usefixtures("without_drawings")
def test_a_report_of_a_smaller_copy_has_the_same_results(whole: Path, small: Path) -> None:
    reports = [json_of("report", whole), json_of("report", small, "--out", small.with_suffix(".html"))]
    for part in ("residual", "spectra", "error_budget", "closed_stretch", "light", "laws", "requests"):
        assert reports[0][part] == reports[1][part], part
    levels = [{check["name"]: check["level"] for check in report["verdict"]["checks"]} for report in reports]
    assert levels[0] == levels[1]
    assert reports[1]["timing"]["interval_us"]["frames"]["count"] == 0
    assert reports[1]["timing"]["latency_us"]["frame_to_mirror"]["count"] == FRAMES // EVERY
    assert "1 in 10 frames and mirror states" in small.with_suffix(".html").read_text()


def test_an_export_contains_the_frames_of_a_smaller_copy(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "small.npz"
    results = json_of("export", small, "--to", "npz", "--frames", "--out", out)
    assert results["selection"] == "1 in 10 frames and mirror states"
    with np.load(out) as file:
        arrays = dict(file)
    assert (len(arrays["sequence"]), len(arrays["frame_sequence"])) == (FRAMES, FRAMES // EVERY)
    assert np.count_nonzero(np.isfinite(arrays["mirror_stroke_nm"])) == FRAMES // EVERY
    assert len(np.load(out.with_suffix(".frames.npy"))) == FRAMES // EVERY


@pytest.mark.parametrize(
    ("options", "remedy"),
    [(["--to", "csv", "--decimate", "3"], "leave these out"), (["--topics", FRAME.key], "add --decimate")],
)
def test_contradictory_export_options_are_refused(whole: Path, options: list[str], remedy: str) -> None:
    assert remedy in refusal("export", whole, *options, kind=ConfigurationError)


def test_the_estimate_of_disk_space_follows_rate_and_selection(tmp_path: Path) -> None:
    keys = {"recorder.folder": str(tmp_path), "camera.rate_hz": 250.0}
    config = load(None, keys)
    log_bytes_per_s = bytes_per_s(config, configured_selection(config))
    assert 3e6 < log_bytes_per_s < 5e6
    gb_per_hour = log_bytes_per_s * 3600 / 1e9
    expected = f"about {gb_per_hour:.0f} GB an hour at 250 Hz and 80 x 80 pixels (size of the simulated camera); "
    assert estimate(config).startswith(f"recording into {tmp_path}: {expected}")
    assert estimate(load(None, {"recorder.folder": ""})).startswith("recording into .: ")
    camera = wire.CameraState(rows=160, columns=120)
    assert " GB an hour at 250 Hz and 160 x 120 pixels; " in estimate(config, camera)
    added_bytes_per_s = bytes_per_s(config, configured_selection(config), camera) - log_bytes_per_s
    assert added_bytes_per_s == pytest.approx((160 * 120 - 80 * 80) * 2 * 0.6 * 250)  # compressed to 60 %
    assert estimate(config, wire.CameraState()) == estimate(config)
    lockstep = config.model_copy(update={"lockstep": True})
    assert " GB an hour at 250 Hz in simulated time and 80 x 80 pixels" in estimate(lockstep)
    assert " 40 x 40 pixels (size of the simulated camera); " in estimate(load(None, keys | {"sensor.kind": "zwfs"}))
    fields = *wire.ControlStep.DESCRIPTOR.fields, *wire.Truth.DESCRIPTOR.fields
    modal_fields = sum(field.is_repeated and field.name.endswith("_nm") for field in fields)
    added_bytes_per_s = bytes_per_s(load(None, keys | {"sensor.modes": 35}), EVERYTHING) - log_bytes_per_s
    assert added_bytes_per_s == pytest.approx(modal_fields * (35 - 14) * 4 * 250)
    assert bytes_per_s(load(None, keys | {"camera.rate_hz": 500.0}), EVERYTHING) > 1.8 * log_bytes_per_s
    fewer = load(None, keys | {"recorder.every": 10, "recorder.topics": [FRAME.key, "lowfc/mirror/{name}/state"]})
    assert bytes_per_s(fewer, configured_selection(fewer)) < 0.5 * log_bytes_per_s
    assert "1 in 10 frames" in estimate(fewer)


def test_the_error_of_lowfc_record_start_names_the_ctl_command() -> None:
    assert "`lowfc ctl record start`" in refusal("record", "start", kind=ConfigurationError)
