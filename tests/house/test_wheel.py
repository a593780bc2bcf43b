"""The wheel: everything is in it, and what it installs runs the loop.

It is installed into an environment of its own. The libraries that it needs are not installed again, for that would need
the network: they are those of this environment, behind its own packages on the path.
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
ALONE = ["--no-index", "--no-deps"]
NEEDED = {
    "data/spc_quarter128.npz",
    "data/sam_layouts.json",
    "data/report.html",
    "contract/wire/lowfc.desc",
    "py.typed",
}


def succeed(*words: str | Path, folder: Path) -> str:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(words, cwd=folder, capture_output=True, text=True, timeout=120, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, so that nothing is left beside the sources."""
    folder = tmp_path_factory.mktemp("wheel")
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / "source" / package, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder / "source")
    succeed(*PIP, "wheel", *ALONE, "--no-build-isolation", "--wheel-dir", folder, folder / "source", folder=folder)
    (found,) = folder.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the programs of an environment with the wheel."""
    folder = tmp_path_factory.mktemp("installed") / "venv"
    venv.create(folder, with_pip=False, symlinks=True)
    python = folder / "bin" / "python"
    succeed(*PIP, "--python", python, "install", *ALONE, wheel, folder=folder)
    own = Path(sysconfig.get_path("purelib", vars={"base": str(folder)}))
    libraries = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (own / "libraries.pth").write_text("\n".join(libraries))  # a .pth in those, as of a checkout, is not read
    return folder / "bin"


def test_everything_is_in_it(wheel: Path) -> None:
    wanted = {
        path.relative_to(ROOT).as_posix()
        for package in PACKAGES
        for path in (ROOT / package).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    with zipfile.ZipFile(wheel) as archive:
        held = set(archive.namelist())
        metadata = Parser().parsestr(archive.read(next(name for name in held if name.endswith("/METADATA"))).decode())
    assert {f"lowfc/{name}" for name in NEEDED} <= wanted
    assert wanted - held == set()
    assert {name for name in held - wanted if ".dist-info/" not in name} == set()
    assert (metadata["Name"], metadata["Version"]) == ("lowfc", lowfc.__version__)
    assert wheel.stat().st_size < 3e6


def test_the_version_is_said_alike_everywhere() -> None:
    assert json.loads((ROOT / "codemeta.json").read_text())["version"] == lowfc.__version__
    assert f"\nversion: {lowfc.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"\n## [{lowfc.__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_what_it_installs_runs_the_loop(installed: Path, tmp_path: Path) -> None:
    where = "import lowfc, sim_camera, sim_dm; print(lowfc.__file__, sim_camera.__file__, sim_dm.__file__)"
    paths = succeed(installed / "python", "-c", where, folder=tmp_path).split()
    assert all(Path(path).is_relative_to(installed.parent) for path in paths)
    assert succeed(installed / "lowfc", "--version", folder=tmp_path).strip() == lowfc.__version__
    assert {"lowfc", "sim-camera", "sim-dm"} <= {path.name for path in installed.iterdir()}
    words = ("sim-loop", "--lockstep", "--duration", "1", "--json")
    figures = json.loads(succeed(installed / "lowfc", *words, folder=tmp_path))
    frames = round(Configuration().camera.rate_hz)
    assert figures["frames_processed"] == figures["commands_applied"] == frames > 0
    assert figures["messages_lost"] == 0


@pytest.mark.slow
@pytest.mark.exclusive
@pytest.mark.timeout(900)
def test_make_release_builds_checks_and_runs_it() -> None:
    done = subprocess.run(["make", "release"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("PASSED") == 2
    assert "frame to command" in done.stdout
