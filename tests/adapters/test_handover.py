"""Messages handled where they arrive: all of a burst, and not all where the handler does not keep up."""

import time
from pathlib import Path

from lowfc.adapters.bus import Sample
from lowfc.adapters.clock import HostClock
from lowfc.adapters.envelope import count_of, sequence_of
from lowfc.adapters.handover import MOST_IN_A_ROW, REST_NS, Handover
from lowfc.adapters.run import open_run
from lowfc.adapters.zenoh_bus import ZenohBus
from lowfc.contract.messages import FRAME

PATIENCE_S = 30.0


class Bench:
    """A handover whose handler takes a given time, and messages that come as soon as they are due."""

    def __init__(self) -> None:
        self.now_ns, self.handled, self.work_ns = 10**9, list[int](), 100_000
        self.handover = Handover(FRAME.key, self._handle, lambda: self.now_ns)

    def _handle(self, sample: Sample) -> None:
        self.handled.append(count_of(sample.sequence))
        self.now_ns += self.work_ns

    def come(self, count: int, due_ns: int = 0) -> None:
        self.now_ns = max(self.now_ns + 10_000, due_ns)  # it takes the bus a moment to hand over the next one
        self.handover.put(Sample(FRAME.key, b"", sequence_of(7, count), due_ns, self.now_ns))


def test_a_burst_is_handled_message_by_message() -> None:
    bench = Bench()
    for count in range(MOST_IN_A_ROW):
        bench.come(count)
    assert bench.handled == list(range(MOST_IN_A_ROW))
    assert (bench.handover.received, bench.handover.skipped, bench.handover.missing) == (MOST_IN_A_ROW, 0, 0)


def test_what_waits_behind_too_many_is_skipped_until_there_is_a_rest() -> None:
    bench = Bench()
    for count in range(MOST_IN_A_ROW + 5):
        bench.come(count)
    assert bench.handled == list(range(MOST_IN_A_ROW))
    assert bench.handover.skipped == 5
    bench.come(99, bench.now_ns + REST_NS + 1)
    assert bench.handled[-1] == 99
    assert bench.handover.missing == 99 - (MOST_IN_A_ROW + 5)


def test_a_slow_handler_is_never_far_behind() -> None:
    bench, period_ns = Bench(), 1_000_000
    bench.work_ns = 3 * period_ns
    behind = []
    for count in range(500):
        due_ns = 2 * 10**9 + count * period_ns
        bench.come(count, due_ns)
        if bench.handled[-1] == count:
            behind.append((bench.now_ns - bench.work_ns - due_ns) / period_ns)
    assert max(behind) < 3 * MOST_IN_A_ROW
    assert 100 < len(bench.handled) < 200
    assert len(bench.handled) + bench.handover.skipped == bench.handover.received == 500


def test_frames_faster_than_their_handler_are_skipped_on_the_real_bus(tmp_path: Path) -> None:
    links = open_run("handover", base=tmp_path).links
    camera, controller = (ZenohBus(links, role, HostClock(tmp_path)) for role in ("camera", "controller"))
    number = 300
    handover = Handover(FRAME.key, lambda _: time.sleep(2e-3), controller.clock.host_ns)
    controller.subscribe(FRAME, handover.put)
    publisher = camera.publisher(FRAME)
    until_s = time.monotonic() + PATIENCE_S
    while not handover.received:
        assert time.monotonic() < until_s
        publisher.put(b"")
        time.sleep(0.01)
    for _ in range(number):
        publisher.put(bytes(1000))
        time.sleep(5e-4)
    while handover.last_sequence + 1 != sequence_of(camera.start_s, publisher.published):
        assert time.monotonic() < until_s
        time.sleep(0.01)
    assert handover.received + handover.missing >= number
    assert 0 < handover.skipped < handover.received
    for bus in (camera, controller):
        bus.close()
