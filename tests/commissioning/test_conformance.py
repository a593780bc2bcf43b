"""`lowfc conformance` on correct devices, and on devices with one fault: it reports that fault and nothing else."""

import json
import socket
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from google.protobuf.message import DecodeError, Message

from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_session import session_config
from lowfc.arrays import Single
from lowfc.contract.configuration import Configuration, Network, load
from lowfc.contract.envelope import Envelope, sequence_of
from lowfc.contract.errors import BusError
from lowfc.contract.messages import (
    CAMERA_STATE,
    FRAME,
    HEALTH,
    MIRROR_STATE,
    RawImage,
    Role,
    Topic,
    image,
    timestamp,
    wire,
)
from lowfc.control.loop.safety import Limits
from lowfc.device.driver import CameraSettings, camera_state
from lowfc.device.mirror_loop import command_of, state_of
from lowfc.device.mirror_protection import Command, Status
from lowfc.programs.commissioning.checks import Check, print_report
from lowfc.programs.commissioning.conformance import command as conformance
from lowfc.programs.commissioning.conformance.camera import watch
from lowfc.programs.commissioning.conformance.command import FIELDS, STATUSES
from lowfc.programs.commissioning.conformance.connection import Connection, Received
from lowfc.programs.commissioning.conformance.dialogue import Dialogue, Expected
from lowfc.programs.commissioning.conformance.frames import camera_checks
from lowfc.programs.commissioning.conformance.mirror import EXPIRES_NS, mirror_checks
from lowfc.testing.clock import FakeClock
from tests.support.loops import json_of, refusal, until
from tests.support.safety_checks import Simulated

MS_NS = 1_000_000
LATENCY_NS = 100_000
SMALL = {"camera.rate_hz": 100, "mirror.rows": 6, "mirror.columns": 7}
CONFIG = load(None, SMALL)
SHAPE = (12, 16)
OFFSET_NS = 1_700_000_000_000_000_000


def envelope(sequence: int, time_ns: int) -> bytes | None:
    return Envelope(sequence, time_ns).encode()


class Device:
    """A simulated device with the interface of its connection, correct except for `changes`.

    A change is a value, or a function of the correct value.

    Time advances in milliseconds, and only in `wait`.
    """

    process = ""
    offset_ns = OFFSET_NS

    def __init__(self, **changes: Any) -> None:
        self.clock = FakeClock()
        self.clock.advance(3600 * 1_000_000_000)  # some time after the start of the publishers
        self.now_ns = self.clock.now_ns
        self.changes = changes
        self.counts: Counter[str] = Counter()
        self.last: dict[str, Received] = {}
        self._waiting: list[Received] = []
        self._health_ns = 0

    def wait(self, seconds: float) -> None:
        end_ns = self.now_ns() + max(1, round(seconds * 1e9))
        while self.now_ns() < end_ns:
            self.clock.advance(min(MS_NS, end_ns - self.now_ns()))
            self.iterate(self.now_ns())

    def received(self) -> list[Received]:
        received, self._waiting = self._waiting, []
        return received

    def put(self, topic: Topic, name: str, payload: bytes) -> None:
        self.clock.advance(1)  # a moment after its last message
        self.receive(payload, self.now_ns())

    def ask(self, key: str) -> list[Received]:
        return self.changed("answer", [self.last[key]] if key in self.last else [])

    def changed(self, name: str, value: Any, *arguments: Any) -> Any:
        change = self.changes.get(name)
        return value if change is None else change(value, *arguments)

    def publish(self, key: str, message: Message | bytes, now_ns: int) -> None:
        count = self.changed("count", self.counts[key], key)
        self.counts[key] += 1
        attach: Callable[[int, int], bytes | None] = self.changes.get("attach", envelope)
        attachment = attach(sequence_of(self.clock.start_s, count), now_ns)
        payload = message if isinstance(message, bytes) else message.SerializeToString()
        self.last[key] = Received(self.changed("key", key), payload, attachment, now_ns + LATENCY_NS)
        self._waiting.append(self.last[key])

    def iterate(self, now_ns: int) -> None:
        if now_ns >= self._health_ns:
            self._health_ns = now_ns + 500 * MS_NS
            health = wire.Health(timestamp=timestamp(now_ns), process=self.process, state="running")
            for key, count in self.counts.items():
                health.topics.add(topic=key, published=count)
            health = self.changed("health", health)
            if health is not None:
                self.publish(HEALTH.at(self.process), health, now_ns)


class Camera(Device):
    """A camera with a noisy spot on 12 x 16 pixels, 100 frames per second."""

    process = "camera"

    def __init__(self, **changes: Any) -> None:
        super().__init__(**changes)
        self._due_ns = 0
        self._index = 0
        y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
        self._spot = 100 + 3000 * np.exp(-((y - 5.5) ** 2 + (x - 7.5) ** 2) / 12)
        self._rng = np.random.default_rng(1)

    def iterate(self, now_ns: int) -> None:
        super().iterate(now_ns)
        if now_ns < self._due_ns:
            return
        self._due_ns = now_ns + CONFIG.period_ns
        time_ns = now_ns - 50_000
        if self._index % 50 == 0:
            state = self.changed("state", camera_state(CameraSettings.configured(CONFIG, *SHAPE), time_ns), self._index)
            if state is not None:
                self.publish(CAMERA_STATE.key, state, now_ns)
        pixels = self._rng.poisson(self._spot).astype(np.uint16)
        pixels = self.changed("pixels", pixels, self._index)
        frame = self.changed("frame", image(pixels, time_ns, "camera"), self._index)
        self._index += 1
        if frame is not None:
            self.publish(FRAME.key, frame, now_ns)


class Mirror(Device):
    """The functions of the simulated mirror, with hooks for faults."""

    process = "mirror-dm"

    def __init__(self, **changes: Any) -> None:
        super().__init__(**changes)
        self.mirror = Simulated(CONFIG, **changes.get("protection", {}))
        self.status = self.mirror.initial
        self._published_ns = 0
        self._received = 0

    def receive(self, payload: bytes, now_ns: int) -> None:
        self._received += 1
        period = self.changes.get("drops")
        if self.changes.get("ignores") or (period and self._received % period == 0):
            return
        try:
            command = wire.MirrorCommand.FromString(payload)
        except DecodeError:
            return
        decoded = self.changed("command", command_of(payload), command, self.status)
        self.status, refused = self.mirror.apply_command(self.status, decoded, now_ns)
        if refused is None:
            self._publish(self.status.time_ns, now_ns)
        elif self.changes.get("loses"):
            self._received = -1  # the next command is number 0, which `drops` skips
        elif self.changes.get("renews"):
            self.status = self.status._replace(received_ns=now_ns)

    def iterate(self, now_ns: int) -> None:
        super().iterate(now_ns)
        self.status = self.changed("tick", self.mirror.tick)(self.status, now_ns)
        if now_ns - self._published_ns >= 100 * MS_NS and not self.changed("silent", False, self.status):
            self._publish(now_ns, now_ns)

    def _publish(self, time_ns: int, now_ns: int) -> None:
        state = state_of(self.status, time_ns)
        self.publish(MIRROR_STATE.at("dm"), self.changed("state", state), now_ns)
        self._published_ns = now_ns


def not_ok(checks: Iterator[Check]) -> dict[str, str]:
    """Statuses of the checks that are not ok, by name."""
    listed = list(checks)
    assert len({check.name for check in listed}) == len(listed)
    assert all(check.expected and check.got and bool(check.advice) != (check.status == "ok") for check in listed)
    return {check.name: str(check.status) for check in listed if check.status != "ok"}


def camera_faults(**changes: Any) -> dict[str, str]:
    return not_ok(camera_checks(watch(Camera(**changes), 3.0, lambda _: None)))


def mirror_faults(mirror: Mirror, config: Configuration = CONFIG, **options: Any) -> dict[str, str]:
    return not_ok(mirror_checks(Dialogue(mirror, Expected(config)), 0.2, **{"show": lambda _: None, **options}))


def failing(health: Any) -> Any:
    """Health of a driver that fails all the time."""
    health.driver_failures = health.timestamp.ToNanoseconds()
    return health


def setting(**values: Any) -> Callable[..., Any]:
    """Function that sets fields of a message."""

    def change(message: Any, *_: Any) -> Any:
        for name, value in values.items():
            setattr(message, name, value)
        return message

    return change


def shifted(shift_ns: int) -> Callable[..., RawImage]:
    def change(frame: RawImage, _: int) -> RawImage:
        frame.timestamp.FromNanoseconds(frame.timestamp.ToNanoseconds() + shift_ns)
        return frame

    return change


def publish_at(function: Callable[[int], int]) -> Callable[[int, int], bytes | None]:
    return lambda sequence, time_ns: envelope(sequence, function(time_ns))


def growing_exposure(state: wire.CameraState, index: int) -> wire.CameraState:
    state.exposure_ns += index
    return state


def eight_bits(frame: RawImage, _: int) -> RawImage:
    frame.data, frame.step = frame.data[::2], frame.width
    return frame


def cropped(frame: RawImage, index: int) -> RawImage:
    if index % 2:
        frame.height, frame.data = 6, frame.data[: len(frame.data) // 2]
    return frame


WRONG, WARNING = "wrong", "warning"
# By fault: changes of the device, and the expected status of each check that is not ok.
CAMERA_FAULTS: dict[str, tuple[dict[str, Any], dict[str, str]]] = {
    "nothing": ({}, {}),
    "no envelope": ({"attach": lambda *_: None}, {"envelope": WRONG, "settings on request": WRONG}),
    "a short envelope": ({"attach": lambda s, t: b"12345678"}, {"envelope": WRONG, "settings on request": WRONG}),
    "a big-endian envelope": ({"attach": struct.Struct(">QQ").pack}, {"sequence": WRONG, "publish time": WRONG}),
    "a sequence without the start": ({"attach": lambda s, t: envelope(s & 0xFFFF, t)}, {"sequence": WRONG}),
    "a start in milliseconds": ({"attach": lambda s, t: envelope(s * 1000 % 2**64, t)}, {"sequence": WRONG}),
    "a constant count": ({"count": lambda count, _: 7}, {"sequence": WRONG}),
    "a count of all topics": ({"count": lambda count, _: 3 * count}, {"sequence": WRONG}),
    "a gap": ({"count": lambda count, _: count + 4 * (count > 100)}, {"sequence": WARNING}),
    "a publish time in us": ({"attach": publish_at(lambda t: t // 1000)}, {"publish time": WRONG}),
    "a monotonic clock": ({"attach": publish_at(lambda t: t - OFFSET_NS)}, {"publish time": WRONG}),
    "another clock": ({"attach": publish_at(lambda t: t - 35 * MS_NS)}, {"publish time": WRONG}),
    "a clock with a resolution of 25 ms": (
        {"attach": publish_at(lambda t: t - t % (25 * MS_NS))},
        {"publish time": WRONG},
    ),
    "no frame time": ({"frame": lambda frame, _: frame.ClearField("timestamp") or frame}, {"frame time": WRONG}),
    "a frame time ahead": ({"frame": shifted(20 * MS_NS)}, {"frame time": WRONG}),
    "a frame time an hour ago": ({"frame": shifted(-3600 * 1000 * MS_NS)}, {"frame time": WRONG}),
    "the start of the exposure": ({"frame": shifted(-5 * MS_NS)}, {"frame time": WARNING}),
    "undecodable bytes": ({"frame": lambda *_: b"\xff\xff\xff"}, {"frames": WRONG}),
    "eight bits": ({"frame": eight_bits}, {"bytes": WRONG}),
    "another encoding": ({"frame": setting(encoding="16UC1")}, {"encoding": WRONG}),
    "no step": ({"frame": setting(step=0)}, {"bytes": WRONG}),
    "rows for columns": ({"frame": setting(width=12, height=16, step=24)}, {"settings' size": WRONG}),
    "a region that changes": ({"frame": cropped}, {"shape": WRONG, "settings' size": WRONG}),
    "no frames": ({"frame": lambda *_: None}, {"frames": WRONG}),
    "another key": (
        {"key": lambda key: key.replace("camera/frame", "camera/frames")},
        {"frames": WRONG, "topics": WRONG},
    ),
    "frames that stop": ({"frame": lambda frame, i: frame if i < 100 else None}, {"steadiness": WRONG}),
    "every tenth frame missing": ({"frame": lambda frame, i: frame if i % 10 else None}, {"steadiness": WARNING}),
    "a stuck image": ({"pixels": lambda dn, i: np.full(SHAPE, 500, np.uint16)}, {"live image": WRONG}),
    "zeros": ({"pixels": lambda dn, i: 0 * dn}, {"live image": WRONG, "light": WRONG}),
    "darkness": ({"pixels": lambda dn, i: dn // 3000 + 100 + i % 2}, {"light": WARNING}),
    "full well": (
        {"pixels": lambda dn, i: np.minimum(dn * 100 + i, 40_100 - (np.arange(16) == 3) * i).astype(np.uint16)},
        {"light": WARNING},
    ),
    "big-endian pixels": ({"pixels": lambda dn, i: dn.byteswap()}, {"byte order": WRONG, "settings' range": WRONG}),
    "left-aligned pixels": ({"pixels": lambda dn, i: dn * 16}, {"byte order": WRONG, "settings' range": WRONG}),
    "no settings": ({"state": lambda *_: None}, {"settings": WRONG}),
    "undecodable settings": ({"state": lambda *_: b"\xff\xff\xff"}, {"settings": WRONG, "settings on request": WRONG}),
    "settings once": ({"state": lambda state, i: state if i == 0 else None}, {"settings": WARNING}),
    "empty settings": ({"state": lambda *_: wire.CameraState()}, {"settings' values": WRONG, "settings' size": WRONG}),
    "settings that change": ({"state": growing_exposure}, {"settings kept": WARNING}),
    "settings of another region": ({"state": setting(rows=16, columns=12)}, {"settings' size": WRONG}),
    "ten bits": ({"state": setting(bit_depth=10)}, {"settings' values": WRONG, "settings' range": WRONG}),
    "saturation too low": ({"state": setting(saturation_dn=2000)}, {"settings' range": WRONG}),
    "a period in us": ({"state": setting(period_ns=10_000, exposure_ns=5_000)}, {"settings' period": WRONG}),
    "a bias of NaN": ({"state": setting(bias_dn=float("nan"))}, {"settings' values": WRONG}),
    "infinite saturation": ({"state": setting(saturation_dn=float("inf"))}, {"settings' values": WRONG}),
    "a bit depth of -1": ({"state": setting(bit_depth=2**32 - 1)}, {"settings' values": WRONG}),
    "no answer": ({"answer": lambda _: []}, {"settings on request": WARNING}),
    "no health": ({"health": lambda _: None}, {"health": WARNING}),
    "driver fails": ({"health": failing}, {"health": WARNING}),
    "another's health": ({"health": setting(process="mycam")}, {"health": WARNING}),
}


@pytest.mark.parametrize("fault", CAMERA_FAULTS)
def test_a_fault_of_a_camera_is_found_and_nothing_else(fault: str) -> None:
    changes, expected = CAMERA_FAULTS[fault]
    assert camera_faults(**changes) == expected


def shaped(function: Callable[[Single], Single]) -> Callable[[wire.MirrorState], wire.MirrorState]:
    def change(state: wire.MirrorState) -> wire.MirrorState:
        shape = np.frombuffer(state.actuators, np.float32).reshape(state.rows, state.columns)
        state.actuators = np.ascontiguousarray(function(shape), np.float32).tobytes()
        return state

    return change


def one_dead(shape: Single, height_nm: float = 0.0) -> Single:
    return np.where(np.arange(shape.size).reshape(shape.shape) == 9, np.float32(height_nm), shape)


def careless(check: str) -> Callable[..., Command]:
    """Function of a driver that repairs an invalid command instead of refusing it."""

    def change(decoded: Command, command: wire.MirrorCommand, status: Status) -> Command:
        actuators_nm = decoded.actuators_nm
        if check == "bytes" and actuators_nm is None:
            return decoded._replace(actuators_nm=np.resize(np.frombuffer(command.actuators, np.float32), (6, 7)))
        if check == "grid" and actuators_nm is not None:
            return decoded._replace(actuators_nm=np.resize(actuators_nm, (6, 7)))
        if check == "finite" and actuators_nm is not None:
            return decoded._replace(actuators_nm=np.nan_to_num(actuators_nm, nan=0.0, posinf=0.0))
        if check == "order":
            return decoded._replace(frame_sequence=max(decoded.frame_sequence, status.frame_sequence))
        return decoded

    return change


WIDE_LIMITS = Limits(10_000.0, 10_000.0, 10_000.0)
UNTRIED = {"limits": WARNING}
NEVER_EXPIRED = {"dead-man": WRONG, "longest command": WARNING} | UNTRIED
MIRROR_FAULTS: dict[str, tuple[dict[str, Any], dict[str, str]]] = {
    "silent, no answers": (
        {"silent": lambda *_: 1, "ignores": True},
        {"idle state": WRONG, "answers": WRONG} | UNTRIED,
    ),
    "no answers": ({"ignores": True}, {"answers": WRONG} | UNTRIED),
    "one command in three unanswered": ({"drops": 3}, {"answers": WRONG} | UNTRIED),
    "one command in 15 skipped after a stall": ({"drops": 15}, {"answers": WARNING}),
    "loses what follows a bad command": ({"drops": 999, "loses": True}, {"after bad commands": WRONG} | UNTRIED),
    "silent when idle": ({"silent": lambda *_: 1}, {"idle state": WRONG, "silence": WRONG} | NEVER_EXPIRED),
    "silent until a command expires": ({"silent": lambda _, status: status.following}, {"silence": WRONG} | UNTRIED),
    "no envelope": ({"attach": lambda *_: None}, {"envelope": WRONG}),
    "undecodable state": ({"state": lambda _: b"\xff\xff\xff"}, {"state": WRONG} | UNTRIED),
    "another grid": ({"state": setting(rows=7, columns=6)}, {"grid": WRONG} | UNTRIED),
    "float64": ({"state": lambda state: setting(actuators=2 * state.actuators)(state)}, {"grid": WRONG} | UNTRIED),
    "NaN for a missing actuator": ({"state": shaped(lambda shape: one_dead(shape, np.nan))}, {"grid": WRONG} | UNTRIED),
    "wavefront instead of surface": ({"state": shaped(lambda shape: 2 * shape)}, {"applied": WRONG} | UNTRIED),
    "um instead of nm": ({"state": shaped(lambda shape: shape / 1000)}, {"applied": WRONG} | UNTRIED),
    "upside down": ({"state": shaped(lambda shape: shape[::-1])}, {"applied": WRONG} | UNTRIED),
    "wrong sign": ({"state": shaped(lambda shape: -shape)}, {"applied": WRONG} | UNTRIED),
    "another order": ({"state": shaped(lambda shape: shape.reshape(7, 6).T)}, {"applied": WRONG} | UNTRIED),
    "a dead actuator": ({"state": shaped(one_dead)}, {"applied": WARNING}),
    "unspecified status": ({"state": setting(status=0)}, {"status": WRONG} | NEVER_EXPIRED),
    "an unknown status": ({"state": setting(status=7)}, {"status": WRONG} | NEVER_EXPIRED),
    "a frame_sequence of -1": ({"state": setting(frame_sequence=2**64 - 1)}, {"state": WRONG} | UNTRIED),
    "impossible heights": ({"state": shaped(lambda shape: shape + np.float32(3e38))}, {"grid": WRONG} | UNTRIED),
    "impossible heights once commanded": (
        {"state": shaped(lambda shape: np.where(np.abs(shape) > 1, np.float32(3e38), shape))},
        {"applied": WRONG} | UNTRIED,
    ),
    "its own timestamp instead of the command's": (
        {"state": lambda state: shifted(3 * MS_NS)(state, 0)},
        {"time": WARNING},
    ),
    "no modal command": ({"state": lambda state: state.ClearField("command_nm") or state}, {"modal command": WARNING}),
    "NaN replaced by zero": (
        {"command": careless("finite")},
        {"NaN refused": WRONG, "infinity refused": WRONG, "dead-man": WRONG} | UNTRIED,
    ),
    "accepts any grid": ({"command": careless("grid")}, {"wrong grid refused": WRONG} | UNTRIED),
    "accepts any length": ({"command": careless("bytes")}, {"short command refused": WRONG} | UNTRIED),
    "accepts old commands": (
        {"command": careless("order")},
        {"old command refused": WRONG, "clear": WARNING} | UNTRIED,
    ),
    "no dead-man": ({"tick": lambda tick: lambda status, now_ns: status}, NEVER_EXPIRED),
    "a refused command extends the timeout": ({"renews": True}, {"dead-man": WRONG} | UNTRIED),
    "expired at once": (
        {"tick": lambda tick: lambda status, now_ns: tick(status._replace(valid_for_ns=MS_NS), now_ns)},
        {"dead-man": WRONG} | UNTRIED,
    ),
    "command_nm set while it relaxes": (
        {
            "state": lambda state: (
                state if state.status != wire.MIRROR_STATUS_EXPIRED else state.command_nm.extend([1.0, 2.0]) or state
            )
        },
        {"relaxing": WRONG} | UNTRIED,
    ),
    "no limits": ({"protection": {"limits": WIDE_LIMITS}}, {"stroke": WRONG, "slew": WRONG, "neighbours": WRONG}),
    "no stroke limit": ({"protection": {"limits": Limits(10_000.0, 150.0, 500.0)}}, {"stroke": WRONG}),
    "no neighbour limit": ({"protection": {"limits": Limits(750.0, 150.0, 10_000.0)}}, {"neighbours": WRONG}),
    "a shorter stroke": ({"protection": {"limits": Limits(400.0, 150.0, 500.0)}}, {"stroke": WARNING}),
    "limits_hit empty": (
        {"state": lambda state: state.ClearField("limits_hit") or state},
        {"stroke": WARNING, "slew": WARNING, "neighbours": WARNING},
    ),
    "no health": ({"health": lambda _: None}, {"health": WARNING}),
}


def test_a_correct_mirror_passes_and_returns_to_its_shape() -> None:
    mirror = Mirror(protection={"flatten": False})
    start = np.full((6, 7), 40, np.float32)
    command = Command("lowfc", 5, 1, 10**10, start, np.zeros(2, np.float32))
    mirror.status, _ = mirror.mirror.apply_command(mirror.status, command, mirror.now_ns())
    assert mirror_faults(mirror) == {}
    np.testing.assert_allclose(mirror.status.surface_nm, start, atol=0.03)
    assert 5 < mirror.status.frame_sequence < 5000, (
        "below a camera's sequences, so that the loop's commands are accepted afterwards"
    )


@pytest.mark.parametrize("fault", MIRROR_FAULTS)
def test_a_fault_of_a_mirror_is_found(fault: str) -> None:
    changes, expected = MIRROR_FAULTS[fault]
    assert mirror_faults(Mirror(**changes)) == expected


def test_an_answer_that_is_read_late_because_this_host_stalls_is_no_fault() -> None:
    class Stalled(Mirror):
        def wait(self, seconds: float) -> None:
            # After two of the commands, wait longer than an answer may take.
            super().wait(0.6037 if self._received in (31, 33) else seconds)

    assert mirror_faults(Stalled()) == {}


def test_a_command_that_expires_once_because_of_a_stall_is_tried_again() -> None:
    first_timeout_ns = [MS_NS]

    def tick(tick: Any) -> Any:
        valid = mirror.status.valid_for_ns == EXPIRES_NS and first_timeout_ns and first_timeout_ns.pop()
        mirror.status = mirror.status._replace(valid_for_ns=valid or mirror.status.valid_for_ns)
        return tick

    mirror = Mirror(tick=tick)
    checks = mirror_checks(Dialogue(mirror, Expected(CONFIG)), 0.2, lambda _: None)
    assert not_ok(iter(checks)) == {}
    assert "(1 failed attempt before)" in {check.name: check.got for check in checks}["dead-man"]


def test_gentle_does_not_test_the_limits() -> None:
    mirror = Mirror()
    highest_nm: list[float] = []
    mirror.changes["state"] = shaped(lambda shape: highest_nm.append(float(np.abs(shape).max())) or shape)
    assert mirror_faults(mirror, gentle=True) == UNTRIED
    assert 0 < max(highest_nm) < 0.051 * CONFIG.mirror.slew_nm  # ordinary commands: 5 % of the smallest limit


def test_an_interrupted_check_returns_the_mirror_to_its_shape() -> None:
    mirror = Mirror()

    def interrupted(check: str) -> None:
        if check == "limits":
            mirror.changes["state"] = raising

    def raising(state: wire.MirrorState) -> wire.MirrorState:
        if np.frombuffer(state.actuators, np.float32).max() > 400:
            del mirror.changes["state"]
            raise KeyboardInterrupt
        return state

    with pytest.raises(KeyboardInterrupt):
        mirror_faults(mirror, show=interrupted)
    assert mirror.status.following
    np.testing.assert_allclose(mirror.status.surface_nm, 0, atol=0.03)


@pytest.mark.parametrize(("dead", "untested"), [([9, 17], {}), ([*range(24), *range(25, 42)], {"stroke": WARNING})])
def test_actuators_configured_as_fixed_are_no_fault(dead: list[int], untested: dict[str, str], tmp_path: Path) -> None:
    active, file = np.arange(42).reshape(6, 7) % 7 < 5, str(tmp_path / "active.npy")
    np.save(file, active.astype(float))
    config = load(None, SMALL | {"mirror.dead": dead, "mirror.stuck_nm": {"24": 30.0}, "mirror.active": file})
    mirror = Mirror(state=shaped(lambda shape: shape * active))
    mirror.mirror = Simulated(config)
    mirror.status = mirror.mirror.initial
    assert mirror_faults(mirror, config) == untested


@pytest.mark.parametrize(
    ("health", "text"),
    [
        (lambda message: setting(last_warning="FRAMES_LOST 1 frame")(failing(message)), "see DRIVER_FAILED in its"),
        (lambda message: setting(last_warning="DRIVER_HANGS for 2 s")(failing(message)), "DRIVER_HANGS for 2 s"),
        (setting(process="mycam"), "name the process 'camera', as its key does"),
    ],
)
def test_the_check_of_health_names_the_drivers_failure_and_the_expected_process(health: Any, text: str) -> None:
    checks = camera_checks(watch(Camera(health=health), 3.0, lambda _: None))
    assert [text in check.got + check.advice for check in checks if check.name == "health"] == [True]


def test_a_mirror_state_without_actuators_is_explained_by_the_drivers_failure() -> None:
    why = "DRIVER_FAILED the driver failed and will be tried again: ValueError: it returned positions of shape ()"
    failed = Mirror(state=setting(actuators=b""), health=setting(driver_failures=1, last_warning=why))
    checks = mirror_checks(Dialogue(failed, Expected(CONFIG)), 0.2, lambda _: None)
    assert [check.advice for check in checks if check.name == "grid"] == [why]


@pytest.mark.parametrize(
    ("reported", "count", "advice"),
    [
        (lambda shape: np.where(np.arange(42).reshape(6, 7) % 7 < 5, shape, 0), 12, "exclude those without a channel"),
        (lambda shape: 16 * np.round(shape / 16), 42, "step is above 7.49 nm, set mirror.driver_bits"),
        (lambda shape: shape / 1000, 42, "with the right orientation, times 0.001: report nm, not um"),
    ],
    ids=["a round mirror", "a coarse step", "um, below one step"],
)
def test_the_advice_on_actuators_that_hardly_move_names_the_cause(reported: Any, count: int, advice: str) -> None:
    checks = mirror_checks(Dialogue(Mirror(state=shaped(reported)), Expected(CONFIG)), 0.2, lambda _: None)
    (applied,) = (check for check in checks if check.name == "applied")
    assert (applied.status, applied.got.partition(" off")[0]) == (WRONG, f"{count} of 42 actuators")
    assert advice in applied.advice


def test_the_report_has_advice_for_failed_checks(capsys: pytest.CaptureFixture[str]) -> None:
    checks = list(camera_checks(watch(Camera(frame=setting(encoding="16UC1")), 1.0, lambda _: None)))
    print_report(checks, STATUSES, FIELDS, None)
    text = capsys.readouterr().out
    assert "'16UC1'" in text
    assert "with encoding mono16" in text
    assert text.splitlines()[-1].startswith("1 wrong, 0 warnings")
    print_report(checks, STATUSES, FIELDS, {"run": "bench"})
    printed = json.loads(capsys.readouterr().out)
    assert (printed["run"], printed["counts"]) == ("bench", {"ok": len(checks) - 1, "warning": 0, "wrong": 1})
    assert {"name": "encoding", "status": "wrong"}.items() <= printed["checks"][5].items()


@pytest.mark.usefixtures("own_runtime")
def test_conformance_refuses_runs_that_it_cannot_check(tmp_path: Path) -> None:
    def complaint(*arguments: object) -> str:
        return refusal("conformance", *arguments)

    assert "lowfc config zenoh --role camera" in complaint("camera")
    assert "lowfc config zenoh --role mirror-dm" in complaint("mirror")
    assert "there is no run 'bench'" in complaint("mirror", "--run", "bench")
    with socket.create_server(("127.0.0.1", open_run("bench").links.ports[Role.CONTROLLER])):
        assert "has a controller" in complaint("mirror", "--run", "bench")
    (tmp_path / "lockstep.toml").write_text("lockstep = true\n")
    assert "a mirror has no command timeout" in complaint("mirror", "--config", tmp_path / "lockstep.toml")
    open_run("far", network=Network(router="tls/127.0.0.1:7447", certificates="."))
    assert "uses a router" in complaint("camera", "--run", "far")


@pytest.mark.usefixtures("own_runtime")
def test_an_absent_camera_fails_the_check_of_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    open_run("bench")
    monkeypatch.setattr(conformance, "CONNECT_S", 0.0)
    report = json_of("conformance", "camera", "--run", "bench", "--duration", 0.2, status=1)
    checks = {check["name"]: check for check in report["checks"]}
    assert checks["frames"]["status"] == "wrong"
    assert "received: nothing" in checks["frames"]["got"]


@pytest.mark.usefixtures("own_runtime")
def test_a_connection_queries_and_receives_messages_without_an_envelope() -> None:
    links = open_run("bench").links
    with zenoh.open(zenoh.Config.from_json5(json.dumps(session_config(links, Role.CAMERA)))) as session:
        session.declare_queryable(CAMERA_STATE.key, lambda query: query.reply(CAMERA_STATE.key, b"settings"))
        with closing(Connection(links, Role.OPERATOR)) as connection:
            until(connection.peers)
            until(lambda: [answer.payload for answer in connection.ask(CAMERA_STATE.key)] == [b"settings"])
            received: list[Received] = []
            until(
                lambda: received.extend(connection.received()) or received,
                each=lambda: session.put(FRAME.key, b"frame"),
            )
            assert received[0][:3] == (FRAME.key, b"frame", None)


@pytest.mark.usefixtures("own_runtime")
def test_only_one_process_may_have_the_role_controller() -> None:
    links = open_run("bench").links
    with (
        closing(Connection(links, Role.CONTROLLER)),
        pytest.raises(BusError, match="does another process have this role"),
    ):
        Connection(links, Role.CONTROLLER)
