"""Notifications to the service manager that started a process: ready, watchdog, stopping, and a status line.

The manager is systemd, or any other that sets NOTIFY_SOCKET to a datagram socket (sd_notify(3)); without one nothing is
sent. Sending never blocks the loop: a manager that does not read loses notifications.
"""

import contextlib
import os
import socket
from collections.abc import Mapping

from lowfc.contract.messages import wire
from lowfc.control.loop.safety import LoopMode
from lowfc.control.loop.wording import hertz


class Supervisor:
    """The service manager, if any.

    `period_ns` is the period of watchdog signals, half the watchdog's timeout; None without a watchdog.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        """Read the manager's socket and the watchdog's timeout from the environment."""
        self.period_ns: int | None = None
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = f"\0{address[1:]}" if address.startswith("@") else address  # @: in the abstract namespace
        self._due_ns = 0
        self._sent: set[str] = set()
        timeout_us = environment.get("WATCHDOG_USEC", "")
        is_ours = environment.get("WATCHDOG_PID", "") in ("", str(os.getpid()))  # otherwise a parent's watchdog
        if self._address and timeout_us.isdecimal() and int(timeout_us) > 0 and is_ours:
            self.period_ns = int(timeout_us) * 1000 // 2

    def ready(self) -> None:
        """Notify that the process is ready."""
        self._send_once("READY=1")

    def stopping(self) -> None:
        """Notify that the process is stopping."""
        self._send_once("STOPPING=1")

    def alive(self, now_ns: int) -> None:
        """Send the watchdog signal if due; to be called only on the thread that does the process's work."""
        if self.period_ns is not None and now_ns >= self._due_ns:
            self._due_ns = now_ns + self.period_ns
            self._send("WATCHDOG=1")

    def send_status(self, health: wire.Health) -> None:
        """Send the process's status line for `systemctl status`."""
        if self._address:
            self._send(f"STATUS={status_line(health)}")

    def _send_once(self, notification: str) -> None:
        if notification not in self._sent:
            self._sent.add(notification)
            self._send(notification)

    def _send(self, notification: str) -> None:
        if not self._address:
            return
        # A manager that is gone or too slow must not stop or block the process.
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as datagrams:
            datagrams.setblocking(False)
            datagrams.sendto(notification.encode(), self._address)


def status_line(health: wire.Health) -> str:
    """State of a process, its loop mode, rate of work and recording failure (those it has), in one line."""
    parts = [health.state]
    if health.mode:
        parts.append(LoopMode(health.mode).in_words)
    parts.append(hertz(health.rate_hz))
    if health.recording.failure:
        parts.append(f"recording failed: {health.recording.failure}")
    return " ".join(", ".join(parts).split())
