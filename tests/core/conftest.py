"""Fixtures shared by the tests of controller and recorder."""

from pathlib import Path

import pytest

from lowfc.programs.core.recording import recorder
from tests.support.recording import Bench


@pytest.fixture(autouse=True)
def _quick_recorder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short waiting and flush times for a recorder in this process, which uses a bus in memory."""
    monkeypatch.setattr(recorder, "_SETTLE_S", (0.03, 0.3))
    monkeypatch.setattr(recorder, "_FLUSH_NS", 50_000_000)
    monkeypatch.setattr(recorder, "_DRAIN_S", 0.2)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path / "logs")
