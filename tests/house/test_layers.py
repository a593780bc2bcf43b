"""Imports point downward, numerical modules are pure, and no product module or folder is too large."""

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("lowfc", "sim_camera", "sim_dm")
FILES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
}
GENERATED = "lowfc.contract.wire"

# Packages of the project that each layer may import in addition to itself.
BELOW = {
    "lowfc.arrays": (),
    "lowfc.optics": (),
    "lowfc.control": (),
    "lowfc.design": ("lowfc.optics", "lowfc.control"),
    "lowfc.contract": ("lowfc.optics", "lowfc.control"),
    "lowfc.adapters": ("lowfc.optics", "lowfc.control", "lowfc.contract"),
    "lowfc.testing": ("lowfc.optics", "lowfc.control", "lowfc.contract", "lowfc.adapters"),
    "lowfc.client": ("lowfc.control", "lowfc.contract", "lowfc.adapters"),
    "lowfc.device": ("lowfc.optics", "lowfc.control", "lowfc.contract", "lowfc.adapters"),
    "lowfc.programs": (
        *("lowfc.optics", "lowfc.control", "lowfc.design", "lowfc.contract", "lowfc.adapters", "lowfc.client"),
        "lowfc.device",
    ),
    "sim_camera": ("lowfc.optics", "lowfc.control", "lowfc.contract", "lowfc.adapters", "lowfc.device"),
    "sim_dm": ("lowfc.optics", "lowfc.control", "lowfc.contract", "lowfc.adapters", "lowfc.device"),
}
LAYERS = tuple(BELOW)
BELOW_ALL = "lowfc.arrays"

PURE_LAYERS = ("lowfc.arrays", "lowfc.optics", "lowfc.control", "lowfc.design")
PURE_MODULES = (
    "lowfc.device.mirror_protection",
    "sim_dm.actuators",
    "sim_camera.contrast",
    "sim_camera.path",
    "sim_camera.pixels",
    "sim_camera.scene",
    "sim_camera.wheel",
    "sim_camera.disturbance",
    "sim_camera.faults",
    "sim_camera.wavefront_statistics",
)
PURE_IMPORTS = (
    *("numpy", "scipy", "abc", "array", "bisect", "collections", "dataclasses", "enum", "functools", "hashlib"),
    *("itertools", "math", "operator", "types", "typing"),
)
# A generator made from a seed is a value; the functions of numpy.random have global state.
FROM_A_SEED = ("Generator", "default_rng", "SeedSequence", "SFC64", "PCG64")
NUMPY_FILES = ("load", "loadtxt", "save", "savez", "savez_compressed", "savetxt", "fromfile", "memmap", "genfromtxt")
FORBIDDEN_CALLS = ("open", "print", "input", "exec", "eval", "__import__", "breakpoint", "globals")
MAX_LINES = 400
MAX_MODULES = 16


def imports_of(tree: ast.AST) -> Iterator[str]:
    """Every module imported anywhere in a file; `a.b` and `a.b.c` for `from a.b import c`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield "." * node.level + (node.module or "")
            yield from ("." * node.level + f"{node.module or ''}.{alias.name}" for alias in node.names)


def inside(name: str, package: str) -> bool:
    return name == package or name.startswith(package + ".")


def layer_of(module: str) -> str:
    if module == "lowfc.__main__":  # `python -m lowfc` is the command line
        return "lowfc.programs"
    return next((layer for layer in LAYERS if inside(module, layer)), "")


def is_pure(module: str) -> bool:
    return layer_of(module) in PURE_LAYERS or module in PURE_MODULES


def layer_faults(module: str, source: str) -> list[str]:
    """Imports that point upward or sideways, and relative imports."""
    own, faults = layer_of(module), []
    for name in imports_of(ast.parse(source)):
        if name.startswith("."):
            faults.append(f"{module} imports {name}: relative")
        target = layer_of(name)
        if target and own and target != own and target not in (BELOW_ALL, *BELOW[own]):
            faults.append(f"{module} imports {name}")
    return faults


def purity_faults(module: str, source: str) -> list[str]:
    """Imports and calls that make a numerical module depend on more than its arguments."""
    tree, faults = ast.parse(source), []
    for name in imports_of(tree):
        if layer_of(name) or name == "lowfc":
            if layer_of(name) and not is_pure(name) and not any(inside(name, pure) for pure in PURE_MODULES):
                faults.append(f"imports {name}")
        elif not any(inside(name, allowed) for allowed in PURE_IMPORTS):
            faults.append(f"imports {name}")
        if inside(name, "numpy.random") and name.rpartition(".")[2] not in FROM_A_SEED:
            faults.append(f"imports {name}")
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in FORBIDDEN_CALLS:
            faults.append(f"calls {node.func.id}")
        if isinstance(node, ast.Global):
            faults.append("changes a global")
        if isinstance(node, ast.Attribute):
            text = ast.unparse(node)
            kind, _, attribute = text.rpartition(".")
            if kind in ("np.random", "numpy.random") and attribute not in FROM_A_SEED:
                faults.append(f"uses {text}")
            if kind in ("np", "numpy") and attribute in NUMPY_FILES:
                faults.append(f"uses {text}")
        takes_a_seed = isinstance(node, ast.Call) and ast.unparse(node.func).rpartition(".")[2] in FROM_A_SEED[1:]
        if takes_a_seed and not (node.args or node.keywords):
            faults.append(f"calls {ast.unparse(node)} without a seed")
    return [f"{module} {fault}" for fault in faults]


def test_imports_point_downward() -> None:
    assert [fault for name, path in FILES.items() for fault in layer_faults(name, path.read_text("utf-8"))] == []


def test_the_bus_does_not_depend_on_the_logs() -> None:
    bus = {name: path.read_text("utf-8") for name, path in FILES.items() if inside(name, "lowfc.adapters.bus")}
    imports = [(name, target) for name, source in bus.items() for target in imports_of(ast.parse(source))]
    assert [pair for pair in imports if inside(pair[1], "lowfc.adapters.logs")] == []


def test_numerical_modules_are_pure() -> None:
    pure = {name: path.read_text("utf-8") for name, path in FILES.items() if is_pure(name)}
    assert [fault for name, source in pure.items() for fault in purity_faults(name, source)] == []


def test_every_module_is_in_a_layer() -> None:
    outside = [module for module in FILES if not layer_of(module) and module != "lowfc"]
    assert outside == []
    assert sum(map(is_pure, FILES)) > 25  # the lists above still match modules


def test_every_source_but_the_tests_is_type_checked() -> None:
    mypy = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["mypy"]
    folders = {path.relative_to(ROOT).parts[0] for path in ROOT.glob("[!.]*/**/*.py")}
    assert set(mypy["files"]) == folders - {"tests", "build"}
    assert mypy["strict"]


def test_no_product_module_is_too_long_or_vaguely_named() -> None:
    long = {module: len(path.read_text(encoding="utf-8").splitlines()) for module, path in FILES.items()}
    assert {
        module: lines for module, lines in long.items() if lines > MAX_LINES and not inside(module, GENERATED)
    } == {}
    vague = {"utils", "util", "helpers", "common", "misc"}
    assert [module for module in FILES if vague & set(module.split("."))] == []


def packages() -> dict[str, Path]:
    """The `__init__.py` of every folder with modules, by the folder's dotted name."""
    return {name: path for name, path in FILES.items() if path.name == "__init__.py" and name != GENERATED}


def test_every_folder_is_a_package_of_at_most_sixteen_modules() -> None:
    folders = {path.parent for path in FILES.values()}
    assert folders - {path.parent for path in packages().values()} - {FILES[GENERATED].parent} == set()
    folders |= {path.parent for path in (ROOT / "tests").rglob("*.py")}
    sizes = {folder: sum(path.stem[:2] != "__" for path in folder.glob("*.py")) for folder in folders}
    assert {folder: size for folder, size in sizes.items() if size > MAX_MODULES} == {}


@pytest.mark.parametrize(
    ("module", "source", "allowed"),
    [
        ("lowfc.control.laws.integrator", "from lowfc.contract import codec", False),
        ("lowfc.control.laws.integrator", "from lowfc.optics.twin.twin import Twin", False),
        ("lowfc.contract.codecs.codec", "def later():\n    from lowfc.adapters.process.clock import HostClock", False),
        ("lowfc.adapters.bus.bus", "import sim_dm.driver", False),
        ("lowfc.client.client", "from lowfc.programs.cli import status", False),
        ("sim_dm.driver", "from sim_camera import bench", False),
        ("lowfc.adapters.bus.bus", "from . import clock", False),
        (
            "lowfc.contract.codecs.codec",
            "from lowfc.control.laws.integrator import Integrator\nimport lowfc.optics.zernike",
            True,
        ),
        ("lowfc.programs.core.controller", "import lowfc.adapters.bus.bus\nfrom lowfc import __version__", True),
    ],
)
def test_upward_imports_are_found(module: str, source: str, allowed: bool) -> None:
    assert (layer_faults(module, source) == []) is allowed


@pytest.mark.parametrize(
    ("source", "allowed"),
    [
        ("import time", False),
        ("from pathlib import Path", False),
        ("def later():\n    import pydantic", False),
        ("from lowfc.contract.errors import LowfcError", False),
        ("import numpy as np\nnp.random.seed(1)", False),
        ("import numpy\nx = numpy.random.rand(3)", False),
        ("from numpy.random import rand", False),
        ("from numpy import random\nrandom.default_rng()", False),
        ("import numpy as np\nseeds = np.random.SeedSequence()", False),
        ("import numpy as np\nx = np.load('file')", False),
        ("x = open('file')", False),
        ("def f():\n    global x\n    x = 1", False),
        ("import numpy.typing as npt\nfrom scipy.optimize import brentq\nfrom dataclasses import dataclass", True),
        ("import numpy as np\nrng = np.random.default_rng([1, 2])\ndef f(rng: np.random.Generator): ...", True),
        ("from lowfc.control.loop.safety import limit", True),
    ],
)
def test_impure_code_is_found(source: str, allowed: bool) -> None:
    assert (purity_faults("lowfc.control.laws.integrator", source) == []) is allowed
