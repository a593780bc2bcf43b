"""Readable text of zenoh's errors."""

import re
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from lowfc.contract.errors import BusError

_MAX_LENGTH = 200  # characters
_SOURCE_LOCATION = re.compile(r"\s*\bat /?\S+\.rs:\d+\.?")


def cause_of(fault: zenoh.ZError) -> str:
    """Cause of an error, without zenoh's source locations and component names."""
    text = _SOURCE_LOCATION.sub("", str(fault).partition("\n")[0]).strip(" .")
    if text.endswith("]") and ": [" in text:  # ": [cause]" at the end; an IPv6 address may end in "]", too
        text = text[:-1].rpartition(": [")[2]
    return text[:_MAX_LENGTH]


@contextmanager
def raising_bus_error(key: str) -> Iterator[None]:
    """Convert an error of zenoh in the block, such as for an invalid key or a closed session, to BusError."""
    try:
        yield
    except zenoh.ZError as fault:
        raise BusError(f"{key} cannot be used: {cause_of(fault)}") from None
