"""The wheel is complete, and the installed programs run the loop.

The wheel is installed into its own virtual environment. Its dependencies are not installed again, since that would
require the network: this environment's libraries are appended to the module search path.
"""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

import lowfc
from lowfc.contract.configuration import Configuration

ROOT = Path(__file__).parents[2]
PACKAGES = ("lowfc", "sim_camera", "sim_dm")
PIP = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check", "--no-input"]
OFFLINE = ["--no-index", "--no-deps"]
REQUIRED = {
    "data/spc_quarter128.npz",
    "data/sam_layouts.json",
    "data/report.html",
    "contract/wire/lowfc.desc",
    "py.typed",
}


def succeed(*argv: str | Path, folder: Path) -> str:
    """Run a program that must succeed, without this environment's PYTHONPATH; return its standard output."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(argv, cwd=folder, capture_output=True, text=True, timeout=120, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, built from a copy, so that the source folder stays clean."""
    folder = tmp_path_factory.mktemp("wheel")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / "source" / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / "source")
    succeed(*PIP, "wheel", *OFFLINE, "--no-build-isolation", "--wheel-dir", folder, folder / "source", folder=folder)
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the programs in a virtual environment with the wheel."""
    folder = tmp_path_factory.mktemp("installed") / "venv"
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    succeed(*PIP, "--python", python, "install", "--no-compile", *OFFLINE, wheel, folder=folder)
    site_packages = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    libraries = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    # Python does not read `.pth` files in the folders listed here, such as that of an editable install.
    (site_packages / "libraries.pth").write_text("\n".join(libraries))
    return folder / "bin"


def test_wheel_contains_all_files(wheel: Path) -> None:
    expected = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    with zipfile.ZipFile(wheel) as archive:
        found = set(archive.namelist())
        metadata = Parser().parsestr(archive.read(next(name for name in found if name.endswith("/METADATA"))).decode())
    assert {f"lowfc/{name}" for name in REQUIRED} <= expected
    assert expected - found == set()
    assert {name for name in found - expected if ".dist-info/" not in name} == set()
    assert (metadata["Name"], metadata["Version"]) == ("lowfc", lowfc.__version__)
    assert wheel.stat().st_size < 3e6


def test_version_is_the_same_everywhere() -> None:
    assert json.loads((ROOT / "codemeta.json").read_text())["version"] == lowfc.__version__
    assert f"\nversion: {lowfc.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## [{lowfc.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_installed_programs_run_the_loop(installed: Path, tmp_path: Path) -> None:
    script = "import lowfc, sim_camera, sim_dm; print(lowfc.__file__, sim_camera.__file__, sim_dm.__file__)"
    paths = succeed(installed / "python", "-c", script, folder=tmp_path).split()
    assert all(Path(path).is_relative_to(installed.parent) for path in paths)
    assert succeed(installed / "lowfc", "--version", folder=tmp_path).strip() == lowfc.__version__
    assert {"lowfc", "sim-camera", "sim-dm"} <= {path.name for path in installed.iterdir()}
    arguments = ("sim-loop", "--lockstep", "--duration", "0.2", "--json")
    results = json.loads(succeed(installed / "lowfc", *arguments, folder=tmp_path))
    frames = round(0.2 * Configuration().camera.rate_hz)
    assert results["frames_processed"] == results["commands_applied"] == frames > 0
    assert results["messages_lost"] == 0


@pytest.mark.slow
@pytest.mark.exclusive
@pytest.mark.timeout(900)
def test_make_release_builds_checks_and_runs_the_wheel() -> None:
    done = subprocess.run(["make", "release"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("PASSED") == 2
    assert "frame to command" in done.stdout
