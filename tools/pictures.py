"""Make the pictures of docs/howto/viewing.md and the README: `python -m tools.measure pictures`, about three minutes.

Real processes are brought into each state, and `lowfc view --headless-screenshot` takes the picture.
A Vulkan driver is needed: `apt install mesa-vulkan-drivers libvulkan1`.
"""

import contextlib
import os
import random
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from PIL import Image

from lowfc.adapters.process.realtime import spread
from lowfc.contract.configuration import load
from lowfc.contract.messages import Role
from lowfc.programs.reliability.chaos.bench import ChaosBench
from tools.shared import ROOT

PICTURES = ROOT / "docs" / "pictures"
LOOK_S = 10.0
"""Time from the start of a view to its picture; the state of the run changes halfway."""
MENU_BAR = 37  # pixels at the top without information on the loop
SHADES = 192  # colours of a stored picture
BRIGHT = {"control.start_mode": "closed", "sensor.sam": "sam27d10_bal14"}
SMALL_WELL = {"control.start_mode": "closed", "camera.full_well_e": 1500.0}


def picture(name: str, source: str, *options: str, meanwhile: Callable[[], object] | None = None) -> None:
    """Take a picture of a run or a log, and store it in the documentation; `meanwhile` is called beside the view."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / f"{name}.png"
        command = [sys.executable, "-m", "lowfc", "view", *source.split(), "--headless-screenshot", str(out), *options]
        view = subprocess.Popen(command)
        if meanwhile is not None:
            time.sleep(LOOK_S * 0.55)
            meanwhile()
        if view.wait(120) != 0:
            raise SystemExit(f"no picture of {name}")
        shown = Image.open(out).convert("RGB")
    shown = shown.crop((0, MENU_BAR, shown.width, shown.height)).resize((1280, 770), Image.Resampling.LANCZOS)
    shown.quantize(SHADES, dither=Image.Dither.NONE).save(PICTURES / f"view-{name}.png", optimize=True)
    sys.stderr.write(f"{name}\n")


class PictureRun(ChaosBench):
    """A run that is brought into the states of the pictures."""

    def take_picture(self, name: str, tab: str = "operator", meanwhile: Callable[[], object] | None = None) -> None:
        """Take a picture of the run."""
        picture(name, f"--run {self.run.run_id}", "--tab", tab, "--seconds", f"{LOOK_S}", meanwhile=meanwhile)

    def restart_camera(self, keys: dict[str, Any]) -> None:
        """Restart the camera with other settings, such as another star."""
        file = self.folder / "other.toml"
        file.write_text(load(None, keys).to_toml())
        self.kill(Role.CAMERA)
        self.restart(Role.CAMERA, [*self.children[Role.CAMERA].command, "--config", str(file)], ready=False)

    def suspend_controller_repeatedly(self) -> None:
        """Suspend the controller (SIGSTOP) twelve times, for 40 ms each."""
        for _ in range(12):
            with self.suspended(Role.CONTROLLER):
                time.sleep(0.04)
            time.sleep(0.3)


@contextlib.contextmanager
def picture_run(keys: dict[str, Any]) -> Iterator[PictureRun]:
    """A run with these settings, for a few pictures."""
    with tempfile.TemporaryDirectory() as name:
        config = load(None, keys | {"recorder.folder": name}, spread(os.sched_getaffinity(0)))
        run = PictureRun(config, Path(name), random.Random(1), None)  # noqa: S311  # nothing secret
        try:
            run.begin()
            time.sleep(6)  # a starting loop skips some frames, which the tiles show for five seconds
            yield run
        finally:
            run.end()


def make() -> None:
    """Take the pictures of every state and every tab."""
    with picture_run(BRIGHT) as run:
        loop = run.client()
        for tab in ("operator", "optics", "engineering"):
            run.take_picture(tab, tab)
        run.take_picture("open", meanwhile=loop.open_loop)
        loop.close_loop()
        time.sleep(5)
        run.take_picture("frames-lost", meanwhile=run.suspend_controller_repeatedly)
        time.sleep(5)
        run.take_picture("recording-stopped", meanwhile=lambda: loop.record(False))
        picture("log", str(max(run.folder.glob("*.mcap"))))
        loop.record(True)
        run.take_picture("star-gone", meanwhile=lambda: run.restart_camera(BRIGHT | {"star.magnitude": 9.0}))
    with picture_run(BRIGHT) as run:
        run.take_picture("controller-dead", meanwhile=lambda: run.kill(Role.CONTROLLER))
    with picture_run(SMALL_WELL) as run:
        run.take_picture("saturated", meanwhile=lambda: run.restart_camera(SMALL_WELL | {"star.magnitude": -2.0}))
