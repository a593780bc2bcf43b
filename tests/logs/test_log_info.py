"""`lowfc info` reports what was written into a log."""

from pathlib import Path

import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.recovery import missing_end_text, recover, recovered_path
from lowfc.adapters.logs.writer import Attachment, LogWriter, being_recorded
from lowfc.contract.envelope import sequence_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.events import EVENTS
from lowfc.contract.messages import CALIBRATION, CONTROLLER_STATE, EVENT, FRAME, HEALTH, STEP, Message, wire
from lowfc.programs.logs import info, survey
from tests.support.loops import json_of, lowfc
from tests.support.mutated_logs import START_NS, START_S, flipped
from tests.support.report_log import SyntheticLog

SECOND_NS = 10**9


def sample(key: str, message: Message, count: int, time_ns: int, start_s: int = START_S) -> Sample:
    return Sample(key, message.SerializeToString(), sequence_of(start_s, count), time_ns, time_ns)


def event(name: str, process: str, start_s: int, number: int, **details: object) -> Sample:
    now_ns = START_NS + 2 * SECOND_NS
    return sample(EVENT.key, EVENTS[name].log(process, now_ns, **details), number, now_ns, start_s)


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """Ten seconds: the camera restarts; frames 5 to 7 of each start and the last step are lost; two send events."""
    writer = LogWriter(
        tmp_path / "night.mcap",
        START_NS,
        {"lowfc": {"lowfc": "0.1.0", "host": "bench", "run": "night", "seed": "3"}},
        [Attachment("config.toml", "application/toml", b"[loop]\n")],
    )
    # The calibration was loaded an hour before: its time does not extend the log.
    writer.write(sample(CALIBRATION.key, wire.Calibration(id="c1"), 0, START_NS - 3600 * SECOND_NS))
    frames = [n for n in range(50) if n not in (5, 6, 7)]
    for number in range(101):
        now_ns = START_NS + number * SECOND_NS // 10
        restarted = number > 50
        count = number - 51 if restarted else number
        if count in frames:  # a message of one kilobyte in place of an image
            writer.write(sample(FRAME.key, wire.Health(process="x" * 1000), count, now_ns, START_S + 5 * restarted))
        if number < 100:
            writer.write(sample(STEP.key, wire.ControlStep(), number, now_ns))
    for count, mode in enumerate((wire.LOOP_MODE_OPEN, wire.LOOP_MODE_CLOSED, wire.LOOP_MODE_CLOSED)):
        state = wire.ControllerState(mode=mode)
        writer.write(sample(CONTROLLER_STATE.key, state, count, START_NS + (count + 1) * SECOND_NS))
    writer.write(event("CAMERA_RESTARTED", "controller", START_S + 1, 0))
    writer.write(event("CAMERA_RESTARTED", "controller", START_S + 1, 1))
    writer.write(event("RECORDING", "recorder", START_S, 0))
    writer.write(event("MESSAGES_LOST", "recorder", START_S, 1, count=3, topic="lowfc/camera/frame"))
    last = wire.Health(process="controller", state="stopped", topics=[wire.TopicCount(topic=STEP.key, published=101)])
    writer.write(sample(HEALTH.at("controller"), last, 0, START_NS + 10 * SECOND_NS))
    return writer.finish({"recording": {"messages": str(writer.messages), "messages_lost": "4"}})


def test_info_reports_what_was_written(log: Path) -> None:
    found = json_of("info", log)
    frame = found["topics"].pop(FRAME.key)
    assert not any(line["restarts"] for line in found["topics"].values()), "only the camera restarted"
    rates = {key: line["rate_hz"] for key, line in found["topics"].items() if key != HEALTH.at("controller")}
    assert {key: line["messages"] for key, line in found.pop("topics").items()} == {
        CALIBRATION.key: 1,
        CONTROLLER_STATE.key: 3,
        STEP.key: 100,
        EVENT.key: 4,
        HEALTH.at("controller"): 1,
    }
    assert rates == {CALIBRATION.key: None, CONTROLLER_STATE.key: None, STEP.key: 10.0, EVENT.key: None}
    assert frame.pop("bytes") > 94_000
    assert frame == {
        "messages": 94,
        "rate_hz": round(93 / 10.0, 3),
        "restarts": 1,
        "missing": 6,
        "schema": "foxglove.RawImage",
    }
    assert found == {
        "log": str(log),
        "files": [str(log)],
        "lockstep": False,
        "selection": "",
        "bytes": log.stat().st_size,
        "state": "complete",
        "start": "2026-01-01T00:00:00.000+00:00",
        "duration_s": 10.0,
        "messages": 203,
        "messages_missing": 7,
        "missing_topics": {},
        "loop_modes": ["open", "closed"],
        "events": {"CAMERA_RESTARTED": 2, "MESSAGES_LOST": 1},
        "unreadable": 0,
        "damage": [],
        "metadata": {
            "lowfc": {"lowfc": "0.1.0", "host": "bench", "run": "night", "seed": "3"},
            "recording": {"messages": "203", "messages_lost": "4"},
        },
        "attachments": {"config.toml": 7},
        "remarks": [f"{log}: its config.toml: unknown key 'loop'; it is ignored"],
    }


def test_the_text_says_whether_the_run_was_in_lockstep_if_that_is_known(log: Path) -> None:
    contents = survey.survey(log, digest=True)
    texts = [info.render(contents | {"lockstep": lockstep}) for lockstep in (True, None, False)]
    assert ["(not a lockstep run" in text for text in texts] == [False, False, True]
    assert ["simulated time" in text for text in texts] == [True, False, False]
    longer = SyntheticLog().frames(20).write(log.parent / "longer.mcap")
    assert survey.survey(longer, digest=True)["digest"] != contents["digest"]


def test_the_text_of_info_has_the_numbers_of_its_json(log: Path) -> None:
    text = lowfc("info", log).stdout
    for expected in (
        "complete",
        "2026-01-01T00:00:00.000+00:00, 10.000 s",
        "203; 7 missing by their sequence numbers, 4 counted as lost by the recorder",
        "open, closed",
        "CAMERA_RESTARTED 2, MESSAGES_LOST 1",
        "config.toml (7 bytes)",
        "lowfc 0.1.0, host bench, run night, seed 3",
    ):
        assert expected in text
    line = next(line.split() for line in text.splitlines() if line.startswith(FRAME.key))
    assert line[1:] == ["94", "9.3", "0.09", "1", "6", "foxglove.RawImage"]


def test_truncated_and_damaged_logs_are_reported(log: Path) -> None:
    data = log.read_bytes()
    log.write_bytes(data[:-500])
    recovered = log.with_name("recovered.mcap")
    recover(log, recovered)
    text = lowfc("info", recovered).stdout
    assert "recovered from night.mcap, which was incomplete; left out: damaged parts 0" in text
    done = lowfc("info", log)
    assert done.exit_code == 0
    assert "truncated" in done.stdout
    assert json_of("info", log)["state"] == "truncated"
    log.write_bytes(data)
    flipped(log, data.index(b"[loop]"))
    done = lowfc("info", log)
    assert done.exit_code == 0
    assert "damaged; `lowfc recover` saves the intact messages" in done.stdout
    assert "the checksum of an attachment is wrong" in done.stdout
    found = json_of("info", log)
    assert (found["state"], len(found["damage"]), found["attachments"]) == ("damaged", 1, {})


def test_a_log_that_is_being_recorded_is_reported_and_not_recovered(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "20270101T000000Z.mcap", START_NS, {"lowfc": {"run": "night"}})
    done = lowfc("info", log.part)
    assert "being recorded; `lowfc ctl record stop` finishes it" in done.stdout
    assert json_of("info", log.part)["state"] == "recording"
    assert "it is being recorded" in missing_end_text([log.part], finished=False)
    with pytest.raises(DataFileError, match="is being recorded, and nothing is lost: `lowfc ctl record stop`"):
        recover(log.part, recovered_path(log.part))
    assert list(tmp_path.iterdir()) == [log.part]
    log.abandon()  # as if killed
    assert json_of("info", log.part)["state"] == "truncated"
    assert "it was cut off" in missing_end_text([log.part], finished=False)
    assert recover(log.part, recovered_path(log.part)).recovered == recovered_path(log.part)


def test_a_log_that_is_finished_while_it_is_read_is_not_called_truncated(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "20270101T000000Z.mcap", START_NS, {"lowfc": {"run": "night"}})
    log.finish({})
    assert "it was finished while it was read" in missing_end_text([log.part], finished=False)
    assert being_recorded(log.part), "it was being recorded when the summary was read"


def test_an_empty_log_is_summarised(tmp_path: Path) -> None:
    path = LogWriter(tmp_path / "a.mcap", START_NS, {}).finish({"recording": {"stopped": "the disk is full"}})
    assert "recording stopped: the disk is full" in lowfc("info", path).stdout
    found = json_of("info", path)
    assert (found["start"], found["duration_s"], found["messages"], found["state"]) == (None, None, 0, "complete")
