import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.mailbox import Mailbox
from lowfc.contract.envelope import sequence_of

pytestmark = pytest.mark.exclusive

PATIENCE_S = 30.0


def sample(count: int, start_s: int = 100) -> Sample:
    return Sample("lowfc/camera/frame", b"", sequence_of(start_s, count), 0, 0)


def test_the_newest_message_is_taken_once() -> None:
    box = Mailbox("key")
    assert box.take(0.0) is None
    box.put(sample(0))
    box.put(sample(1))
    assert box.take(PATIENCE_S) == sample(1)
    assert box.take(0.0) is None
    assert (box.received, box.skipped, box.missing, box.restarts) == (2, 1, 0, 0)


def test_a_gap_is_missing_and_a_new_start_is_none() -> None:
    box = Mailbox()
    for count in (5, 6, 9):
        box.put(sample(count))
    assert (box.missing, box.restarts) == (2, 0)
    box.put(sample(40, start_s=101))
    assert (box.missing, box.restarts) == (2, 1)
    box.put(sample(42, start_s=101))
    assert (box.missing, box.restarts) == (3, 1)
    box.put(sample(41, start_s=101))  # old news: delivered, and no gap any more
    assert (box.missing, box.last_sequence) == (2, sequence_of(101, 42))
    assert box.take(0.0) == sample(41, start_s=101)


def test_wake_ends_the_wait_at_once_and_only_once() -> None:
    box = Mailbox()
    box.wake()
    assert box.take(PATIENCE_S) is None
    assert box.take(0.0) is None
    waiter = threading.Timer(0.01, box.wake)
    waiter.start()
    assert box.take(PATIENCE_S) is None
    waiter.join()
    box.wake()
    box.put(sample(0))
    assert box.take(PATIENCE_S) == sample(0)
    assert box.take(PATIENCE_S) is None  # the wake that came with the message is not forgotten


def test_a_message_ends_the_wait_of_another_thread() -> None:
    box, there = Mailbox(), Mailbox()
    got: list[Sample | None] = []

    def loop() -> None:
        for _ in range(500):
            got.append(box.take(PATIENCE_S))
            there.wake()

    thread = threading.Thread(target=loop)
    thread.start()
    for count in range(500):
        box.put(sample(count))
        there.take(PATIENCE_S)
    thread.join()
    assert got == [sample(count) for count in range(500)]
    assert (box.received, box.skipped, box.missing) == (500, 0, 0)


@given(st.lists(st.sampled_from(["put", "take", "lose"]), max_size=40))
def test_every_message_is_taken_skipped_missing_or_waiting(actions: list[str]) -> None:
    box, count, taken, sent, started = Mailbox(), 0, 0, 0, False
    for action in actions:
        if action == "take":
            taken += box.take(0.0) is not None
            continue
        if action == "put":
            box.put(sample(count))
            started = True
        if started:
            sent += 1
        count += 1
    trailing = 0
    while trailing < sent and actions and [a for a in actions if a != "take"][-1 - trailing] == "lose":
        trailing += 1
    waiting = box.take(0.0) is not None
    assert sent - trailing == taken + waiting + box.skipped + box.missing


def test_two_threads_lose_nothing_between_them() -> None:
    box = Mailbox()
    done = threading.Event()

    def flood() -> None:
        for count in range(20_000):
            box.put(sample(count))
        done.set()

    thread = threading.Thread(target=flood)
    thread.start()
    taken = 0
    while not done.is_set():
        taken += box.take(0.001) is not None
    thread.join()
    taken += box.take(0.0) is not None
    assert taken + box.skipped == box.received == 20_000
    assert box.missing == 0
