"""Notifications to the service manager that started a process: ready, alive, stopping, and one line of its state.

The manager is systemd, or any other that sets NOTIFY_SOCKET to a datagram socket (sd_notify(3)); without one nothing is
sent. The loop never waits for it: a manager that does not read misses notifications.
"""

import contextlib
import os
import socket
from collections.abc import Mapping

from lowfc.contract.messages import wire
from lowfc.control.loop.safety import LoopMode


class Supervisor:
    """The service manager, where there is one.

    It wants a sign of life within twice `period_ns`; None where it wants none.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        """Read the manager's socket and its timeout from the environment."""
        self.period_ns: int | None = None
        self._address = environment.get("NOTIFY_SOCKET", "").replace("@", "\0", 1)
        self._due_ns = 0
        self._said: set[str] = set()
        wait_us = environment.get("WATCHDOG_USEC", "")
        ours = environment.get("WATCHDOG_PID", "") in ("", str(os.getpid()))  # it may be a parent's
        if self._address and wait_us.isdecimal() and int(wait_us) > 0 and ours:
            self.period_ns = int(wait_us) * 1000 // 2

    def ready(self) -> None:
        """Started: what waits for this process may start."""
        self._once("READY=1")

    def stopping(self) -> None:
        """Told to stop, or done."""
        self._once("STOPPING=1")

    def alive(self, now_ns: int) -> None:
        """A sign of life, where one is due; for the loop that does the work, and for no thread beside it."""
        if self.period_ns is not None and now_ns >= self._due_ns:
            self._due_ns = now_ns + self.period_ns
            self._say("WATCHDOG=1")

    def tell(self, health: wire.Health) -> None:
        """State of the process, as the line that `systemctl status` shows."""
        if self._address:
            self._say(f"STATUS={status_line(health)}")

    def _once(self, what: str) -> None:
        if what not in self._said:
            self._said.add(what)
            self._say(what)

    def _say(self, what: str) -> None:
        if not self._address:
            return
        # a manager that is gone or does not keep up is no reason to stop or to wait
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as datagrams:
            datagrams.setblocking(False)
            datagrams.sendto(what.encode(), self._address)


def status_line(health: wire.Health) -> str:
    """State, loop mode, rate and what failed, in one line."""
    parts = [health.state]
    if health.mode:
        parts.append(LoopMode(health.mode).in_words)
    parts.append(f"{health.rate_hz:.0f} Hz")
    if health.recording.failure:
        parts.append(f"recording failed: {health.recording.failure}")
    return " ".join(", ".join(parts).split())
