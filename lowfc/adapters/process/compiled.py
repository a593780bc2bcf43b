"""The fused step compiled by numba (extra `fast`), before the first frame."""

import importlib.util
from functools import cache
from typing import Any

from lowfc.adapters.process.extras import install_advice
from lowfc.control.kernel import functions
from lowfc.control.kernel.tables import FUSED, NUMPY, Kernel

FASTMATH = frozenset({"reassoc", "contract"})
"""What of fast-math is allowed: NaN and infinity stay visible, and the same binary gives the same bytes."""


def available() -> bool:
    """Whether the fused step can be compiled here."""
    return importlib.util.find_spec("numba") is not None


def missing() -> str:
    """What to do where it cannot."""
    return f"the fused step needs numba: {install_advice('fast')}"


@cache
def kernel(name: str) -> Kernel:
    """The kernel of that name, ready for use; without numba, numpy's.

    The first use on a host compiles for some seconds; later ones load what was compiled, where that could be kept.
    """
    return Kernel(FUSED, *_compiled()) if name == FUSED and available() else NUMPY


def _compiled() -> list[Any]:
    import numba
    from numba import types

    njit: Any = numba.njit

    def array(kind: Any, dimensions: int, *, readonly: bool = True) -> Any:
        return types.Array(kind, dimensions, "C", readonly=readonly)

    real, flag, single = types.float64, types.boolean, types.float32
    counts, line, plane = array(types.uint16, 1), array(single, 1), array(single, 2)
    result, surface = array(single, 1, readonly=False), array(single, 2, readonly=False)
    law = (plane, line, plane, plane, flag)
    signatures = {
        functions.measure: real(counts, counts, line, plane, result, line, types.int64, real, real, result),
        functions.respond: flag(*(line,) * 5, *law, *(plane,) * 3, *(real,) * 3, result, surface),
    }
    options: dict[str, Any] = {"fastmath": set(FASTMATH), "error_model": "numpy"}
    found = []
    for function, signature in signatures.items():
        try:
            found.append(njit(signature, cache=True, **options)(function))
        except RuntimeError:  # no folder in which it may be kept
            found.append(njit(signature, **options)(function))
    return found
