"""Identity of a calibration, a law or a table: a hash of its content."""

import hashlib
from collections.abc import Iterable

import numpy as np


def identity(parts: Iterable[tuple[str, object]]) -> str:
    """SHA-256 of named parts in their order; empty arrays and None are skipped.

    The names are those of release 0.1 and never change, so that the content of files and logs keeps its identity.
    """
    digest = hashlib.sha256()
    for name, value in parts:
        if value is None or (isinstance(value, np.ndarray) and not value.size):
            continue
        digest.update(name.encode())
        if isinstance(value, np.ndarray):
            digest.update(value.tobytes())
        else:
            digest.update(repr(value).encode())
    return digest.hexdigest()
