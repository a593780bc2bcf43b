"""Fixtures shared by the tests of controller and recorder."""

import pytest

from lowfc.programs.core.recording import recorder


@pytest.fixture(autouse=True)
def _quick_recorder(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short waiting and flush times for a recorder in this process, which uses a bus in memory."""
    monkeypatch.setattr(recorder, "_SETTLE_S", (0.03, 0.3))
    monkeypatch.setattr(recorder, "_FLUSH_NS", 50_000_000)
    monkeypatch.setattr(recorder, "_DRAIN_S", 0.2)
