"""Origin of figures: versions, host, processor and linear algebra, by which two runs can be told apart."""

import contextlib
import importlib.metadata
import os
import platform
import shutil
import subprocess
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_info

from lowfc import __version__

LIBRARIES = ("numpy", "scipy", "eclipse-zenoh", "mcap", "protobuf", "foxglove-schemas-protobuf", "lz4")

_NUMPY = Path(np.__file__).resolve().parents[1]
_SIMD = ("sse", "ssse", "avx", "fma", "f16c", "amx", "neon", "asimd", "sve", "fphp")


def provenance(run_id: str = "", seed: int | None = None) -> dict[str, str]:
    """Versions and host of a run; they stay the same while host and installation do.

    Args:
        run_id: of the run; empty for none.
        seed: of a simulated run.

    Returns:
        Versions by library, and lowfc, python, host, kernel, processor, processors, cpu_features (the processor's
        vector instructions) and blas (library, version and the kernel chosen for this processor); numba, run, seed and
        git (commit of a checkout) where there is one.
    """
    found = {
        "lowfc": __version__,
        "python": platform.python_version(),
        "host": platform.node(),
        "kernel": platform.release(),
        "processor": _of_the_processor("model name", "Model") or platform.machine(),
        "processors": str(os.cpu_count()),
        "cpu_features": " ".join(
            sorted({flag for flag in _of_the_processor("flags", "Features").split() if flag.startswith(_SIMD)})
        ),
        "blas": _blas(),
        **{library: importlib.metadata.version(library) for library in LIBRARIES},
    }
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        found["numba"] = importlib.metadata.version("numba")
    if run_id:
        found["run"] = run_id
    if seed is not None:
        found["seed"] = str(seed)
    if commit := _commit():
        found["git"] = commit
    return found


def _of_the_processor(*names: str) -> str:
    """Value of the first line of /proc/cpuinfo with one of these names; empty without one."""
    with Path("/proc/cpuinfo").open() as lines:
        for line in lines:
            name, _, value = line.partition(":")
            if name.strip() in names:
                return value.strip()
    return ""


def _blas() -> str:
    """The linear algebra that numpy calls; scipy's own, where it is loaded too, is not in the loop."""
    loaded = [library for library in threadpool_info() if library["user_api"] == "blas"]
    of_numpy = [library for library in loaded if Path(library["filepath"]).is_relative_to(_NUMPY / "numpy.libs")]
    names = {
        " ".join(str(library[key]) for key in ("internal_api", "version", "architecture") if library.get(key))
        for library in of_numpy or loaded
    }
    return ", ".join(sorted(names))


def _commit() -> str:
    checkout = Path(__file__).parents[3]
    git = shutil.which("git")
    if git is None or not (checkout / ".git").exists():
        return ""
    done = subprocess.run(  # noqa: S603  # a fixed command
        [git, "-C", str(checkout), "describe", "--always", "--dirty", "--tags"],
        capture_output=True,
        text=True,
        timeout=5,
        check=False,
    )
    return done.stdout.strip()
