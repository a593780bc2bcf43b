"""Fixtures of all tests: private runtime directories and caches, and no silent skips where none are allowed."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

NO_SKIPS = os.environ.get("LOWFC_NO_SKIPS") == "1"
LONGEST = (
    *("test_lockstep", "test_gain_watch", "test_calibrate", "test_optics_twin", "test_tutorials", "test_validate"),
    *("test_commission", "test_calibrate_commands", "test_validate_figures", "test_what_if", "test_guard", "test_site"),
)
"""Test files that are started first, so that no worker runs one of them alone at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    order = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path.stem, len(LONGEST)))


@pytest.fixture(scope="session", autouse=True)
def _private_runtime(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Give all tests a private runtime directory, separate from the user's loops."""
    path = tmp_path_factory.mktemp("runtime")
    path.chmod(0o700)
    os.environ["XDG_RUNTIME_DIR"] = str(path)
    os.environ["XDG_STATE_HOME"] = str(path / "state")  # for latches of safe mode


@pytest.fixture(scope="session", autouse=True)
def _private_cache(pytestconfig: pytest.Config) -> None:
    """Cache optical models separately from the user's, in a folder shared by all workers and later sessions."""
    assert pytestconfig.cache is not None
    os.environ["XDG_CACHE_HOME"] = str(pytestconfig.cache.mkdir("home"))


@pytest.fixture(autouse=True)
def _same_process() -> Iterator[None]:
    """Check that a command run in this process leaves scheduling class, niceness and processors unchanged."""
    before = _scheduling()
    yield
    assert _scheduling() == before


def _scheduling() -> tuple[int, int, set[int]]:
    return os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0), os.sched_getaffinity(0)


@pytest.fixture
def own_runtime(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give a test its own runtime directory, without runs and latches of other tests."""
    path = tmp_path_factory.mktemp("own")  # not `tmp_path`: a folder `lowfc` there would hide the package
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(path))
    monkeypatch.setenv("XDG_STATE_HOME", str(path / "state"))
    return path


@pytest.fixture
def without_drawings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Omit the drawings of reports, which take ten times as long as the rest."""
    monkeypatch.setattr("lowfc.programs.logs.report.drawings._DRAWINGS", {})


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if NO_SKIPS and report.skipped and not hasattr(report, "wasxfail"):
        report.outcome = "failed"


@pytest.fixture(scope="session")
def artefacts() -> Path:
    """Folder in which tests leave images for inspection."""
    path = Path(__file__).parent / "artefacts"
    path.mkdir(exist_ok=True)
    return path
