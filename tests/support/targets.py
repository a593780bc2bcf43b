"""Fuzzing targets: readers of external data, each with valid inputs to mutate and the errors that it may raise."""

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from random import Random

import numpy as np
from google.protobuf.message import Message

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.files import calibration_file, law_file, layouts
from lowfc.adapters.files.sensors import load_pupil
from lowfc.adapters.logs.history import read_history
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.recovery import recover
from lowfc.adapters.process.latch import Latch
from lowfc.adapters.process.service import Service
from lowfc.contract import configuration
from lowfc.contract.codecs import codec
from lowfc.contract.codecs.bench_codec import decode_bench_value, encode_bench_value
from lowfc.contract.codecs.calibration_codec import decode_calibration, encode_calibration, with_identity
from lowfc.contract.codecs.law_codec import wire_law
from lowfc.contract.codecs.state_codec import controller_state, decode_state
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.envelope import Envelope
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import CAMERA_STATE, COMMAND, FRAME, image, wire
from lowfc.control.laws.linear_law import LinearLaw, integrator
from lowfc.control.loop.advance import advance
from lowfc.control.loop.camera import CameraSettings
from lowfc.control.loop.command_channels import PlayTable
from lowfc.control.loop.inputs import Input, Load, MirrorShape, Tick
from lowfc.control.loop.interlocks import BenchReport
from lowfc.control.loop.requests import prepared
from lowfc.control.loop.state import State
from lowfc.device import DriverOptions
from lowfc.device.mirror_loop import MirrorLoop, command_of
from lowfc.programs.core.controller import Controller
from lowfc.programs.view.snapshot import SHOWN, Accumulator
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from sim_dm.driver import SimulatedMirror
from tests.support.controller_inputs import CALIBRATION, INTERLOCKS
from tests.support.mutated_logs import damaged, mutated, rewritten, small_log
from tests.support.report_log import SyntheticLog
from tests.support.safety_checks import Simulated, violations
from tests.support.toy import GRID, NOLL, calibration, frame, loaded, settings

NORMAL = settings(interlocks=INTERLOCKS)
LAW = integrator(np.full(len(NOLL), 0.4), np.zeros(len(NOLL)), NOLL, 1.0, 1000.0)
CONFIG = load(None, {"mirror.rows": GRID[0], "mirror.columns": GRID[1], "realtime.cache_warmup": False})


@dataclass(frozen=True)
class Target:
    """A reader of external bytes.

    Attributes:
        name: name of the target.
        corpus: valid inputs.
        read: reads an input; may raise only `errors`.
        errors: permitted exceptions.
        message: class of the inputs if they are protobuf messages.
        cost: approximate time to read an input, relative to a message.
    """

    name: str
    corpus: tuple[bytes, ...]
    read: Callable[[bytes], object]
    errors: tuple[type[Exception], ...] = ()
    message: type[Message] | None = None
    cost: int = 1

    def input(self, number: int) -> bytes:
        """Mutated input `number`, which depends only on this number and the target."""
        rng = Random(f"{self.name} {number}")  # noqa: S311
        data = rng.choice(self.corpus)
        if self.message is not None and rng.random() < 0.5:
            return rewritten(self.message.FromString(data), rng)
        if self.name.startswith("log"):
            return mutated(data, number)[1]
        return damaged(data, self.corpus, rng)


class Loop:
    """A controller that processes any input; its commands are checked against the limits."""

    def __init__(self) -> None:
        self.state = loaded(NORMAL)
        self.count = 0

    def process_input(self, input_: Input) -> None:
        before = self.state.loop.actuators_nm if self.state.loop is not None else np.zeros(GRID, np.float32)
        self.state, outputs = advance(NORMAL, self.state, input_)
        if outputs.step is not None:
            codec.encode_step(outputs.step, self.state.input_number)
        if outputs.command is not None:
            assert violations(NORMAL.limits, before, outputs.command.actuators_nm) == []
            codec.encode_command(outputs.command, 1, "lowfc", 1)
        controller_state(self.state, NORMAL, 0).SerializeToString()

    def frame(self, payload: bytes) -> None:
        """Process a frame preceded by the 16 bytes of its envelope."""
        self.count += 1
        sequence, time_ns = Envelope.decode_checked(payload[:16])
        self.process_input(codec.decode_frame(payload[16:], sequence, 0 - time_ns))  # age at time 0

    def request(self, name: str, payload: bytes) -> None:
        request = codec.decode_request(payload, name, 0)
        self.process_input(request)
        codec.encode_request(request, codec.Reply(True, "", 0), 1, None)
        self.count += 1
        self.process_input(frame(self.count))

    def mirror_state(self, data: bytes) -> None:
        shape = codec.decode_mirror(data)
        if shape is not None:
            self.process_input(shape)
            advance(NORMAL, loaded(NORMAL), shape)  # a controller that has sent no command adopts the shape

    def camera_state(self, data: bytes) -> None:
        self.process_input(codec.decode_camera(data, 3))


def targets(folder: Path) -> list[Target]:
    """All targets; files are written to `folder`."""
    return [*_messages(), *_requests(), *_files(folder), *_logs(folder)]


ENVELOPE = Envelope(1 << 32, 5).encode()


class Processes:
    """The real controller and mirror on a memory bus: no message may stop them."""

    def __init__(self) -> None:
        self.hub, self.clock, self.number = MemoryHub(), FakeClock(), 0
        roles = ("controller", "mirror-dm")
        self.services = [Service(name, "fuzz", self.clock, MemoryBus(self.hub, name, self.clock)) for name in roles]
        self.mirror = MirrorLoop(SimulatedMirror(DriverOptions(), CONFIG), self.services[1], CONFIG)
        self.controller = Controller(CONFIG, self.services[0], CALIBRATION, "a test", Latch(()))
        self.controller._mirror_adopted = True
        camera = MemoryBus(self.hub, "camera", self.clock)
        self.frames, self.camera_states = camera.publisher(FRAME), camera.publisher(CAMERA_STATE)
        self.commands = MemoryBus(self.hub, "somebody", self.clock).publisher(COMMAND, "dm")

    def frame(self, data: bytes) -> None:
        """Publish a frame in an envelope with an extreme sequence and time."""
        self.number += 1
        rng = Random(self.number)  # noqa: S311
        self.frames.put(data, rng.choice(EXTREMES), rng.choice(EXTREMES))
        self._run_once()

    def command(self, data: bytes) -> None:
        self.commands.put(data)
        self._run_once()

    def camera_state(self, data: bytes) -> None:
        self.camera_states.put(data)
        self._run_once()

    def _run_once(self) -> None:
        self.clock.advance(1_000_000)
        self.mirror._idle()
        self.controller._between_frames(self.controller._camera.mailbox.take(0))
        self.controller._publish_state(self.clock.now_ns())
        for service in self.services:
            assert service.running, service.why
            service.health().SerializeToString()
        driven_nm = self.mirror._status.driven_nm
        assert np.isfinite(driven_nm).all()
        assert violations(self.mirror._protection.limits, driven_nm, driven_nm) == []


EXTREMES = (0, 1, 5, 1 << 31, 1 << 32, 1_800_000_000 << 32, 1 << 62, (1 << 62) + 1, 1 << 63, (1 << 64) - 1)


def _messages() -> list[Target]:
    loop, processes = Loop(), Processes()
    state = loaded(NORMAL)
    shape = np.ones(GRID, np.float32)
    modes = np.ones(len(NOLL), np.float32)
    loading, mirror = Load(0, CALIBRATION, "x"), MirrorShape(0, shape, modes)
    inputs = (loading, mirror, CameraSettings(0, (6, 7), 100.0, 6e4), Tick(0, 5), BenchReport(0, "mask", 2.5))
    command = wire.MirrorCommand(frame_sequence=5, channel="lowfc", valid_for_ns=10**8, rows=4, columns=5)
    command.actuators, command.command_nm[:] = shape.tobytes(), modes.tolist()
    mirror_state = wire.MirrorState(rows=4, columns=5, actuators=shape.tobytes(), command_nm=modes.tolist())
    camera = wire.CameraState(rows=6, columns=7, bias_dn=100, saturation_dn=6e4)
    frame_bytes = image(frame(1).pixels, 5, "sensor").SerializeToString()
    command_bytes, mirror_bytes, camera_bytes = (one.SerializeToString() for one in (command, mirror_state, camera))
    return [
        Target("envelope", (ENVELOPE,), Envelope.decode, (LowfcError,)),
        Target("frame", (ENVELOPE + frame_bytes,), loop.frame, (LowfcError,), cost=3),
        Target("camera to controller", (frame_bytes,), processes.frame, message=codec.RawImage, cost=10),
        Target("controller to mirror", (command_bytes,), processes.command, message=wire.MirrorCommand, cost=10),
        Target("camera's settings", (camera_bytes,), processes.camera_state, message=wire.CameraState, cost=10),
        Target("mirror state", (mirror_bytes,), loop.mirror_state, (LowfcError,), wire.MirrorState),
        Target("camera state", (camera_bytes,), loop.camera_state, (LowfcError,), wire.CameraState),
        Target(
            "bench value",
            tuple(encode_bench_value(value, 5) for value in (True, 2.5, "parked")),
            decode_bench_value,
            (LowfcError,),
            wire.BenchValue,
        ),
        Target(
            "controller input",
            tuple(codec.encode_input(each, 3) for each in inputs),
            lambda data: codec.decode_input(wire.ControlInput.FromString(data), {CALIBRATION.id: CALIBRATION}),
            (ValueError, codec.DecodeError),
            wire.ControlInput,
        ),
        Target(
            "calibration",
            (encode_calibration(CALIBRATION, 0),),
            lambda data: decode_calibration(wire.Calibration.FromString(data)),
            (ValueError, codec.DecodeError),
            wire.Calibration,
        ),
        Target(
            "controller state",
            (_state_with_all_parts(state).SerializeToString(),),
            lambda data: _advance_from(
                *decode_state(wire.ControllerState.FromString(data), calibration(), *_laws_and_probe_sequences())
            ),
            (ValueError, codec.DecodeError),
            wire.ControllerState,
            10,
        ),
        Target(
            "mirror command", (command_bytes,), _apply_to_mirror, (codec.DecodeError, LowfcError), wire.MirrorCommand, 2
        ),
        Target("a view's messages", (command_bytes,), _show, cost=10),
    ]


@cache
def _laws_and_probe_sequences() -> tuple[dict[str, LinearLaw], dict[str, PlayTable]]:
    """Laws and probe sequences of the valid requests, by identity."""
    requests = [prepared(NORMAL, codec.request(one, one.name, 0)) for one in _valid_requests()]
    laws = {one.law.id: one.law for one in requests if one.law is not None}
    return laws, {one.played.id: one.played for one in requests if one.played is not None}


def _state_with_all_parts(state: State) -> wire.ControllerState:
    """State of a controller with a channel, an offset, a law and a probe sequence."""
    state, _ = advance(NORMAL, state, BenchReport(0, "mask", None))
    for request in _valid_requests():
        if request.name in ("channel", "offset", "law", "play"):
            state, _ = advance(NORMAL, state, codec.request(request, request.name, 0))
    return controller_state(state, NORMAL, 0)


def _advance_from(_settings: object, state: State) -> None:
    """Check that a decoded state can be advanced."""
    for number in range(1, 4):
        state, _ = advance(NORMAL, state, frame(number + 1000))


def _apply_to_mirror(data: bytes) -> None:
    mirror = Simulated(CONFIG)
    after, _ = mirror.apply_command(mirror.initial, command_of(data), 10)
    assert violations(mirror.protection.limits, mirror.initial.driven_nm, after.driven_nm) == []
    mirror.tick(after, 10**9)


def _show(data: bytes) -> None:
    """Pass a message to the viewer once on each topic that it displays."""
    accumulator = Accumulator()
    for topic in SHOWN:
        accumulator.add(Sample(topic.at("dm"), data, 0, 1, 1))
    accumulator.snapshot(2)


def _valid_requests() -> list[wire.Request]:
    shape = np.ones(GRID, np.float32).tobytes()
    table = np.ones((5, 1), np.float32).tobytes()
    return [
        wire.Request(name="gain", modes=[2, 3], values=[0.3, 0.2]),
        wire.Request(name="limit", values=[40.0]),
        wire.Request(name="offset", values=[1.0]),
        wire.Request(name="step", values=[5.0]),
        wire.Request(name="close"),
        wire.Request(name="channel", text="dark-hole", actuators=shape),
        wire.Request(name="play", text="mirror", table=table, columns=1, actuators=shape),
        wire.Request(name="law", law=wire_law(LAW)),
        wire.Request(name="load", calibration=wire.Calibration.FromString(encode_calibration(CALIBRATION, 0))),
        wire.Request(name="note", text="clouds"),
    ]


def _requests() -> list[Target]:
    requests = {one.name: one.SerializeToString() for one in _valid_requests()}
    return [
        Target(f"request {name}", (data,), partial(Loop().request, name), (ValueError,), wire.Request, 10)
        for name, data in requests.items()
    ]


def _file_target(name: str, corpus: tuple[bytes, ...], read: Callable[[Path], object], path: Path, cost: int) -> Target:
    """Target whose inputs are written to a file, which is then read."""

    def run(data: bytes) -> object:
        path.write_bytes(data)
        return read(path)

    return Target(name, corpus, run, (LowfcError,), cost=cost)


def _bytes_of(save: Callable[[Path], object], path: Path) -> tuple[bytes]:
    save(path)
    return (path.read_bytes(),)


def _files(folder: Path) -> list[Target]:
    with_modes = with_identity(replace(CALIBRATION, actuators_to_modes=np.ones((len(NOLL), 20), np.float32)))
    fits = tuple(calibration_file.to_bytes(each) for each in (CALIBRATION, with_modes))
    laws = _bytes_of(partial(law_file.save, LAW), folder / "law.fits")
    pupils = _bytes_of(lambda path: np.savez(path, quarter=np.ones((2, 2))), folder / "pupil.npz")
    sam = json.loads(layouts.SHIPPED.read_text(encoding="utf-8"))["layouts"]["sam27d07"]
    sams = tuple(json.dumps(one).encode() for one in (sam, {"layouts": {"a": sam}}))
    toml = Configuration().to_toml().encode()
    return [
        _file_target("calibration file", fits, calibration_file.load, folder / "input.fits", 300),
        _file_target("law file", laws, law_file.load, folder / "input.fits", 300),
        _file_target("configuration file", (toml,), configuration.load, folder / "input.toml", 60),
        _file_target("layout file", sams, lambda path: layouts.load_layout(f"{path}"), folder / "input.json", 20),
        _file_target("pupil file", pupils, lambda path: load_pupil(256, path), folder / "input.npz", 30),
    ]


def _logs(folder: Path) -> list[Target]:
    small_logs = tuple(
        small_log(folder / f"log{finished}.mcap", finished=finished).read_bytes() for finished in (True, False)
    )
    log = SyntheticLog().frames(30).request("gain", (0.3,)).frames(20)
    loop_log = (log.write(folder / "run.mcap").read_bytes(),)

    def recover_log(path: Path) -> None:
        with tempfile.TemporaryDirectory(dir=folder) as out:
            recover(path, Path(out) / "out.mcap")

    path = folder / "input.mcap"
    return [
        _file_target("log, read", small_logs, lambda path: list(LogReader(path, skip_damaged=True)), path, 300),
        _file_target("log, its history", loop_log, lambda path: read_history(LogReader(path)), path, 300),
        _file_target("log, recovered", small_logs, recover_log, path, 600),
    ]
