"""A reservation of the loop for one client; a thread renews it until it is released."""

import contextlib
import secrets
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from lowfc.adapters.process.host import by_this_process
from lowfc.contract.errors import BusError, CalibrationError, LowfcError, RequestRefusedError
from lowfc.control.loop.lease import LEASE_OVER, MAX_S, REMAINING_TIME_SEPARATOR

if TYPE_CHECKING:
    from lowfc.adapters.process.progress import ProgressCallback

DURATION_S = 10.0
"""Time in force without renewal: after the holder's death, other clients are refused for this long."""
RENEWAL_S = 0.5
"""Time between renewals, by this host's clock."""


def new_identity() -> int:
    """Make the identity of a reservation: a random number above 0."""
    return secrets.randbits(63) | 1


class Lease:
    """A reservation of the loop, from its construction to `release`; the holder's requests carry its `id`."""

    def __init__(self, ask: Callable[..., object], purpose: str, duration_s: float | None, *, lockstep: bool) -> None:
        """Reserve the loop for a purpose such as "lowfc calibrate", with its expected duration, or None if unknown.

        `ask` sends the requests. In lockstep a reservation ends by the loop's time, which may run a hundred times
        faster than the host's clock, so each renewal lasts as long as the controller allows.

        Raises:
            RequestRefusedError: another client has reserved the loop, or the loop is in safe mode.
            BusError: no controller is running.
        """
        self.id = new_identity()
        self._ask = ask
        self._purpose = by_this_process(purpose)
        self._in_force_s = MAX_S if lockstep else DURATION_S
        self._end_s = None if duration_s is None else time.monotonic() + duration_s
        self._ended = ""
        self._lock = threading.Lock()
        self._done = threading.Event()
        self._reserve("lease")
        self._thread = threading.Thread(target=self._renew, name="lease", daemon=True)
        self._thread.start()

    def expect(self, duration_s: float) -> None:
        """Set the expected remaining duration."""
        self._end_s = time.monotonic() + duration_s

    def expecting(self, progress: "ProgressCallback", rate_hz: float) -> "ProgressCallback":
        """Wrap a progress callback that counts frames, so that other clients can read the remaining time."""

        def count(what: str, done: int, total: int) -> None:
            self.expect((total - done) / rate_hz)
            progress(what, done, total)

        return count

    def check(self) -> None:
        """Renew the reservation now; CalibrationError with the reason if it has ended, BusError without an answer."""
        with self._lock:
            if not self._ended:
                try:
                    self._reserve("renew")
                except RequestRefusedError as fault:
                    self._ended = str(fault).removeprefix("renew refused: ").removeprefix(LEASE_OVER)
            if self._ended:
                raise CalibrationError(f"the reservation of the loop ended: {self._ended}")

    def release(self) -> None:
        """End the reservation."""
        self._done.set()
        self._thread.join()
        with contextlib.suppress(LowfcError):
            self._ask("release", values=0.0, lease_id=self.id)

    def _renew(self) -> None:
        while not self._done.wait(RENEWAL_S):
            try:
                self.check()
            except BusError:
                continue  # the controller may come back; the next request reports the fault
            except CalibrationError:
                return

    def _reserve(self, request: str) -> None:
        holder = self._purpose
        if self._end_s is not None:
            holder += f"{REMAINING_TIME_SEPARATOR}{max(0.0, self._end_s - time.monotonic()):.0f} s to go"
        self._ask(request, values=self._in_force_s, text=holder, lease_id=self.id)
