"""`last`, and several files of one recording as one log, in commands that read logs."""

import os
import shutil
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.files import calibration_file
from lowfc.adapters.logs.parts import LAST, WholeLog, named_files, named_log, named_logs
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.recovery import recover
from lowfc.adapters.logs.series import STANDARD, LogSeries, shortage
from lowfc.adapters.logs.writer import Attachment, LogWriter
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.configuration import Configuration
from lowfc.contract.envelope import sequence_of
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.messages import BENCH, CALIBRATION, CONTROLLER_STATE, FRAME, topic_of, wire
from lowfc.programs.logs.report.results import report_of
from lowfc.programs.logs.report.source import read_run
from tests.support.loops import json_of, lowfc, refusal
from tests.support.mutated_logs import flipped
from tests.support.report_log import METADATA, SyntheticLog
from tests.support.toy import START

FRAMES = 2200
TOML = [Attachment("config.toml", "application/toml", Configuration().to_toml().encode())]


def recorded(folder: Path, samples: Sequence[Sample], files: int, *, finish: bool = True) -> list[Path]:
    """Files of one recording, each with the newest calibration and states at its beginning."""
    series = LogSeries(folder, HostClock(), METADATA, TOML, STANDARD)
    states: dict[str, Sample] = {}
    for number in range(files):
        series.begin(states.values(), new_recording=not number)
        for sample in samples[len(samples) * number // files : len(samples) * (number + 1) // files]:
            series.write(sample)
            if topic_of(sample.key).queryable:
                states[sample.key] = sample
        if finish or number < files - 1:
            series.end({"messages": str(len(samples)), "messages_lost": "0"})
    if not finish:
        series.flush()
        series.give_up()
    return series.files


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    return SyntheticLog().request("close").frames(FRAMES, lost=[100, 101]).samples


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return Path("logs")


def test_last_is_the_newest_log_with_all_its_files(folder: Path, samples: list[Sample]) -> None:
    (older,) = recorded(folder, samples[:20], 1)
    newer = recorded(folder, samples[:60], 11)  # `-2` to `-12`: not in alphabetical order
    assert [older, *newer] != sorted([older, *newer])
    Path(folder, "notes.txt").touch()
    Path(folder, "zzz.mcap").touch()
    assert named_files([Path(LAST)]) == newer
    assert named_log([folder / LAST]) == tuple(newer)
    assert named_files([*reversed(newer)]) == newer
    assert named_logs([newer[1], older, newer[0]]) == [(newer[0], newer[1]), (older,)]
    with pytest.raises(ConfigurationError, match="one log"):
        named_log([older, *newer])
    with pytest.raises(ConfigurationError, match="same part"):
        named_files([older, older])
    Path(LAST).symlink_to(older)
    assert named_files([Path(LAST)]) == [Path(LAST)]


def test_last_without_a_log_is_an_error(folder: Path) -> None:
    with pytest.raises(DataFileError, match=r"newest log in logs, which cannot be read: No such file.*FOLDER/last"):
        named_files([Path(LAST)])
    folder.mkdir()
    with pytest.raises(DataFileError, match="there is none"):
        named_files([Path(LAST)])


def test_a_log_of_a_killed_recorder_is_the_last_until_it_is_recovered(folder: Path, samples: list[Sample]) -> None:
    files = recorded(folder, samples[:300], 2, finish=False)
    assert files[1].name.endswith(".mcap.part")
    assert named_files([Path(LAST)]) == files
    saved = folder / files[1].name.replace(".mcap.part", "-recovered.mcap")
    recover(files[1], saved)
    assert named_files([Path(LAST)]) == [files[0], saved]


def test_logs_that_do_not_name_their_recording_are_separate(folder: Path) -> None:
    """Logs of version 0.1 do not name their recording."""
    logs = [LogWriter(folder / f"20260101T00000{n}Z.mcap", 0, METADATA).finish({}) for n in range(3)]
    assert named_logs(logs) == [(log,) for log in logs]
    assert named_files([Path(LAST)]) == logs[-1:]


def test_the_files_of_a_log_are_read_as_one(folder: Path, samples: list[Sample]) -> None:
    samples = samples[: len(samples) // 4]
    files = recorded(folder, samples, 4)
    assert sum(len(list(LogReader(path))) for path in files) > len(samples)
    assert next(iter(LogReader(files[3]))).key in (CALIBRATION.key, CONTROLLER_STATE.key, "lowfc/camera/state")
    log = WholeLog(files)
    read = list(log)
    assert [(one.key, one.sequence) for one in read] == [(one.key, one.sequence) for one in samples]
    assert log.complete
    assert (log.size, log.position) == (sum(path.stat().st_size for path in files),) * 2
    assert log.metadata["recording"]["messages"] == str(len(samples))
    os.truncate(files[3], files[3].stat().st_size - 50)
    log = WholeLog(files, topics=[FRAME])
    assert len(list(log)) == sum(FRAME.matches(one.key) for one in samples)
    assert not log.complete


def test_bench_values_of_every_publisher_are_read_from_every_file(folder: Path) -> None:
    night = SyntheticLog()
    for count in range(4):
        for start in (START, START + 60):
            night.put(BENCH, wire.BenchValue(number=count), sequence_of(start, count), name="mask")
    read = [one for one in WholeLog(recorded(folder, night.samples, 2)) if BENCH.matches(one.key)]
    assert [one.sequence for one in read] == [one.sequence for one in night.samples if BENCH.matches(one.key)]


COMMANDS = [
    ["info", "--digest"],
    ["report"],
    ["replay", "--jobs", "1"],
    ["what-if", "--calibration", "other.fits"],
    ["tune", "--controller", "lqg"],
    ["export", "--to", "npz", "--frames", "--force"],
    ["export", "--decimate", "7"],
    ["latency"],
]
KEYS_OF_FILES = {
    *("log", "logs", "file", "files", "bytes", "bytes_before", "metadata", "attachments", "speed", "runs", "source"),
    *("remarks", "settings", "warnings"),
}


def without_files(results: Any) -> Any:
    """Results without the keys whose values depend on the files or on the time taken."""
    if isinstance(results, dict):
        return {key: without_files(value) for key, value in results.items() if key not in KEYS_OF_FILES}
    return results


@pytest.fixture(scope="module")
def ten_files_and_one(tmp_path_factory: pytest.TempPathFactory, samples: list[Sample]) -> Callable[[bool], Path]:
    """Function that returns a folder with the same log in ten files and in one file.

    Its argument: whether the log has all samples; otherwise it has the first quarter of them.
    """

    @cache
    def recorded_folder(all_samples: bool) -> Path:
        folder = tmp_path_factory.mktemp("recorded")
        chosen = samples if all_samples else samples[: len(samples) // 4]
        calibration_file.save(SyntheticLog().calibration, folder / "other.fits")
        recorded(folder / "logs", samples[:9], 1)  # an older log
        recorded(folder / "logs", chosen, 10)
        recorded(folder / "one", chosen, 1)
        return folder

    return recorded_folder


@pytest.mark.parametrize("arguments", COMMANDS, ids=" ".join)
def test_a_command_gives_the_same_results_for_ten_files_as_for_one(
    ten_files_and_one: Callable[[bool], Path], monkeypatch: pytest.MonkeyPatch, arguments: list[str]
) -> None:
    monkeypatch.chdir(ten_files_and_one(arguments[0] == "tune"))  # tuning needs some two thousand frames
    ten, one = (without_files(json_of(arguments[0], log, *arguments[1:])) for log in (LAST, f"one/{LAST}"))
    assert ten == one


def test_a_report_says_that_a_file_between_two_others_is_missing(folder: Path, samples: list[Sample]) -> None:
    files = recorded(folder, samples[: len(samples) // 4], 4)
    missing = "1 file missing between the first and the last"
    for named, text in ((files[2:], "complete, no message lost"), (files[::2], missing)):
        report = report_of(read_run(named)).results
        assert report["verdict"]["checks"][0]["text"] == text
        assert report["log"]["complete"] == (named == files[2:])
    damaged = report_of(read_run((files[0], flipped(files[2], -100)))).results
    assert damaged["verdict"]["checks"][0]["text"] == f"1 damaged part left out; {missing}"


def test_acceptance_reads_several_files(folder: Path, samples: list[Sample]) -> None:
    """The log contains no acceptance test; the error is about the whole log and not about one of its files."""
    files = recorded(folder, samples[:1500], 3)
    for arguments in ([LAST], [str(path) for path in files]):
        assert "contains no `lowfc acceptance rejection`" in refusal("acceptance", "rejection", *arguments)


ONE_BY_ONE = [["info"], ["report"], ["export", "--to", "csv", "--force"], ["recover"]]


@pytest.mark.usefixtures("without_drawings")
@pytest.mark.parametrize("arguments", ONE_BY_ONE, ids=lambda arguments: arguments[0])
def test_several_logs_are_processed_one_by_one(folder: Path, arguments: list[str]) -> None:
    night = SyntheticLog().frames(3)
    first, second = (str(night.write(Path(f"{name}.mcap"))) for name in "ab")
    several = lowfc(*arguments, first, second)
    alone = [lowfc(*arguments, log).stdout for log in (first, second)]
    assert several.exit_code == 0, several.exception
    assert several.stdout.replace("\n", "") == "".join(alone).replace("\n", "")
    for more in [["--json"], *([["--out", "c"]] if arguments != ["info"] else [])]:
        assert f"name one log, not 2 ({Path(first).name}, {Path(second).name})" in refusal(
            *arguments, first, second, *more, kind=ConfigurationError
        )


@pytest.mark.parametrize(
    "arguments", [*ONE_BY_ONE, ["replay"], ["what-if", "--set", "gain=1"]], ids=lambda arguments: arguments[0]
)
def test_a_file_that_is_not_a_log_is_an_error(tmp_path: Path, arguments: list[str]) -> None:
    (tmp_path / "text").write_text("this is not an MCAP file, by far")
    for name, expected in (("text", "is not an MCAP file"), ("gone", "cannot be read: No such file")):
        done = lowfc(*arguments, tmp_path / name)
        assert isinstance(done.exception, DataFileError)
        assert expected in str(done.exception)
        assert done.stdout == ""
    assert [path.name for path in tmp_path.iterdir()] == ["text"]


def test_a_folder_that_is_removed_during_the_check_of_its_space_counts_as_absent(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, usage = tmp_path / "logs", shutil.disk_usage
    folder.mkdir()

    def removing(path: Path) -> object:
        if path == folder:
            folder.rmdir()
        return usage(path)

    monkeypatch.setattr(shutil, "disk_usage", removing)
    assert shortage(folder, 0) == ""
    assert not folder.exists()
