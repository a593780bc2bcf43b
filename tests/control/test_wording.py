"""Sentences that people read: singular and plural, the loop's modes."""

import numpy as np
import pytest

from lowfc.contract.events import EVENTS
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.wording import counted


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ((0, "frame"), "0 frames"),
        ((1, "frame"), "1 frame"),
        ((2, "frame"), "2 frames"),
        ((1.0, "frame"), "1 frame"),
        ((1.5, "frame"), "1.5 frames"),
        ((1234567, "message"), "1234567 messages"),
        ((2, "process", "processes"), "2 processes"),
    ],
)
def test_a_number_goes_with_its_noun(words: tuple[float, str], expected: str) -> None:
    assert counted(*words) == expected


def test_events_keep_singular_and_plural() -> None:
    event = EVENTS["FRAMES_MISSING"]
    assert (
        event.log("controller", 0, count=1, number=7).message
        == "FRAMES_MISSING 1 frame missing or skipped before frame 7"
    )
    assert "2 frames missing" in event.log("controller", 0, count=np.int64(2), number=7).message
    assert "1 message lost" in EVENTS["MESSAGES_LOST"].log("recorder", 0, count=1, topic="t").message


def test_safe_mode_has_a_name_that_everybody_knows() -> None:
    assert [mode.in_words for mode in LoopMode] == ["idle", "open", "closed", "in safe mode"]
    assert EVENTS["SAFED"].log("controller", 0, why="x").message.startswith("SAFED loop in safe mode: x; ")
