"""A run's directory: links, secret, start times of processes, the safe-mode latch, and atomic replacement of files."""

import errno
import os
import socket
import subprocess
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import pytest

from lowfc.adapters.bus.bus import ALL, Query
from lowfc.adapters.bus.run import mirror_role, new_run_id, open_run, own_directory, runtime_base
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.files.whole_file import being_written, draft, require_folder, write_whole
from lowfc.adapters.process import latch as latch_module
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.latch import Latch, latch_files
from lowfc.contract.errors import BusError, DataFileError
from lowfc.contract.messages import REQUEST_KEY, Role, wire
from tests.support.loops import lowfc, mount, until

pytestmark = pytest.mark.usefixtures("own_runtime")
FULL_DISK = Mock(side_effect=OSError(errno.ENOSPC, "No space left on device"))


def test_a_run_has_a_secret_private_files_and_free_ports_below_the_outgoing_range(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lowest_outgoing = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    monkeypatch.setattr("lowfc.adapters.bus.run._LOWEST_PORT", lowest_outgoing - 12)  # 12 ports to choose from
    run = open_run("night", mirrors=("dm", "tip"))
    assert set(run.links.ports) == {"camera", "controller", "mirror-dm", "mirror-tip", "recorder"}
    assert len(set(run.links.ports.values())) == 5
    assert all(port < lowest_outgoing for port in run.links.ports.values())
    for port in run.links.ports.values():
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", port))
    assert len(run.links.secret) == 64
    assert run.path.stat().st_mode & 0o777 == 0o700
    assert {path.stat().st_mode & 0o7777 for path in run.path.iterdir()} == {0o1600}, (
        "the sticky bit keeps them from removal by systemd-tmpfiles"
    )
    assert run.links.secret_file.read_text() == f"lowfc:{run.links.secret}\n"
    assert run.links.secret not in repr(run)
    other = open_run(new_run_id())
    assert other.path != run.path
    assert other.links.secret != run.links.secret
    assert not set(other.links.ports.values()) & set(run.links.ports.values())
    run.remove()
    assert not run.path.exists()


def test_simultaneous_opens_get_the_same_run(own_runtime: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        links = [run.links for run in pool.map(open_run, ["one"] * 8)]
    assert all((other, other.secret) == (links[0], links[0].secret) for other in links)
    assert [path.name for path in (own_runtime / "lowfc").iterdir()] == ["one"]


@pytest.mark.parametrize("name", ["", "../up", "a/b", ".hidden", "Night", "x" * 49, "a b"])
def test_an_invalid_run_name_is_refused(name: str) -> None:
    with pytest.raises(BusError, match="a run's name"):
        open_run(name)


def test_a_mirror_that_the_run_does_not_have_is_refused() -> None:
    open_run("night")
    with pytest.raises(BusError, match=r"no 'mirror-tip'.*remove its directory and start again with that"):
        open_run("night", mirrors=("dm", "tip"))
    assert mirror_role("tip") == "mirror-tip"
    with pytest.raises(BusError, match="there is no run 'dusk'"):
        open_run("dusk", ())


@pytest.mark.parametrize(
    ("name", "text"),
    [
        *(
            ("links.json", text)
            for text in (None, "", "{}", "[]", "\xff", '{"run_id": "night", "ports": {"camera": 0}}')
        ),
        ("links.json", '{"run_id": "day", "ports": {}, "user": "lowfc"}'),
        *(("credentials", text) for text in (None, "", "lowfc", "\xff", "somebody:else")),
    ],
)
def test_damaged_files_of_a_run_are_an_error(name: str, text: str | None) -> None:
    file = open_run("night").path / name
    file.unlink()
    if text is not None:
        file.write_text(text, encoding="latin-1")  # "\xff" is then not UTF-8
    with pytest.raises(DataFileError, match=name):
        _ = open_run("night").links.secret


def test_a_run_that_cannot_be_made_is_an_error_and_leaves_nothing(
    own_runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = runtime_base()
    (base / "taken").touch()
    with pytest.raises(DataFileError, match=r"taken cannot be made: Not a directory"):
        open_run("taken")
    monkeypatch.setattr(Path, "write_text", FULL_DISK)
    with pytest.raises(DataFileError, match=r"night cannot be made: No space left on device"):
        open_run("night")
    assert [path.name for path in base.iterdir()] == ["taken"]
    monkeypatch.setattr(os, "link", FULL_DISK)
    with pytest.raises(DataFileError, match=r"clock-.* cannot be read or made: No space left on device"):
        HostClock()


def test_directories_of_other_users_public_directories_and_links_are_refused(
    own_runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    base = own_runtime / "lowfc"
    base.mkdir(mode=0o755)
    with pytest.raises(DataFileError, match="mode 700"):
        runtime_base()
    base.chmod(0o700)
    assert runtime_base() == base
    monkeypatch.setattr(os, "geteuid", lambda: base.stat().st_uid + 1)
    with pytest.raises(DataFileError, match="mode 700"):
        own_directory(base)
    monkeypatch.undo()
    (own_runtime / "real").mkdir(mode=0o700)
    (own_runtime / "link").symlink_to(own_runtime / "real")
    with pytest.raises(DataFileError, match="mode 700"):
        own_directory(own_runtime / "link")
    with pytest.raises(DataFileError, match="ended cannot be read: No such file or directory"):
        own_directory(own_runtime / "ended")


def test_an_invalid_runtime_directory_is_an_error(own_runtime: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (own_runtime / "lowfc").write_text("")
    with pytest.raises(DataFileError, match="should be a directory"):
        runtime_base()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(own_runtime / "gone"))
    with pytest.raises(DataFileError, match="XDG_RUNTIME_DIR"):
        runtime_base()
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    # This user id is unused, so that the created directory belongs to another user.
    monkeypatch.setattr(os, "geteuid", lambda: 4_000_000_000)
    shared = Path("/tmp/lowfc-4000000000")  # noqa: S108  # the path under test
    try:
        with pytest.raises(DataFileError, match="of user 4000000000"):
            runtime_base()
    finally:
        shared.rmdir()


def test_each_start_time_of_a_role_is_claimed_once() -> None:
    links = open_run("night").links
    assert [links.claim_start("camera", start_s) for start_s in (100, 100, 50, 200)] == [100, 101, 102, 200]
    assert links.claim_start("controller", 100) == 100


@pytest.mark.parametrize("text", ["", "9" * 5000, str(2**32), "\u00b2", "-7", "later"])
def test_an_invalid_stored_start_is_ignored(text: str) -> None:
    links = open_run("night").links
    file = links.secret_file.parent / "start-camera"
    file.write_text(text)
    assert [links.claim_start("camera", 100), links.claim_start("camera", 100)] == [100, 101]
    file.unlink()
    file.mkdir()  # not writable, even for root
    assert links.claim_start("camera", 100) == 100


def test_safe_is_requested_even_if_the_runs_directory_is_read_only() -> None:
    run = open_run("night")
    mount("--bind", run.path, run.path)
    bus = ZenohBus(run.links, "controller", HostClock())
    requested: list[str] = []

    def answer(query: Query) -> None:
        requested.append(query.name)
        query.reply(
            wire.Request(name=query.name, accepted=True, reply="the mirror relaxes to flat").SerializeToString()
        )

    bus.queryable(REQUEST_KEY.format(name=ALL), answer)
    mount("-o", "remount,bind,ro", run.path)
    try:
        with pytest.raises(OSError, match="Read-only"):
            (run.path / "start-operator").write_text("")
        done = lowfc("ctl", "safe", "--run", "night")
    finally:
        subprocess.run(["umount", "--lazy", run.path], check=True)
        bus.close()
    assert (done.exit_code, requested) == (0, ["safe"]), done.output


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    (tmp_path / "run").mkdir()
    (tmp_path / "state" / "lowfc").mkdir(parents=True)
    return tmp_path / "run" / "safe", tmp_path / "state" / "lowfc" / "night.safe"


def test_the_latch_is_kept_in_two_places_and_each_restores_the_other(files: tuple[Path, Path]) -> None:
    first = Latch(files)
    assert (first.safe, first.writable) == (False, True)
    first.set(True)
    until(lambda: all(file.exists() for file in files))
    first.close()
    for lost in files:
        lost.unlink()
        again = Latch(files)
        assert again.safe
        until(lost.exists)
        again.close()
    last = Latch(files)
    last.set(False)
    until(lambda: not any(file.exists() for file in files))
    last.close()
    assert not Latch(files).safe


def test_a_latch_under_its_former_name_counts(files: tuple[Path, Path]) -> None:
    files[0].with_name("safed").touch()
    latch = Latch(files)
    assert latch.safe
    latch.set(True)
    latch.set(False)
    latch.close()
    assert not files[0].with_name("safed").exists(), "cleared under either name"


def test_a_latch_is_kept_in_one_place_while_the_other_is_missing_and_later_in_both_again(
    files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(latch_module, "RETRY_S", 0.01)
    reported: list[str] = []

    def failed(why: str) -> None:
        reported.append(why)
        raise OSError("the disk is full")

    latch = Latch(files, failed)
    files[0].parent.rmdir()
    files[0].parent.touch()  # a file where the run's directory was
    latch.set(True)
    until(files[1].exists)
    until(lambda: reported)
    assert str(files[0]) in reported[0]
    latch.set(False)
    until(lambda: not files[1].exists())
    latch.set(True)
    files[0].parent.unlink()
    files[0].parent.mkdir()
    until(lambda: all(file.exists() for file in files))
    latch.close()
    assert len(reported) == 1, "reported once despite retries, and a failing handler does not end the thread"


def test_an_unreadable_latch_counts_as_safe_mode_and_an_unwritable_one_is_detected(tmp_path: Path) -> None:
    reported: list[str] = []
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    latch = Latch([loop / "safe"], reported.append)
    assert (latch.safe, latch.writable) == (True, False)
    assert "cannot be read" in reported[0]
    latch.close()
    (tmp_path / "file").touch()
    nowhere = Latch([tmp_path / "file" / "safe"], reported.append)
    assert (nowhere.safe, nowhere.writable) == (False, False)
    nowhere.set(True)
    nowhere.close()
    assert "cannot be written" in reported[-1]


def test_the_latch_of_a_launchers_run_is_in_its_directory_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "home"))
    by_hand = open_run("night", base=tmp_path)
    assert latch_files(by_hand) == (tmp_path / "night" / "safe", tmp_path / "home" / "lowfc" / "night.safe")
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path}/var{os.pathsep}/elsewhere")
    assert latch_files(by_hand)[1] == tmp_path / "var" / "night.safe"
    launched = open_run("launched", base=tmp_path, listeners=(Role.LAUNCHER,))
    assert latch_files(launched) == (tmp_path / "launched" / "safe",)


def test_a_file_that_cannot_be_written_is_an_error_both_when_checked_and_when_written(tmp_path: Path) -> None:
    pipe, loop = tmp_path / "pipe", tmp_path / "loop"
    os.mkfifo(pipe)
    loop.symlink_to("loop")
    faults = dict.fromkeys((pipe, Path(), Path("/"), tmp_path), "not a regular file")
    faults[tmp_path / ("x" * 300)] = "File name too long"
    faults[Path("/proc/calibration.fits")] = "No such file"  # not even root can write there
    for file, why in faults.items():
        for write in (require_folder, partial(write_whole, content=b"")):
            with pytest.raises(DataFileError, match=f"^{file} cannot be written: {why}"):
                write(file)
    for allowed in (loop, tmp_path / ("x" * 255)):
        require_folder(tmp_path / "file", allowed)
        write_whole(allowed, b"")
    with pytest.raises(DataFileError, match="nowhere/file cannot be written: No such file"):
        write_whole(tmp_path / "nowhere" / "file", b"")


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, calls = tmp_path / "file", list[bool]()
    monkeypatch.setattr(os, "fsync", lambda _: calls.append(path.exists()))
    write_whole(path, b"content")
    assert calls == [False]


def test_being_written_reports_errors_of_its_block_as_file_errors_and_draft_does_not(tmp_path: Path) -> None:
    with (
        pytest.raises(DataFileError, match="file cannot be written: Connection refused"),
        being_written(tmp_path / "file"),
    ):
        raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")
    with pytest.raises(ConnectionRefusedError), draft(tmp_path / "file"):
        raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")
    assert list(tmp_path.iterdir()) == []


def test_a_failed_write_leaves_the_old_file_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    for content in (b"former", b"first"):
        write_whole(path, content)
    monkeypatch.setattr(Path, "replace", FULL_DISK)
    with pytest.raises(DataFileError, match=r"file cannot be written: No space left on device"):
        write_whole(path, b"second")
    assert path.read_bytes() == b"first"
    assert list(tmp_path.iterdir()) == [path]
