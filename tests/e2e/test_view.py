"""The view of real processes, in the real viewer and a real browser, by their pixels; saved files, refused options."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from rich.console import Console

from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.join import clock_of
from lowfc.adapters.viewer.rerun_viewer import RerunViewer, Show
from lowfc.client import running
from lowfc.contract.configuration import load
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import Role
from lowfc.programs.launch import sim_loop
from lowfc.programs.view.command import view
from lowfc.programs.view.draw.tabs import Tab
from lowfc.programs.view.layout import LIVE_WINDOW_S, layout
from lowfc.programs.view.live_view import LiveView
from lowfc.programs.view.panels.tiles import FILL
from lowfc.programs.view.target import Target
from lowfc.programs.view.verdicts.tile import Level
from tests.support.loops import FIXED, LOWFC, children, interrupt, run, start, until
from tests.support.report_log import SyntheticLog
from tests.support.viewers import browser_screenshot, complaints, needs_chromium, on_screen, pixels, share_of, views

MIN_SHADES = 8  # least number of colours below the title of a panel with content; an empty panel has one
TITLE_ROWS = 30


@pytest.fixture(scope="module")
def live(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Name of a run whose loop is closed."""
    folder = tmp_path_factory.mktemp("loop")
    (folder / "loop.toml").write_text(FIXED)
    process = start(folder, "sim-loop", "--config", "loop.toml", "--rate", "20", "--no-record")
    try:
        until(lambda: running() or process.poll() is not None)
        yield running()[0]
    finally:
        interrupt(process)
    assert process.returncode in (0, 130)


@pytest.mark.exclusive
@pytest.mark.slow
def test_the_loop_continues_when_its_view_is_killed(tmp_path: Path) -> None:
    process = start(tmp_path, "sim-loop", "--web", "--rate", "200", "--duration", "4", "--json")
    until(lambda: "view" in children(process.pid))
    view = children(process.pid)["view"]
    until(psutil.Process(view).children)
    os.kill(view, signal.SIGKILL)
    out, stderr = process.communicate(timeout=60)
    assert process.returncode == 0, stderr
    assert "the loop continues without a view" in stderr
    results = json.loads(out)
    assert results["frames_processed"] >= 0.98 * results["frames_published"] > 600
    assert results["messages_lost"] == 0


def test_a_log_without_an_end_is_saved_as_a_valid_rrd_file(tmp_path: Path) -> None:
    log = SyntheticLog().frames(300).write(tmp_path / "cut.mcap", finish=False)
    done = run(tmp_path, "view", str(log), "--save", "cut.rrd", "--json")
    assert done.returncode == 0, done.stderr
    assert "no end" in done.stderr
    assert json.loads(done.stdout)["moments"] > 5
    verify = [str(Path(sys.executable).parent / "rerun"), "rrd", "verify", "cut.rrd"]
    checked = subprocess.run(verify, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert checked.returncode == 0, checked.stderr


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        ({"web": True, "native": True}, "use one"),
        ({"foxglove": True, "web": True}, "--foxglove"),
        ({"foxglove": True, "web_port": 15999}, "--foxglove"),
        ({"foxglove": True, "tab": Tab.OPTICS}, "--foxglove"),
        ({"native": True, "web_port": 15999}, "add --web"),
        ({"logs": [Path("nothing.mcap")], "save": Path("x.rrd"), "port": 15999}, "--save starts no viewer"),
        ({"run": "nosuch", "web": True}, "there is no run"),
        ({"logs": [Path("nothing.mcap")], "save": Path("x.rrd")}, "nothing.mcap"),
        ({"logs": [Path("nothing.mcap")], "save": Path("nowhere/x.rrd")}, "nowhere"),
        ({"native": True}, "no screen"),
        ({"headless_screenshot": Path("x.jpg")}, "ends in .png"),
        ({"web": True, "port": 15999, "web_port": 15999}, "must differ"),
        ({"logs": [Path("nothing.mcap")], "seconds": 3.0}, "--seconds"),
    ],
)
def test_invalid_view_options_are_one_line_errors(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, object], complaint: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for screen in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(screen, raising=False)
    monkeypatch.setattr("lowfc.adapters.process.realtime.lower_priority", lambda: None)
    if "run" not in options and "logs" not in options:
        options = options | {"run": open_run("mistaken").run_id}
    with pytest.raises(LowfcError, match=complaint) as raised:
        view(**options)  # type: ignore[arg-type]
    assert len(str(raised.value).splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("show", "expected"), [(Show.NATIVE, False), (Show.WEB, True)])
def test_sim_loop_starts_a_view_with_a_web_port_only_for_a_browser(show: Show, expected: bool) -> None:
    command = sim_loop._view(open_run("shown"), show, Console(quiet=True)).command
    assert f"--{show}" in command
    assert ("--web-port" in command) == expected


@pytest.mark.slow
@on_screen
def test_every_panel_of_every_tab_shows_the_live_loop(live: str, artefacts: Path) -> None:
    joined = open_run(live)
    config = load(joined.path / "config.toml")
    clock = clock_of(config)
    bus = ZenohBus(joined.links, Role.VIEWER, clock)
    target = Target(picture=Path("a.png"))
    live_view = LiveView(config, live, clock, bus, target)
    try:
        live_view.run(5.0)
        assert live_view.renewals == 0
        viewer = live_view.viewer
        for number, tab in enumerate(Tab):
            blueprint = layout(tab)
            stream = target.stream(viewer, live, LIVE_WINDOW_S)
            stream.send_blueprint(blueprint)
            stream.disconnect()
            picture = viewer.screenshot(artefacts / f"live-{tab}.png", timeout_s=6)
            assert pixels(picture).shape == (1000, 1600, 3)
            shown = {view.name: _shades(viewer, view.id) for view in views(blueprint.root_container.contents[number])}
            assert len(shown) > 4
            assert {name: shades for name, shades in shown.items() if shades < MIN_SHADES} == {}, tab
        assert complaints(viewer) == []
    finally:
        live_view.close()
        bus.close()


@pytest.mark.exclusive
@pytest.mark.browser
@needs_chromium
def test_the_web_view_shows_the_live_loop_and_fetches_from_this_host_only(live: str, artefacts: Path) -> None:
    process = subprocess.Popen([*LOWFC, "view", "--web", "--run", live], stderr=subprocess.PIPE, text=True)
    try:
        address = re.search(r"http://127\.0\.0\.1:\S+", process.stderr.readline())
        picture = artefacts / "live-browser.png"
        good = FILL[Level.GOOD]
        page = browser_screenshot(address.group(), picture, 120, lambda shown: share_of(shown, good) > 0.01, (560, 350))
        assert share_of(pixels(picture.read_bytes()), good) > 0.01, "a tile has the colour of a good state"
        assert {url.startswith(("http://127.0.0.1", "data:", "blob:")) for url in page.fetched.values()} == {True}
    finally:
        _, stderr = interrupt(process)
        assert process.returncode == 0, stderr


def _shades(viewer: RerunViewer, view_id: object) -> int:
    """Number of different colours in a panel, below its title."""
    from rerun.experimental import ViewerClient

    shown = pixels(ViewerClient.connect(viewer.url).take_screenshot(view_id))[TITLE_ROWS:]  # type: ignore[arg-type]
    return len(np.unique(shown.reshape(-1, 3), axis=0))
