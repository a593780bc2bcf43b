"""Watch of a driver: faults and hanging calls are counted and reported in events; a fault delays the next call."""

import re
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lowfc.adapters.process.service import Service
from lowfc.contract.errors import ConfigurationError, LowfcError
from lowfc.contract.messages import wire

CHECK_S = 0.1  # period of the checks whether a call has returned
PAUSES_NS = (0, 100_000_000, 200_000_000, 500_000_000, 1_000_000_000, 2_000_000_000, 4_000_000_000)
"""Pause before the retry after the first, second, ... consecutive failure, ns."""
RECOVERED_NS = 1_000_000_000
"""A driver counts as recovered after this time without failure."""
REPEAT_NS = 10_000_000_000
"""Period at which a persistent fault is reported again."""
CLOSE_S = 5.0
"""Timeout of closing a driver, if longer than that of its calls."""
_HERE = Path(__file__).parent
_PROGRAMS = _HERE.parent / "programs"


def described(fault: Exception | SystemExit) -> str:
    """Describe an exception of a driver, with the file and line of the driver that raised it."""
    frames = [
        frame
        for frame in traceback.extract_tb(fault.__traceback__)
        if (path := Path(frame.filename)).parent != _HERE
        and not path.is_relative_to(_PROGRAMS)
        and "importlib" not in frame.filename
    ]
    driver_frames = [frame for frame in frames if frame.filename == frames[0].filename]
    where = f" ({Path(driver_frames[-1].filename).name}, line {driver_frames[-1].lineno})" if driver_frames else ""
    try:
        text = str(fault)
    except Exception:  # as in a driver that returns a number from `__str__`
        text = "(its __str__ fails)"
    return f"{type(fault).__name__}: {text}"[:300] + where


@contextmanager
def opening(problem: str) -> Iterator[None]:
    """Raise a driver's exception, except `LowfcError`, as a ConfigurationError that begins with `problem`."""
    try:
        yield
    except LowfcError:
        raise
    except Exception as fault:
        raise ConfigurationError(f"{problem}: {described(fault)}") from fault


@contextmanager
def closed_on_fault(close: Callable[[], None]) -> Iterator[None]:
    """Close a driver if the block, which precedes its loop, raises; a fault of `close` is not reported then."""
    try:
        yield
    except BaseException:
        with suppress(Exception):
            close()
        raise


class DriverWatch:
    """Watches the calls of one driver.

    Attributes:
        failures: number of failures since the start, including calls that did not return.
        why: the last failure, as text.
        hangs: whether the current call has exceeded its timeout.
        failed_ns: time of the last failure, ns of the host's clock.
        retry_ns: time before which the driver is not called, ns of the host's clock.
    """

    def __init__(self, service: Service, timeout_s: float, on_hang: Callable[[], None] = lambda: None) -> None:
        """Set the timeout of a call, after which `on_hang` is called on another thread."""
        self.failures = self.failed_ns = self.retry_ns = 0
        self.hangs, self.why = False, ""
        self.timeout_s = timeout_s
        self._service = service
        self._on_hang = on_hang
        self._calls = self._checked_call = self._checks = self._consecutive = self._since_recovery = 0
        self._in_call = False
        self._kind, self._reported_ns, self._fields = "", 0, wire.Health()
        self._closed = threading.Event()
        self._ending = threading.Lock()  # a call does not end while it is being reported as hanging

    @contextmanager
    def until_closed(
        self, close: Callable[[], None], fill: Callable[[wire.Health], None], finish: Callable[[], None] = lambda: None
    ) -> Iterator[None]:
        """Watch on a separate thread during the block; then call `finish`, `fill` (for the last Health) and `close`."""
        threading.Thread(target=self._run_checks, name="driver's watch", daemon=True).start()
        try:
            yield
        finally:
            self.timeout_s = max(self.timeout_s, CLOSE_S)
            self.begin()
            try:
                with suppress(LowfcError):
                    self.call(finish)
                with suppress(LowfcError):
                    self.fill(fill, wire.Health())
                close()
                self.returned()
            except Exception as fault:
                self.failed(fault)
            finally:
                self._closed.set()

    def begin(self) -> None:
        """Note that a call begins."""
        self._calls += 1
        self._in_call = True

    def returned(self) -> bool:
        """Note that the call has returned; return whether it did so in time."""
        with self._ending:
            self._in_call = False
            in_time, self.hangs = not self.hangs, False
        return in_time

    def worked(self) -> None:
        """Note that a call has returned a valid result."""
        self._consecutive = 0
        if self._since_recovery and self._service.clock.host_ns() - self.failed_ns >= RECOVERED_NS:
            self._service.event("DRIVER_BACK", count=self._since_recovery)
            self._since_recovery, self._kind = 0, ""

    def call(self, method: Callable[..., None], *arguments: object) -> None:
        """Call an optional method; count and report a fault, but raise a `LowfcError` again. No pause follows."""
        try:
            method(*arguments)
        except Exception as fault:
            self._report(fault)

    def fill(self, fill: Callable[[wire.Health], None], health: wire.Health) -> None:
        """Add the number of failures and the driver's fields to a Health; after `close`, the driver's last fields."""
        health.driver_failures = self.failures
        if not self._closed.is_set():
            self._fields.Clear()
            self.call(fill, self._fields)
        health.MergeFrom(self._fields)

    def failed(self, fault: Exception | SystemExit) -> None:
        """Note that a call raised or returned an invalid result; a `LowfcError`, for the user, is raised again."""
        self.returned()
        self._report(fault)
        self.retry_ns = self._service.clock.host_ns() + PAUSES_NS[min(self._consecutive, len(PAUSES_NS) - 1)]
        self._consecutive += 1

    def _report(self, fault: Exception | SystemExit) -> None:
        if isinstance(fault, LowfcError):
            raise fault
        self._count()
        self.why = described(fault)
        kind = re.sub(r"\d+", "", self.why)  # a message that differs only in its numbers is the same fault
        if kind != self._kind or self.failed_ns >= self._reported_ns + REPEAT_NS:
            self._kind, self._reported_ns = kind, self.failed_ns
            self._service.event("DRIVER_FAILED", why=self.why)

    def check(self) -> None:
        """Report a call that lasts for too many checks; time is not measured, as the host may have been suspended."""
        with self._ending:
            if not self._in_call or self._calls != self._checked_call:
                self._checked_call, self._checks = self._calls, 0
                return
            self._checks += 1
            if self._checks * CHECK_S >= self.timeout_s and not self.hangs:
                self.hangs, self.why = True, "the driver does not return"
                self._count()
                self._service.event("DRIVER_HANGS", hangs_s=self._checks * CHECK_S)
                self._on_hang()

    def _count(self) -> None:
        self.failures += 1
        self._since_recovery += 1
        self.failed_ns = self._service.clock.host_ns()

    def _run_checks(self) -> None:
        while not self._closed.wait(CHECK_S):
            self.check()
