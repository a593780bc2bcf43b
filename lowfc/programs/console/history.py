"""Events and requests, newest last; a repeated event is one line with its count."""

import re
from collections import deque

from rich.text import Text

from lowfc.contract.messages import Log, from_timestamp, wire
from lowfc.programs.console import panels

_LINES = 200  # largest number of lines that are kept
_REPEAT_S = 10.0
"""An event that differs only in numbers from another within this time is shown once, with its count."""
_SEARCHED = 8  # number of last lines that are searched for a repeated event
_DIGITS = re.compile(r"\d+")


class History:
    """Lines for the events and requests of a run."""

    def __init__(self) -> None:
        self._lines: deque[tuple[wire.Request | Log, int]] = deque(maxlen=_LINES)

    def add(self, entry: wire.Request | Log) -> None:
        """Add an event or request; an event that repeats one of the last lines replaces that line."""
        times = 1
        for line in reversed(range(len(self._lines))[-_SEARCHED:]):
            if _repeats(self._lines[line][0], entry):
                times += self._lines[line][1]
                del self._lines[line]
                break
        self._lines.append((entry, times))

    def last(self, count: int) -> Text:
        """The newest `count` lines."""
        shown = list(self._lines)[-max(1, count) :]
        return Text("\n").join(
            panels.request_line(entry) if isinstance(entry, wire.Request) else panels.event_line(entry, times)
            for entry, times in shown
        )


def _repeats(before: wire.Request | Log, now: wire.Request | Log) -> bool:
    if isinstance(before, wire.Request) or isinstance(now, wire.Request):
        return False
    apart_s = (from_timestamp(now.timestamp) - from_timestamp(before.timestamp)) * 1e-9
    return (
        apart_s < _REPEAT_S
        and (before.name, before.level) == (now.name, now.level)
        and _DIGITS.sub("", before.message) == _DIGITS.sub("", now.message)
    )
