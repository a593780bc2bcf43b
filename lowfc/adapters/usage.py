"""What a process uses of its host, as the kernel tells it."""

import os
from pathlib import Path
from typing import NamedTuple

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_TICKS_HZ = os.sysconf("SC_CLK_TCK")


class Used(NamedTuple):
    """What /proc/PID/stat says of a process.

    Attributes:
        name: of its program.
        started: in the kernel's ticks since boot.
        processor_s: time that it has used, all its threads, seconds.
    """

    name: str
    started: int
    processor_s: float


def used(stat: str) -> Used:
    """Read a line of /proc/PID/stat; the name may hold blanks and brackets."""
    name, _, rest = stat.partition("(")[2].rpartition(")")
    fields = rest.split()
    return Used(name, int(fields[19]), (int(fields[11]) + int(fields[12])) / _TICKS_HZ)


def resident_bytes(process: int | str = "self") -> int:
    """Resident memory of a process, by its number.

    Raises:
        OSError: there is no such process.
    """
    with open(f"/proc/{process}/statm", "rb") as file:  # noqa: PTH123  # the loop calls it; Path costs more than the read
        return int(file.read().split()[1]) * _PAGE_BYTES


def processor_s(process: int) -> float:
    """Processor time that a process has used, all its threads, seconds.

    Raises:
        OSError: there is no such process.
    """
    return used(Path(f"/proc/{process}/stat").read_text()).processor_s
