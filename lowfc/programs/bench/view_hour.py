"""Memory of a view over an hour of traffic: a short log, played over and over into a real viewer, without waiting."""

import itertools
import tempfile
import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from lowfc.adapters.log_reader import Logged, LogReader
from lowfc.adapters.progress import passing_bar
from lowfc.adapters.usage import resident_bytes
from lowfc.contract.configuration import Configuration
from lowfc.contract.messages import TRUTH, Message, Topic, from_timestamp, timestamp, topic_of, wire
from lowfc.programs.bench.view_loop import LoopBesideView, loop_configuration
from lowfc.programs.view.bridge import OWN_BYTES, VIEWER_SPARE_BYTES
from lowfc.programs.view.layout import LIVE_WINDOW_S
from lowfc.programs.view.moment import PICTURES_HZ, PICTURES_PER_WHOLE, SHOWN, Gatherer
from lowfc.programs.view.painter import Painter
from lowfc.programs.view.place import place
from lowfc.programs.view.tabs import Tab

RECORDED_S = 10.0
"""Of a real loop; played over and over."""
MEMORY_MB = 512.0
"""What the viewer may keep, as `lowfc view` lets it by default."""

_LOG_MB = 4000.0
_LOOK_NS = 1_000_000_000  # of traffic
_PERIOD_NS = round(1e9 / PICTURES_HZ)


class Played(NamedTuple):
    """One message, as if it had just been sent."""

    topic: Topic
    key: str
    payload: bytes
    time_ns: int


class Sample(NamedTuple):
    """Memory after so much traffic, and panels that had failed by then."""

    traffic_s: float
    messages: int
    failed_panels: int
    bridge_bytes: int
    viewer_bytes: int


class Tape:
    """The messages of a log that a view looks at, again and again, later each time.

    Attributes:
        known: states from before the first frame, which a view asks for.
    """

    def __init__(self, log: Iterable[Logged]) -> None:
        """Keep what came between the first frame and the last; of pictures as many as a live view takes.

        Raises:
            ValueError: there are no two frames of a simulated camera.
        """
        heard = list(_thinned(log))
        truths = [
            (logged.log_time_ns, wire.Truth.FromString(logged.payload)) for topic, logged in heard if topic is TRUTH
        ]
        if len(truths) < 2:
            raise ValueError(f"a tape needs two frames of a simulated camera; got {len(truths)}")
        (begin_ns, first), (end_ns, last) = truths[0], truths[-1]
        self._frames = last.frame_sequence - first.frame_sequence + 1
        self._lap_ns = (end_ns - begin_ns) * self._frames // (self._frames - 1)
        self.known = [
            Played(topic, logged.key, logged.payload, logged.publish_time_ns)
            for topic, logged in heard
            if topic.queryable and logged.log_time_ns < begin_ns
        ]
        self._messages = [
            (topic, logged, topic.message.FromString(logged.payload))
            for topic, logged in heard
            if begin_ns <= logged.log_time_ns <= end_ns
        ]

    def play(self) -> Iterator[Played]:
        """All messages in their order, for ever; times and sequences go on where the lap before ended."""
        for lap in itertools.count():
            later_ns, later_frames = lap * self._lap_ns, lap * self._frames
            for topic, logged, message in self._messages:
                payload = shifted(message, later_ns, later_frames)
                yield Played(topic, logged.key, payload, logged.log_time_ns + later_ns)


def _thinned(log: Iterable[Logged]) -> Iterator[tuple[Topic, Logged]]:
    """What reaches a live view."""
    due_ns: dict[str, int] = {}
    for logged in log:
        topic = topic_of(logged.key)
        if topic.newest_only:
            if logged.log_time_ns < due_ns.get(logged.key, 0):
                continue
            due_ns[logged.key] = logged.log_time_ns + _PERIOD_NS
        yield topic, logged


def shifted(message: Message, later_ns: int, later_frames: int) -> bytes:
    """Payload of a message, its time and the frames that it speaks of moved on."""
    moved: Any = type(message)()
    moved.CopyFrom(message)
    moved.timestamp.CopyFrom(timestamp(from_timestamp(moved.timestamp) + later_ns))
    if isinstance(moved, wire.ControlTiming):
        moved.frame_sequence[:] = [one + later_frames for one in moved.frame_sequence]
    elif isinstance(moved, wire.ControlStep | wire.Truth | wire.MirrorState) and moved.frame_sequence:
        moved.frame_sequence += later_frames
    return bytes(moved.SerializeToString())


def measure_hour(rate_hz: float, traffic_s: float) -> dict[str, Any]:
    """Record a short real loop, then draw its traffic for `traffic_s` into a real viewer for the browser.

    What draws is what a live view is made of, but for the bus and the wait between two moments.

    Returns:
        rate_hz; traffic_s; took_s and messages; failed_panels, which draw nothing and should be none; bridge (this
        process, with the log that it plays) and viewer, of each the figures of `growth` and bound_mb, beyond which a
        live view begins anew; viewer_limit_mb, as given to the viewer.

    Raises:
        BusError, ProcessDiedError, ViewerError: the loop or the viewer did not come up, or ended.
    """
    samples: list[Sample] = []
    with tempfile.TemporaryDirectory(prefix="lowfc-bench-") as name, passing_bar(Console(stderr=True)) as bar:
        task = bar.add_task("recording", total=traffic_s)
        config = loop_configuration(rate_hz, Path(name), _LOG_MB)
        tape = Tape(_recorded(config, Path(name)))
        bar.update(task, description="drawing")
        begun_s = time.monotonic()
        for sample in _draw(config, tape, traffic_s):
            samples.append(sample)
            bar.update(task, completed=sample.traffic_s)
    traffic = [sample.traffic_s for sample in samples]
    return {
        "rate_hz": rate_hz,
        "traffic_s": samples[-1].traffic_s,
        "messages": samples[-1].messages,
        "failed_panels": samples[-1].failed_panels,
        "took_s": time.monotonic() - begun_s,
        "viewer_limit_mb": MEMORY_MB,
        "bridge": {"bound_mb": OWN_BYTES / 1e6, **growth(traffic, [sample.bridge_bytes for sample in samples])},
        "viewer": {
            "bound_mb": MEMORY_MB + VIEWER_SPARE_BYTES / 1e6,
            **growth(traffic, [sample.viewer_bytes for sample in samples]),
        },
    }


def growth(traffic_s: Sequence[float], memory_bytes: Sequence[int]) -> dict[str, float]:
    """How memory went, from samples after so much traffic.

    Returns:
        most_mb, first_mb and last_mb; growth_mb_per_hour, the slope of the second half, per hour of traffic.
    """
    times_s, memory_mb = np.array(traffic_s), np.array(memory_bytes) / 1e6
    later = times_s >= times_s[-1] / 2
    slope = np.polyfit(times_s[later] - times_s[-1], memory_mb[later], 1)[0]
    return {
        "most_mb": float(memory_mb.max()),
        "first_mb": float(memory_mb[0]),
        "last_mb": float(memory_mb[-1]),
        "growth_mb_per_hour": float(slope) * 3600,
    }


def render_hour(figures: dict[str, Any]) -> str:
    """The result of `measure_hour` as a table."""
    lines = [
        f"{'process':<8} {'most':>10} {'bound':>10} {'first':>10} {'last':>10} {'growth over the second half':>30}"
    ]
    lines += [
        f"{name:<8} {one['most_mb']:>7.0f} MB {one['bound_mb']:>7.0f} MB {one['first_mb']:>7.0f} MB "
        f"{one['last_mb']:>7.0f} MB {one['growth_mb_per_hour']:>14.1f} MB per hour"
        for name, one in (("bridge", figures["bridge"]), ("viewer", figures["viewer"]))
    ]
    lines.append(
        f"{figures['traffic_s']:.0f} s of traffic at {figures['rate_hz']:g} Hz, {figures['messages']} messages, in "
        f"{figures['took_s']:.0f} s; panels that failed: {figures['failed_panels']}; the viewer's limit, as it counts "
        f"itself: {figures['viewer_limit_mb']:.0f} MB"
    )
    return "\n".join(lines)


def _recorded(config: Configuration, folder: Path) -> Iterator[Logged]:
    """What a view looks at of a short real run."""
    with LoopBesideView(config, folder) as loop:
        loop.wait(RECORDED_S)
    for log in sorted(folder.glob("*.mcap")):
        yield from LogReader(log, topics=SHOWN)


def _draw(config: Configuration, tape: Tape, traffic_s: float) -> Iterator[Sample]:
    """Draw into a viewer of its own, as the live view does, but without waiting; look at the memory now and then."""
    where = place(
        native=False,
        web=True,
        save=None,
        picture=None,
        tab=Tab.OPERATOR,
        memory_mb=MEMORY_MB,
        port=None,
        web_port=None,
    )
    with where.viewer() as viewer:
        stream = where.stream(viewer, None, "bench", LIVE_WINDOW_S)
        painter, gatherer = Painter(config, stream), Gatherer()
        panels = len(painter.panels)
        for message in tape.known:
            gatherer.take(*message)
        begin_ns = due_ns = look_ns = 0
        moments = 0
        for messages, message in enumerate(tape.play(), start=1):
            gatherer.take(*message)
            begin_ns = begin_ns or message.time_ns
            if message.time_ns < due_ns:
                continue
            painter.draw(gatherer.moment(message.time_ns, whole=moments % PICTURES_PER_WHOLE == 0))
            due_ns = message.time_ns + _PERIOD_NS
            moments += 1
            if message.time_ns < look_ns:
                continue
            stream.flush()  # a live view is never further ahead of its viewer
            look_ns = message.time_ns + _LOOK_NS
            passed_s = (message.time_ns - begin_ns) * 1e-9
            yield Sample(passed_s, messages, panels - len(painter.panels), resident_bytes(), viewer.resident_bytes())
            if passed_s >= traffic_s:
                break
        stream.disconnect()
