"""Make the pictures of the documentation: `python docs/make_pictures.py`, about a minute.

It runs the simulated loop in a temporary folder, open at first, closes it after two seconds, opens the log in rerun's
viewer without a window, with a layout whose plots read the fields of the project's own messages, and writes
`docs/pictures/log-in-rerun.png`. Needs a Vulkan driver: `apt install mesa-vulkan-drivers libvulkan1`.
"""

import contextlib
import io
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import rerun_cli
from mcap.reader import make_reader
from PIL import Image
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping
from rerun.experimental import ViewerClient

from lowfc.contract.messages import Message, RawImage, wire

PICTURE = Path(__file__).parent / "pictures" / "log-in-rerun.png"
LOWFC = [sys.executable, "-m", "lowfc"]
LOOP = ["sim-loop", "--open", "--duration", "7", "--rate", "300", "--seed", "1"]
LOOP += ["--sensor", "sam27d10_bal14", "--disturbance", "reaction-wheel"]
OPEN_FOR_BYTES = 4_000_000  # of the log; with the time that `lowfc ctl` takes to start, some two seconds
WINDOW = (1600, 1000)
MOST_BYTES = 400_000
MENU_BAR = 37  # pixels at the top that say nothing about the log
TIMELINE = "message_log_time"
FRAME, SURFACE, EVENT = "/lowfc/camera/frame", "/lowfc/mirror/dm/surface", "/lowfc/event"
STEP, TRUTH = "/lowfc/control/step", "/lowfc/sim/truth"

ORANGE, BLUE, GREEN, PINK, VIOLET, YELLOW, GREY = (
    0xFF9F1CFF,
    0x2EC4F1FF,
    0x7AE582FF,
    0xFF6B9DFF,
    0xB388EBFF,
    0xF7E967FF,
    0x8A94A0FF,
)


def main() -> None:
    """Run the loop, look at its log, keep the picture."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        log = run_loop(folder)
        closed_ns = when_closed(log)
        drawn = layout(log, closed_ns)
        with viewer(folder) as url:
            recording = rr.RecordingStream("lowfc")
            recording.connect_grpc(url)
            recording.send_blueprint(drawn)
            recording.log_file_from_path(log)
            recording.flush()
            screenshot = look(ViewerClient.connect(url), closed_ns + 200_000_000)
            recording.disconnect()
    picture = Image.open(io.BytesIO(screenshot)).convert("RGB")
    picture = picture.crop((0, MENU_BAR, picture.width, picture.height))
    PICTURE.parent.mkdir(exist_ok=True)
    picture.quantize(256, dither=Image.Dither.NONE).save(PICTURE, optimize=True)
    if PICTURE.stat().st_size > MOST_BYTES:
        raise SystemExit(f"{PICTURE} is larger than {MOST_BYTES} bytes")


def run_loop(folder: Path) -> Path:
    """Log of a loop that is open at first and closed then, in a run directory of its own."""
    runtime = folder / "runtime"
    runtime.mkdir(mode=0o700)
    environment = os.environ | {"XDG_RUNTIME_DIR": str(runtime)}
    process = subprocess.Popen([*LOWFC, *LOOP], cwd=folder, env=environment)
    while sum(path.stat().st_size for path in folder.glob("logs/*.part")) < OPEN_FOR_BYTES:
        if process.poll() is not None:
            raise SystemExit("the loop ended before it was closed")
        time.sleep(0.05)
    subprocess.run([*LOWFC, "ctl", "close"], env=environment, check=True)
    if process.wait(timeout=60) != 0:
        raise SystemExit("the loop failed")
    (log,) = folder.glob("logs/*.mcap")
    return log


def messages(log: Path, topic: str) -> Iterator[tuple[int, bytes]]:
    """Log time and payload of every message of a topic."""
    with log.open("rb") as stream:
        for _, _, message in make_reader(stream).iter_messages(topics=[topic]):
            yield message.log_time, message.data


def when_closed(log: Path) -> int:
    """Log time at which the operator's request took effect."""
    for time_ns, payload in messages(log, STEP):
        if wire.ControlStep.FromString(payload).mode == wire.LOOP_MODE_CLOSED:
            return time_ns
    raise SystemExit("the loop was never closed")


def layout(log: Path, closed_ns: int) -> rrb.Blueprint:
    """Images and events above, the whole run in the middle, the moment of closing below."""
    calibration = wire.Calibration.FromString(next(messages(log, "/lowfc/calibration"))[1])
    names = [f"Z{noll} {name}" for noll, name in zip(calibration.noll, calibration.mode_names, strict=True)]
    truth_ns = [time_ns for time_ns, _ in messages(log, TRUTH)]
    whole, around = (truth_ns[0], truth_ns[-1]), (closed_ns - 250_000_000, closed_ns + 450_000_000)
    brightest = max(np.frombuffer(RawImage.FromString(data).data, "<u2").max() for _, data in messages(log, FRAME))
    images = [
        image("Sensor frame, DN", log, FRAME, "inferno", (90.0, 0.4 * float(brightest))),
        image("Mirror surface, ±60 nm", log, SURFACE, "spectral", (-60.0, 60.0)),
    ]
    columns = rrb.TextLogColumns(text_log_columns=["loglevel", "body"])
    events = rrb.TextLogView(origin=EVENT, name="Events", columns=columns)
    wavefront = {".disturbance_rms_nm": ("disturbance", GREY), ".residual_rms_nm": ("residual", BLUE)}
    rms = plot("Wavefront over the pupil, nm rms", TRUTH, wire.Truth, wavefront, whole, (0, 70))

    def modes(field: str, colours: dict[int, int]) -> dict[str, tuple[str, int]]:
        return {f".{field}[{mode}]": (names[mode], colour) for mode, colour in colours.items()}

    tilt, higher = {0: ORANGE, 1: BLUE}, {2: GREEN, 3: PINK, 4: VIOLET, 5: YELLOW, 6: BLUE}
    errors = plot("Tilt measured, nm rms", STEP, wire.ControlStep, modes("error_nm", tilt), around, (-75, 75))
    commands = plot("Tilt commanded, nm rms", STEP, wire.ControlStep, modes("command_nm", tilt), around, (-75, 75))
    slow = plot("Z4 to Z8 commanded, nm rms", STEP, wire.ControlStep, modes("command_nm", higher), whole, (-10, 30))
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(*images, events, column_shares=[1.0, 1.0, 2.2]),
            rms,
            rrb.Horizontal(errors, commands, slow),
            row_shares=[1.25, 0.8, 1.3],
        ),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="paused"),
        auto_views=False,
    )


def image(
    title: str, log: Path, topic: str, colormap: rr.components.ColormapLike, limits: tuple[float, float]
) -> rrb.Spatial2DView:
    """View of an image of the log in false colours, between limits."""
    shown = rr.DepthImage.from_fields(colormap=colormap, depth_range=limits, magnification_filter="nearest")
    mappings = [source(f"DepthImage:{part}", f"Image:{part}") for part in ("buffer", "format")]
    first = RawImage.FromString(next(messages(log, topic))[1])
    return rrb.Spatial2DView(
        origin=topic,
        name=title,
        overrides={topic: shown.visualizer(mappings=mappings)},
        visual_bounds=rrb.VisualBounds2D(x_range=(-1, first.width + 1), y_range=(-1, first.height + 1)),
    )


def plot(
    title: str,
    topic: str,
    message: type[Message],
    fields: dict[str, tuple[str, int]],
    span: tuple[int, int],
    limits: tuple[float, float],
) -> rrb.TimeSeriesView:
    """View of fields of the project's own messages, each with a name and a colour, over a span of log time."""
    component = f"{message.DESCRIPTOR.full_name}:message"
    lines = [
        rr.SeriesLines(names=name, colors=colour, widths=1.5).visualizer(
            mappings=[source("Scalars:scalars", component, selector)]
        )
        for selector, (name, colour) in fields.items()
    ]
    first, last = (rr.TimeRangeBoundary.absolute(nanos=time_ns) for time_ns in span)
    return rrb.TimeSeriesView(
        origin=topic,
        name=title,
        overrides={topic: lines},
        axis_x=rrb.TimeAxis(view_range=rrb.TimeRange(start=first, end=last)),
        axis_y=rrb.ScalarAxis(range=limits),
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )


def source(target: str, component: str, selector: str | None = None) -> VisualizerComponentMapping:
    """Read what is drawn from this component of the log."""
    kind = ComponentSourceKind.SourceComponent
    return VisualizerComponentMapping(target, kind, source_component=component, selector=selector)


@contextlib.contextmanager
def viewer(folder: Path) -> Iterator[str]:
    """Address of a viewer without a window; the real program, for the `rerun` on the path outlives its parent."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    program = str(Path(rerun_cli.__file__).parent / "rerun")
    size = "x".join(map(str, WINDOW))
    words = [program, "--headless", "--bind", "127.0.0.1", "--port", port, "--window-size", size]
    environment = os.environ | dict.fromkeys(("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"), str(folder))
    subprocess.run([program, "analytics", "disable"], env=environment, capture_output=True, check=True)
    process = subprocess.Popen(words, env=environment, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        url = f"rerun+http://127.0.0.1:{port}/proxy"
        for _ in range(100):
            with contextlib.suppress(RuntimeError, ConnectionError):
                ViewerClient.connect(url).get_state()
                break
            if process.poll() is not None:
                raise SystemExit("the viewer ended: is a Vulkan driver installed?")
            time.sleep(0.1)
        yield url
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def look(client: ViewerClient, time_ns: int) -> bytes:
    """Screenshot with the cursor at a log time, once all is loaded and drawn and the notifications are gone."""
    for _ in range(100):
        state = client.get_state()
        if state.recordings and state.recordings[0].current_time and not state.loading:
            break
        time.sleep(0.2)
    client.set_time(TIMELINE, timestamp=np.datetime64(time_ns, "ns"), play_state="paused")
    time.sleep(8)
    client.set_time(TIMELINE, timestamp=np.datetime64(time_ns, "ns"), play_state="paused")
    failed = [f"{view.name}: {report.summary}" for view in client.get_state().views for report in view.reports]
    if failed:
        raise SystemExit("\n".join(failed))
    return client.take_screenshot()


if __name__ == "__main__":
    main()
