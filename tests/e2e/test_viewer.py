"""A log of the real loop, opened with rerun's plain viewer as a user would: are the images on the screen?

The proof is in the pixels: a view's screenshot, sampled where the picture's pixels must be, correlates with the picture
decoded from the log, and does not with anything else that the view could show instead.
"""

import contextlib
import io
import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mcap.reader import make_reader

from lowfc.adapters.viewer.rerun_viewer import vulkan_drivers
from lowfc.contract.messages import FLOAT32, MONO16, RawImage, wire
from tests.support.loops import loop
from tests.support.viewers import needs_vulkan

FRAME, SURFACE = "/lowfc/camera/frame", "/lowfc/mirror/dm/surface"
SAME = 0.99  # of 1; a view without an image, or with another one, stays below OTHER
OTHER = 0.8

Picture = npt.NDArray[np.floating[Any]]

pytestmark = [pytest.mark.exclusive, pytest.mark.viewer, needs_vulkan]


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
