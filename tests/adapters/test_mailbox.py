"""Mailbox, dispatch and gap detection: each message is handled, skipped or missing."""

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.bus.dispatch import OLD_NS, Dispatch
from lowfc.adapters.bus.mailbox import Mailbox
from lowfc.contract.envelope import count_of, sequence_of
from lowfc.contract.messages import FRAME
from lowfc.contract.sequence_gaps import REMEMBERED, Gaps

PATIENCE_S = 30.0


def sample(count: int, start_s: int = 100) -> Sample:
    return Sample("lowfc/camera/frame", b"", sequence_of(start_s, count), 0, 0)


def test_a_gap_in_the_counts_is_missing_messages_and_a_restart_of_the_publisher_is_not() -> None:
    box = Mailbox()
    for count in (5, 6, 9):
        box.put(sample(count))
    assert box.missing == 2
    box.put(sample(40, start_s=101))
    assert box.missing == 2
    box.put(sample(42, start_s=101))
    assert box.missing == 3
    box.put(sample(41, start_s=101))  # a late message is delivered and closes its gap
    assert (box.missing, box.last_sequence) == (2, sequence_of(101, 42))
    assert box.take(0.0) == sample(41, start_s=101)
    for count in (2**32 - 1, 2**32, 2**32 + 2):  # after 50 days at 1 kHz, the count carries into the start time
        box.put(sample(count, start_s=102))
    assert box.missing == 3


def test_each_wake_ends_one_wait_at_once() -> None:
    box, begun_s = Mailbox(), time.monotonic()
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
    assert box.take(PATIENCE_S) is None  # the wake before the message is still pending
    assert time.monotonic() - begun_s < PATIENCE_S, "no wait ended by its timeout"


def test_a_message_ends_the_wait_of_another_thread() -> None:
    box, handled = Mailbox(), Mailbox()
    received: list[Sample | None] = []

    def loop() -> None:
        for _ in range(500):
            received.append(box.take(PATIENCE_S))
            handled.wake()

    thread = threading.Thread(target=loop)
    thread.start()
    for count in range(500):
        box.put(sample(count))
        handled.take(PATIENCE_S)
    thread.join()
    assert received == [sample(count) for count in range(500)]
    assert (box.received, box.skipped, box.missing) == (500, 0, 0)


@given(st.lists(st.sampled_from(["put", "take", "lose"]), max_size=40))
def test_every_message_is_taken_skipped_missing_or_waiting(actions: list[str]) -> None:
    box, taken, published = Mailbox(), 0, ""  # published: "x" for each message that was put, " " for each that was lost
    for action in actions:
        if action == "take":
            taken += box.take(0.0) is not None
            continue
        if action == "put":
            box.put(sample(len(published)))
        published += "x" if action == "put" else " "
    waiting = box.take(0.0) is not None
    # Messages that were lost before the first or after the last arrival cannot be detected.
    assert len(published.strip()) == taken + waiting + box.skipped + box.missing


PERIOD_NS = 1_000_000


class TimedDispatch:
    """A Dispatch whose handler takes `work_ns`; a message arrives when published, or 10 us after the last work."""

    def __init__(self, period_ns: int | None = PERIOD_NS, *, handle_superseded: bool = False) -> None:
        self.now_ns, self.work_ns = 10**9, 100_000
        self.handled: list[int] = []
        self.superseded: list[int] = []
        superseded = self._handler(self.superseded) if handle_superseded else None
        self.dispatch = Dispatch(FRAME.key, self._handler(self.handled), lambda: self.now_ns, period_ns, superseded)

    def _handler(self, handled: list[int]) -> Callable[[Sample], None]:
        def handle(sample: Sample) -> None:
            handled.append(count_of(sample.sequence))
            self.now_ns += self.work_ns

        return handle

    def arrive(self, count: int, put_ns: int) -> None:
        self.now_ns = max(self.now_ns + 10_000, put_ns)  # 10 us: time between two queued messages of the bus
        self.dispatch.put(Sample(FRAME.key, b"", sequence_of(7, count), put_ns, self.now_ns))


@pytest.mark.parametrize("handle_superseded", [True, False])
def test_only_the_newest_of_the_queued_messages_is_handled(handle_superseded: bool) -> None:
    """The process stood still for ten periods, in which ten messages arrived."""
    timed = TimedDispatch(handle_superseded=handle_superseded)
    timed.work_ns = 20_000
    begun_ns = timed.now_ns + 10**8
    timed.arrive(0, begun_ns)
    timed.now_ns = begun_ns + 10 * PERIOD_NS + 1000
    for count in range(1, 11):
        timed.arrive(count, begun_ns + count * PERIOD_NS)
    superseded, skipped = (list(range(1, 10)), 0) if handle_superseded else ([], 9)
    assert (timed.handled, timed.superseded) == ([0, 10], superseded)
    assert (timed.dispatch.received, timed.dispatch.skipped, timed.dispatch.missing) == (11, skipped, 0)


def test_a_single_old_message_counts_as_superseded() -> None:
    timed = TimedDispatch()
    timed.arrive(0, timed.now_ns + 10**8)
    timed.now_ns += 10**9
    timed.arrive(1, timed.now_ns - OLD_NS)
    timed.now_ns += 10**9
    timed.arrive(2, timed.now_ns - PERIOD_NS)  # late by a period, but not queued: nothing shows that a newer one exists
    assert timed.handled == [0, 2]


def test_without_a_period_nothing_is_superseded() -> None:
    timed = TimedDispatch(None)
    for count in range(50):
        timed.arrive(count, 0)
    assert timed.handled == list(range(50))
    assert timed.dispatch.skipped == 0


def test_a_slow_handler_never_falls_far_behind() -> None:
    timed = TimedDispatch(handle_superseded=True)
    timed.work_ns = 3 * PERIOD_NS
    begun_ns, lags = timed.now_ns + 10**8, []  # lags in periods
    for count in range(500):
        put_ns = begun_ns + count * PERIOD_NS
        before = len(timed.handled)
        timed.arrive(count, put_ns)
        if len(timed.handled) > before:
            lags.append((timed.now_ns - timed.work_ns - put_ns) / PERIOD_NS)
    assert max(lags) < 5
    assert len(timed.handled) > 5
    assert len(timed.handled) + len(timed.superseded) + timed.dispatch.skipped == timed.dispatch.received == 500


def test_the_handler_is_never_run_by_two_receive_threads_at_once() -> None:
    """Each link of the bus has its own thread, and so has the direct link."""
    running, most_running, begin = 0, 0, threading.Barrier(2)  # numbers of handlers that run at once

    def handle(_: Sample) -> None:
        nonlocal running, most_running
        running += 1
        time.sleep(0)  # lets the other thread run
        most_running = max(most_running, running)
        running -= 1

    dispatch = Dispatch(FRAME.key, handle, time.monotonic_ns)

    def receive(start_s: int) -> None:
        begin.wait(PATIENCE_S)
        for count in range(1000):
            dispatch.put(Sample(FRAME.key, b"", sequence_of(start_s, count), 0, 0))

    threads = [threading.Thread(target=receive, args=(start_s,)) for start_s in (1, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE_S)
    assert (dispatch.received, most_running) == (2000, 1)


def test_only_messages_that_never_arrive_are_missing_whatever_the_order_of_the_others() -> None:
    rng = np.random.default_rng(5)
    arrived = [0, *rng.permutation(rng.choice(np.arange(1, 1000), 800, replace=False)).tolist()]
    gaps, seen = Gaps(0), set()
    for count in [*arrived, *arrived[:50]]:
        assert gaps.add(count) == (count not in seen)
        seen.add(count)
        assert gaps.missing == max(seen) + 1 - len(seen)


def test_a_gap_of_any_size_uses_bounded_memory() -> None:
    gaps = Gaps(0)
    far = 1 << 31
    for count in (0, far, far + 3 * REMEMBERED, far + 6 * REMEMBERED):
        gaps.add(count)
    assert gaps.missing == far + 6 * REMEMBERED - 3
    assert len(gaps._open) <= 2 * REMEMBERED
    assert gaps.add(far + 6 * REMEMBERED - 1)
    assert not gaps.add(7), "below the remembered range"
