"""The latch of safe mode: two places that fail apart, no exception, no delay."""

import os
from pathlib import Path

import pytest

from lowfc.adapters.bus.run import open_run
from lowfc.adapters.process import latch as latch_module
from lowfc.adapters.process.latch import Latch, latch_files
from lowfc.contract.messages import Role
from tests.support.loops import until

pytestmark = pytest.mark.exclusive


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    (tmp_path / "run").mkdir()
    (tmp_path / "state" / "lowfc").mkdir(parents=True)
    return tmp_path / "run" / "safe", tmp_path / "state" / "lowfc" / "night.safe"


def test_it_is_kept_in_both_places_and_either_is_enough(files: tuple[Path, Path]) -> None:
    first = Latch(files)
    assert (first.safe, first.kept) == (False, True)
    first.set(True)
    until(lambda: all(file.exists() for file in files))
    first.close()
    for lost in files:
        lost.unlink()
        again = Latch(files)
        assert again.safe
        again.close()
        lost.touch()
    last = Latch(files)
    last.set(False)
    until(lambda: not any(file.exists() for file in files))
    last.close()
    assert not Latch(files).safe


def test_the_former_name_counts(files: tuple[Path, Path]) -> None:
    files[0].with_name("safed").touch()
    latch = Latch(files)
    assert latch.safe
    latch.set(True)
    latch.set(False)
    latch.close()
    assert not files[0].with_name("safed").exists(), "cleared under either name"


def test_a_directory_that_is_gone_harms_nobody_and_comes_back(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latch_module, "RETRY_S", 0.01)
    said: list[str] = []
    latch = Latch(files, said.append)
    files[0].parent.rmdir()
    files[0].parent.touch()  # a file where the run's directory was
    latch.set(True)
    until(files[1].exists)
    until(lambda: bool(said))
    assert str(files[0]) in said[0]
    files[0].parent.unlink()
    files[0].parent.mkdir()
    until(files[0].exists)
    latch.close()
    assert len(said) == 1, "said once, however often it was tried"


def test_what_cannot_be_read_is_safe_and_what_cannot_be_written_is_not_kept(tmp_path: Path) -> None:
    said: list[str] = []
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    latch = Latch([loop / "safe"], said.append)
    assert (latch.safe, latch.kept) == (True, False)
    assert "cannot be read" in said[0]
    latch.close()
    (tmp_path / "file").touch()
    nowhere = Latch([tmp_path / "file" / "safe"], said.append)
    assert (nowhere.safe, nowhere.kept) == (False, False)
    nowhere.set(True)
    nowhere.close()
    assert "cannot be written" in said[-1]


def test_a_run_of_a_launcher_needs_its_directory_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    by_hand = open_run("night", base=tmp_path)
    assert latch_files(by_hand) == (tmp_path / "night" / "safe", tmp_path / "home" / "lowfc" / "night.safe")
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path}/var{os.pathsep}/elsewhere")
    assert latch_files(by_hand)[1] == tmp_path / "var" / "night.safe"
    launched = open_run("launched", base=tmp_path, listeners=(Role.LAUNCHER,))
    assert latch_files(launched) == (tmp_path / "launched" / "safe",)


def test_a_start_that_finds_one_place_writes_the_other(files: tuple[Path, Path]) -> None:
    files[0].touch()
    latch = Latch(files)
    until(files[1].exists)
    latch.close()


def test_what_was_written_in_part_is_cleared_whole(files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(latch_module, "RETRY_S", 0.01)
    files[1].parent.rmdir()
    files[1].parent.touch()
    said: list[str] = []

    def failed(why: str) -> None:
        said.append(why)
        raise OSError("the disk is full")

    latch = Latch(files, failed)
    latch.set(True)
    until(files[0].exists)
    latch.set(False)
    until(lambda: not files[0].exists())
    latch.close()
    assert len(said) == 1, "said once, and who is told cannot end it"
