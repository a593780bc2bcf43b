"""What figures of time depend on."""

import os
import platform
from pathlib import Path
from typing import Any

_CLOCK_SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")


def host() -> dict[str, Any]:
    """Processor, how many there are, kernel, clock source, Python."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.machine(),
        "processors": os.cpu_count(),
        "kernel": platform.release(),
        "clock_source": _CLOCK_SOURCE.read_text().strip() if _CLOCK_SOURCE.exists() else "not known",
        "python": platform.python_version(),
    }
