"""Every documented command is run here or in a test that is named here; every link leads to a file."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.device.test_isio_loop import DOCUMENTED as BESIDE_CACAO
from tests.docs import test_tutorials as tutorials
from tests.e2e.test_bench_day import COMMANDS as BENCH_DAY
from tests.e2e.test_operator import COMMANDS as OPERATING
from tests.e2e.test_own_hardware import COMMISSIONING, DOCUMENTED
from tests.support.loops import command, in_background, interrupt, output_of, recorded_bytes, start, until
from tests.support.viewers import on_screen

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
ROUTE = "rerun rrd route --application-id $(basename $log .mcap) deploy/layouts/log.rbl | rerun $log -"
# Commands that CI itself or another test runs, and where.
ELSEWHERE = {
    "make sim-loop": ".ci/run",
    "make test": ".ci/run",
    "make release": "tests/house/test_wheel.py",
    "lowfc console": "tests/console/test_console.py",
    "lowfc ctl gain 0.3 --modes 2,3": "tests/e2e/test_operator.py",
    "lowfc runs": "tests/e2e/test_operator.py",
    "lowfc doctor": "tests/commissioning/test_doctor.py",
    "lowfc doctor --config /etc/lowfc/lowfc.toml": "tests/commissioning/test_doctor.py",
    "lowfc gateway epics": "tests/interlocks/test_gateway.py",
    "rerun $(ls -t logs/*.mcap | head -1)": "tests/e2e/test_rerun_viewer.py",
    ROUTE: "tests/view/test_viewer_layouts.py",
}
SHORTENED_OPTIONS = {
    "--duration 20": "--duration 2",
    "--duration 5": "--duration 0.5",
    "--seconds 2": "--seconds 0.5",
    "--trials 20": "--trials 4",
    "--steps 200": "--steps 40",
}
PROGRAMS = ("lowfc", "sim-camera", "sim-dm", "make", "rerun", "python")


def commands(document: Path) -> list[str]:
    """Command lines of a document without trailing comments; indented by four spaces, or by more within a list."""
    lines = re.findall(r"^ {4,}(\S.*)$", document.read_text(), flags=re.MULTILINE)
    bare = [line.split("  #")[0].strip() for line in lines]
    return [line for line in bare if line.split()[0] in PROGRAMS]


def run(folder: Path, line: str) -> str:
    """Run a documented command, shortened by `SHORTENED_OPTIONS`."""
    for long, short in SHORTENED_OPTIONS.items():
        line = line.replace(long, short)
    return command(folder, line)


def test_every_command_in_the_documentation_is_tested() -> None:
    found = [
        line
        for document in (README, *ROOT.glob("docs/**/*.md"), *ROOT.glob("deploy/*.md"))
        for line in commands(document)
        if document.parent != tutorials.PAGES or tutorials.NOT_FOLLOWED.search(line)
    ]
    assert len(found) > 15
    tested = {*ELSEWHERE, LOOP, *LOGS, *FILES, *BY_HAND, *SESSION, *BENCH, *VALIDATE, *DESIGN, *VIEW_FILES}
    tested |= {*tutorials.LIVE, tutorials.CHAOS, tutorials.BASLER, RECORD_SELECTED, *UNTIL_INTERRUPTED}
    tested |= {*DOCUMENTED, *OPERATING, *BENCH_DAY, *BESIDE_CACAO, *COMMISSIONING}
    assert set(found) == tested
    for line, where in ELSEWHERE.items():
        text = (ROOT / where).read_text().lower()
        assert all(word in text for word in re.findall(r"[a-z-]+", line)[:3]), line


def test_every_link_leads_to_a_file() -> None:
    links = [
        document.parent / target
        for document in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("deploy/*.md"))
        for target in re.findall(r"\]\((?![a-z]+:|#)([^)#\s]+)", document.read_text())
    ]
    assert len(links) > 100
    assert [str(link) for link in links if not link.exists()] == []


def test_every_test_named_in_the_documentation_exists() -> None:
    sources = "\n".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    documents = {path: path.read_text() for path in ROOT.glob("docs/**/*.md")}
    named = {(path, name) for path, text in documents.items() for name in re.findall(r"`(test_\w+)`", text)}
    assert len(named) > 50
    assert {(path, name) for path, name in named if f"def {name}(" not in sources} == set()


LOOP = "lowfc sim-loop --rate 1000 --duration 20 --disturbance reaction-wheel --star-magnitude 2"
VALIDATE = ("lowfc validate table4 photometry --trials 20",)
DESIGN = (
    "lowfc design spc --cells 32 --outer 8 --out pupil.npz",
    "lowfc design sam --steps 200 --merit contrast --out mask.json",
    "lowfc design zwfs --out zwfs.toml",
    "lowfc design clowfs --defocus 2:5 --out clowfs.toml",
)
FILES = (
    "lowfc config show > lowfc.toml",
    "lowfc config check lowfc.toml",
    "lowfc sim-loop --config lowfc.toml --duration 5",
)
RECORD_SELECTED = "lowfc record --run bench --every 10 --topics lowfc/camera/frame --topics 'lowfc/mirror/*/state'"
BY_HAND = ("sim-camera --run bench", "sim-dm --run bench", "lowfc controller --run bench", "lowfc record --run bench")
SESSION = ("lowfc config zenoh --run bench --role camera",)
BENCH = ("lowfc bench twin", "lowfc bench record --rate 1000 --seconds 2")
UNTIL_INTERRUPTED = (
    "lowfc sim-loop --web",
    "lowfc view",
    "lowfc view --web",
    "lowfc view --foxglove",
    "lowfc view last",
)
"""Commands that run until Ctrl-C."""
VIEW_FILES = (
    "lowfc view --headless-screenshot now.png",
    "lowfc view --save night.rrd --seconds 60",
    "lowfc view last --headless-screenshot log.png --tab optics",
)
LOGS = (
    "lowfc info last",
    "lowfc replay last",
    "lowfc what-if last --set gain=0.3,leak=0.01",
    "lowfc publish last --speed 2",
    "lowfc recover last",
    "lowfc report last",
    "lowfc export last",
    "lowfc export last --decimate 10",
    "lowfc info last --digest",
)


@pytest.mark.exclusive
@pytest.mark.slow
def test_the_documented_loop_runs_and_writes_one_log(tmp_path: Path) -> None:
    assert "frame to command" in run(tmp_path, LOOP)
    assert len(list((tmp_path / "logs").glob("*.mcap"))) == 1


@pytest.mark.exclusive
@pytest.mark.slow
@pytest.mark.parametrize("recorder", [BY_HAND[3], RECORD_SELECTED])
def test_the_documented_processes_start_separately(tmp_path: Path, recorder: str) -> None:
    with in_background(tmp_path, *BY_HAND[:3], recorder) as all_stderr:
        status = [sys.executable, "-m", "lowfc", "ctl", "status", "--run", "bench"]
        until(lambda: subprocess.run(status, cwd=tmp_path, capture_output=True, check=False).returncode == 0, 120)
        until(lambda: recorded_bytes(tmp_path) > 4e6)
        session = json.loads(run(tmp_path, SESSION[0]))
        assert session["listen"]["endpoints"][0].startswith("tcp/127.0.0.1:")
    for name, stderr in zip(("camera", "mirror-dm", "controller", "recorder"), all_stderr, strict=True):
        assert f"{name}: ready (run bench)\n" in stderr
    assert len(list((tmp_path / "logs").glob("*.mcap"))) == 1


@pytest.mark.exclusive
@pytest.mark.slow
def test_the_documented_benchmarks_print_their_results(tmp_path: Path) -> None:
    assert "rank" in run(tmp_path, BENCH[0])
    assert "longest wait" in run(tmp_path, BENCH[1])


@pytest.mark.slow
@on_screen
def test_the_documented_views_open_and_save_files(tmp_path: Path) -> None:
    loop = start(tmp_path, *UNTIL_INTERRUPTED[0].split()[1:], "--rate", "100")
    try:
        until(lambda: recorded_bytes(tmp_path) > 4e6)
        for line in UNTIL_INTERRUPTED[1:4]:
            view_and_interrupt(tmp_path, line)
        for line in VIEW_FILES[:2]:
            run(tmp_path, line.replace("--seconds 60", "--seconds 1").replace("now.png", "now.png --seconds 2"))
    finally:
        _, stderr = interrupt(loop)
    assert loop.returncode == 0, stderr
    assert "http://127.0.0.1:" in stderr
    view_and_interrupt(tmp_path, UNTIL_INTERRUPTED[4])
    run(tmp_path, VIEW_FILES[2])
    assert {path.name for path in tmp_path.iterdir()} >= {"now.png", "night.rrd", "log.png"}


def view_and_interrupt(folder: Path, line: str) -> None:
    """Run a view until it prints its address, then Ctrl-C."""
    process = start(folder, *line.split()[1:])
    assert "127.0.0.1" in process.stderr.readline()
    _, stderr = interrupt(process)
    assert process.returncode == 0, stderr


@pytest.mark.slow
def test_the_documented_validation_prints_its_tables(tmp_path: Path) -> None:
    printed = run(tmp_path, VALIDATE[0])
    assert "tilt" in printed
    assert "peak" in printed


@pytest.mark.slow
def test_the_loop_runs_with_the_documented_designs(tmp_path: Path) -> None:
    for line in DESIGN:
        run(tmp_path, line)
    (tmp_path / "own.toml").write_text('[sensor]\npupil = "pupil.npz"\nsam = "mask.json"\n')
    run(tmp_path, "lowfc sim-loop --config own.toml --lockstep --duration 0.2")


@pytest.mark.slow
def test_the_documented_commands_read_a_log(tmp_path: Path) -> None:
    run(tmp_path, "lowfc sim-loop --lockstep --rate 200 --duration 2 --json")
    printed = [run(tmp_path, line) for line in LOGS]
    assert "lowfc/camera/frame" in printed[0]
    assert "400 frames, commands identical, largest difference 0 nm" in printed[1]
    assert "what if" in printed[2]
    assert "published" in printed[3]
    assert "is intact" in printed[4]
    assert "1 in 10 frames and mirror states" in printed[7]
    assert "digest " in printed[8]
    assert "-every-10.mcap" not in printed[8], "`last` names the recorded log, not its export"
    assert {path.suffix for path in (tmp_path / "logs").iterdir()} == {".mcap", ".html", ".fits"}


@pytest.mark.slow
def test_the_documented_configuration_is_written_checked_and_used(tmp_path: Path) -> None:
    for line in FILES[:-1]:
        output_of(tmp_path, line)
    run(tmp_path, FILES[-1])
