"""A driver whose process dies, and is started again as a service manager does."""

import subprocess
from pathlib import Path

from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import FRAME, Role
from tests.support.loops import LOWFC, going_on, until

DRIVER = """
import os, time
import numpy as np
from lowfc.device import CameraSettings, Exposure

class Dying:
    def __init__(self, options, config):
        self.number, self.lives = 0, os.path.exists("died")

    def settings(self):
        return CameraSettings(8, 8, exposure_ns=5_000_000, period_ns=10_000_000)

    def expose(self):
        time.sleep(0.01)
        self.number += 1
        if self.number == 200 and not self.lives:
            open("died", "w").close()
            os._exit(7)
        return Exposure(np.full((8, 8), self.number, np.uint16), None, self.number)

    def close(self):
        pass
"""


def test_a_camera_whose_process_dies_is_a_new_start_once_it_is_started_again(tmp_path: Path) -> None:
    (tmp_path / "dying.py").write_text(DRIVER)
    words = ("camera", "dying.py:Dying", "--run", "dying")
    starts: list[int] = []
    bus = ZenohBus(open_run("dying").links, Role.OPERATOR, HostClock())
    bus.subscribe(FRAME, lambda sample: starts.append(start_of(sample.sequence)))
    try:
        died = subprocess.run([*LOWFC, *words], cwd=tmp_path, timeout=60, check=False)
        assert died.returncode == 7, "a failure, after which units of deploy start it again"
        with going_on(tmp_path, f"lowfc {' '.join(words)}"):
            until(lambda: len(set(starts)) == 2)
    finally:
        bus.close()
    assert starts == sorted(starts)
