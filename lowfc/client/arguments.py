"""Numbers of a request, from the arguments of a program."""

import numpy as np
import numpy.typing as npt

from lowfc.arrays import Single
from lowfc.contract.errors import RequestRefusedError

ARGUMENT_ERRORS = (ValueError, TypeError, OverflowError)
"""Errors of numpy and protobuf for an argument that is not of the required type."""


def floats(name: str, values: npt.ArrayLike) -> Single:
    """Values of any shape, in their unit, as float32; RequestRefusedError if some are not numbers."""
    try:
        return np.asarray(values, np.float32)
    except ARGUMENT_ERRORS as fault:
        raise RequestRefusedError(f"{name} refused: {fault}") from None
