"""Fixtures and start order of all tests; with LOWFC_NO_SKIPS=1 a skipped test fails."""

import contextlib
import gc
import os
import signal
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest
from xdist.remote import Producer
from xdist.scheduler import LoadFileScheduling

from lowfc.adapters.bus.run import Run, new_run_id, open_run

NO_SKIPS = os.environ.get("LOWFC_NO_SKIPS") == "1"
TESTS = Path(__file__).parent
EARLY_FOLDERS = frozenset(TESTS / name for name in ("optics", "control", "paper", "design", "contract", "sim"))
"""Folders whose tests hardly wait for other processes: they run beside the exclusive tests."""
LONG_FILES = ("test_lockstep", "test_gain_watch", "test_calibrate", "test_tutorials", "test_commission", "test_what_if")
"""Test files that are started after these folders, so that no worker runs one of them alone at the end."""
gc.disable()  # nothing that the collection of tests imports is garbage


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    def start_order(item: pytest.Item) -> tuple[bool, bool, int]:
        rank = LONG_FILES.index(item.path.stem) if item.path.stem in LONG_FILES else len(LONG_FILES)
        exclusive = _exclusive(item.path)
        assert exclusive or item.get_closest_marker("exclusive") is None, item.nodeid
        return not exclusive, EARLY_FOLDERS.isdisjoint(item.path.parents), rank

    items.sort(key=start_order)


@pytest.hookimpl(optionalhook=True)  # with `-p no:xdist` no plugin declares this hook
def pytest_xdist_auto_num_workers() -> int:
    """One worker more than processors, because the worker with the exclusive tests mostly waits."""
    return len(os.sched_getaffinity(0)) + 1


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LoadFileScheduling:
    return _Scheduling(config, log)


class _Scheduling(LoadFileScheduling):
    """One worker runs all files with exclusive tests, one after another; each other file is run by one worker."""

    def _split_scope(self, nodeid: str) -> str:
        file = super()._split_scope(nodeid)
        return "exclusive" if _exclusive(TESTS.parent / file) else file


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Run the other tests at idle priority, so that an exclusive test on another worker gets the processors."""
    if "PYTEST_XDIST_WORKER" in os.environ and not _exclusive(item.path):
        with contextlib.suppress(OSError):  # a container may forbid it
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


@cache
def _exclusive(file: Path) -> bool:
    """Whether a file has an exclusive test: read from its text, as xdist passes names of tests without markers."""
    text = file.read_text()
    return "pytest.mark.exclusive" in text or "@on_screen" in text


@pytest.fixture(scope="session", autouse=True)
def _private_runtime(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Give the tests of each worker a private runtime directory, separate from the user's loops."""
    path = tmp_path_factory.mktemp("runtime")
    path.chmod(0o700)
    os.environ["XDG_RUNTIME_DIR"] = str(path)
    os.environ["XDG_STATE_HOME"] = str(path / "state")  # for latches of safe mode


@pytest.fixture(scope="session", autouse=True)
def _private_cache(pytestconfig: pytest.Config) -> None:
    """Cache optical models separately from the user's, in a folder that all workers and later sessions share."""
    os.environ["XDG_CACHE_HOME"] = str(pytestconfig.cache.mkdir("home"))


@pytest.fixture
def run() -> Iterator[Run]:
    new_run = open_run(new_run_id())
    yield new_run
    new_run.remove()


@pytest.fixture(autouse=True)
def _unchanged_scheduling() -> Iterator[None]:
    """Check that a command run in this process leaves scheduling class, niceness and processors unchanged."""
    before = _scheduling()
    yield
    assert _scheduling() == before


def _scheduling() -> tuple[int, int, set[int]]:
    return os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0), os.sched_getaffinity(0)


@pytest.fixture
def own_runtime(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give a test its own runtime directory, without runs and latches of other tests."""
    # Not `tmp_path`: in tests that change to it, a folder `lowfc` there would hide the package.
    path = tmp_path_factory.mktemp("own")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(path))
    monkeypatch.setenv("XDG_STATE_HOME", str(path / "state"))
    return path


@pytest.fixture
def restored_signals() -> Iterator[None]:
    """Restore the handlers of signals that a command sets."""
    before = {number: signal.getsignal(number) for number in (signal.SIGHUP, signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture
def without_drawings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Omit the drawings of reports, which take ten times as long as the rest of a report."""
    monkeypatch.setattr("lowfc.programs.logs.report.drawings._DRAWINGS", {})


@pytest.fixture
def without_layout(monkeypatch: pytest.MonkeyPatch) -> None:
    """Omit the layout of plots, which takes half of the time of drawing them."""
    monkeypatch.setattr("lowfc.adapters.files.drawing.lay_out", lambda figure, *_: figure.set_layout_engine(None))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if NO_SKIPS and report.skipped and not hasattr(report, "wasxfail"):
        report.outcome = "failed"


@pytest.fixture(scope="session")
def artefacts() -> Path:
    """Folder in which tests leave images for inspection."""
    path = TESTS / "artefacts"
    path.mkdir(exist_ok=True)
    return path
