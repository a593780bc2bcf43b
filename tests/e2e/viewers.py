"""Viewers as the tests look at them: rerun's own, and its page in a real browser."""

import base64
import contextlib
import io
import itertools
import json
import os
import select
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from lowfc.adapters.rerun_viewer import vulkan_drivers

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
CALL_S = 60.0  # software that draws a frame of WebGL on a busy machine takes its time

needs_vulkan = pytest.mark.skipif(
    not vulkan_drivers() and "VK_ICD_FILENAMES" not in os.environ,
    reason="no Vulkan driver is installed: apt install mesa-vulkan-drivers libvulkan1",
)
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed: apt install chromium")

Pixels = npt.NDArray[np.uint8]


def pixels(png: bytes) -> Pixels:
    """(rows, columns, 3) of a PNG."""
    from PIL import Image

    with Image.open(io.BytesIO(png)) as picture:
        return np.asarray(picture.convert("RGB"))


def share_of(picture: Pixels, colour: tuple[int, int, int], tolerance: int = 12) -> float:
    """Which part of a picture has a colour, 0 to 1."""
    return float(np.all(np.abs(picture.astype(int) - colour) <= tolerance, axis=2).mean())


class Page:
    """One page of a headless Chromium, spoken to over two pipes in its debugging protocol.

    Attributes:
        fetched: address of everything it asked for, by number; without what its own policy forbade.
        complaints: errors and warnings of its console.
    """

    def __init__(self, process: "subprocess.Popen[bytes]", out: int, into: int) -> None:
        self.fetched: dict[str, str] = {}
        self.complaints: list[str] = []
        self._process, self._out, self._into = process, out, into
        self._said = b""
        self._loaded = False
        self._numbers = itertools.count(1)
        self._session: dict[str, str] = {}
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        self._session = {"sessionId": self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]}
        for domain in ("Page", "Network", "Runtime", "Log"):
            self.call(f"{domain}.enable")

    def open(self, address: str) -> None:
        """Go there and wait until the page has loaded, which the viewer in it has not yet."""
        self._loaded = False
        self.call("Page.navigate", url=address)
        deadline_s = time.monotonic() + CALL_S
        while not self._loaded:
            self._note(self._next(deadline_s))

    def screenshot(self) -> bytes:
        """PNG of what it shows now."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def screenshot_when(self, shows: Callable[[Pixels], bool], seconds: float) -> bytes:
        """PNG of the page once it shows what is waited for, or at the end of the time."""
        deadline_s = time.monotonic() + seconds
        while True:
            picture = self.screenshot()
            if shows(pixels(picture)) or time.monotonic() > deadline_s:
                return picture
            time.sleep(0.5)

    def call(self, method: str, **parameters: Any) -> Any:
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters} | self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        deadline_s = time.monotonic() + CALL_S
        while True:
            answer = self._next(deadline_s)
            if answer.get("id") == number:
                assert "error" not in answer, (method, answer)
                return answer["result"]
            self._note(answer)

    def _next(self, deadline_s: float) -> dict[str, Any]:
        while b"\0" not in self._said:
            ready, _, _ = select.select([self._into], [], [], max(0.0, deadline_s - time.monotonic()))
            assert ready, "the browser does not answer"
            more = os.read(self._into, 1 << 20)
            assert more, f"the browser ended with {self._process.wait()}"
            self._said += more
        message, _, self._said = self._said.partition(b"\0")
        return dict(json.loads(message))

    def _note(self, message: dict[str, Any]) -> None:
        event, about = message.get("method"), message.get("params", {})
        if event == "Page.loadEventFired":
            self._loaded = True
        elif event == "Network.requestWillBeSent":
            self.fetched[about["requestId"]] = about["request"]["url"]
        elif event == "Network.loadingFailed" and about.get("blockedReason") == "csp":
            self.fetched.pop(about["requestId"], None)
        elif event == "Log.entryAdded" and about["entry"]["level"] in ("warning", "error"):
            self.complaints.append(f"{about['entry']['text']} {about['entry'].get('url', '')}")
        elif event == "Runtime.consoleAPICalled" and about["type"] in ("warning", "error"):
            self.complaints.append(" ".join(str(one.get("value", "")) for one in about["args"]))
        elif event == "Runtime.exceptionThrown":
            self.complaints.append(str(about["exceptionDetails"].get("exception", about["exceptionDetails"])))


@contextlib.contextmanager
def browser(folder: Path, size_px: tuple[int, int] = (1600, 1000)) -> Iterator[Page]:
    """A headless Chromium that can draw WebGL in software, with a profile of its own and no wish to call home.

    It fetches from this machine only: all other addresses lead to a port where nobody listens.
    """
    quiet = ("quic", "background-networking", "component-update", "sync", "default-apps", "extensions", "dev-shm-usage")
    words = [
        *(
            str(CHROMIUM),
            "--headless",
            "--no-sandbox",
            "--no-first-run",
            "--hide-scrollbars",
            "--remote-debugging-pipe",
        ),
        *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"),
        *(f"--disable-{name}" for name in quiet),
        *("--proxy-server=http://127.0.0.1:9", f"--user-data-dir={folder / 'profile'}"),
        f"--window-size={size_px[0]},{size_px[1]}",
    ]
    theirs_in, ours_out = os.pipe()
    ours_in, theirs_out = os.pipe()

    def plumb() -> None:  # Chromium reads from 3 and writes to 4
        spare = os.dup(theirs_out), os.dup(theirs_in)
        os.dup2(spare[1], 3)
        os.dup2(spare[0], 4)

    with (folder / "browser.txt").open("wb") as said:
        process = subprocess.Popen(
            words, stdout=said, stderr=said, preexec_fn=plumb, pass_fds=(3, 4), start_new_session=True
        )
    os.close(theirs_in)
    os.close(theirs_out)
    try:
        yield Page(process, ours_out, ours_in)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(timeout=10)
        os.close(ours_out)
        os.close(ours_in)


def browser_screenshot(
    address: str,
    path: Path,
    seconds: float,
    shows: Callable[[Pixels], bool],
    size_px: tuple[int, int] = (1600, 1000),
) -> Page:
    """Picture of a page in a browser, once it shows what is waited for or after so many seconds.

    Args:
        address: of the page.
        path: PNG to write; the browser's profile is beside it while it runs.
        seconds: at most to wait.
        shows: whether a picture is what is waited for.
        size_px: width and height of the window; drawing takes time in proportion.

    Returns:
        What the page fetched and complained of.
    """
    folder = path.parent / f"{path.stem}-browser"
    folder.mkdir()
    try:
        with browser(folder, size_px) as page:
            page.open(address)
            path.write_bytes(page.screenshot_when(shows, seconds))
            return page
    finally:
        shutil.rmtree(folder, ignore_errors=True)
