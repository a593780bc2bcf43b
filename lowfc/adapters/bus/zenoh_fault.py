"""Zenoh's errors, for people."""

import re

import zenoh

_LONGEST = 200  # characters
_PLACE = re.compile(r"\s*\bat /?\S+\.rs:\d+\.?")


def plain(fault: zenoh.ZError) -> str:
    """The cause, without the places in zenoh's sources and the names of its parts."""
    text = _PLACE.sub("", str(fault).splitlines()[0])
    cause = text.rpartition("[")[2].partition("]")[0] or text
    return cause.strip(" .[]")[:_LONGEST]
