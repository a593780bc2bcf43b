"""Names that a program with the run's secret invents: bounded in every process, and reported."""

from collections.abc import Callable

import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.names import LARGEST_HEALTH_BYTES, LONGEST_NAME, MOST_NAMES, Names
from lowfc.adapters.logs.loss_account import MOST_STARTS, LossAccount
from lowfc.adapters.process.service import Service
from lowfc.contract.envelope import sequence_of
from lowfc.contract.errors import BadMessageError
from lowfc.contract.messages import COMMAND, EVENT, FRAME, HEALTH, MIRROR_STATE, Log, Role, topic_of, wire
from lowfc.programs.launch.watch import Watch
from lowfc.programs.view.snapshot import Accumulator
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub

pytestmark = pytest.mark.exclusive

FORGED = 1000


def health(number: int = 0) -> bytes:
    return wire.Health(process=f"forged-{number}", pid=number, state="ready").SerializeToString()


def test_a_topic_has_a_number_of_names_and_roles_always_have_room() -> None:
    names = Names()
    for number in range(MOST_NAMES):
        assert names.admit(MIRROR_STATE, MIRROR_STATE.at(f"m{number}")) == f"m{number}"
    with pytest.raises(BadMessageError, match=f"{MOST_NAMES} names are known.*'one-more'"):
        names.admit(MIRROR_STATE, MIRROR_STATE.at("one-more"))
    assert names.admit(MIRROR_STATE, MIRROR_STATE.at("m7")) == "m7"
    assert names.admit(HEALTH, HEALTH.at("one-more")) == "one-more", "names of another topic have their own room"
    for number in range(MOST_NAMES - 1):
        names.admit(HEALTH, HEALTH.at(f"p{number}"))
    assert [names.admit(HEALTH, HEALTH.at(role)) for role in Role] == list(Role)
    assert names.admit(FRAME, FRAME.key) == ""


def test_a_name_has_a_length() -> None:
    names = Names()
    assert names.admit(HEALTH, HEALTH.at("n" * LONGEST_NAME))
    with pytest.raises(BadMessageError, match=f"up to {LONGEST_NAME} characters, got {LONGEST_NAME + 1}"):
        names.admit(HEALTH, HEALTH.at("n" * (LONGEST_NAME + 1)))


def test_a_health_has_a_size() -> None:
    body = wire.Health(state="x" * LARGEST_HEALTH_BYTES).SerializeToString()
    with pytest.raises(BadMessageError, match=f"up to {LARGEST_HEALTH_BYTES} bytes, got {len(body)}"):
        Names().health(HEALTH.at("camera"), body)


def test_a_very_long_key_is_not_remembered() -> None:
    topic_of.cache_clear()
    with pytest.raises(KeyError):
        topic_of(HEALTH.at("n" * 10_000))
    assert topic_of.cache_info().currsize == 0


@pytest.fixture
def hub() -> MemoryHub:
    return MemoryHub()


@pytest.fixture
def forge(hub: MemoryHub) -> Callable[[], None]:
    bus = MemoryBus(hub, "operator", FakeClock())

    def flood() -> None:
        for number in range(FORGED):
            bus.publisher(HEALTH, f"forged-{number}").put(health(number))

    return flood


def test_forged_names_fill_no_process_and_are_one_event(hub: MemoryHub, forge: Callable[[], None]) -> None:
    events: list[str] = []
    MemoryBus(hub, "launcher", FakeClock()).subscribe(
        EVENT, lambda sample: events.append(Log.FromString(sample.payload).message)
    )
    camera = Service("camera", "night", FakeClock(), MemoryBus(hub, "camera", FakeClock()))
    forge()
    Service("controller", "night", FakeClock(), MemoryBus(hub, "controller", FakeClock())).beat()
    camera.beat()
    assert len(camera.heard) == MOST_NAMES + 1
    assert "controller" in camera.heard
    (event,) = (event for event in events if "BAD_MESSAGE" in event)
    assert event.startswith(f"BAD_MESSAGE {FORGED - MOST_NAMES} on lowfc/health/* could not be read")


def test_a_process_that_returns_under_many_numbers_is_remembered_once(hub: MemoryHub) -> None:
    camera = Service("camera", "night", FakeClock(), MemoryBus(hub, "camera", FakeClock()))
    stranger = MemoryBus(hub, "operator", FakeClock()).publisher(HEALTH, "stranger")
    for number in range(FORGED):
        stranger.put(health(number))
        assert camera.newcomers()
    assert not camera.newcomers()
    assert len(camera._known) == 1


def test_a_launcher_and_a_view_are_not_filled_either(hub: MemoryHub) -> None:
    watch, view = Watch({}, []), Accumulator()
    launcher = MemoryBus(hub, "launcher", FakeClock())
    launcher.subscribe(HEALTH, watch.hear)
    for number in range(FORGED):
        view.add(HEALTH, HEALTH.at(f"forged-{number}"), health(number), 1, 1)
        launcher.publisher(HEALTH, f"forged-{number}").put(health(number))
    assert len(watch.health) == len(view.snapshot(1).health) == MOST_NAMES
    assert view.unreadable == launcher.faults.unreadable[HEALTH.at("*")][0] == FORGED - MOST_NAMES


def entry(start_s: int, count: int, payload: bytes = b"") -> Sample:
    return Sample(FRAME.key, payload, sequence_of(start_s, count), 0, 0)


def test_the_ledger_keeps_the_newest_starts_apart_and_the_sum_of_all() -> None:
    ledger = LossAccount()
    for start_s in range(FORGED):
        ledger.enter(FRAME, entry(start_s, 0), recorded=True)
        ledger.enter(FRAME, entry(start_s, 3), recorded=start_s != 5)  # 1 and 2 are missing, in one 3 too
    assert len(ledger._tallies[FRAME.key, ""]) == MOST_STARTS + 1
    assert ledger.recorded() == {FRAME.key: 2 * FORGED - 1}
    assert ledger.lost() == ledger.news() == {FRAME.key: 2 * FORGED + 1}
    assert ledger.news() == {}
    assert ledger.starts == FORGED
    ledger.revert()
    assert ledger.recorded() == {FRAME.key: 0}, "nothing had been flushed"


def test_the_ledger_takes_no_number_of_names_from_messages() -> None:
    ledger = LossAccount()
    for number in range(FORGED):
        ledger.enter(EVENT, entry(1, 0, Log(name=f"forged-{number}").SerializeToString()), recorded=True)
    forged = wire.Health(process="controller", state="stopped")
    for number in range(FORGED):
        forged.topics.add(topic=COMMAND.at(f"forged-{number}"), published=9)
    with pytest.raises(BadMessageError):
        ledger.believe(entry(1, 0), forged)
    assert len(ledger._tallies) == MOST_NAMES + 1 + MOST_NAMES
