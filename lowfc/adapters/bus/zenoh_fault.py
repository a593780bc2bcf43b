"""Readable text of zenoh's errors."""

import re

import zenoh

_LONGEST = 200  # characters
_PLACE = re.compile(r"\s*\bat /?\S+\.rs:\d+\.?")


def plain(fault: zenoh.ZError) -> str:
    """Cause of an error, without zenoh's source locations and component names."""
    text = _PLACE.sub("", str(fault).partition("\n")[0])
    cause = text.rpartition("[")[2].partition("]")[0] or text
    return cause.strip(" .[]")[:_LONGEST]
