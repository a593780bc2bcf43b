"""Rerun's viewer as a child process, and a log as rerun itself reads it."""

import os
import re
import signal
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
import psutil
import pytest
import rerun as rr
from rerun.chunk import McapReader

from lowfc.adapters.viewer.rerun_viewer import RerunViewer, Show, ViewerError
from lowfc.contract.messages import SURFACE, RawImage, image, topic_of, wire
from tests.support.loops import payloads, until
from tests.support.report_log import SyntheticLog
from tests.support.viewers import complaints, listening, on_screen, pixels, share_of

ORANGE, BLUE = (214, 110, 20), (20, 90, 214)
MIN_SHARE = 0.05  # least fraction of the viewer's pixels that have each of the two colours


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
    stream = _send_two_colours(headless)
    path = tmp_path / "screen.png"
    picture = headless.screenshot(path)
    assert path.read_bytes() == picture
    shown = pixels(picture)
    assert shown.shape == (400, 640, 3)
    assert min(share_of(shown, colour) for colour in (ORANGE, BLUE)) > MIN_SHARE
    assert _mean_row(shown, ORANGE) < _mean_row(shown, BLUE), "orange is above blue"
    assert [view.origin for view in headless.state().views] == ["/image"]
    assert complaints(headless) == []
    stream.disconnect()


@on_screen
def test_a_picture_is_taken_although_the_viewer_abandons_a_query(
    headless: RerunViewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    real_ask, faults = RerunViewer._ask, [ViewerError("deadline expired"), ViewerError("dropped the request")]

    def ask(viewer: RerunViewer, question: Any) -> Any:
        if faults:
            raise faults.pop()
        return real_ask(viewer, question)

    stream = _send_two_colours(headless)
    monkeypatch.setattr(RerunViewer, "_ask", ask)
    assert headless.screenshot()
    assert not faults
    stream.disconnect()


@on_screen
def test_a_headless_viewer_is_reached_from_this_host_only(headless: RerunViewer) -> None:
    assert listening(headless.pid) == {("127.0.0.1", headless.port)}


def test_a_page_is_reached_from_this_host_only(web: RerunViewer) -> None:
    sockets = listening(web.pid)
    assert {host for host, _ in sockets} == {"127.0.0.1"}
    assert web.port in {port for _, port in sockets}
    assert ("127.0.0.1", web.web_port) in listening(os.getpid())


def test_a_viewer_that_hangs_or_dies_is_noticed(web: RerunViewer) -> None:
    assert web.alive
    assert web.answers()
    assert web.resident_bytes() > 1 << 20
    os.kill(web.pid, signal.SIGSTOP)
    until(lambda: psutil.Process(web.pid).status() == psutil.STATUS_STOPPED)
    assert web.alive
    assert not web.answers(0.3)
    os.kill(web.pid, signal.SIGCONT)
    assert web.answers(5.0)
    os.kill(web.pid, signal.SIGKILL)
    os.waitid(os.P_PID, web.pid, os.WEXITED | os.WNOWAIT)
    assert not web.alive
    assert not web.answers()
    assert web.resident_bytes() == 0
    assert f"the viewer on port {web.port} was killed by SIGKILL" in web.exit_description()


def test_a_new_viewer_on_the_same_port_receives_a_new_stream(web: RerunViewer) -> None:
    old_stream = _send_two_colours(web)
    os.kill(web.pid, signal.SIGSTOP)
    web.stop()
    assert not Path(f"/proc/{web.pid}").exists()
    web.stop()
    with RerunViewer(Show.WEB, port=web.port, web_port=web.web_port) as replacement:
        assert (replacement.url, replacement.web_address) == (web.url, web.web_address)
        _send_two_colours(replacement).disconnect()
    old_stream.disconnect()


def test_a_suspended_viewer_dies_with_its_parent() -> None:
    program = (
        "import os, signal\nfrom lowfc.adapters.viewer.rerun_viewer import RerunViewer, Show\n"
        "viewer = RerunViewer(Show.WEB)\nprint(viewer.pid, flush=True)\n"
        "os.kill(viewer.pid, signal.SIGSTOP)\nos.kill(os.getpid(), signal.SIGKILL)"
    )
    parent = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert parent.returncode == -signal.SIGKILL, parent.stderr
    until(lambda: not _is_running(int(parent.stdout)))


@pytest.mark.parametrize(
    ("show", "variable", "value", "complaint"),
    [
        (Show.NATIVE, "DISPLAY", "", r"no screen.*use --web"),
        (Show.NATIVE, "DISPLAY", ":9999", r"exit status 1 .*X server.*use --web"),
        (Show.HEADLESS, "VK_ICD_FILENAMES", "/nowhere.json", "mesa-vulkan-drivers"),
    ],
)
def test_a_missing_display_or_driver_is_a_one_line_error(
    monkeypatch: pytest.MonkeyPatch, show: Show, variable: str, value: str, complaint: str
) -> None:
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv(variable, value)
    with pytest.raises(ViewerError, match=complaint) as caught:
        RerunViewer(show)
    assert "\n" not in str(caught.value)


def test_a_port_in_use_is_a_one_line_error(web: RerunViewer) -> None:
    with pytest.raises(ViewerError) as caught:
        RerunViewer(Show.WEB, port=web.port)
    assert str(web.port) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_content_security_policy_allows_this_host_only(web: RerunViewer) -> None:
    with urlopen(web.web_address) as page:  # noqa: S310
        policy = page.headers["Content-Security-Policy"]
    addresses = set(re.findall(r"https?://\S+", policy))
    assert addresses == {f"http://127.0.0.1:{web.port}"}, "without this policy, the page sends usage statistics"


def _send_two_colours(viewer: RerunViewer) -> rr.RecordingStream:
    """Send an image, orange above blue; returns its stream, which must be disconnected before the viewer ends."""
    stream = rr.RecordingStream("lowfc-test", recording_id="test")
    stream.connect_grpc(viewer.url)
    image = np.empty((80, 80, 3), np.uint8)
    image[:40], image[40:] = ORANGE, BLUE
    stream.set_time("time", timestamp=1.0)
    stream.log("image", rr.Image(image))
    stream.flush(timeout_sec=10)
    return stream


def _mean_row(shown: Any, colour: tuple[int, int, int]) -> float:
    """Mean row of the pixels that are within 12 of 255 of a colour in each channel."""
    return float(np.nonzero(np.all(np.abs(shown.astype(int) - colour) <= 12, axis=2))[0].mean())


def _is_running(pid: int) -> bool:
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE


@pytest.fixture(scope="module")
def night(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with messages of most topics."""
    log = SyntheticLog().frames(100)
    log.put(SURFACE, image(np.random.default_rng(1).normal(size=(6, 9)).astype(np.float32), log.now_ns, "dm"))
    log.health("recorder", state="running")
    return log.write(tmp_path_factory.mktemp("log") / "night.mcap")


def read_by_rerun(log: Path, column: str) -> dict[str, list[Any]]:
    """Values of the columns that match a pattern, by topic, as rerun reads a log without code of lowfc."""
    found: dict[str, list[Any]] = defaultdict(list)
    for chunk in McapReader(log).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if re.fullmatch(column, name):
                found[chunk.entity_path] += [row[0] for row in batch.column(name).to_pylist()]
    return found


def test_rerun_reads_images_as_images(night: Path) -> None:
    formats, buffers = (read_by_rerun(night, f"Image:{part}") for part in ("format", "buffer"))
    for key, kind in (("/lowfc/camera/frame", "<u2"), ("/lowfc/mirror/dm/surface", "<f4")):
        sent = [RawImage.FromString(payload) for payload in payloads(night)[key]]
        assert len(sent) == len(buffers[key]) > 0
        assert [(read["width"], read["height"]) for read in formats[key]] == [(raw.width, raw.height) for raw in sent]
        for buffer, raw in zip(buffers[key], sent, strict=True):
            np.testing.assert_array_equal(np.array(buffer, np.uint8).view(kind), np.frombuffer(raw.data, kind))


def test_rerun_reads_our_own_messages_with_their_values(night: Path) -> None:
    read, sent = read_by_rerun(night, r"lowfc\.v1\.\w+:message"), payloads(night)
    own = {key for key in sent if topic_of(key[1:]).message.DESCRIPTOR.full_name.startswith("lowfc.v1.")}
    assert read.keys() == own
    assert len(own) >= 8
    truths = [wire.Truth.FromString(payload).residual_rms_nm for payload in sent["/lowfc/sim/truth"]]
    assert [truth["residual_rms_nm"] for truth in read["/lowfc/sim/truth"]] == truths
    steps = [wire.ControlStep.FromString(payload).error_nm for payload in sent["/lowfc/control/step"]]
    assert [step["error_nm"] for step in read["/lowfc/control/step"]] == [list(step) for step in steps]
