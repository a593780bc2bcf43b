"""Make the pictures of docs/viewing.md and the README: `python -m tools.measure pictures`, about three minutes.

Real processes are brought into each state by hand, as an operator's bad night would, and `lowfc view
--headless-screenshot` looks at them. Needs a Vulkan driver: `apt install mesa-vulkan-drivers libvulkan1`.
"""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from PIL import Image

from tools.shared import ROOT

PICTURES = ROOT / "docs" / "pictures"
RUN = "pictures"
LOOK_S = 10.0
"""How long a view looks before its picture is taken; states come about in the middle of it."""
MENU_BAR = 37  # pixels at the top that say nothing about the loop
SHADES = 192
CLOSED = '[control]\nstart_mode = "closed"\n'
BRIGHT = CLOSED + '[sensor]\nsam = "sam27d10_bal14"\n'
SMALL_WELL = CLOSED + "[camera]\nfull_well_e = 1500\n"

Process = subprocess.Popen[bytes]


class Night:
    """A run's processes, one by one."""

    def __init__(self, folder: Path, config: str) -> None:
        self._folder = folder
        self._environment = os.environ | {"XDG_RUNTIME_DIR": str(folder)}
        self.processes: dict[str, Process] = {}
        for name in ("controller", "mirror", "recorder", "camera"):
            self.start(name, config)

    def start(self, name: str, config: str) -> None:
        """Start one of them, with its own idea of the bench."""
        file = self._folder / f"{name}.toml"
        file.write_text(config)
        module = {"camera": ["sim_camera"], "mirror": ["sim_dm"], "recorder": ["lowfc", "record"]}
        words = [sys.executable, "-m", *module.get(name, ["lowfc", name]), "--run", RUN, "--config", str(file)]
        with (self._folder / f"{name}.txt").open("wb") as said:
            self.processes[name] = subprocess.Popen(words, cwd=self._folder, env=self._environment, stderr=said)

    def restart(self, name: str, config: str) -> None:
        """End one as told, and start it with another bench in mind."""
        self.processes[name].terminate()
        self.processes[name].wait(10)
        self.start(name, config)

    def ask(self, *words: str) -> None:
        """`lowfc ctl`."""
        command = [sys.executable, "-m", "lowfc", "ctl", *words, "--run", RUN]
        subprocess.run(command, env=self._environment, check=True, stdout=subprocess.DEVNULL)

    def stumble(self) -> None:
        """Hold the controller up for a moment, again and again."""
        for _ in range(12):
            self.processes["controller"].send_signal(signal.SIGSTOP)
            time.sleep(0.04)
            self.processes["controller"].send_signal(signal.SIGCONT)
            time.sleep(0.3)

    def picture(self, name: str, tab: str, happening: Callable[[], None] | None = None) -> None:
        """Look at it, let something happen meanwhile, keep the picture."""
        out = self._folder / f"{name}.png"
        words = [sys.executable, "-m", "lowfc", "view", "--run", RUN, "--headless-screenshot", str(out), "--tab", tab]
        view = subprocess.Popen([*words, "--seconds", f"{LOOK_S}"], env=self._environment)
        time.sleep(LOOK_S * 0.55)
        if happening is not None:
            happening()
        if view.wait(60) != 0:
            raise SystemExit(f"no picture of {name}")
        keep(name, out)

    def picture_of_the_log(self, name: str) -> None:
        """The last log that was finished, as a whole."""
        out = self._folder / f"{name}.png"
        log = max(self._folder.glob("logs/*.mcap"))
        words = [sys.executable, "-m", "lowfc", "view", str(log), "--headless-screenshot", str(out)]
        subprocess.run(words, env=self._environment, check=True)
        keep(name, out)

    def end(self) -> None:
        """End what is left."""
        for name in ("camera", "controller", "mirror", "recorder"):
            process = self.processes[name]
            process.terminate()
            process.wait(10)


def keep(name: str, out: Path) -> None:
    """Keep a picture among those of the documentation."""
    shown = Image.open(out).convert("RGB")
    shown = shown.crop((0, MENU_BAR, shown.width, shown.height)).resize((1280, 770), Image.Resampling.LANCZOS)
    PICTURES.mkdir(exist_ok=True)
    shown.quantize(SHADES, dither=Image.Dither.NONE).save(PICTURES / f"view-{name}.png", optimize=True)
    sys.stderr.write(f"{name}\n")


@contextlib.contextmanager
def night(config: str) -> Iterator[Night]:
    """A run with these settings, for a few pictures."""
    with tempfile.TemporaryDirectory() as name:
        made = Night(Path(name), config)
        try:
            time.sleep(6)  # starting, a loop skips some frames, and the tiles remember that for five seconds
            yield made
        finally:
            made.end()


def make() -> None:
    """Every state, and every tab."""
    with night(BRIGHT) as run:
        for tab in ("operator", "optics", "engineering"):
            run.picture(tab, tab)
        run.picture("open", "operator", lambda: run.ask("open"))
        run.ask("close")
        time.sleep(5)
        run.picture("frames-lost", "operator", run.stumble)
        time.sleep(5)
        run.picture("recording-stopped", "operator", lambda: run.ask("record", "stop"))
        run.picture_of_the_log("log")
        run.ask("record", "start")
        run.picture("star-gone", "operator", lambda: run.restart("camera", BRIGHT + "[star]\nmagnitude = 9\n"))
    with night(BRIGHT) as run:
        run.picture("controller-dead", "operator", run.processes["controller"].kill)
    with night(SMALL_WELL) as run:
        run.picture("saturated", "operator", lambda: run.restart("camera", SMALL_WELL + "[star]\nmagnitude = -2\n"))
