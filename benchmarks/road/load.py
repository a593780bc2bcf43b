"""A background load that anybody can run: for each processor, one process that moves memory, one that writes files.

All are of the normal class. The first moves 64 MB back and forth without a pause; the second writes and syncs 4 MB,
sorts numbers for a while and sleeps for up to 20 ms, over and over.

    python -m benchmarks.road.load memory FOLDER NUMBER
"""

import contextlib
import os
import random
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from lowfc.adapters.child import Child
from lowfc.adapters.usage import processor_s

ROOT = Path(__file__).parents[2]
WHAT = (
    "for each processor a process that copies 64 MB back and forth without a pause, and one that writes and syncs "
    "4 MB, sorts 100000 numbers and sleeps up to 20 ms, over and over; all in the normal class"
)

_BYTES, _WRITTEN_BYTES, _SORTED = 64 << 20, 4 << 20, 100_000
_SLEEP_S = 0.02
_READY_S, _LOOK_S = 20.0, 0.02


class Load:
    """The load's processes."""

    def __init__(self, children: Sequence[Child]) -> None:
        self._children = children

    def used_s(self) -> float:
        """Processor time that they have used, seconds.

        Raises:
            RuntimeError: one of them has ended.
        """
        for child in self._children:
            if child.process is None or child.status is not None:
                raise RuntimeError(f"{child.how_it_ended()}\n{child.last_words()}")
        return sum(processor_s(child.process.pid) for child in self._children if child.process is not None)


@contextlib.contextmanager
def background(processors: int | None = None) -> Iterator[Load]:
    """Keep the host busy; returns when every process works.

    Raises:
        RuntimeError: one of them does not.
    """
    with tempfile.TemporaryDirectory(prefix="lowfc-load-") as name:
        folder = Path(name)
        count = len(os.sched_getaffinity(0)) if processors is None else processors
        children = [
            Child(
                f"{work} {number}",
                [sys.executable, "-m", "benchmarks.road.load", work, name, str(number)],
                folder / f"{work}-{number}.stderr",
                {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"},
            )
            for number in range(count)
            for work in WORKS
        ]
        load = Load(children)
        try:
            for child in children:
                child.start()
            deadline_s = time.monotonic() + _READY_S
            while sum(1 for _ in folder.glob("ready-*")) < len(children):
                load.used_s()
                if time.monotonic() > deadline_s:
                    raise RuntimeError(f"the load did not begin within {_READY_S:g} s")
                time.sleep(_LOOK_S)
            yield load
        finally:
            for child in children:
                child.stop(1.0)


def _move_memory(ready: Path, _: Path, __: int) -> None:
    here, there = np.ones(_BYTES, np.uint8), np.empty(_BYTES, np.uint8)
    ready.touch()
    while True:
        np.copyto(there, here)
        np.copyto(here, there)


def _write_and_sleep(ready: Path, file: Path, seed: int) -> None:
    chance = random.Random(seed)  # noqa: S311  # not a secret
    content = os.urandom(_WRITTEN_BYTES)
    numbers = np.random.default_rng(seed).random(_SORTED)
    ready.touch()
    while True:
        with file.open("wb") as stream:
            stream.write(content)
            stream.flush()
            os.fsync(stream.fileno())
        np.sort(numbers)
        time.sleep(chance.uniform(0, _SLEEP_S))


WORKS = {"memory": _move_memory, "files": _write_and_sleep}


def main() -> None:
    """One process of the load, until it is told to end."""
    work, name, number = sys.argv[1:]
    folder = Path(name)
    WORKS[work](folder / f"ready-{work}-{number}", folder / f"written-{number}", int(number))


if __name__ == "__main__":
    main()
