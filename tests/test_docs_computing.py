"""Commands of the documents that only compute."""

from pathlib import Path

from test_docs import DESIGN, VALIDATE, run


def test_the_validation(tmp_path: Path) -> None:
    said = run(tmp_path, VALIDATE[0])
    assert "tilt" in said
    assert "peak" in said


def test_the_designs_are_taken_by_the_loop(tmp_path: Path) -> None:
    for command in DESIGN:
        run(tmp_path, command)
    (tmp_path / "own.toml").write_text('[sensor]\npupil = "pupil.npz"\nsam = "mask.json"\n')
    run(tmp_path, "lowfc sim-loop --config own.toml --lockstep --duration 0.2")
