"""`lowfc bridge isio` in this process: steps in streams for an independent reader, other channels in the loop."""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Query
from lowfc.adapters.image_stream.stream import StreamError
from lowfc.contract.codecs.calibration_codec import encode_calibration, with_identity
from lowfc.contract.errors import BusError, ConfigurationError
from lowfc.contract.messages import CALIBRATION, CONTROLLER_STATE, REQUEST_KEY, STEP, wire
from lowfc.programs.bridge import isio as bridge
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.image_streams.plain import FLOAT32, PlainStream, file_of
from tests.support.loops import lowfc, refusal
from tests.support.toy import GRID, calibration

AT_NS = 1_700_000_000_000_000_000


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    return tmp_path


def stream(folder: Path, name: str, columns: int, rows: int = 1, *, make: bool = False) -> PlainStream:
    create_or_open = PlainStream.make if make else PlainStream
    return create_or_open(file_of(folder, name), columns, rows, FLOAT32)


class RunWithStreams:
    """The bus of a run, with a publisher of steps and the bridge's streams."""

    def __init__(self) -> None:
        self.hub, self.clock = MemoryHub(), FakeClock(AT_NS)
        self.steps = MemoryBus(self.hub, "controller", self.clock).publisher(STEP)
        self.streams = bridge.StepStreams(MemoryBus(self.hub, "operator", self.clock), self.clock, "night")

    def step(self, **fields: Any) -> None:
        message = wire.ControlStep(mode=wire.LOOP_MODE_CLOSED, **fields)
        message.timestamp.FromNanoseconds(AT_NS)
        self.steps.put(message.SerializeToString())
        self.streams.write_new_steps()


def test_each_step_is_an_image_of_one_row(folder: Path) -> None:
    run = RunWithStreams()
    run.step(error_nm=[3, -4], command_nm=[1, 2], flux_dn=500)
    error, command = (stream(folder, f"night_{name}", 2) for name in ("error", "command"))
    residual, flux = (stream(folder, f"night_{name}", 1) for name in ("residual", "flux"))
    values = [image.pixels.ravel().tolist() for image in (error, command, residual, flux)]
    assert values == [[3, -4], [1, 2], [5], [500]]
    run.step(command_nm=[1, 3], flux_dn=0)  # a refused frame has no error
    run.steps.put(b"\xff")
    run.streams.write_new_steps()
    assert [image.count for image in (error, command, residual, flux)] == [1, 2, 1, 2]
    assert command.pixels.ravel().tolist() == [1, 3]
    run.step(error_nm=[1, 2, 2], command_nm=[0, 0, 0], flux_dn=1)  # another calibration: the stream is created again
    recreated = stream(folder, "night_error", 3)
    assert (recreated.count, recreated.pixels.ravel().tolist(), error.count) == (1, [1, 2, 2], 1)


def test_an_existing_stream_is_adopted_unless_another_process_writes_it(folder: Path) -> None:
    command = stream(folder, "night_command", 2, make=True)
    stream(folder, "night_flux", 7, make=True)
    run = RunWithStreams()
    run.step(command_nm=[1, 2], flux_dn=500)
    assert command.pixels.ravel().tolist() == [1, 2]
    assert stream(folder, "night_flux", 1).pixels.ravel().tolist() == [500]
    stream(folder, "night_residual", 34, 34, make=True)
    with pytest.raises(StreamError, match="'night_residual' belongs to another program"):
        RunWithStreams().step(error_nm=[3, -4])
    command.pack("<i", command.writers, os.getppid())
    with pytest.raises(StreamError, match=f"process {os.getppid()} writes stream 'night_command'"):
        RunWithStreams().step(command_nm=[1, 2])


@pytest.mark.parametrize("case", ["normal", "busy", "controller-late", "run-restarted"])
def test_other_channels_are_reported_to_the_loop(case: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bridge polls ten times. Cases:

    normal: the controller restarts at the fourth poll. busy: as normal, and the controller is busy at the first five
    polls. controller-late: the controller starts only at the fourth poll. run-restarted: the run restarts, and not only
    the controller; the bridge joins the new run.
    """
    hub, clock, received = MemoryHub(), FakeClock(AT_NS), list[wire.Request]()
    controller = MemoryBus(hub, "controller", clock)
    controller.publisher(CALIBRATION).put(encode_calibration(with_identity(calibration()), 0))
    states = controller.publisher(CONTROLLER_STATE)
    started = wire.ControllerState(mirror_rows=GRID[0], mirror_columns=GRID[1]).SerializeToString()
    if case != "controller-late":
        states.put(started)

    def answer(query: Query) -> None:
        received.append(wire.Request.FromString(query.payload))
        query.reply(wire.Request(accepted=True).SerializeToString())

    controller.queryable(REQUEST_KEY.format(name="*"), answer)
    turbulence = stream(folder, "dm00disp01", GRID[1], GRID[0], make=True)
    turbulence.write(np.full(GRID, 0.02, np.float32))
    stream(folder, "dm00disp03", GRID[1], GRID[0], make=True).write(np.full(GRID, 9, np.float32))  # the loop's own
    stream(folder, "dm00disp04", GRID[1], GRID[0], make=True).write(np.full(GRID, np.nan, np.float32))
    stream(folder, "dm00disp05", 7, 6, make=True)
    real_channel, rounds = bridge.Client.channel, 0
    restarts = iter([False] * 4 + [case == "run-restarted"])

    def channel(client: bridge.Client, name: str, shape_nm: Any) -> Any:
        if case == "busy" and rounds < 5:
            raise BusError("busy")
        return real_channel(client, name, shape_nm)

    def pause(seconds: float) -> None:
        nonlocal rounds
        rounds += 1
        clock.advance(10**9)
        if rounds == 4 and case != "run-restarted":
            states.put(started)
        if rounds == 7:
            states.put(b"\xff")
            turbulence.write(np.zeros(GRID, np.float32))
        if rounds == 10:
            raise KeyboardInterrupt

    monkeypatch.setattr(bridge.Client, "channel", channel)
    monkeypatch.setattr(bridge, "time", SimpleNamespace(monotonic=lambda: clock.now_ns() * 1e-9, sleep=pause))
    monkeypatch.setattr(bridge, "the_known_run", lambda run: run)
    monkeypatch.setattr(
        bridge, "open_run", lambda *_: SimpleNamespace(links=None, restarted=lambda: next(restarts, False))
    )
    monkeypatch.setattr(bridge, "ZenohBus", lambda _, role, clock, **__: MemoryBus(hub, role, clock))
    monkeypatch.setattr(bridge, "lower_priority", lambda: None)
    done = lowfc("bridge", "isio", "--run", "bench", "--beside", "dm00disp03", "--nm-per-unit", "2000")
    assert done.exit_code == 0, done.output
    shapes = [np.frombuffer(request.actuators, np.float32) for request in received]
    assert {request.text for request in received} == {"external"}
    *reported, removed = shapes
    assert len(reported) == (1 if case in ("busy", "controller-late") else 2), "once to each controller"
    for shape in reported:
        assert shape == pytest.approx(np.full(GRID[0] * GRID[1], 40.0))
    assert removed.size == 0
    left_out = [line for line in done.stderr.splitlines() if line.startswith("other channels: dm00disp01")]
    assert len(left_out) == (2 if case == "run-restarted" else 1)
    assert all(f"stream 'dm00disp0{cause}" in left_out[0] for cause in ("5' has 7 x 6", "4' has values that are not"))
    assert done.stderr.count("other channels: not reported to the loop: busy") == (case == "busy")
    assert done.stderr.count("not reported to the loop: run 'bench' has no controller") == (case == "controller-late")


@pytest.mark.parametrize(
    "options",
    [["dm00"], ["dm00disp03", "--external", "dm00disp03"], ["", "--external", "dm00disp04", "--external", "dm00disp"]],
)
def test_the_own_channel_must_be_a_numbered_dm_channel_and_not_external(options: list[str]) -> None:
    assert "--external" in refusal("bridge", "isio", "--beside", *options, kind=ConfigurationError)
