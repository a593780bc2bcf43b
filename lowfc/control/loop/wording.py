"""Words that many sentences share."""

PAUSED = "operator asked to pause"
"""Cause of the open mode of a loop that is paused."""
AUTO = "auto"
"""Text of a request for automatic gains, and what the text of those begins with that no person made."""
MEASURED_FIRST = "the gains are measured before the loop closes"
"""Cause of the open mode in which a loop with automatic gains begins."""
MOST_TEXT = 10_000
"""Characters of a note."""


def counted(count: float, noun: str, plural: str = "") -> str:
    """A number and its noun: 1 frame, 2 frames, 1.5 frames."""
    number = f"{count:g}" if isinstance(count, float) else count
    return f"{number} {noun if count == 1 else plural or f'{noun}s'}"


def mode_word(mode: str) -> str:
    """A loop mode as people read it."""
    return "in safe mode" if mode == "safe" else mode
