"""Recording, as an operator begins and ends it: questions to the recorder, answered with the file that is meant."""

from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path

from lowfc.adapters.bus.bus import ALL, Bus, Query
from lowfc.adapters.process.clock import Clock
from lowfc.contract.messages import RECORD_KEY, timestamp, wire


class RecordingSwitch:
    """Questions that wait for the recorder's loop, and their answers."""

    def __init__(
        self, bus: Bus, clock: Clock, handlers: Mapping[str, Callable[[], str | None]], outlook: Callable[[], str]
    ) -> None:
        """Declare it on the bus; each handler does what its name says.

        A handler returns why not where it did not, and None while it is at it: it is called again then. The answer to
        "start" ends with the `outlook`, if there is one: what the recording will take.
        """
        self._outlook = outlook
        self._clock = clock
        self._handlers = handlers
        self._queries: deque[Query] = deque()
        bus.queryable(RECORD_KEY.format(name=ALL), self._queries.append)

    def serve(self, files: list[Path]) -> None:
        """Do what was asked since the last call; `files` are the logs so far, and change with it."""
        while self._queries:
            query = self._queries[0]
            handler = self._handlers.get(query.name)
            refusal: str | None
            if handler is None:
                refusal = f"a recorder is told to {' or to '.join(self._handlers)}, not to {query.name}"
            else:
                refusal = handler()
            if refusal is None:
                return
            self._queries.popleft()
            path = str(files[-1].absolute()) if files else ""
            outlook = self._outlook() if query.name == "start" else ""
            done = f"{query.name}: {path}" + (f"; {outlook}" if outlook else "")
            message = wire.Request(
                timestamp=timestamp(self._clock.now_ns()),
                name=query.name,
                text=path,
                accepted=not refusal,
                reply=refusal or done,
            )
            query.reply(message.SerializeToString())
