"""A hand-off between two processes of one host: the newest of a few slots in shared memory, and a wake-up."""

import ctypes
import mmap
import os
from collections.abc import Callable
from pathlib import Path

_SLOTS = 8
_SLOT_HEAD_BYTES = 32  # number, time, length
_SEMAPHORE_OFFSET = 64  # before it the newest number, in a line of its own
_BODY_OFFSET = 128

WAKES = ("semaphore", "pipe")


class Ring:
    """One process puts, one takes the newest; a message is lost where the taker is more than one behind.

    A slot's number is written after its content and looked at again after the content was copied, so that nobody takes
    half of one message and half of another. That holds on processors that keep the order of stores (x86).
    """

    def __init__(self, path: Path, most_bytes: int, wake: str, *, make: bool) -> None:
        """Open the ring in a file of a memory file system; one side makes it, before the other opens it.

        Args:
            path: of the file.
            most_bytes: of a payload.
            wake: one of `WAKES`.
            make: this side makes it.
        """
        self._stride = _SLOT_HEAD_BYTES + (most_bytes + 7) // 8 * 8
        size = _BODY_OFFSET + _SLOTS * self._stride
        if make:
            path.write_bytes(bytes(size))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), size)
        self._words = memoryview(self._memory).cast("Q")
        self._taken = 0
        signal = _semaphore(self._memory, make=make) if wake == "semaphore" else _pipe(path, make=make)
        self._post, self._wait = signal

    def put(self, number: int, time_ns: int, payload: bytes) -> None:
        """Leave a message and wake who waits for it; numbers grow, from 1."""
        start = _BODY_OFFSET + number % _SLOTS * self._stride
        words, word = self._words, start // 8
        words[word] = 0
        words[word + 1] = time_ns
        words[word + 2] = len(payload)
        body = start + _SLOT_HEAD_BYTES
        self._memory[body : body + len(payload)] = payload
        words[word] = words[0] = number
        self._post()

    def take(self) -> tuple[int, int, bytes]:
        """Wait for a message newer than the last taken; its number, time and payload."""
        words = self._words
        while True:
            number = words[0]
            if number == self._taken:
                self._wait()
                continue
            start = _BODY_OFFSET + number % _SLOTS * self._stride
            word, body = start // 8, start + _SLOT_HEAD_BYTES
            time_ns = words[word + 1]
            payload = self._memory[body : body + words[word + 2]]
            if words[word] == number:  # else it was overwritten while it was copied: there is a newer one
                self._taken = number
                return number, time_ns, payload


Signal = tuple[Callable[[], object], Callable[[], object]]


def _semaphore(memory: mmap.mmap, *, make: bool) -> Signal:
    """A POSIX semaphore in the shared memory. Posting keeps the interpreter's lock, for it is soon done."""
    waiting, posting = ctypes.CDLL(None), ctypes.PyDLL(None)
    place = ctypes.c_void_p(ctypes.addressof(ctypes.c_char.from_buffer(memory, _SEMAPHORE_OFFSET)))
    if make and waiting.sem_init(place, 1, 0) != 0:
        raise OSError("this host has no semaphores in shared memory")
    post, wait = posting.sem_post, waiting.sem_wait
    return lambda: post(place), lambda: wait(place)


def _pipe(path: Path, *, make: bool) -> Signal:
    """A named pipe beside the file."""
    name = path.with_suffix(".wake")
    if make:
        os.mkfifo(name)
    pipe = os.open(name, os.O_RDWR)  # of both sides, so that opening waits for nobody
    return lambda: os.write(pipe, b"\0"), lambda: os.read(pipe, 64)
