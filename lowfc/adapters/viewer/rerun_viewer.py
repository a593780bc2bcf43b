"""The rerun viewer as a child process: as a window, without a screen (headless), or as a page for the browser.

It listens on loopback only, does not use the network, and ends with its parent. The binary is started directly: rerun's
servers in a Python process cannot be bound to an address, and the script `rerun` leaves the binary running when the
script is killed.

Measured with rerun 0.41:

- `RecordingStream.log` to a hanging viewer continues until about 100 MB are unsent (the calling process grows by 150
  MB), then blocks. With a dead viewer the call does not block and the calling process does not grow; a new stream with
  the same ids to a new viewer on the same port continues the recording.
- `disconnect`, `del`, and the end of the process block while the viewer hangs: call stop() first.
- A browser's page must be reloaded after its server has restarted.
- The memory limit applies to the data as counted by rerun: the memory of a viewer levelled off at 184 MB for the limit
  "100MB", that of a headless viewer at 545 MB for "200MB".
- ViewerClient has no timeout: all its calls here run in a thread that may be abandoned.
"""

import http.client
import importlib.util
import os
import signal
import socket
import tempfile
import threading
import time
from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar
from urllib.parse import quote

import psutil

from lowfc.adapters.bus.run import free_ports
from lowfc.adapters.files.whole_file import being_written
from lowfc.adapters.process.child import Child
from lowfc.adapters.process.host import resident_bytes
from lowfc.adapters.viewer.viewer_page import ViewerPage
from lowfc.contract.errors import LowfcError

if TYPE_CHECKING:
    from rerun.experimental import ViewerClient, ViewerState

HOST = "127.0.0.1"
_DRIVER_FOLDERS = ("/usr/share/vulkan/icd.d", "/usr/local/share/vulkan/icd.d", "/etc/vulkan/icd.d")
_DRIVER_VARIABLES = ("VK_ICD_FILENAMES", "VK_DRIVER_FILES")
_START_S = 20.0
_POLL_S = 0.05
_CALL_S = 20.0
_STOP_S = 1.0
_REDRAW_S = 0.5  # between two images: longer than a pause in the animation of a notification
_FAILURE_MARKS = ("panicked at", "Error:", "ERROR")  # in lines of the viewer's output
_HTTP2_HELLO = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes([0, 0, 0, 4, 0, 0, 0, 0, 0])  # with empty SETTINGS

Answer = TypeVar("Answer")


class ViewerError(LowfcError):
    """The viewer cannot be started, or does not answer."""


class Show(StrEnum):
    """Display mode of the viewer."""

    NATIVE = "native"
    HEADLESS = "headless"
    WEB = "web"


class RerunViewer:
    """One viewer, running from construction until stop() or the end of its `with` block.

    A RecordingStream connects to `url`, a browser to `web_address`, which is None unless `show` is WEB.
    """

    def __init__(
        self,
        show: Show,
        *,
        memory_limit: str = "512MB",
        size_px: tuple[int, int] = (1600, 1000),
        port: int | None = None,
        web_port: int | None = None,
    ) -> None:
        """Start the viewer and wait until it answers; a port of None is replaced by a free one.

        `memory_limit` bounds the data of the stream that the viewer keeps; `size_px` is (width, height) if headless.

        Raises:
            ViewerError: the binary, a screen or a driver is missing, or the viewer does not start.
        """
        free = free_ports(3)
        self.show = show
        self.port = port or free[0]
        self.web_port = (web_port or free[1]) if show is Show.WEB else None
        self.url = stream_url(self.port)
        self.web_address = web_address(self.url, self.web_port) if self.web_port else None
        self._page: ViewerPage | None = None
        self._source_port = free[2]
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115  # unnamed: removed even if this process is killed
        self._output = ""
        stderr = Path(f"/proc/self/fd/{self._stderr.fileno()}")
        self._child = Child(f"the viewer on port {self.port}", [], stderr, death_signal=signal.SIGKILL)
        try:
            self._child.environment = _environment(show)
            self._child.command = [str(viewer_binary()), "--bind", HOST, "--port", str(self.port)]
            self._child.command += _arguments(show, memory_limit, size_px, self._source_port)
            self._start()
            if self.web_port:
                self._page = ViewerPage(HOST, self.web_port, self._source_port, self.port)
        except OSError as fault:
            self.stop()
            raise ViewerError(f"the viewer cannot be started ({fault}): use another --port and --web-port") from fault
        except BaseException:
            self.stop()
            raise

    def __enter__(self) -> "RerunViewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def pid(self) -> int:
        """Process id of the viewer."""
        assert self._child.process is not None  # noqa: S101  # __init__ started it
        return self._child.process.pid

    @property
    def alive(self) -> bool:
        """Whether its process exists, even if it hangs."""
        return self._child.process is not None and self._child.status is None

    def answers(self, timeout_s: float = 1.0) -> bool:
        """Whether its server answers on a new connection, which the kernel accepts even for a hanging viewer."""
        try:
            with socket.create_connection((HOST, self.port), timeout_s) as link:
                link.settimeout(timeout_s)
                link.sendall(_HTTP2_HELLO)
                return bool(link.recv(9))
        except OSError:
            return False

    def resident_bytes(self) -> int:
        """Resident memory of its process; 0 if it has ended."""
        try:
            return resident_bytes(self.pid)
        except psutil.NoSuchProcess:
            return 0

    def exit_description(self) -> str:
        """One line on how the viewer ended."""
        how = self._child.exit_description()
        return how if (self._child.status or 0) < 0 else f"{how} ({self._failure()})"

    def stop(self) -> None:
        """Stop the viewer: SIGTERM, then SIGKILL after a second; no effect if it has ended."""
        if self._page is not None:
            self._page.stop()
            self._page = None
        self._child.stop(_STOP_S)
        self._failure()  # keeps the output for `exit_description`
        self._stderr.close()

    def screenshot(self, path: Path | None = None, timeout_s: float = 20.0) -> bytes:
        """PNG of the whole viewer: after loading, the first image equal to the one before, or the last in `timeout_s`.

        Raises:
            ViewerError: the viewer does not answer, or has not loaded everything within `timeout_s`.
            DataFileError: the file cannot be written.
        """
        deadline_s = time.monotonic() + timeout_s
        while not ((state := self._ask_again(_state, deadline_s)).recordings and state.views and not state.loading):
            if time.monotonic() > deadline_s:
                raise ViewerError(
                    f"the viewer has {len(state.recordings)} recordings, {len(state.views)} views and "
                    f"{len(state.loading)} still to load after {timeout_s:g} s; is anything sent to {self.url}?"
                )
            time.sleep(_POLL_S)
        deadline_s = time.monotonic() + timeout_s
        picture = before = b""
        while not picture or (picture != before and time.monotonic() < deadline_s):
            if picture:
                time.sleep(_REDRAW_S)
            before, picture = picture, self._ask_again(lambda client: client.take_screenshot(), deadline_s)
        if path is not None:
            with being_written(path) as part:
                part.write_bytes(picture)
        return picture

    def state(self) -> "ViewerState":
        """Recordings, views and pending loads of the viewer; ViewerError if it does not answer."""
        return self._ask(_state)

    def _start(self) -> None:
        self._child.start()
        deadline_s = time.monotonic() + _START_S
        ready = self._page_is_served if self.show is Show.WEB else self._draws
        while not (ready() and self.alive):
            if not self.alive:
                raise ViewerError(f"{self.exit_description()}{_ADVICE[self.show]}")
            if time.monotonic() > deadline_s:
                raise ViewerError(
                    f"the viewer does not answer on {self.url} after {_START_S:g} s; its last output: "
                    f"{self._failure()}{_ADVICE[self.show]}"
                )
            time.sleep(_POLL_S)

    def _failure(self) -> str:
        """Most useful line of its output: the failure before a stack trace, otherwise the last line."""
        if not self._stderr.closed:
            self._stderr.seek(0)
            self._output = self._stderr.read().decode(errors="replace")
        lines = [line.strip() for line in self._output.split("\n") if line.strip()]
        failures = [line for line in lines if any(mark in line for mark in _FAILURE_MARKS)]
        return next(iter(failures or lines[-1:]), "it wrote nothing")

    def _page_is_served(self) -> bool:
        page = http.client.HTTPConnection(HOST, self._source_port, timeout=1.0)
        try:
            page.request("HEAD", "/")
            return page.getresponse().status == http.client.OK and self.answers()
        except (OSError, http.client.HTTPException):
            return False
        finally:
            page.close()

    def _draws(self) -> bool:
        """Whether the viewer draws: without a graphics driver, only its server runs for a moment."""
        try:
            if self.show is Show.HEADLESS:
                return self.answers() and bool(self._ask(lambda client: client.take_screenshot(max_size=16)))
            return self.answers() and bool(self.state())
        except ViewerError:
            return False

    def _ask_again(self, question: "Callable[[ViewerClient], Answer]", deadline_s: float) -> Answer:
        """Query the viewer, and repeat a failed query until the deadline: on a loaded host it abandons queries."""
        while True:
            try:
                return self._ask(question)
            except ViewerError:
                if not self.alive or time.monotonic() > deadline_s:
                    raise
            time.sleep(_POLL_S)

    def _ask(self, question: "Callable[[ViewerClient], Answer]") -> Answer:
        """Query the viewer on a separate thread, which is abandoned if the viewer hangs."""
        answers: list[Answer] = []
        faults: list[Exception] = []

        def call() -> None:
            from rerun.experimental import ViewerClient

            try:
                answers.append(question(ViewerClient.connect(self.url)))
            except Exception as fault:  # rerun raises RuntimeError, ConnectionError and others
                faults.append(fault)

        asker = threading.Thread(target=call, name="ask-viewer", daemon=True)
        asker.start()
        asker.join(_CALL_S)
        if answers:
            return answers[0]
        if not self.alive:
            raise ViewerError(self.exit_description())
        fault = str(faults[0]).partition("\n")[0] if faults else ""  # the other lines are metadata
        what = f"answers with {fault}" if faults else f"does not answer within {_CALL_S:g} s"
        raise ViewerError(f"the viewer on {self.url} {what}; stop it and start it again")


def _state(client: "ViewerClient") -> "ViewerState":
    return client.get_state()


_REINSTALL = "install it again: pip install --force-reinstall rerun-sdk"
_NO_SCREEN = "use --web and a browser, --headless-screenshot FILE.png, or --save FILE.rrd"
_PACKAGES = "apt install mesa-vulkan-drivers libvulkan1"
_ADVICE = {Show.NATIVE: f"; {_NO_SCREEN}", Show.HEADLESS: f"; if there is no Vulkan driver: {_PACKAGES}", Show.WEB: ""}


def stream_url(port: int) -> str:
    """URL for a RecordingStream to a viewer that listens on a port."""
    return f"rerun+http://{HOST}:{port}/proxy"


def web_address(url: str, web_port: int) -> str:
    """Address of the page that opens the stream, with the dark theme of our layout and no stored state."""
    return f"http://{HOST}:{web_port}/?url={quote(url, safe='')}&hide_welcome_screen&persist=0&theme=dark"


def has_screen() -> bool:
    """Whether the environment names a screen for a window."""
    return any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))


def require_screen(show: Show | None) -> None:
    """Raise ViewerError if a window is requested and there is no screen."""
    if show is Show.NATIVE and not has_screen():
        raise ViewerError(f"there is no screen for a window (neither DISPLAY nor WAYLAND_DISPLAY is set); {_NO_SCREEN}")


def vulkan_drivers() -> list[Path]:
    """Installed Vulkan drivers, the software renderer first."""
    drivers = [path for folder in _DRIVER_FOLDERS for path in sorted(Path(folder).glob("*.json"))]
    return sorted(drivers, key=lambda path: not path.name.startswith("lvp"))


def viewer_binary() -> Path:
    """The viewer's binary as installed by rerun-sdk; ViewerError if it is missing."""
    package = importlib.util.find_spec("rerun_cli")
    binary = Path(package.origin).parent / "rerun" if package is not None and package.origin is not None else None
    if binary is None or not binary.is_file():
        raise ViewerError(f"the package rerun-sdk has no viewer here; {_REINSTALL}")
    return binary


def _arguments(show: Show, memory_limit: str, size_px: tuple[int, int], source_port: int) -> list[str]:
    if show is Show.WEB:
        return ["--serve-web", "--web-viewer-port", str(source_port), "--server-memory-limit", memory_limit]
    headless = ["--headless", "--window-size", f"{size_px[0]}x{size_px[1]}"] if show is Show.HEADLESS else []
    limits = ["--memory-limit", memory_limit, "--server-memory-limit", "0B"]
    return [*limits, "--hide-welcome-screen", "--expect-data-soon", *headless]


def _environment(show: Show) -> dict[str, str]:
    """Environment of the viewer: no usage statistics, no network access, no output below warnings."""
    environment = {name: value for name, value in os.environ.items() if name.lower() != "no_proxy"}
    require_screen(show)
    if show is Show.HEADLESS and not any(environment.get(name) for name in _DRIVER_VARIABLES):
        drivers = vulkan_drivers()
        if not drivers:
            raise ViewerError(f"there is no Vulkan driver to draw with; {_PACKAGES}")
        environment["VK_ICD_FILENAMES"] = str(drivers[0])
    environment.pop("FORCE_RERUN_ANALYTICS", None)
    environment["CI"] = "1"  # disables usage statistics without changing the user's settings
    environment["ALL_PROXY"] = f"http://{HOST}:9"  # no proxy there: prevents the version check at api.github.com
    environment["NO_COLOR"] = "1"  # the end of its output is printed in our errors
    environment["RUST_LOG"] = "warn,egui_wgpu=error,re_renderer=error,re_viewer::native=error"
    return environment
