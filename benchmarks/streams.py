"""Latency from frame to command, by ImageStreamIO and by the direct link, with the same controller and frames.

Over ImageStreamIO a program writes each frame into a stream. A camera process, or the controller itself (`--camera`),
reads it with the driver `isio`, extended by time stamps (`stream_ends.TimedCamera`). `lowfc mirror isio` writes the
command into a channel. Over the direct link the source of frames and the mirror are those of `lowfc latency`.

Example:
    python -m benchmarks streams --seconds 5 --repeats 9
"""

import argparse
import os
import tempfile
from pathlib import Path

import numpy as np

from benchmarks import stream_ends
from benchmarks.runner import Lines, Report, Result, add_times, ranged
from benchmarks.sizes import Size, configuration, prepared_run
from lowfc.adapters.bus.run import Run, mirror_role
from lowfc.adapters.image_stream.stream import Stream, stream_path
from lowfc.adapters.process.child import Child
from lowfc.contract.messages import Role
from lowfc.programs.launch.processes import program
from lowfc.programs.launch.sim_loop import children_of
from lowfc.programs.measure.latency.frame_statistics import WARM_UP_S
from lowfc.programs.measure.latency.run import LatencyOptions, one_loop
from tools.shared import ROOT

SIZE = Size()
DIRECT, CAMERA_PROCESS = "direct link", "ImageStreamIO, camera process"
IN_CONTROLLER = "ImageStreamIO, read by the controller"
SPANS = {"frame_to_command": "frame to command", "frame_to_mirror": "frame to mirror"}
PERCENTILES = {"p50": "p50", "p99": "p99", "p99_9": "p99.9"}
FRAME_STREAM, CHANNEL = "lowfs", "dm00disp03"

_MEMORY = Path("/dev/shm")  # noqa: S108  # a private folder is created in it


def options(parser: argparse.ArgumentParser) -> None:
    """Add duration, repeats and rate."""
    add_times(parser, seconds=3.0, repeats=9)
    parser.add_argument("--rate", dest="rate_hz", type=float, default=1000.0, help="frames per second (%(default)g)")


def measure(options: argparse.Namespace, report: Report) -> Result:
    """Run the three loops one after the other; reverse the order in every second turn.

    Returns:
        turns (the results of `one_run` by loop), seconds and rate_hz.
    """
    turns: list[dict[str, Result]] = []
    for number in range(options.repeats):
        turns.append({})
        for name in (DIRECT, CAMERA_PROCESS, IN_CONTROLLER)[:: -1 if number % 2 else 1]:
            report(f"turn {number + 1} of {options.repeats}: {name}")
            turns[-1][name] = one_run(options.rate_hz, options.seconds, name)
    return {"turns": turns, "seconds": options.seconds, "rate_hz": options.rate_hz}


def one_run(rate_hz: float, seconds: float, name: str) -> Result:
    """Run one of the loops once.

    Returns:
        frame_to_command and frame_to_mirror (percentiles in us), frames, without_command; over streams also
        stream_to_camera: from just before a frame is written until just before the camera publishes it.
    """
    driver = stream_ends.__name__
    config = configuration(SIZE, rate_hz).model_copy(update={"drivers": {driver: {"stream": FRAME_STREAM}}})
    by_streams = name != DIRECT
    loop = LatencyOptions(config, seconds, 1)
    with prepared_run(SIZE, config) as run, tempfile.TemporaryDirectory(prefix="lowfc-streams-", dir=_MEMORY) as folder:
        found = one_loop(loop, run, _processes(loop, run, Path(folder), name) if by_streams else None)
    start = "due" if by_streams else "frame"
    spans_us = {f"frame_to_{end}": found["latency_us"][f"{start}_to_{end}"] for end in ("command", "mirror")}
    if by_streams:
        spans_us["stream_to_camera"] = found["latency_us"]["due_to_frame"]
    return spans_us | {"frames": found["frames"], "without_command": found["frames_without_command"]}


def _processes(loop: LatencyOptions, run: Run, folder: Path, name: str) -> list[Child]:
    """Processes of a loop whose streams are in a folder; the first is the program that writes the frames."""
    config, seconds = loop.config, WARM_UP_S + loop.duration_s
    Stream.create(folder / stream_path(FRAME_STREAM).name, (SIZE.side, SIZE.side), np.uint16)
    role = mirror_role(config.mirror.name)
    shared = ["--run", run.run_id, "--config", str(run.path / "config.toml")]
    writer, wait_for_mirror = stream_ends.__name__, ["--wait-for", role]
    driver = f"{writer}:{stream_ends.TimedCamera.__name__}"
    commands = {
        "source": ["-m", writer, str(run.path), FRAME_STREAM, str(round(seconds * config.camera.rate_hz))],
        role: ["-m", "lowfc", "mirror", "isio", *shared, "--stream", CHANNEL],
    }
    if name == CAMERA_PROCESS:
        waits = ["--wait-for", str(Role.CONTROLLER), *wait_for_mirror]
        commands[str(Role.CAMERA)] = ["-m", "lowfc", "camera", driver, *shared, *waits]
    children = [program(role, arguments, run.path / f"{role}.stderr") for role, arguments in commands.items()]
    (controller,) = (one for one in children_of(config, run, seconds, record=False) if one.name == Role.CONTROLLER)
    if name == IN_CONTROLLER:
        controller.command += ["--camera", driver, *wait_for_mirror]
    children.append(controller)
    for child in children:
        child.environment = os.environ | {"MILK_SHM_DIR": str(folder), "PYTHONPATH": str(ROOT)}
    return children


def tables(result: Result) -> list[Lines]:
    """Latencies of each loop, and their ratios turn by turn."""
    turns = result["turns"]
    lines = [
        [
            "loop",
            *(f"{label}, us: {at}" for label in SPANS.values() for at in PERCENTILES.values()),
            "frames without a command",
        ]
    ]
    for name in (DIRECT, CAMERA_PROCESS, IN_CONTROLLER):
        each = [turn[name] for turn in turns]
        cells = [ranged([one[span][at] for one in each]) for span in SPANS for at in PERCENTILES]
        without, frames = (sum(one[key] for one in each) for key in ("without_command", "frames"))
        lines.append([name, *cells, f"{without} of {frames}"])
    for name in (CAMERA_PROCESS, IN_CONTROLLER):
        each = [
            [turn[name][span][at] / turn[DIRECT][span][at] for turn in turns] for span in SPANS for at in PERCENTILES
        ]
        ratios = [ranged(one, "{:.2f}".format) for one in each]
        lines.append([f"{name}: ratio to the {DIRECT} of the same turn", *ratios, ""])
    return [lines]


def about(result: Result) -> str:
    """Definitions of the measured quantities."""
    turns = result["turns"]
    camera_process, controller = (
        ranged([turn[name]["stream_to_camera"]["p50"] for turn in turns]) for name in (CAMERA_PROCESS, IN_CONTROLLER)
    )
    return (
        f"Medians (lowest to highest) over {len(turns)} turns of {result['seconds']:g} s each at {result['rate_hz']:g} "
        f"Hz; {SIZE.side} x {SIZE.side} pixels, {SIZE.modes} modes, {SIZE.actuators} actuators. Latency "
        "begins just before the writer sets the stream's write flag, or just before the frame is sent over the direct "
        "link; it ends just after the controller's send, or just before the mirror publishes its state. Over "
        f"ImageStreamIO, the latency includes {camera_process} us (p50) until the camera process publishes the frame; "
        f"if the controller reads the stream itself, {controller} us until it has the frame."
    )
