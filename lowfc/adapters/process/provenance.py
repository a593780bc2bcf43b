"""Provenance of results: versions, host, processor and linear algebra library."""

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
    """Versions and host of a run: the same for every run of an installation on a host, except for run and seed.

    Args:
        run_id: name of the run; empty for none.
        seed: seed of a simulated run.

    Returns:
        Versions by library, and lowfc, python, host, kernel, processor, processors, cpu_features (the processor's
        vector instructions) and blas (library, version and the kernel chosen for this processor); numba, run, seed and
        git (`git describe` of a checkout) where there is one.
    """
    entries = {
        "lowfc": __version__,
        "python": platform.python_version(),
        "host": platform.node(),
        "kernel": platform.release(),
        "processor": _cpuinfo("model name", "Model") or platform.machine(),
        "processors": str(os.cpu_count()),
        "cpu_features": " ".join(
            sorted({flag for flag in _cpuinfo("flags", "Features").split() if flag.startswith(_SIMD)})
        ),
        "blas": _blas(),
        **{library: importlib.metadata.version(library) for library in LIBRARIES},
    }
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        entries["numba"] = importlib.metadata.version("numba")
    if run_id:
        entries["run"] = run_id
    if seed is not None:
        entries["seed"] = str(seed)
    if commit := _commit():
        entries["git"] = commit
    return entries


def _cpuinfo(*names: str) -> str:
    """First value in /proc/cpuinfo with one of these names; empty if there is none."""
    with Path("/proc/cpuinfo").open() as lines:
        for line in lines:
            name, _, value = line.partition(":")
            if name.strip() in names:
                return value.strip()
    return ""


def _blas() -> str:
    """BLAS library used by numpy; scipy's own, if loaded, is not used in the loop."""
    loaded = [library for library in threadpool_info() if library["user_api"] == "blas"]
    numpy_blas = [library for library in loaded if Path(library["filepath"]).is_relative_to(_NUMPY / "numpy.libs")]
    names = {
        " ".join(str(library[key]) for key in ("internal_api", "version", "architecture") if library.get(key))
        for library in numpy_blas or loaded
    }
    return ", ".join(sorted(names))


def _commit() -> str:
    checkout = Path(__file__).parents[3]
    git = shutil.which("git")
    if git is None or not (checkout / ".git").exists():
        return ""
    try:
        result = subprocess.run(  # noqa: S603  # a fixed command
            [git, "-C", str(checkout), "describe", "--always", "--dirty", "--tags"],
            capture_output=True,
            text=True,
            timeout=5,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):  # a slow disk must not keep the recorder from starting
        return ""
    return result.stdout.strip()
