"""Rerun's viewer: as a child process of ours, and as a user opens a log of the real loop with it."""

import contextlib
import io
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mcap.reader import make_reader

from lowfc.adapters.viewer.rerun_viewer import RerunViewer, Show, ViewerError, vulkan_drivers
from lowfc.contract.messages import FLOAT32, MONO16, RawImage, wire
from tests.support.loops import loop, until
from tests.support.viewers import CHROMIUM, browser_screenshot, needs_chromium, on_screen, pixels, share_of

ORANGE, BLUE = (214, 110, 20), (20, 90, 214)
SHARE = 0.05  # of the viewer's pixels that an image of two colours gives each of them, at least


@pytest.fixture(scope="module")
def headless() -> Iterator[RerunViewer]:
    with RerunViewer(Show.HEADLESS, size_px=(640, 400)) as viewer:
        yield viewer


@pytest.fixture
def web() -> Iterator[RerunViewer]:
    with RerunViewer(Show.WEB) as viewer:
        yield viewer


@on_screen
def test_an_image_that_was_logged_is_on_the_screen(headless: RerunViewer, tmp_path: Path) -> None:
    stream = _two_colours(headless)
    path = tmp_path / "screen.png"
    picture = headless.screenshot(path)
    assert path.read_bytes() == picture
    shown = pixels(picture)
    assert shown.shape == (400, 640, 3)
    assert _both(shown)
    assert _mean_row(shown, ORANGE) < _mean_row(shown, BLUE), "it is upside down"
    assert [view.origin for view in headless.state().views] == ["/image"]
    assert headless.complaints() == []
    _end(stream)


@on_screen
def test_a_view_that_cannot_draw_is_complained_of() -> None:
    import rerun as rr

    with RerunViewer(Show.HEADLESS, size_px=(640, 400)) as viewer:
        stream = _two_colours(viewer)
        stream.log("image", rr.Image(bytes=b"too short", width=80, height=80, color_model="RGB", datatype="U8"))
        stream.flush(timeout_sec=10)
        viewer.screenshot()
        assert [line for line in viewer.complaints() if "image" in line]
        _end(stream)


@on_screen
def test_a_headless_viewer_is_reached_from_this_host_only(headless: RerunViewer) -> None:
    assert _listening(headless.pid) == {("127.0.0.1", headless.port)}


def test_a_page_is_reached_from_this_host_only(web: RerunViewer) -> None:
    theirs = _listening(web.pid)
    assert {host for host, _ in theirs} == {"127.0.0.1"}
    assert web.port in {port for _, port in theirs}
    assert ("127.0.0.1", web.web_port) in _listening(os.getpid())


def test_a_viewer_that_hangs_or_dies_is_noticed(web: RerunViewer) -> None:
    assert web.alive
    assert web.answers()
    assert web.resident_bytes() > 1 << 20
    os.kill(web.pid, signal.SIGSTOP)
    until(lambda: _state(web.pid) == "T")
    assert web.alive
    assert not web.answers(0.3)
    os.kill(web.pid, signal.SIGCONT)
    assert web.answers(5.0)
    os.kill(web.pid, signal.SIGKILL)
    os.waitid(os.P_PID, web.pid, os.WEXITED | os.WNOWAIT)
    assert not web.alive
    assert not web.answers()
    assert web.resident_bytes() == 0
    assert f"the viewer on port {web.port} was killed by SIGKILL" in web.how_it_ended()


def test_a_new_viewer_on_the_same_port_takes_a_new_stream(web: RerunViewer) -> None:
    before = _two_colours(web)
    os.kill(web.pid, signal.SIGKILL)
    os.waitid(os.P_PID, web.pid, os.WEXITED | os.WNOWAIT)
    web.stop()
    with RerunViewer(Show.WEB, port=web.port, web_port=web.web_port) as again:
        assert (again.url, again.web_address) == (web.url, web.web_address)
        _end(_two_colours(again))
    _end(before)


def test_none_is_left_when_it_is_stopped_hanging() -> None:
    viewer = RerunViewer(Show.WEB)
    os.kill(viewer.pid, signal.SIGSTOP)
    viewer.stop()
    viewer.stop()
    assert not viewer.alive
    assert not Path(f"/proc/{viewer.pid}").exists()


@pytest.mark.parametrize("hangs", [False, True])
def test_it_dies_with_its_parent(hangs: bool) -> None:
    program = (
        "import os, signal\nfrom lowfc.adapters.viewer.rerun_viewer import RerunViewer, Show\n"
        "viewer = RerunViewer(Show.WEB)\nprint(viewer.pid, flush=True)\n"
        f"if {hangs}:\n    os.kill(viewer.pid, signal.SIGSTOP)\nos.kill(os.getpid(), signal.SIGKILL)"
    )
    parent = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert parent.returncode == -signal.SIGKILL, parent.stderr
    until(lambda: not _runs(int(parent.stdout)))


def test_without_a_screen_one_line_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(ViewerError, match=r"no screen.*use --web") as caught:
        RerunViewer(Show.NATIVE)
    assert "\n" not in str(caught.value)


def test_a_screen_that_is_not_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":9999")
    with pytest.raises(ViewerError, match=r"exit status 1 .*X server.*use --web") as caught:
        RerunViewer(Show.NATIVE)
    assert "\n" not in str(caught.value)


def test_without_a_driver_one_line_names_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("VK_ICD_FILENAMES", "/nowhere.json")
    with pytest.raises(ViewerError, match=r"mesa-vulkan-drivers") as caught:
        RerunViewer(Show.HEADLESS)
    assert "\n" not in str(caught.value)


def test_a_port_that_is_taken_is_one_line(web: RerunViewer) -> None:
    with pytest.raises(ViewerError) as caught:
        RerunViewer(Show.WEB, port=web.port)
    assert str(web.port) in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow  # the live loop's page is looked at anyway
@pytest.mark.browser
@needs_chromium
def test_an_image_that_was_logged_is_on_the_page(web: RerunViewer, tmp_path: Path) -> None:
    assert CHROMIUM is not None
    assert web.web_address is not None
    stream = _two_colours(web)
    path = tmp_path / "page.png"
    page = browser_screenshot(web.web_address, path, 90.0, _both, size_px=(800, 500))
    assert _both(pixels(path.read_bytes())), page.complaints
    assert any("ReadMessages" in address and str(web.port) in address for address in page.fetched.values())
    refused = [line for line in page.complaints if "Content Security Policy" in line]
    assert any("tel.rerun.io" in line for line in refused), "it no longer wants to call home; the page could go"
    for address in page.fetched.values():
        assert address.startswith(("http://127.0.0.1:", "data:", "blob:")), address
    _end(stream)


def _two_colours(viewer: RerunViewer) -> Any:
    """A stream that has sent an image, orange above blue."""
    import rerun as rr

    stream = rr.RecordingStream("lowfc-test", recording_id="test")
    stream.connect_grpc(viewer.url)
    image = np.empty((80, 80, 3), np.uint8)
    image[:40], image[40:] = ORANGE, BLUE
    stream.set_time("time", timestamp=1.0)
    stream.log("image", rr.Image(image))
    stream.flush(timeout_sec=10)
    return stream


def _end(stream: Any) -> None:
    """Let the stream go while its viewer is there, or it says so on our standard error."""
    stream.disconnect()


def _both(shown: Any) -> bool:
    return share_of(shown, ORANGE) > SHARE and share_of(shown, BLUE) > SHARE


def _mean_row(shown: Any, colour: tuple[int, int, int]) -> float:
    return float(np.nonzero(np.all(np.abs(shown.astype(int) - colour) <= 12, axis=2))[0].mean())


def _listening(pid: int) -> set[tuple[str, int]]:
    """Address and port of every socket on which a process listens, of IPv4 and IPv6."""
    import psutil

    return {
        (one.laddr.ip, one.laddr.port) for one in psutil.Process(pid).net_connections("inet") if one.status == "LISTEN"
    }


def _state(pid: int) -> str:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def _runs(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists() and _state(pid) != "Z"


FRAME, SURFACE = "/lowfc/camera/frame", "/lowfc/mirror/dm/surface"
SAME = 0.99  # of 1; a view without an image, or with another one, stays below OTHER
OTHER = 0.8

Picture = npt.NDArray[np.floating[Any]]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewer")
    path: Path = loop(folder, "--rate", "100", "--duration", "2", "--disturbance", "reaction-wheel")["log"]
    return path


@pytest.fixture(scope="module")
def pictures(log: Path) -> dict[str, list[tuple[int, Picture]]]:
    """Log time and pixels of every image, by topic."""
    found: dict[str, list[tuple[int, Picture]]] = {FRAME: [], SURFACE: []}
    kinds = {MONO16: "<u2", FLOAT32: "<f4"}
    with log.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages(topics=list(found)):
            image = RawImage.FromString(message.data)
            pixels = np.frombuffer(image.data, kinds[image.encoding]).reshape(image.height, image.width)
            found[channel.topic].append((message.log_time, pixels.astype(float)))
    return found


@pytest.fixture(scope="module")
def viewer(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A client of `rerun FILE.mcap`, loaded."""
    with _viewer(log, tmp_path_factory.mktemp("home")) as client:
        yield client


@on_screen
def test_frames_and_the_surface_are_on_the_screen(
    viewer: Any, pictures: dict[str, list[tuple[int, Picture]]], artefacts: Path
) -> None:
    assert all(len(images) > 20 for images in pictures.values()), "a log with hardly an image proves nothing"
    views = {view.origin: view for view in viewer.get_state().views}
    assert views.keys() >= pictures.keys(), "the viewer makes a view for each image by itself"
    half_way = pictures[FRAME][len(pictures[FRAME]) // 2][0]
    expected = {
        topic: next(pixels for time_ns, pixels in reversed(images) if time_ns <= half_way)
        for topic, images in pictures.items()
    }

    _go_to(viewer, min(images[0][0] for images in pictures.values()) - 1)
    for topic, picture in expected.items():
        empty = _screenshot(viewer, views[topic].view_id)
        assert _likeness(empty, picture) < OTHER, f"nothing is there yet, and it passes for {topic}"

    _go_to(viewer, half_way)
    for topic, picture in expected.items():
        assert views[topic].view_class == "2D"
        shown = _until_like(viewer, views[topic].view_id, picture)
        turned = min(_likeness(shown, np.rot90(picture, quarters)) for quarters in (1, 2, 3))
        assert turned < OTHER, "the comparison would take another picture for it"
    (artefacts / "log-in-the-plain-viewer.png").write_bytes(viewer.take_screenshot())
    state = viewer.get_state()
    assert [view.reports for view in state.views] == [[]] * len(state.views)
    assert state.recordings[0].current_time == half_way


@on_screen
def test_the_viewer_decodes_our_own_messages(viewer: Any, log: Path) -> None:
    components = {
        entity.entity_path: {component.component: component.datatype for component in entity.components}
        for entity in viewer.get_recording_schema().entities
    }
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    own = {
        channel.topic: summary.schemas[channel.schema_id].name
        for channel in summary.channels.values()
        if summary.schemas[channel.schema_id].name.startswith("lowfc.v1.")
    }
    assert len(own) >= 10
    for topic, schema in own.items():
        assert components[topic][f"{schema}:message"].startswith("Struct("), topic
    assert '"error_nm": List(' in components["/lowfc/control/step"]["lowfc.v1.ControlStep:message"]
    complaints = [entry for entry in viewer.get_logs() if entry.level != "INFO" and "rasterizer" not in entry.message]
    assert not complaints


@on_screen
def test_rerun_reads_the_values_that_were_sent(log: Path) -> None:
    from rerun.chunk import McapReader

    name = "lowfc.v1.Truth:message"
    reader = McapReader(log, include_topic_regex=["^/lowfc/sim/truth$"])
    batches = [chunk.to_record_batch() for chunk in reader.stream()]
    read = [
        row[0]["residual_rms_nm"]
        for batch in batches
        if name in batch.schema.names
        for row in batch.column(name).to_pylist()
    ]
    with log.open("rb") as stream:
        messages = make_reader(stream).iter_messages(topics=["/lowfc/sim/truth"])
        sent = [wire.Truth.FromString(message.data).residual_rms_nm for _, _, message in messages]
    assert len(sent) > 100
    assert read == sent


@contextlib.contextmanager
def _viewer(log: Path, home: Path) -> Iterator[Any]:
    """The real binary, for the `rerun` on the path is a script that starts it and would outlive its parent."""
    import rerun_cli
    from rerun.experimental import ViewerClient

    binary = str(Path(rerun_cli.__file__).parent / "rerun")
    environment = os.environ | {"HOME": str(home), "XDG_CONFIG_HOME": str(home), "XDG_DATA_HOME": str(home)}
    software = [str(path) for path in vulkan_drivers() if path.name.startswith("lvp")]
    if software:  # the same everywhere, and there where no graphics card is
        environment.setdefault("VK_ICD_FILENAMES", software[0])
    subprocess.run([binary, "analytics", "disable"], env=environment, capture_output=True, timeout=20, check=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    words = [binary, "--headless", "--bind", "127.0.0.1", "--port", port, "--window-size", "1600x1000", str(log)]
    said = home / "viewer.txt"
    with said.open("w") as stream:
        process = subprocess.Popen(words, env=environment, stdout=stream, stderr=stream, start_new_session=True)
    try:
        deadline_s = time.monotonic() + 30
        while True:
            assert process.poll() is None, said.read_text()
            assert time.monotonic() < deadline_s, said.read_text()
            with contextlib.suppress(RuntimeError, ConnectionError):
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                state = client.get_state()
                if state.recordings and not state.loading and len(state.views) > 1:
                    break
            time.sleep(0.1)
        yield client
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(timeout=10)


def _go_to(viewer: Any, time_ns: int) -> None:
    """Stop the play, which begins with the log and so before the first frame, and show this moment."""
    viewer.set_time("message_log_time", timestamp=np.datetime64(time_ns, "ns"), play_state="paused")


def _screenshot(viewer: Any, view_id: str) -> Picture:
    """Brightness of a view's pixels."""
    from PIL import Image

    with Image.open(io.BytesIO(viewer.take_screenshot(view_id))) as image:
        return np.asarray(image.convert("L"), dtype=float)


def _until_like(viewer: Any, view_id: str, picture: Picture, timeout_s: float = 20.0) -> Picture:
    """Screenshot of a view, once it shows the picture."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        shown = _screenshot(viewer, view_id)
        likeness = _likeness(shown, picture)
        if likeness > SAME:
            return shown
        assert time.monotonic() < deadline_s, f"the view does not show the image: correlation {likeness:.3f}"
        time.sleep(0.2)


def _likeness(shown: Picture, picture: Picture) -> float:
    """Highest correlation of a view with a picture that is centred in it and fills it, give or take a few pixels."""
    height, width = picture.shape
    fit = min(shown.shape[0] / height, shown.shape[1] / width)
    best = 0.0
    for scale in fit * np.arange(0.96, 1.05, 0.01):
        for shift in range(-4, 5):
            rows = ((np.arange(height) - height / 2 + 0.5) * scale + shown.shape[0] / 2 + shift).astype(int)
            columns = ((np.arange(width) - width / 2 + 0.5) * scale + shown.shape[1] / 2).astype(int)
            seen = shown[np.ix_(rows.clip(0, shown.shape[0] - 1), columns.clip(0, shown.shape[1] - 1))]
            if seen.std() > 0:
                best = max(best, float(np.corrcoef(seen.ravel(), picture.ravel())[0, 1]))
    return best
