"""What the tests of controller and recorder share."""

import pytest

from lowfc.programs.core.recording import recorder


@pytest.fixture(autouse=True)
def _quick_recorder(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recorder in this process waits for others, and flushes, as long as a bus in memory needs."""
    monkeypatch.setattr(recorder, "_SETTLE_S", (0.03, 0.3))
    monkeypatch.setattr(recorder, "_FLUSH_NS", 50_000_000)
    monkeypatch.setattr(recorder, "_DRAIN_S", 0.2)
