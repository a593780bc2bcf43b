"""The fused step, compiled by numba (extra `fast`) before the first frame."""

import importlib.util
import threading
from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from lowfc.adapters.process.extras import install_advice
from lowfc.arrays import Pixels, Sequences, Single
from lowfc.control.kernel import functions
from lowfc.control.kernel.tables import FUSED, NUMPY, Kernel

FASTMATH = frozenset({"reassoc", "contract"})
"""Permitted parts of fast-math: they preserve NaN and infinity, and the same binary gives the same bytes."""
SHARED_BYTES = 8 << 20
"""Size of R from which threads share a frame; for a smaller R, waking the threads takes longer than they save."""


def available() -> bool:
    """Whether numba, which compiles the fused step, is installed."""
    return importlib.util.find_spec("numba") is not None


def advice() -> str:
    """Reason why the fused step cannot be compiled, and what to do; to be called only if it cannot."""
    if not available():
        return f"the fused step needs numba: {install_advice('fast')}"
    try:
        importlib.import_module("numba")
    except ImportError as fault:  # it may be too old for numpy
        upgrade = install_advice("fast").replace("install ", "install --upgrade ")
        return f"numba cannot be imported ({fault}); upgrade it: {upgrade}"
    return "this host forbids compiling at run time: allow memory that is writable and executable"


@cache
def kernel(name: str, threads: int = 1) -> Kernel:
    """Return the kernel of that name, compiled; numpy's if that is not possible.

    The first call on a host compiles for some seconds; later ones load the cached result. The threads share the pass
    over a large frame; their number does not change the result.
    """
    if name != FUSED or not available():
        return NUMPY
    try:
        measure, respond, measure_blocks = _compiled()
    except (ImportError, PermissionError):  # PermissionError: by SELinux, or in a unit with MemoryDenyWriteExecute
        return NUMPY
    return Kernel(FUSED, measure if threads == 1 else Pool(measure, measure_blocks, threads).measure, respond)


class Pool:
    """Threads that share the pass over large frames and sleep in between; they inherit this process's scheduling."""

    def __init__(self, measure: Callable[..., float], measure_blocks: Callable[..., None], threads: int) -> None:
        """Start the threads; the calling thread is one of `threads`."""
        self._measure = measure
        self._measure_blocks = measure_blocks
        self._work: tuple[Any, ...] = ()
        self._scratch = [np.empty(0, np.float32)] * (threads - 1)
        self._shares: list[tuple[int, int]] = []
        self._locks = [(threading.Lock(), threading.Lock()) for _ in range(threads - 1)]  # go and done of each thread
        for number, go_and_done in enumerate(self._locks):
            for lock in go_and_done:
                lock.acquire()
            threading.Thread(target=self._share, args=(number, *go_and_done), name="fused step", daemon=True).start()

    def measure(
        self,
        pixels: Pixels,
        good: Pixels,
        dark: Single,
        tiles: Single,
        scratch: Single,
        sums_nm: Single,
        totals: Sequences,
        *rest: Any,
    ) -> float:
        """Do the same as `lowfc.control.kernel.functions.measure`; the threads share the pass over a large frame."""
        scanned = pixels, good, dark, tiles, scratch, sums_nm, totals
        if tiles.nbytes < SHARED_BYTES:
            return self._measure(*scanned, *rest)
        if self._scratch[0].size != scratch.size or self._shares[-1][1] != len(totals):
            threads = len(self._locks) + 1
            edges = [len(totals) * number // threads for number in range(threads + 1)]
            self._shares = list(pairwise(edges))
            self._scratch = [np.empty(scratch.size, np.float32) for _ in self._locks]
        self._work = scanned
        for go, _ in self._locks:
            go.release()
        first, last = self._shares[-1]
        self._measure_blocks(pixels, good, dark, tiles, scratch, first, last, sums_nm, totals)
        for _, done in self._locks:
            done.acquire()
        return self._measure(pixels[:0], *scanned[1:], *rest)  # without pixels, it uses the sums computed above

    def _share(self, number: int, go: threading.Lock, done: threading.Lock) -> None:
        """Process this thread's share of each frame."""
        while go.acquire():
            pixels, good, dark, tiles, _, sums_nm, totals = self._work
            first, last = self._shares[number]
            self._measure_blocks(pixels, good, dark, tiles, self._scratch[number], first, last, sums_nm, totals)
            done.release()


def _compiled() -> list[Any]:
    import numba
    from numba import types
    from numba.extending import register_jitable

    njit: Any = numba.njit

    def array(kind: Any, dimensions: int, *, readonly: bool = True) -> Any:
        return types.Array(kind, dimensions, "C", readonly=readonly)

    real, flag, single, whole = types.float64, types.boolean, types.float32, types.int64
    counts, line, plane = array(types.uint16, 1), array(single, 1), array(single, 2)
    line_out, plane_out = array(single, 1, readonly=False), array(single, 2, readonly=False)
    law, totals = (plane, line, plane, plane, flag), array(types.uint64, 2, readonly=False)
    frame = counts, counts, line, plane, line_out
    signatures = {
        functions.measure: real(*frame, plane_out, totals, line, whole, real, real, line_out),
        functions.respond: flag(*(line,) * 5, *law, *(plane,) * 3, *(real,) * 3, line_out, plane_out),
        functions.measure_blocks: types.void(*frame, whole, whole, plane_out, totals),
    }
    options: dict[str, Any] = {"fastmath": set(FASTMATH), "error_model": "numpy"}
    for called in (functions.scan, functions.measure_blocks):
        register_jitable(**options)(called)
    compiled = []
    for function, signature in signatures.items():
        gil = {"nogil": function is functions.measure_blocks}
        try:
            compiled.append(njit(signature, cache=True, **options, **gil)(function))
        except RuntimeError:  # no writable cache folder
            compiled.append(njit(signature, **options, **gil)(function))
    return compiled
