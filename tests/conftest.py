"""What all tests share: runs that leave nothing behind, and no silent skips where none are allowed."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

NO_SKIPS = os.environ.get("LOWFC_NO_SKIPS") == "1"
LONGEST = (
    *("test_lockstep", "test_gain_watch", "test_calibrate", "test_optics_twin", "test_tutorials", "test_validate"),
    *("test_commission", "test_calibrate_commands", "test_validate_figures", "test_what_if", "test_guard", "test_site"),
)
"""Files that are begun first, so that no worker is left alone with one of them at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    place = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONGEST)))


@pytest.fixture(scope="session", autouse=True)
def _private_runtime(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Give all runs of the tests a runtime directory of their own, so that they meet no loop of the user's."""
    path = tmp_path_factory.mktemp("runtime")
    path.chmod(0o700)
    os.environ["XDG_RUNTIME_DIR"] = str(path)
    os.environ["XDG_STATE_HOME"] = str(path / "state")  # where latches of safe mode are kept


@pytest.fixture(scope="session", autouse=True)
def _private_cache(pytestconfig: pytest.Config) -> None:
    """Keep optical models apart from the user's, in a folder that all workers and later sessions share."""
    assert pytestconfig.cache is not None
    os.environ["XDG_CACHE_HOME"] = str(pytestconfig.cache.mkdir("home"))


@pytest.fixture(autouse=True)
def _same_process() -> Iterator[None]:
    """A command run in this process leaves later tests no scheduling class, niceness or processors of its own."""
    before = _scheduling()
    yield
    assert _scheduling() == before


def _scheduling() -> tuple[int, int, set[int]]:
    return os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, 0), os.sched_getaffinity(0)


@pytest.fixture
def own_runtime(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Give a test a runtime directory of its own, in which there is no run yet, and no latch of another test's run."""
    path = tmp_path_factory.mktemp("own")  # not `tmp_path`: a folder `lowfc` there would hide the package
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(path))
    monkeypatch.setenv("XDG_STATE_HOME", str(path / "state"))
    return path


@pytest.fixture
def without_drawings(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reports whose drawings nobody looks at have none: they take ten times as long as all the rest."""
    monkeypatch.setattr("lowfc.programs.logs.report.drawings._DRAWINGS", {})


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    if NO_SKIPS and report.skipped and not hasattr(report, "wasxfail"):
        report.outcome = "failed"


@pytest.fixture(scope="session")
def artefacts() -> Path:
    """Where tests leave pictures for people to look at."""
    path = Path(__file__).parent / "artefacts"
    path.mkdir(exist_ok=True)
    return path
