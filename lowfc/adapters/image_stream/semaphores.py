"""POSIX semaphores in shared memory, through the functions of the C library."""

import ctypes
import errno
import mmap
import time

from lowfc.adapters.image_stream.layout import SEMAPHORE_BYTES

MAX_VALUE = 10
"""Value at which a semaphore is no longer posted: its reader is behind or absent."""

_LIBC = ctypes.CDLL(None, use_errno=True)
_SHARING_MODE = slice(8, 12)  # bytes of a semaphore that no operation changes


class _TimeSpec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class Semaphores:
    """An array of semaphores."""

    def __init__(self, mapping: mmap.mmap, start: int, count: int) -> None:
        """Use `count` semaphores from byte `start` of the mapping, which stays mapped as long as this object exists."""
        self._memory = (ctypes.c_char * (SEMAPHORE_BYTES * count)).from_buffer(mapping, start)
        first = ctypes.addressof(self._memory)
        self._addresses = [ctypes.c_void_p(first + SEMAPHORE_BYTES * index) for index in range(count)]
        self._value = ctypes.c_int()
        self._end = _TimeSpec()

    def initialise(self) -> None:
        """Initialise the semaphores to zero, shared between processes."""
        for address in self._addresses:
            _LIBC.sem_init(address, 1, 0)

    def usable(self) -> bool:
        """Whether this C library created the semaphores; it aborts a process that uses another library's."""
        fresh = ctypes.create_string_buffer(SEMAPHORE_BYTES)
        _LIBC.sem_init(fresh, 1, 0)
        memory = self._memory.raw
        starts = range(0, len(memory), SEMAPHORE_BYTES)
        return all(
            memory[start : start + SEMAPHORE_BYTES][_SHARING_MODE] == fresh.raw[_SHARING_MODE] for start in starts
        )

    def value(self, index: int) -> int:
        """Value of a semaphore: number of posts not yet consumed."""
        _LIBC.sem_getvalue(self._addresses[index], ctypes.byref(self._value))
        return self._value.value

    def wait(self, index: int, timeout_s: float) -> bool:
        """Wait for a post and consume it; False after the timeout or a signal."""
        end_ns = time.monotonic_ns() + int(timeout_s * 1e9)
        self._end.seconds, self._end.nanoseconds = divmod(end_ns, 1_000_000_000)
        return bool(_LIBC.sem_clockwait(self._addresses[index], time.CLOCK_MONOTONIC, ctypes.byref(self._end)) == 0)

    def drain(self, index: int) -> None:
        """Consume all pending posts."""
        for _ in range(self.value(index)):
            if _LIBC.sem_trywait(self._addresses[index]) and ctypes.get_errno() == errno.EAGAIN:
                return

    def post_all(self) -> list[int]:
        """Post each semaphore except those at `MAX_VALUE`; return the indices posted."""
        value, reference = self._value, ctypes.byref(self._value)
        posted = []
        for index, address in enumerate(self._addresses):
            _LIBC.sem_getvalue(address, reference)
            if value.value < MAX_VALUE:
                _LIBC.sem_post(address)
                posted.append(index)
        return posted
