"""What a calibration or a law is, whatever it is called: a hash of everything in it."""

import hashlib
from dataclasses import fields
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def identity(value: "DataclassInstance") -> str:
    """SHA-256 of every field but `id`; an array without numbers is as if it were not there."""
    digest = hashlib.sha256()
    for part in fields(value):
        found = getattr(value, part.name)
        if part.name != "id" and not (isinstance(found, np.ndarray) and not found.size):
            digest.update(part.name.encode())
            digest.update(found.tobytes() if isinstance(found, np.ndarray) else repr(found).encode())
    return digest.hexdigest()
