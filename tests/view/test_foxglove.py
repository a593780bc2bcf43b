"""A real Foxglove server on a bus, and a client that speaks its protocol as the apps do."""

import base64
import contextlib
import json
import os
import signal
import struct
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pool
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.json_format import MessageToDict
from google.protobuf.message_factory import GetMessageClass
from websockets.sync.client import connect

from lowfc.adapters.bus.bus import ALL
from lowfc.adapters.bus.run import Run, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.contract.errors import BusError, ConfigurationError
from lowfc.contract.messages import (
    BENCH,
    CALIBRATION,
    CAMERA_STATE,
    COMMAND,
    FRAME,
    HEALTH,
    MIRROR_STATE,
    STEP,
    SURFACE,
    TRUTH,
    Role,
    image,
    wire,
)
from lowfc.programs.view.foxglove_bridge import SHOWN, FoxgloveBridge
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from tests.support.loops import start, until
from tests.support.viewers import listening

pytest.importorskip("foxglove")

PATIENCE_S = 10.0
COUNT = 200  # messages of each topic, at most one per millisecond
_DATA = struct.Struct("<BIQ")  # head of a message: operation 1, number of the subscription, time

STEP_BYTES = wire.ControlStep(frame_sequence=7, mode=wire.LOOP_MODE_CLOSED, error_nm=[1.5, -2.0]).SerializeToString()
FRAME_BYTES = image(np.arange(12, dtype=np.uint16).reshape(3, 4), 5, "camera").SerializeToString()


class Client:
    """A client of the server; `channels`: the channels that the server advertises, by topic."""

    def __init__(self, connection: Any) -> None:
        self.connection = connection
        self.channels: dict[str, dict[str, Any]] = {}
        self._topics: dict[int, str] = {}

    def subscribe(self, *topics: str) -> None:
        """Wait until the topics are advertised, and subscribe to them."""
        while not self.channels.keys() >= set(topics):
            assert self._receive() is None
        subscriptions = []
        for topic in topics:
            number = len(self._topics)
            self._topics[number] = topic
            subscriptions.append({"id": number, "channelId": self.channels[topic]["id"]})
        self.connection.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))

    def next(self) -> tuple[str, int, bytes]:
        """Topic, time and payload of the next message."""
        while (message := self._receive()) is None:
            pass
        return message

    def decode(self, topic: str, payload: bytes) -> dict[str, Any]:
        """A message, decoded with nothing but the schema that the server advertised."""
        channel = self.channels[topic]
        assert (channel["encoding"], channel["schemaEncoding"]) == ("protobuf", "protobuf")
        pool = descriptor_pool.DescriptorPool()
        for file in FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
            pool.Add(file)
        message = GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
        return MessageToDict(message.FromString(payload), preserving_proto_field_name=True)

    def _receive(self) -> tuple[str, int, bytes] | None:
        received = self.connection.recv(timeout=PATIENCE_S)
        if isinstance(received, bytes):
            _, number, time_ns = _DATA.unpack_from(received)
            return self._topics[number], time_ns, received[_DATA.size :]
        self.channels |= {channel["topic"]: channel for channel in json.loads(received).get("channels", ())}
        return None


@contextlib.contextmanager
def connected(port: int, max_queued: int | None = None) -> Iterator[Client]:
    address, protocols = f"ws://127.0.0.1:{port}", ["foxglove.sdk.v1"]
    with connect(address, subprotocols=protocols, max_size=None, max_queue=max_queued, compression=None) as link:
        yield Client(link)


@contextlib.contextmanager
def running(bus: MemoryBus) -> Iterator[FoxgloveBridge]:
    bridge = FoxgloveBridge(MemoryBus(bus.hub, Role.VIEWER, bus.clock), bus.clock, "test", port=0)
    thread = threading.Thread(target=bridge.run)
    thread.start()
    try:
        yield bridge
    finally:
        bridge.service.stop("the test is over")
        thread.join(PATIENCE_S)
        assert not thread.is_alive()


@pytest.fixture
def bus() -> MemoryBus:
    """Bus of the publishing process."""
    return MemoryBus(MemoryHub(), Role.CONTROLLER, FakeClock())


@pytest.fixture
def bridge(bus: MemoryBus) -> Iterator[FoxgloveBridge]:
    with running(bus) as bridge:
        yield bridge


def test_every_topic_of_the_viewer_has_a_channel_with_its_schema(bridge: FoxgloveBridge, bus: MemoryBus) -> None:
    shown = {"/" + topic.at("dm"): topic for topic in SHOWN if topic not in (BENCH, HEALTH, SURFACE)}
    with connected(bridge.port) as client:
        bus.publisher(COMMAND, "dm").put(b"")  # not a topic of the viewer: no channel may appear
        bus.publisher(MIRROR_STATE, "dm").put(b"")
        own = "/" + HEALTH.at(Role.VIEWER)
        client.subscribe("/lowfc/mirror/dm/state", own)
        assert client.channels.keys() - {own} == shown.keys()
        for key, topic in shown.items():
            assert client.channels[key]["schemaName"] == topic.message.DESCRIPTOR.full_name
            assert client.decode(key, b"") == {}


def test_messages_arrive_unchanged(bridge: FoxgloveBridge, bus: MemoryBus) -> None:
    with connected(bridge.port) as client:
        client.subscribe("/" + FRAME.key, "/" + STEP.key, "/" + CAMERA_STATE.key)
        until(lambda: len(bridge.subscriptions) == 3)
        bus.publisher(FRAME).put(FRAME_BYTES, publish_time_ns=11)
        bus.publisher(STEP).put(STEP_BYTES, publish_time_ns=12)
        assert client.next() == ("/" + FRAME.key, 11, FRAME_BYTES)
        assert client.next() == ("/" + STEP.key, 12, STEP_BYTES)
        states = bus.publisher(CAMERA_STATE)
        for sequence in (9, 9, 4):  # a log published twice, and then an older one
            states.put(b"", publish_time_ns=13, sequence=sequence)
            assert client.next() == ("/" + CAMERA_STATE.key, 13, b"")
        assert client.decode("/" + STEP.key, STEP_BYTES)["mode"] == "LOOP_MODE_CLOSED"
    until(lambda: not bridge.subscriptions)


def test_a_late_client_receives_the_calibration(bus: MemoryBus) -> None:
    calibration = wire.Calibration(id="before the bridge", noll=[2, 3]).SerializeToString()
    bus.publisher(CALIBRATION).put(calibration, publish_time_ns=3)
    with running(bus) as bridge:
        bus.publisher(HEALTH, "controller").put(wire.Health(process="controller", pid=1).SerializeToString())
        until(lambda: CALIBRATION.key in bridge.last_states)
        for _ in range(2):
            with connected(bridge.port) as client:
                client.subscribe("/" + CALIBRATION.key)
                assert client.next() == ("/" + CALIBRATION.key, 3, calibration)


def test_a_client_that_does_not_read_loses_messages_and_blocks_no_other_client(
    bridge: FoxgloveBridge, bus: MemoryBus
) -> None:
    truth = bus.publisher(TRUTH)
    payload = wire.Truth(residual_nm=[1.0] * 4000).SerializeToString()
    count = 3000  # 48 MB: more than the sockets hold
    with connected(bridge.port, max_queued=1) as frozen, connected(bridge.port) as reading:
        frozen.subscribe("/" + TRUTH.key)
        reading.subscribe("/" + STEP.key)
        until(lambda: len(bridge.subscriptions) == 2)
        for number in range(1, count + 1):
            truth.put(payload, publish_time_ns=number)
        bus.publisher(STEP).put(STEP_BYTES)
        reading.next()
        times_ns = [0]
        while times_ns[-1] < count:
            times_ns.append(frozen.next()[1])
    assert times_ns == sorted(times_ns)
    assert 1000 < len(times_ns) < count, "a bounded number of messages waits for the client"


def test_the_port_is_on_loopback_only_and_start_errors_have_one_line(
    bridge: FoxgloveBridge, bus: MemoryBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert {host for host, port in listening(os.getpid()) if port == bridge.port} == {"127.0.0.1"}
    with pytest.raises(BusError, match=f"127.0.0.1:{bridge.port} .*--port") as in_use:
        FoxgloveBridge(bus, bus.clock, "test", bridge.port)
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(ConfigurationError, match=r"pip install '?foxglove-sdk") as missing:
        FoxgloveBridge(bus, bus.clock, "test", 0)
    assert "\n" not in f"{in_use.value}{missing.value}"


@pytest.mark.exclusive
def test_the_process_serves_a_real_run(tmp_path: Path, run: Run) -> None:
    process = start(tmp_path, "view", "--foxglove", "--port", 0, "--run", run.run_id)
    bus = ZenohBus(run.links, Role.CONTROLLER, HostClock())
    received: list[str] = []
    bus.subscribe(HEALTH, lambda sample: received.append(wire.Health.FromString(sample.payload).process), ALL)
    frames, steps = map(bus.publisher, (FRAME, STEP))
    try:
        address = process.stderr.readline().split()[4]
        port = int(address.rpartition(":")[2].rstrip(";"))
        with connected(port) as client:
            until(lambda: received)
            client.subscribe("/" + FRAME.key, "/" + STEP.key)
            time.sleep(0.2)  # the server takes a moment to subscribe
            for _ in range(COUNT):
                frames.put(FRAME_BYTES)
                steps.put(STEP_BYTES)
                time.sleep(0.001)
            counts = {"/" + FRAME.key: 0, "/" + STEP.key: 0}
            while counts["/" + STEP.key] < COUNT:
                counts[client.next()[0]] += 1
            assert 0 < counts["/" + FRAME.key] < COUNT / 2, "only images are thinned"
            assert set(received) == {Role.VIEWER}
            client.connection.socket.close()  # like a killed client
            until(lambda: steps.put(STEP_BYTES * 1000) and steps.published > COUNT + 20)
        bus.close()
        run.remove()  # the run starts again
        bus = ZenohBus(open_run(run.run_id).links, Role.CONTROLLER, HostClock())
        calibrations = bus.publisher(CALIBRATION)
        with connected(port) as client:
            client.subscribe("/" + CALIBRATION.key)
            received.clear()
            bus.subscribe(HEALTH, lambda sample: received.append(sample.key), ALL)
            until(lambda: received)
            calibrations.put(b"")
            assert client.next()[0] == "/" + CALIBRATION.key
        process.send_signal(signal.SIGTERM)
        _, stderr = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.wait()
        bus.close()
    assert (process.returncode, stderr.count("serving run")) == (0, 1), stderr
