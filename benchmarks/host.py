"""What figures of time depend on."""

from typing import Any

from lowfc.adapters.host import Host
from lowfc.adapters.provenance import provenance


def host() -> dict[str, Any]:
    """Processor, how many there are, kernel, clock source, Python."""
    known = provenance()
    try:
        clock_source = Host().clock_source()
    except OSError:
        clock_source = "not known"
    return {
        "processor": known["processor"],
        "processors": int(known["processors"]),
        "kernel": known["kernel"],
        "clock_source": clock_source,
        "python": known["python"],
    }
