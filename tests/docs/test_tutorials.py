"""Tutorials: the commands of each page in order, except real-time loops and views.

The last tests here and `test_docs` run real-time loops and views. Only the shortened first tutorial and the bad
night are not marked slow.
"""

import re
import shutil
from pathlib import Path

import pytest

from tests.support.loops import command, in_background, interrupt, output_of, recorded_bytes, start, until

ROOT = Path(__file__).parents[2]
PAGES = ROOT / "docs" / "tutorials"
LIVE = (
    "lowfc sim-loop --run night --open --star-magnitude 0",
    "lowfc calibrate --run night --method hadamard --snr 20 --out night.fits",
    "lowfc calibrate --compare computed.fits night.fits",
    "lowfc ctl load night.fits --run night",
    "lowfc ctl close --run night",
)
CHAOS = "lowfc chaos --case frames-dark --keep bad"
BASLER = "lowfc conformance camera --run basler --config basler.toml"
NOT_FOLLOWED = re.compile(
    r"^lowfc (ctl|console|runs|chaos|validate|bench|view|config|camera|conformance|controller|record)\b|^sim-|^rerun|"
    r"--run |--web|--compare|^lowfc sim-loop --rate|--config lowfc|spc"
)
_IN_THIS_PROCESS = re.compile(r"lowfc (?!sim-loop)")


def page_outputs(folder: Path, page: str, *, shorter: bool = False) -> dict[str, str]:
    """Output of each command of a page except those of `NOT_FOLLOWED`, in order; only loops are separate processes."""
    text = (PAGES / f"{page}.md").read_text()
    for name, content in re.findall(r"Save this as `(\S+)`.*?```\w+\n(.*?)```", text, re.DOTALL):
        (folder / name).write_text(content)
    printed = {}
    for with_comment in re.findall(r"^    (\S.*)$", text, re.MULTILINE):
        line = with_comment.split("  #")[0].strip()
        if not NOT_FOLLOWED.search(line):  # the command ends by itself and needs no loop
            short = line.replace("--duration 20", "--duration 0.5") if shorter else line
            printed[line] = (output_of if _IN_THIS_PROCESS.match(line) else command)(folder, short)
    return printed


def tilt_mas(summary: str) -> float:
    """Residual tilt in a summary, mas."""
    return float(re.findall(r"tilt per axis +residual (\S+) of", summary)[0])


@pytest.mark.parametrize("shorter", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_the_first_loop_tutorial_runs_as_written(tmp_path: Path, shorter: bool, request: pytest.FixtureRequest) -> None:
    if shorter:
        request.getfixturevalue("without_drawings")
    page = (PAGES / "first_loop.md").read_text()
    assert page.index("install -e '.[plots]'") < page.index("lowfc report last"), "`plots` is installed before its use"
    first, info, report, replay, what_if, digest = page_outputs(tmp_path, "first_loop", shorter=shorter).values()
    assert "frame to command" in first
    assert "lowfc/camera/frame" in info
    assert ".html" in report
    assert "commands identical, largest difference 0 nm" in replay
    assert "what if" in what_if
    assert "digest " in digest


@pytest.mark.slow
def test_the_tuned_law_tutorial_gives_the_pages_numbers(tmp_path: Path) -> None:
    computed, integrator, tuned, law = page_outputs(tmp_path, "tuned_law").values()
    assert "computed.fits" in computed
    assert "written: lqg.fits" in tuned
    assert (tilt_mas(integrator), tilt_mas(law)) == pytest.approx((3.1, 1.2), rel=0.15), "the page's numbers"


@pytest.mark.slow
def test_the_design_mask_tutorial_runs_as_written(tmp_path: Path) -> None:
    design, *loops = page_outputs(tmp_path, "design_mask").values()
    assert "written to mask.json" in design
    assert len(loops) == 3
    assert all("frame to command" in output for output in loops)


@pytest.mark.usefixtures("without_drawings")  # `test_golden` tests the drawings of this log
def test_the_bad_night_tutorial_runs_as_written(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "tests" / "golden", tmp_path / "tests" / "golden")
    info, report, replay, killed_info, recovered, recovered_info = page_outputs(tmp_path, "bad_night").values()
    assert "FRAMES_REFUSED 6, NO_FRAMES 3" in info
    assert report.startswith("Not a good run: ")
    assert (tmp_path / "night.html").is_file()
    assert "163 frames" in replay
    assert "rule changed" in replay
    assert "completes it" in killed_info
    assert "whole.mcap" in recovered
    assert re.search(r"^state +complete$", recovered_info, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.exclusive
def test_the_tuned_law_tutorial_runs_with_a_real_time_loop(tmp_path: Path, own_runtime: Path) -> None:
    command(tmp_path, "lowfc calibrate --method analytic --out computed.fits")
    loop = start(tmp_path, *LIVE[0].split()[1:])
    try:
        until(lambda: recorded_bytes(tmp_path) > 4e6)
        printed = [command(tmp_path, line) for line in LIVE[1:]]
    finally:
        _, stderr = interrupt(loop)
    assert loop.returncode == 0, stderr
    assert "good" in printed[0]
    assert "loop closed" in printed[-1]


@pytest.mark.slow
@pytest.mark.exclusive
def test_the_bad_night_tutorial_keeps_the_log_of_an_injected_fault(tmp_path: Path, own_runtime: Path) -> None:
    command(tmp_path, CHAOS)
    assert list((tmp_path / "bad").rglob("*.mcap"))


@pytest.mark.basler
@pytest.mark.slow
@pytest.mark.exclusive
def test_the_your_camera_tutorial_passes_with_the_vendors_emulation(
    tmp_path: Path, own_runtime: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = (PAGES / "your_camera.md").read_text()
    (line,) = re.findall(r"^    (PYLON_CAMEMU=1 lowfc camera .*)$", text, re.MULTILINE)
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    (tmp_path / "basler.toml").write_text(re.findall(r"```toml\n(.*?)```", text, re.DOTALL)[0])
    with in_background(tmp_path, line.partition(" ")[2]):
        until(lambda: (own_runtime / "lowfc" / "basler").exists())
        assert "0 wrong" in command(tmp_path, BASLER)
