"""Steps of a dark hole: the loop undoes only those that do not shift its zero point; an interrupt ends the loop."""

from collections.abc import Iterator
from pathlib import Path
from subprocess import TimeoutExpired
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lowfc.contract.configuration import load
from lowfc.contract.errors import LowfcError, RequestRefusedError
from lowfc.control.loop.inputs import Step
from lowfc.programs.paper import dark_hole
from lowfc.programs.paper.dark_hole import PLAIN, SHIFTED
from tests.support.in_process_loop import SMALL_MIRROR, InProcessLoop

STEPS = 4
CONFIG = SMALL_MIRROR | {
    "sensor.kind": "zwfs",
    "sensor.modes": 4,
    "camera.rate_hz": 1000,
    "camera.instants": 1,
    "disturbance.preset": "quiet",
    "star.magnitude": -2.0,
    "control.start_mode": "closed",
    "control.tilt_gain": 0.4,
    "control.gain": 0.4,
}


class LoggedLoop(InProcessLoop):
    """A loop that keeps all its steps, and returns them with the truth as a history."""

    def __init__(self) -> None:
        super().__init__(load(None, CONFIG))
        self._grid = self.config.mirror.rows, self.config.mirror.columns
        self.kept_steps: list[Step] = []

    def steps(self, count: int | None = None, patience_s: float = 0.0) -> Iterator[Step]:
        for step in super().steps(count):
            self.kept_steps.append(step)
            yield step

    def history(self) -> Any:
        truths = [self.scene.truth(index, surface).sampled for index, surface in enumerate(self.surfaces_nm)]
        return SimpleNamespace(
            steps=SimpleNamespace(
                sequence=np.array([step.frame_sequence for step in self.kept_steps]),
                command_nm=np.array([step.command_nm for step in self.kept_steps]),
            ),
            true=SimpleNamespace(
                disturbance_nm=np.array([truth.disturbance_nm for truth in truths]),
                residual_nm=np.array([truth.residual_nm for truth in truths]),
            ),
        )


@pytest.mark.parametrize(
    ("fault", "handler", "patience_s", "expected_error", "message"),
    [
        (RequestRefusedError("too far from flat"), "default_int_handler", 60, LowfcError, "flat; output.* loop: begun"),
        (KeyboardInterrupt(), "default_int_handler", 60, KeyboardInterrupt, None),
        (KeyboardInterrupt(), "SIG_IGN", 0.1, TimeoutExpired, None),
    ],
)
def test_a_refused_step_or_an_interrupt_ends_the_loop(
    fault, handler, patience_s, expected_error, message, tmp_path, monkeypatch
):
    begin = f"import os, signal, time; from pathlib import Path; signal.signal(signal.SIGINT, signal.{handler})"
    record = "Path('pid').write_text(str(os.getpid())); print('begun', flush=True); Path('ready').touch()"
    (tmp_path / "silent.py").write_text(f"{begin}\n{record}\ntime.sleep(600)\n")

    def fail(_):
        monkeypatch.setattr(dark_hole, "PATIENCE_S", patience_s)
        raise fault

    monkeypatch.setattr(dark_hole, "COMMAND", "silent")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(dark_hole, "running", lambda: ["run"] * (tmp_path / "ready").exists())
    monkeypatch.setattr(dark_hole, "new_run_id", lambda: "run")
    monkeypatch.setattr(dark_hole, "Client", fail)
    with pytest.raises(expected_error, match=message):
        dark_hole.dark_hole(tmp_path, 1.0)
    assert not Path("/proc", (tmp_path / "pid").read_text()).exists()


def test_the_loop_undoes_only_the_steps_that_do_not_shift_its_zero_point(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("STEPS", STEPS), ("STEPS_COMBINED", STEPS), ("SETTLE", 40), ("WINDOW", 40)):
        monkeypatch.setattr(dark_hole, name, value)
    loop = LoggedLoop()
    marks, channel_nm = dark_hole.apply_steps(loop, 1.0, np.zeros(1))
    assert channel_nm.shape == (1 + STEPS, 4)
    assert [len(marks[channel]) for channel in (SHIFTED, PLAIN)] == [STEPS + 1, 2]
    found = dark_hole.channel_results(loop.history(), marks, channel_nm)
    shifted, plain = found[SHIFTED], found[PLAIN]
    assert np.linalg.norm(shifted.channel_nm[-1]) > 2, "nm of wavefront that a loop without the shift would remove"
    assert shifted.undone()[0] == pytest.approx(0, abs=0.04)
    assert plain.undone()[0] == pytest.approx(1, abs=0.04)
    before_nm, after_nm = shifted.residual_nm
    assert after_nm < 1.5 * before_nm
