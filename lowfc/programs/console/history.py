"""Events and requests, newest last; a repeated event has one line."""

import re
from collections import deque

from rich.text import Text

from lowfc.contract.messages import Log, from_timestamp, wire
from lowfc.programs.console import panels

_MOST = 200
_WITHIN_S = 10.0
"""An event repeated within this time is shown once, with its count."""
_LOOKED_AT = 8
_DIGITS = re.compile(r"\d+")


class History:
    """Lines for the events and requests of a run."""

    def __init__(self) -> None:
        self._lines: deque[tuple[wire.Request | Log, int]] = deque(maxlen=_MOST)

    def add(self, one: wire.Request | Log) -> None:
        """Add the newest; an event like one of the last ones takes its place."""
        times = 1
        for place in range(len(self._lines) - 1, max(-1, len(self._lines) - 1 - _LOOKED_AT), -1):
            if _alike(self._lines[place][0], one):
                times += self._lines[place][1]
                del self._lines[place]
                break
        self._lines.append((one, times))

    def last(self, count: int) -> Text:
        """The newest ones, a line each."""
        shown = list(self._lines)[-max(1, count) :]
        return Text("\n").join(
            panels.request_line(one) if isinstance(one, wire.Request) else panels.event_line(one, times)
            for one, times in shown
        )


def _alike(before: wire.Request | Log, now: wire.Request | Log) -> bool:
    if isinstance(before, wire.Request) or isinstance(now, wire.Request):
        return False
    apart_s = (from_timestamp(now.timestamp) - from_timestamp(before.timestamp)) * 1e-9
    return (
        apart_s < _WITHIN_S
        and (before.name, before.level) == (now.name, now.level)
        and _DIGITS.sub("", before.message) == _DIGITS.sub("", now.message)
    )
