"""The implementations compared, and their requirements on this host."""

import argparse
import contextlib
import importlib.metadata
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from benchmarks.peers import shared
from benchmarks.sizes import FRAMES
from lowfc.adapters.process import compiled
from lowfc.control.kernel.tables import FUSED as FUSED_KERNEL
from lowfc.control.kernel.tables import KERNELS

CHAIN, ZENOH, PYRTCAO = "chain.c", "plain_zenoh", "pyrtcao_loop"
FUSED = f"lowfc, {FUSED_KERNEL}"

_CONSTANTS = ("SIDE", "PIXELS", "MODES", "MIRROR_SIDE", "ACTUATORS", "GAIN", "LEAK", "LIMIT_NM")  # of the C chain
_LIMIT_ONLY = "limit of each mode"


class ComparisonError(Exception):
    """An implementation did not start, did not end or sent no command."""


@dataclass(frozen=True)
class Implementation:
    """An implementation of the loop: description, log, protection of the mirror, use across machines.

    `roles` are its processes, in the order of their start; a run ends when the source of frames ends. lowfc starts its
    own processes and has a `kernel` instead.
    """

    name: str
    description: str
    log: str
    safety: str
    multi_host: str
    roles: tuple[str, ...] = ()
    program: str = ""
    kernel: str = ""


def _pyrtcao(name: str, description: str, safety: str, *roles: str) -> Implementation:
    log = "its streams keep the newest frame; its telemetry recorder reads them"
    return Implementation(f"pyrtcao, {name}", description, log, safety, "no; can be commanded remotely", roles, PYRTCAO)


def _lowfc(kernel: str) -> Implementation:
    return Implementation(
        f"lowfc, {kernel}",
        "its own controller and simulated mirror; `lowfc latency` runs them with the comparison's prepared frames",
        log="every frame, command, mirror state and step is published for a recorder; bit-exact replay",
        safety="late, dark, saturated and identical frames refused, missing ones bridged; limits of modal command, "
        "stroke, slew and difference of neighbours, the last three in the mirror too; command timeout",
        multi_host="yes, mutual TLS",
        kernel=kernel,
    )


IMPLEMENTATIONS = (
    Implementation(
        "C chain",
        "four C processes over ImageStreamIO between source and mirror: pixels minus reference image, "
        "6400 x 20 product, integrator, modes to actuators; CACAO's stages without its process control",
        "its streams keep the newest frame; a logger may read them",
        _LIMIT_ONLY,
        "no",
        ("source", "acquire", "product", "filter", "actuators", "mirror"),
        CHAIN,
    ),
    Implementation(
        "zenoh",
        "zenoh, with sessions and publishers set up as lowfc's; the step in numpy, in the subscriber's callback",
        "any process may subscribe",
        _LIMIT_ONLY,
        "yes",
        ("source", "controller"),
        ZENOH,
    ),
    _pyrtcao(
        "stock",
        "WavefrontSensor, a component that computes the signal from the pixels, Loop.leaky_integrator and "
        "WavefrontCorrector, each a process; the command is modes, which the corrector converts to actuators",
        "none here; an optional limit of all actuators (`command_cap`)",
        *("modal_mirror", "source", "signal", "loop"),
    ),
    _pyrtcao(
        "fused",
        "WavefrontSensor, one component with the whole step compiled by numba, and WavefrontCorrector, each a process",
        _LIMIT_ONLY,
        *("mirror", "source", "fused"),
    ),
    *map(_lowfc, KERNELS),
)


def program(implementation: Implementation, options: argparse.Namespace, folder: Path) -> list[str]:
    """The program of an implementation's processes; the C chain is compiled into the folder."""
    if implementation.program != CHAIN:
        python = options.pyrtcao if implementation.program == PYRTCAO else sys.executable
        return [python, "-m", f"{__package__}.{implementation.program}"]
    constants = {name: getattr(shared, name) for name in _CONSTANTS} | {"DISTINCT_FRAMES": FRAMES}
    command = ["cc", "-O3", "-march=native", "-ffast-math", *(f"-D{name}={value}" for name, value in constants.items())]
    sources = [Path(__file__).with_name(CHAIN), options.isio / "ImageStreamIO.c"]
    command += [f"-I{options.isio}", *map(str, sources), "-o", str(folder / "chain"), "-lpthread", "-lrt", "-lm"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603  # the user's own compiler
    if done.returncode:
        raise ComparisonError(f"cc failed: {done.stderr}")
    return [str(folder / "chain")]


def missing(implementation: Implementation, options: argparse.Namespace) -> str:
    """Why an implementation cannot run; empty if it can."""
    if implementation.program == CHAIN:
        if shutil.which("cc") is None:
            return "there is no C compiler (cc); Debian: apt install gcc"
        if options.isio is None or not (options.isio / "ImageStreamIO.c").is_file():
            what = f"{options.isio} has no ImageStreamIO.c" if options.isio else "no checkout of ImageStreamIO is given"
            return f"{what}: git clone https://github.com/milk-org/ImageStreamIO DIR, then --isio DIR"
    if implementation.program == PYRTCAO and "pyrtcao" not in versions(options):
        how = "python -m venv DIR && DIR/bin/pip install pyrtcao, then --pyrtcao DIR/bin/python"
        return f"pyrtcao is not installed in {options.pyrtcao}: {how}"
    if implementation.kernel == FUSED_KERNEL and not compiled.available():
        return compiled.advice()
    return ""


def versions(options: argparse.Namespace) -> dict[str, str]:
    """Versions of the software compared; pyrtcao's and ImageStreamIO's if present."""
    found = {name: importlib.metadata.version(name) for name in ("lowfc", "eclipse-zenoh", "numpy")}
    command = [options.pyrtcao, "-c", "import importlib.metadata as m; print(m.version('pyrtcao'))"]
    with contextlib.suppress(OSError):
        done = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603  # the user's
        if not done.returncode:
            found["pyrtcao"] = done.stdout.strip()
    with contextlib.suppress(OSError, TypeError):
        header = (options.isio / "ImageStruct.h").read_text()
        found["ImageStreamIO"] = "".join(re.findall(r'IMAGESTRUCT_VERSION\s+"(.+?)"', header))
    return found
