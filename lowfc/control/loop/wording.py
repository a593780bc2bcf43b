"""Phrases and formats shared by several messages, and the largest length of a note."""

PAUSED = "operator asked to pause"
"""Cause of the open mode of a loop that is paused."""
AUTO = "auto"
"""Text of a request for automatic gains; it also begins the requests that the controller makes for them itself."""
MEASURED_FIRST = "the gains are measured before the loop closes"
"""Cause of the open mode in which a loop with automatic gains begins."""
CAMERA_MISFIT = "the camera does not fit the calibration"
"""Beginning of the cause if the loop is open because the camera's settings differ from the calibration's."""
MAX_NOTE_LENGTH = 10_000
"""Largest number of characters of a note in the log."""


def counted(count: float, noun: str, plural: str = "") -> str:
    """Format a number with its noun: 1 frame, 2 frames, 1.5 frames."""
    number = f"{count:g}" if isinstance(count, float) else str(count)
    return f"{number} {noun if number == '1' else plural or f'{noun}s'}"


def mode_word(mode: str) -> str:
    """A loop mode in words."""
    return "in safe mode" if mode == "safe" else mode


def hertz(rate_hz: float) -> str:
    """Text of a frame rate."""
    return f"{rate_hz:.0f} Hz" if rate_hz >= 10 else f"{rate_hz:.2g} Hz"
