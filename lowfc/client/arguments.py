"""Arguments of a request, as a program passes them."""

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Single
from lowfc.contract.errors import RequestRefusedError, brief, raised_as

T = TypeVar("T")
ARGUMENT_ERRORS = (ValueError, TypeError, OverflowError)
"""Errors of numpy and protobuf for an argument that is not of the required type."""


def floats(name: str, values: npt.ArrayLike) -> Single:
    """Values of any shape, in any unit, as float32; RequestRefusedError if some are not real numbers."""
    with raised_as(RequestRefusedError, ARGUMENT_ERRORS, f"{name} refused"):
        return np.asarray(real(values), np.float32)


def real(values: npt.ArrayLike) -> npt.ArrayLike:
    """Values of any shape, in any unit; TypeError if complex or masked: numpy would drop imaginary part or mask."""
    if np.iscomplexobj(values) or np.ma.is_masked(values):
        raise TypeError("expected real numbers without a mask, got complex or masked ones")
    return values


def checked_type(name: str, value: object, kind: type[T]) -> T:
    """Return `value`, an argument of a request; RequestRefusedError if its type is not `kind`."""
    if not isinstance(value, kind):
        raise RequestRefusedError(f"{name} refused: expected {kind.__name__}, got {brief(value)}")
    return value
