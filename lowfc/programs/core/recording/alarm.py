"""Runs the command `recorder.on_event` when an event of the level `recorder.on_event_level` or above occurs.

The recorder runs it, because a run has at most one recorder, which receives every event and is not in the loop; a
console may be closed, or open twice. The command is started by a thread without real-time priority, and so has none
either. Events that arrive while the command runs, or within `recorder.on_event_every_s` after it, wait. Then, or when
the recorder ends, the command is run once for them, with the most severe event.
"""

import contextlib
import math
import os
import signal
import subprocess
import threading
import time
from collections import deque

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.process.realtime import lower_priority
from lowfc.adapters.process.service import Service
from lowfc.contract.events import EVENTS, Level
from lowfc.contract.messages import EVENT, Log, from_timestamp
from lowfc.contract.printable import printable

TIMEOUT_S = 60.0
"""Time after which a command is killed."""
_MAX_WAITING_EVENTS = 1000
_END_S = 2.0  # time that an ending recorder waits for the command; a service manager kills the command after that
_LEVELS: dict[int, str] = {level.value: level.name.lower() for level in Level}
_FAILED = EVENTS["ON_EVENT_FAILED"].name


class Alarm:
    """Runs a shell command on events of a level or above, one at a time and not too often."""

    def __init__(self, service: Service, command: str, level: Level, min_interval_s: float) -> None:
        """Run the command from the next event on; its failure is published as an event that does not trigger it."""
        self._command, self._level, self._min_interval_s, self._service = command, level, min_interval_s, service
        self._waiting: deque[Log] = deque(maxlen=_MAX_WAITING_EVENTS)
        self._arrived, self._closing, self._deadline_s = threading.Event(), threading.Event(), math.inf
        service.bus.subscribe(EVENT, self._receive)
        self._thread = threading.Thread(target=self._work, name="on-event", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Run the command for waiting events, once a running command has ended; wait at most `_END_S` for both."""
        self._deadline_s = time.monotonic() + _END_S
        self._closing.set()
        self._arrived.set()
        self._thread.join(2 * _END_S)

    def _receive(self, sample: Sample) -> None:
        event = Log.FromString(sample.payload)
        if event.level >= self._level and not event.message.startswith(_FAILED):
            self._waiting.append(event)
            self._arrived.set()

    def _work(self) -> None:
        lower_priority()  # only this thread and its child processes
        while self._arrived.wait():
            self._arrived.clear()
            events = [self._waiting.popleft() for _ in range(len(self._waiting))]
            if events:
                self._run(max(events, key=lambda event: event.level), len(events) - 1)
                self._closing.wait(self._min_interval_s)
            if self._closing.is_set() and not self._waiting:
                return

    def _run(self, event: Log, others: int) -> None:
        name, _, text = printable(event.message).partition(" ")
        variables = {
            "LOWFC_RUN": self._service.run_id,
            "LOWFC_EVENT": name,
            "LOWFC_TEXT": text,
            "LOWFC_LEVEL": _LEVELS.get(event.level, str(event.level)),
            "LOWFC_PROCESS": printable(event.name),
            "LOWFC_TIME": f"{from_timestamp(event.timestamp) * 1e-9:.3f}",
            "LOWFC_OTHERS": str(others),
        }
        try:
            command = subprocess.Popen(  # noqa: S603  # configured by the user
                ["/bin/sh", "-c", self._command],
                stdin=subprocess.DEVNULL,
                env={**os.environb, **{key.encode(): value.encode() for key, value in variables.items()}},  # UTF-8
                start_new_session=True,
            )
            due_s = time.monotonic() + TIMEOUT_S
            while (status := command.poll()) is None and time.monotonic() < min(due_s, self._deadline_s):
                time.sleep(0.02)
            if status:
                self._fail(f"it ended with exit status {status}")
            elif status is None and not self._closing.is_set():
                with contextlib.suppress(OSError):  # it has ended, or runs as another user
                    os.killpg(command.pid, signal.SIGKILL)
                command.wait()
                self._fail(f"it was killed after {TIMEOUT_S:g} s")
        except OSError as fault:
            self._fail(f"it cannot be run: {fault.strerror}")

    def _fail(self, why: str) -> None:
        self._service.event(_FAILED, why=why)
