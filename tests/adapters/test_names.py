"""Which envelopes, sequences, names and start times a process accepts from the bus."""

from collections.abc import Callable

import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.names import MAX_HEALTH_BYTES, MAX_NAME_LENGTH, MAX_NAMES, Names
from lowfc.adapters.bus.start_check import StartCheck
from lowfc.adapters.process.clock import SIMULATED_START_NS
from lowfc.contract.envelope import Envelope, count_of, sequence_of, start_of
from lowfc.contract.errors import BadMessageError, BusError
from lowfc.contract.messages import FRAME, HEALTH, MIRROR_STATE, Role, topic_of, wire
from lowfc.programs.launch.watch import Watch
from lowfc.programs.view.snapshot import Accumulator
from lowfc.testing.clock import FakeClock
from lowfc.testing.listener import Listener
from lowfc.testing.memory_bus import MemoryBus, MemoryHub


def test_an_envelope_is_16_little_endian_bytes() -> None:
    envelope = Envelope(sequence_of(1_767_225_600, 7), 0x0102030405060708)
    data = envelope.encode()
    assert data == bytes([7, 0, 0, 0]) + (1_767_225_600).to_bytes(4, "little") + bytes([8, 7, 6, 5, 4, 3, 2, 1])
    assert Envelope.decode(data) == envelope
    assert (start_of(envelope.sequence), count_of(envelope.sequence)) == (1_767_225_600, 7)


@pytest.mark.parametrize("data", [b"", b"x" * 15, b"x" * 17])
@pytest.mark.parametrize("read", [Envelope.decode, Envelope.decode_checked])
def test_data_of_another_length_than_16_bytes_is_refused_as_an_envelope(
    data: bytes, read: Callable[[bytes], object]
) -> None:
    with pytest.raises(BusError, match=f"16 bytes.*got {len(data)}"):
        read(data)


@pytest.mark.parametrize("start_s", [1_767_225_600, 2_177_452_800, 4_102_444_800, 2**32 - 4])
def test_sequences_grow_past_2_to_the_32_messages_in_any_year(start_s: int) -> None:
    before, after = sequence_of(start_s, 2**32 - 1), sequence_of(start_s, 2**32)
    assert after == before + 1
    assert sequence_of(start_s, 2**32 + 7) < sequence_of(start_s + 2, 0)
    for sequence in (before, after):
        assert Envelope.decode_checked(Envelope(sequence, 2**62).encode()) == (sequence, 2**62)


@pytest.mark.parametrize("sequence_and_time_ns", [(2**64 - 2**33, 0), (2**64 - 1, 0), (0, 2**62 + 1), (0, 2**64 - 1)])
def test_sequences_and_times_that_would_overflow_are_refused(sequence_and_time_ns: tuple[int, int]) -> None:
    sequence, time_ns = sequence_and_time_ns
    with pytest.raises(BadMessageError, match=f"below 2.64 - 2.33.*got {sequence} and {time_ns} ns"):
        Envelope.decode_checked(Envelope(sequence, time_ns).encode())


NOW_S = SIMULATED_START_NS // 10**9
DAY_S = 86_400


def test_a_start_time_far_ahead_of_the_hosts_clock_is_refused_and_reported_with_both_times() -> None:
    reported: list[tuple[str, str]] = []
    clock = FakeClock()
    check = StartCheck(clock, 24.0, lambda start, here: reported.append((start, here)))
    assert not check.ahead(sequence_of(NOW_S, 5))
    assert not check.ahead(sequence_of(NOW_S + DAY_S - 5, 0))
    next_year = sequence_of(NOW_S + 365 * DAY_S, 0)
    assert check.ahead(next_year)
    clock.advance(2 * 10**9)
    assert check.ahead(next_year + 7)
    assert reported == [("2027-01-01T00:00:00Z", "2026-01-01T00:00:00Z")], "reported once"
    assert check.ahead((1 << 64) - (1 << 33) - 1), "the largest sequence that an envelope may have"
    later = sequence_of(NOW_S + DAY_S + 60, 0)
    assert check.ahead(later)
    clock.advance(120 * 10**9)
    assert not check.ahead(later), "no longer ahead after the clock has advanced"


@pytest.mark.parametrize(
    ("clock", "max_ahead_h", "start_s", "ahead"),
    [
        (FakeClock(), 0.0, NOW_S + 400 * DAY_S, False),
        (FakeClock(lockstep=True), 24.0, NOW_S + 400 * DAY_S, False),
        (FakeClock(5 * 10**9), 24.0, NOW_S, True),  # a host with a clock in 1970
        (FakeClock(4_102_444_800 * 10**9), 24.0, 4_102_444_800, False),  # a host in 2100
        (FakeClock(4_102_444_800 * 10**9), 24.0, 4_102_444_800 + 2 * DAY_S, True),
    ],
)
def test_start_times_are_compared_with_the_hosts_clock(
    clock: FakeClock, max_ahead_h: float, start_s: int, ahead: bool
) -> None:
    assert StartCheck(clock, max_ahead_h, lambda start, here: None).ahead(sequence_of(start_s, 1 << 20)) is ahead


FORGED_NAMES = 1000


def health(number: int = 0) -> bytes:
    return wire.Health(process=f"forged-{number}", pid=number, state="ready").SerializeToString()


def test_the_number_of_names_per_topic_is_limited_except_for_roles() -> None:
    names = Names()
    for number in range(MAX_NAMES):
        assert names.admit(MIRROR_STATE, MIRROR_STATE.at(f"m{number}")) == f"m{number}"
    with pytest.raises(BadMessageError, match=f"{MAX_NAMES} names are known.*'one-more'"):
        names.admit(MIRROR_STATE, MIRROR_STATE.at("one-more"))
    assert names.admit(MIRROR_STATE, MIRROR_STATE.at("m7")) == "m7"
    assert names.admit(HEALTH, HEALTH.at("one-more")) == "one-more", "each topic has its own limit"
    for number in range(MAX_NAMES - 1):
        names.admit(HEALTH, HEALTH.at(f"p{number}"))
    assert [names.admit(HEALTH, HEALTH.at(role)) for role in Role] == list(Role)
    assert names.admit(FRAME, FRAME.key) == ""


def test_the_sizes_of_names_and_of_health_messages_are_limited() -> None:
    names = Names()
    assert names.admit(HEALTH, HEALTH.at("n" * MAX_NAME_LENGTH))
    with pytest.raises(BadMessageError, match=f"up to {MAX_NAME_LENGTH} characters, got {MAX_NAME_LENGTH + 1}"):
        names.admit(HEALTH, HEALTH.at("n" * (MAX_NAME_LENGTH + 1)))
    body = wire.Health(state="x" * MAX_HEALTH_BYTES).SerializeToString()
    with pytest.raises(BadMessageError, match=f"up to {MAX_HEALTH_BYTES} bytes, got {len(body)}"):
        names.health(HEALTH.at("camera"), body)


def test_a_very_long_key_is_not_cached() -> None:
    topic_of.cache_clear()
    with pytest.raises(KeyError):
        topic_of(HEALTH.at("n" * 10_000))
    assert topic_of.cache_info().currsize == 0


@pytest.fixture
def listener() -> Listener:
    return Listener(FakeClock())


def test_forged_names_do_not_fill_the_memory_of_a_process_and_give_one_event(listener: Listener) -> None:
    camera = listener.service("camera")
    for number in range(FORGED_NAMES):
        listener.bus.publisher(HEALTH, f"forged-{number}").put(health(number))
    listener.service("controller").beat()
    camera.beat()
    assert len(camera.last_health) == MAX_NAMES + 1
    assert "controller" in camera.last_health
    (event,) = listener.event_texts("BAD_MESSAGE")
    assert event.startswith(f"BAD_MESSAGE {FORGED_NAMES - MAX_NAMES} messages on lowfc/health/* could not be read")


def test_only_one_start_time_is_stored_of_a_process_that_restarts_often(listener: Listener) -> None:
    camera, stranger = listener.service("camera"), listener.bus.publisher(HEALTH, "stranger")
    for number in range(FORGED_NAMES):
        listener.bus.restart()
        stranger.put(health(number))
        assert camera.has_newcomers()
    assert not camera.has_newcomers()
    assert len(camera._known_starts) == 1


def test_forged_names_do_not_fill_the_memory_of_launcher_and_viewer() -> None:
    watch, view = Watch({}, []), Accumulator()
    launcher = MemoryBus(MemoryHub(), "launcher", FakeClock())
    launcher.subscribe(HEALTH, watch.add_health)
    for number in range(FORGED_NAMES):
        view.add(Sample(HEALTH.at(f"forged-{number}"), health(number), 1, 1, 1))
        launcher.publisher(HEALTH, f"forged-{number}").put(health(number))
    assert len(watch.health) == len(view.snapshot(1).health) == MAX_NAMES
    assert view.unreadable == launcher.faults.unreadable[HEALTH.at("*")][0] == FORGED_NAMES - MAX_NAMES
