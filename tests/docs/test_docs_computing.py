"""Commands of the documents that only compute."""

from pathlib import Path

import pytest

from tests.docs.test_docs import DESIGN, FILES, LOGS, VALIDATE, run


@pytest.mark.slow
def test_the_validation(tmp_path: Path) -> None:
    said = run(tmp_path, VALIDATE[0])
    assert "tilt" in said
    assert "peak" in said


@pytest.mark.slow
def test_the_designs_are_taken_by_the_loop(tmp_path: Path) -> None:
    for command in DESIGN:
        run(tmp_path, command)
    (tmp_path / "own.toml").write_text('[sensor]\npupil = "pupil.npz"\nsam = "mask.json"\n')
    run(tmp_path, "lowfc sim-loop --config own.toml --lockstep --duration 0.2")


@pytest.mark.slow
def test_the_logs(tmp_path: Path) -> None:
    run(tmp_path, "lowfc sim-loop --lockstep --rate 200 --duration 2 --json")
    said = [run(tmp_path, command) for command in LOGS]
    assert "lowfc/camera/frame" in said[0]
    assert "400 frames, commands identical, largest difference 0 nm" in said[1]
    assert "what if" in said[2]
    assert "played" in said[3]
    assert "is whole" in said[4]
    assert "1 in 10 frames and mirror states" in said[7]
    assert "digest " in said[8]
    assert "-every-10.mcap" not in said[8], "the newest log is the one that was recorded"
    assert {path.suffix for path in (tmp_path / "logs").iterdir()} == {".mcap", ".html", ".fits"}


def test_the_configuration(tmp_path: Path) -> None:
    for command in FILES:
        run(tmp_path, command)
