"""Faults of a driver: one that raises or does not return is counted, named in an event and tried again later."""

import re
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from lowfc.adapters.process.service import Service
from lowfc.contract.errors import ConfigurationError, LowfcError

LOOK_S = 0.1
PAUSES_NS = (0, 100_000_000, 200_000_000, 500_000_000, 1_000_000_000, 2_000_000_000, 4_000_000_000)
"""Pause after the first failure, the second in a row, and so on."""
STEADY_NS = 1_000_000_000
"""A driver works again when it has not failed for this long."""
AGAIN_NS = 10_000_000_000
"""Period at which a persistent fault is reported again."""
_HERE = Path(__file__).parent


def described(fault: Exception) -> str:
    """Describe an exception of a driver, with the line of the driver that raised it."""
    frames = [frame for frame in traceback.extract_tb(fault.__traceback__) if Path(frame.filename).parent != _HERE]
    its_own = [frame for frame in frames if frame.filename == frames[0].filename]
    where = f" ({Path(its_own[-1].filename).name}, line {its_own[-1].lineno})" if its_own else ""
    return f"{type(fault).__name__}: {fault}"[:300] + where


@contextmanager
def opening(what: str) -> Iterator[None]:
    """Turn any exception of a driver that is not watched yet, except `LowfcError`, into a ConfigurationError."""
    try:
        yield
    except LowfcError:
        raise
    except Exception as fault:
        raise ConfigurationError(f"{what}: {described(fault)}") from fault


class DriverWatch:
    """Watches the calls of one driver.

    Attributes:
        failures: failures since the start, calls that did not return included.
        hangs: the current call has exceeded its timeout.
        failed_ns: host's time of the last failure.
        retry_ns: host's time before which the driver is not called.
    """

    def __init__(self, service: Service, patience_s: float, hanging: Callable[[], None] = lambda: None) -> None:
        """Set the timeout of a call, after which `hanging` is called on another thread."""
        self.failures = self.failed_ns = self.retry_ns = 0
        self.hangs = False
        self.patience_s = patience_s
        self._service = service
        self._hanging = hanging
        self._calls = self._looked_at = self._looks = self._row = self._series = 0
        self._under_way = False
        self._kind, self._said_ns = "", 0
        self._ended = threading.Event()

    @contextmanager
    def over(self, close: Callable[[], None]) -> Iterator[None]:
        """Watch on a separate thread; close the driver at the end of the block in any case."""
        threading.Thread(target=self._look_on, name="driver's watch", daemon=True).start()
        try:
            yield
        finally:
            self._ended.set()
            try:
                close()
            except Exception as fault:
                self.failed(fault)

    def begin(self) -> None:
        """A call begins."""
        self._calls += 1
        self._under_way = True

    def returned(self) -> bool:
        """Note that the call has returned; return whether it did so in time."""
        self._under_way = False
        in_time, self.hangs = not self.hangs, False
        return in_time

    def worked(self) -> None:
        """Note that a call returned a valid result."""
        self._row = 0
        if self._series and self._service.clock.host_ns() - self.failed_ns >= STEADY_NS:
            self._service.event("DRIVER_BACK", count=self._series)
            self._series, self._kind = 0, ""

    def failed(self, fault: Exception) -> None:
        """Note that a call raised or returned nonsense; a `LowfcError`, for a user to correct, is raised again."""
        self._under_way = self.hangs = False
        if isinstance(fault, LowfcError):
            raise fault
        self.retry_ns = self._service.clock.host_ns() + PAUSES_NS[min(self._row, len(PAUSES_NS) - 1)]
        self._row += 1
        self._count()
        why = described(fault)
        kind = re.sub(r"\d+", "", why)  # the same fault with other numbers counts as the same
        if kind != self._kind or self.failed_ns >= self._said_ns + AGAIN_NS:
            self._kind, self._said_ns = kind, self.failed_ns
            self._service.event("DRIVER_FAILED", why=why)

    def look(self) -> None:
        """Report a call that lasts too many checks; checks are counted because the host may have stood still."""
        if not self._under_way or self._calls != self._looked_at:
            self._looked_at, self._looks = self._calls, 0
            return
        self._looks += 1
        if self._looks * LOOK_S >= self.patience_s and not self.hangs:
            self.hangs = True
            self._count()
            self._service.event("DRIVER_HANGS", hangs_s=self._looks * LOOK_S)
            self._hanging()

    def _count(self) -> None:
        self.failures += 1
        self._series += 1
        self.failed_ns = self._service.clock.host_ns()

    def _look_on(self) -> None:
        while not self._ended.wait(LOOK_S):
            self.look()
