"""Permissions of a log: its owner may read it, and others as `recorder.file_mode` allows."""

import errno
import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lowfc.adapters.files.whole_file import require_folder, write_whole
from lowfc.adapters.logs.recovery import recover
from lowfc.adapters.logs.series import LogLimits, LogSeries
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.configuration import load
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.programs.core.recording.process import log_limits
from tests.support.loops import refusal
from tests.support.mutated_logs import small_log


@pytest.fixture(params=[0o000, 0o022, 0o077])
def umask(request: pytest.FixtureRequest) -> Iterator[int]:
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def mode_of(path: Path) -> int:
    return path.stat().st_mode & 0o777


@pytest.mark.parametrize("mode", [None, 0o600, 0o664])
def test_every_log_of_a_series_has_the_configured_mode(tmp_path: Path, umask: int, mode: int | None) -> None:
    limits = LogLimits() if mode is None else LogLimits(file_mode=mode)
    series = LogSeries(tmp_path / "logs", HostClock(), {}, [], limits)
    for _ in range(2):
        series.begin([])
        (part,) = series.files[0].parent.glob("*.part")
        assert mode_of(part) == (mode or 0o640) & ~umask, "0640 by default"
        series.end({})
    assert [mode_of(path) for path in series.files] == [(mode or 0o640) & ~umask] * 2


def test_a_recovered_log_has_the_mode_of_its_source(tmp_path: Path) -> None:
    source = small_log(tmp_path / "night.mcap", finished=False)
    for mode in (0o600, 0o640, 0o644):
        source.chmod(mode)
        out = tmp_path / f"{mode:o}.mcap"
        recover(source, out)
        assert mode_of(out) == mode


def test_a_written_file_obeys_the_umask_and_the_mode_of_its_source(tmp_path: Path, umask: int) -> None:
    source = small_log(tmp_path / "night.mcap", finished=True)
    source.chmod(0o640)
    write_whole(tmp_path / "plot.png", b"")
    write_whole(tmp_path / "night.html", b"", source)
    assert mode_of(tmp_path / "plot.png") == 0o666 & ~umask
    assert mode_of(tmp_path / "night.html") == 0o640 & ~umask


def test_a_log_is_not_replaced_by_another_file(tmp_path: Path) -> None:
    log = small_log(tmp_path / "calibration.fits", finished=True)
    before = log.read_bytes()
    for refusing in (lambda: require_folder(log), lambda: write_whole(log, b"SIMPLE")):
        with pytest.raises(DataFileError, match="is a log, which is never overwritten"):
            refusing()
    assert log.read_bytes() == before


@pytest.mark.parametrize("command", ["info", "recover", "replay"])
@pytest.mark.parametrize("name", ["last", "night.mcap", "night.mcap.part"])
def test_a_folder_without_permission_is_an_error_and_no_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str, name: str
) -> None:
    folder = tmp_path / "of another user"

    def denied_in_folder(function: Callable[..., object]) -> Callable[..., object]:
        def denied(path: object, *arguments: object, **options: object) -> object:
            if str(path).startswith(str(folder)):
                raise PermissionError(errno.EACCES, "Permission denied")
            return function(path, *arguments, **options)

        return denied

    for function in ("open", "listdir", "scandir", "stat"):  # root has permission for everything
        monkeypatch.setattr(os, function, denied_in_folder(getattr(os, function)))
    assert "cannot be read: Permission denied" in refusal(command, folder / name, kind=DataFileError)


def test_the_recorder_uses_the_configured_mode() -> None:
    assert log_limits(load(None, {"recorder.file_mode": "0604"})).file_mode == 0o604


@pytest.mark.parametrize("mode", ["0666 ", "640", "0o640", "0440", "0641", "0x20", "", 416])
def test_an_invalid_mode_is_refused(mode: object) -> None:
    with pytest.raises(ConfigurationError, match=r"recorder\.file_mode = "):
        load(None, {"recorder.file_mode": mode})
