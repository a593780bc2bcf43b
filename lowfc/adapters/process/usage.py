"""Memory and processor time of a process, as the kernel reports them."""

import os
from pathlib import Path

_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_TICKS_HZ = os.sysconf("SC_CLK_TCK")


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
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS_HZ
