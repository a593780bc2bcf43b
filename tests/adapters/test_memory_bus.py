import pytest

from lowfc.adapters.bus.bus import Query, Sample, name_in
from lowfc.contract.envelope import Envelope, count_of, sequence_of, start_of
from lowfc.contract.errors import BadMessageError, BusError
from lowfc.contract.messages import CALIBRATION, CAMERA_STATE, COMMAND, FRAME, HEALTH
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub

pytestmark = pytest.mark.exclusive


def test_an_envelope_is_16_little_endian_bytes() -> None:
    envelope = Envelope(sequence_of(1_767_225_600, 7), 0x0102030405060708)
    data = envelope.encode()
    assert data == bytes([7, 0, 0, 0]) + (1_767_225_600).to_bytes(4, "little") + bytes([8, 7, 6, 5, 4, 3, 2, 1])
    assert Envelope.decode(data) == envelope
    assert (start_of(envelope.sequence), count_of(envelope.sequence)) == (1_767_225_600, 7)


@pytest.mark.parametrize("data", [b"", b"x" * 15, b"x" * 17])
def test_other_lengths_are_no_envelope(data: bytes) -> None:
    with pytest.raises(BusError, match=f"16 bytes.*got {len(data)}"):
        Envelope.decode(data)
    with pytest.raises(BusError, match=f"16 bytes.*got {len(data)}"):
        Envelope.unpack(data)


@pytest.mark.parametrize("year_start_s", [1_767_225_600, 2_177_452_800, 4_102_444_800, 2**32 - 4])
def test_sequences_grow_past_2_to_the_32_messages_in_any_year(year_start_s: int) -> None:
    before, after = sequence_of(year_start_s, 2**32 - 1), sequence_of(year_start_s, 2**32)
    assert after == before + 1
    assert sequence_of(year_start_s, 2**32 + 7) < sequence_of(year_start_s + 2, 0)
    for sequence in (before, after):
        assert Envelope.unpack(Envelope(sequence, 2**62).encode()) == (sequence, 2**62)


@pytest.mark.parametrize("numbers", [(2**64 - 2**33, 0), (2**64 - 1, 0), (0, 2**62 + 1), (0, 2**64 - 1)])
def test_numbers_that_would_overflow_are_no_envelope(numbers: tuple[int, int]) -> None:
    with pytest.raises(BadMessageError, match=f"below 2.64 - 2.33.*got {numbers[0]} and {numbers[1]} ns"):
        Envelope.unpack(Envelope(*numbers).encode())


def pair() -> tuple[MemoryHub, MemoryBus, MemoryBus, FakeClock]:
    hub, clock = MemoryHub(), FakeClock()
    return hub, MemoryBus(hub, "camera", clock), MemoryBus(hub, "controller", clock), clock


def test_a_put_reaches_every_subscriber_of_its_key() -> None:
    _, camera, controller, clock = pair()
    seen: list[Sample] = []
    controller.subscribe(COMMAND, seen.append, "tip")
    controller.subscribe(COMMAND, seen.append)
    controller.subscribe(FRAME, seen.append)
    clock.advance(5)
    envelope = camera.publisher(COMMAND, "dm").put(b"body", publish_time_ns=3)
    (sample,) = seen
    assert sample == Sample("lowfc/mirror/dm/command", b"body", envelope.sequence, 3, clock.now_ns())
    camera.publisher(COMMAND, "tip").put(b"")
    assert len(seen) == 3
    assert name_in(COMMAND, seen[-1].key) == "tip"
    assert name_in(FRAME, FRAME.key) == ""


def test_sequences_of_a_restarted_role_never_repeat() -> None:
    hub, camera, _, clock = pair()
    first = camera.publisher(FRAME).put(b"").sequence
    camera.close()
    again = MemoryBus(hub, "camera", clock).publisher(FRAME)
    assert start_of(again.put(b"").sequence) == start_of(first) + 1
    assert count_of(again.put(b"").sequence) == 1
    with pytest.raises(BusError, match="closed"):
        camera.publisher(FRAME).put(b"")


def test_a_late_joiner_gets_the_last_message_of_a_queryable_topic() -> None:
    _, camera, controller, clock = pair()
    state, frames = camera.publisher(CAMERA_STATE), camera.publisher(FRAME)
    assert controller.get(CAMERA_STATE.key) == []
    state.put(b"one")
    envelope = state.put(b"two")
    frames.put(b"frame")
    clock.advance(9)
    assert controller.get(CAMERA_STATE.key) == [
        Sample(CAMERA_STATE.key, b"two", envelope.sequence, envelope.publish_time_ns, clock.now_ns())
    ]
    assert controller.get(FRAME.key) == controller.get(CALIBRATION.key) == []
    for bus in (camera, controller):
        bus.publisher(HEALTH, bus.role).put(bus.role.encode())
    assert [sample.payload for sample in controller.get("lowfc/health/*")] == [b"camera", b"controller"]


def test_a_question_gets_the_handlers_answer() -> None:
    _, camera, controller, _ = pair()

    def answer(query: Query) -> None:
        query.reply(query.name.encode() + query.payload)

    controller.queryable("lowfc/request/*", answer)
    assert [sample.payload for sample in camera.get("lowfc/request/gain", b"=1")] == [b"gain=1"]
    assert camera.get("lowfc/other/gain") == []


def test_a_broken_handler_harms_nobody_else(capsys: pytest.CaptureFixture[str]) -> None:
    _, camera, controller, _ = pair()
    seen: list[Sample] = []

    def fail(_: object) -> None:
        raise RuntimeError("broken")

    controller.subscribe(FRAME, fail)
    controller.subscribe(FRAME, seen.append)
    controller.queryable("lowfc/request/*", fail)
    frames = camera.publisher(FRAME)
    frames.put(b"")
    frames.put(b"")
    assert camera.get("lowfc/request/open", timeout_s=0.01) == []
    assert len(seen) == 2
    assert controller.faults.counts == {
        "controller: handler of lowfc/camera/frame": 2,
        "controller: queryable of lowfc/request/open": 1,
    }
    assert capsys.readouterr().err.count("RuntimeError: broken") == 2


def test_messages_can_be_lost_on_purpose() -> None:
    hub, camera, controller, _ = pair()
    seen: list[int] = []
    hub.lose = lambda role, key, envelope: role == "controller" and count_of(envelope.sequence) == 1
    controller.subscribe(FRAME, lambda sample: seen.append(count_of(sample.sequence)))
    frames = camera.publisher(FRAME)
    for _ in range(3):
        frames.put(b"")
    assert seen == [0, 2]
