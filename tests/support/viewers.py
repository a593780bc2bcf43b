"""Helpers for tests of rerun's native viewer, and of its web viewer in a real browser."""

import base64
import contextlib
import io
import itertools
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
import pytest
import rerun.blueprint as rrb
from PIL import Image
from rerun.experimental import ViewerClient
from websockets.sync.client import ClientConnection, connect

from lowfc.adapters.viewer.rerun_viewer import RerunViewer, vulkan_drivers
from tests.support.loops import until

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
CALL_S = 60.0  # software rendering of WebGL is slow on a busy machine

needs_vulkan = pytest.mark.skipif(
    not vulkan_drivers() and "VK_ICD_FILENAMES" not in os.environ,
    reason="no Vulkan driver is installed: apt install mesa-vulkan-drivers libvulkan1",
)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed: apt install chromium")


def on_screen(test: Callable[..., None]) -> Callable[..., None]:
    """Mark a test that lets rerun draw: it needs a Vulkan driver, and runs exclusively."""
    return pytest.mark.exclusive(pytest.mark.viewer(needs_vulkan(test)))


Pixels = npt.NDArray[np.uint8]


def pixels(png: bytes) -> Pixels:
    """Pixels (rows, columns, 3) of a PNG."""
    with Image.open(io.BytesIO(png)) as picture:
        return np.asarray(picture.convert("RGB"))


def share_of(picture: Pixels, colour: tuple[int, int, int]) -> float:
    """Fraction of the pixels, 0 to 1, of which each channel differs from a colour by at most 12 of 255."""
    return float(np.all(np.abs(picture.astype(int) - colour) <= 12, axis=2).mean())


def views(part: rrb.Container | rrb.View) -> list[rrb.View]:
    """Views of a layout or of a part of it."""
    return [part] if isinstance(part, rrb.View) else [view for one in part.contents for view in views(one)]


def complaints(viewer: RerunViewer) -> list[str]:
    """Faults that the viewer's views report, and the warnings and errors of its log."""
    reports = [report.summary for view in viewer.state().views for report in view.reports]
    logs = ViewerClient.connect(viewer.url).get_logs()
    return reports + [entry.message for entry in logs if entry.level != "INFO"]


def listening(pid: int) -> set[tuple[str, int]]:
    """Address and port of every listening IPv4 and IPv6 socket of a process."""
    sockets = psutil.Process(pid).net_connections("inet")
    return {(one.laddr.ip, one.laddr.port) for one in sockets if one.status == "LISTEN"}


class Page:
    """A page of a headless Chromium, controlled by its debugging protocol.

    Attributes:
        fetched: addresses requested by the page, by request id, without those blocked by its Content-Security-Policy.
        complaints: errors and warnings of its console.
    """

    def __init__(self, connection: ClientConnection) -> None:
        self.fetched: dict[str, str] = {}
        self.complaints: list[str] = []
        self._connection = connection
        self._numbers = itertools.count(1)
        self._session: dict[str, str] = {}
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = {"sessionId": self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]}
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def open(self, address: str) -> None:
        """Open an address and wait until the page has loaded; the viewer in it may still be loading."""
        self.call("Page.navigate", url=address)
        while self._next().get("method") != "Page.loadEventFired":
            pass

    def screenshot_when(self, shows: Callable[[Pixels], bool], seconds: float) -> bytes:
        """PNG of the page once `shows` is true, or after the timeout."""
        deadline_s = time.monotonic() + seconds
        while True:
            picture = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
            if shows(pixels(picture)) or time.monotonic() > deadline_s:
                return picture
            time.sleep(0.5)

    def call(self, method: str, **parameters: Any) -> Any:
        number = next(self._numbers)
        self._connection.send(json.dumps({"id": number, "method": method, "params": parameters} | self._session))
        while (answer := self._next()).get("id") != number:
            pass
        assert "error" not in answer, (method, answer)
        return answer["result"]

    def _next(self) -> dict[str, Any]:
        message: dict[str, Any] = json.loads(self._connection.recv(timeout=CALL_S))
        event, parameters = message.get("method"), message.get("params", {})
        if event == "Network.requestWillBeSent":
            self.fetched[parameters["requestId"]] = parameters["request"]["url"]
        elif event == "Network.loadingFailed" and parameters.get("blockedReason") == "csp":
            self.fetched.pop(parameters["requestId"], None)
        elif event in ("Log.entryAdded", "Runtime.consoleAPICalled", "Runtime.exceptionThrown"):
            level = parameters.get("entry", {}).get("level") or parameters.get("type", "error")
            if level in ("warning", "error"):
                self.complaints.append(json.dumps(parameters))
        return message


@contextlib.contextmanager
def browser(folder: Path, size_px: tuple[int, int], *, webgl: bool = False) -> Iterator[Page]:
    """Run a headless Chromium that can connect to this host only; `webgl` is drawn in software, which is slow."""
    quiet = ("quic", "background-networking", "component-update", "sync", "default-apps", "extensions", "dev-shm-usage")
    options = ["headless", "no-sandbox", "no-first-run", "hide-scrollbars", "remote-debugging-port=0"]
    drawing = ("use-angle=swiftshader", "enable-unsafe-swiftshader", "ignore-gpu-blocklist")
    options += drawing if webgl else ("disable-gpu",)
    options += [f"disable-{name}" for name in quiet]
    options += ["proxy-server=http://127.0.0.1:9", f"user-data-dir={folder / 'profile'}"]  # no proxy listens there
    options += [f"window-size={size_px[0]},{size_px[1]}"]
    with (folder / "browser.txt").open("wb") as output:
        command = [str(CHROMIUM), *(f"--{option}" for option in options)]
        process = subprocess.Popen(command, stdout=output, stderr=output, start_new_session=True)
    try:
        active = folder / "profile" / "DevToolsActivePort"
        until(lambda: active.exists() and active.read_text().count("\n"), CALL_S)
        port, path = active.read_text().split("\n")
        with connect(f"ws://127.0.0.1:{port}{path}", max_size=None, proxy=None) as connection:
            yield Page(connection)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(timeout=10)


def browser_screenshot(
    address: str, path: Path, seconds: float, shows: Callable[[Pixels], bool], size_px: tuple[int, int]
) -> Page:
    """Write a PNG of a page in a browser once `shows` is true, or after `seconds`."""
    folder = path.parent / f"{path.stem}-browser"
    folder.mkdir()
    try:
        with browser(folder, size_px, webgl=True) as page:
            page.open(address)
            path.write_bytes(page.screenshot_when(shows, seconds))
            return page
    finally:
        shutil.rmtree(folder, ignore_errors=True)
