"""Faults of the simulated camera: the same for the same seed, and what they say they are."""

import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.bus.bus import Sample
from lowfc.contract.codecs.codec import decode_frame
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import ConfigurationError
from lowfc.contract.messages import FRAME, image
from lowfc.testing.clock import FakeClock
from lowfc.testing.memory_bus import MemoryBus, MemoryHub
from sim_camera.faults import LOST_SHARE, MOST_FRAMES_LATE, TRACK_PIXELS, Fault, Kind
from sim_camera.faulty import EARLIER_S, FaultyFrames, read_fault

FIRST, FRAMES = 100, 400
LAST = FIRST + FRAMES + MOST_FRAMES_LATE + 1
IMAGE = np.arange(400, dtype=np.uint16).reshape(20, 20)
DARK, HIGHEST = 100, 60_000


def fault(kind: Kind, seed: int = 5) -> Fault:
    return Fault(kind, FIRST, FRAMES, seed)


def order(kind: Kind, seed: int = 5) -> list[int]:
    return [frame for index in range(LAST) for frame in fault(kind, seed).sent(index)]


def spoilt(kind: Kind, index: int) -> np.ndarray:
    return fault(kind).pixels(index, IMAGE, IMAGE[::-1], DARK, HIGHEST)


@pytest.mark.parametrize("kind", Kind)
def test_outside_its_time_a_fault_changes_nothing(kind: Kind) -> None:
    for index in (1, FIRST - 1, FIRST + FRAMES + MOST_FRAMES_LATE + 1):
        assert fault(kind).sent(index) == (index,)
        assert spoilt(kind, index) is IMAGE
        assert fault(kind).payload(index, b"whole", 5) == b"whole"


def test_a_tenth_of_the_frames_is_lost_as_the_seed_says() -> None:
    lost = set(range(LAST)) - set(order(Kind.LOST))
    assert lost <= set(range(FIRST, FIRST + FRAMES))
    assert len(lost) == pytest.approx(LOST_SHARE * FRAMES, rel=0.5)
    assert order(Kind.LOST) == order(Kind.LOST) != order(Kind.LOST, seed=6)


def test_duplicated_frames_come_twice_in_their_order() -> None:
    found = order(Kind.DUPLICATED)
    assert found == sorted(found)
    assert {frame for frame, count in Counter(found).items() if count == 2} == set(range(FIRST, FIRST + FRAMES))


def test_reordered_frames_come_in_pairs_the_second_one_first() -> None:
    found = order(Kind.REORDERED)
    assert sorted(found) == list(range(LAST))
    assert found[FIRST : FIRST + 4] == [FIRST + 1, FIRST, FIRST + 3, FIRST + 2]


def test_late_frames_all_come_by_up_to_fifty_frames_late() -> None:
    when = {frame: index for index in range(LAST) for frame in fault(Kind.LATE).sent(index)}
    assert set(when) == set(range(LAST))
    late = [when[frame] - frame for frame in range(FIRST, FIRST + FRAMES)]
    assert (min(late), max(late)) == (1, MOST_FRAMES_LATE)


def test_what_the_detector_gives() -> None:
    assert (spoilt(Kind.SATURATED, FIRST) == HIGHEST).all()
    dark = spoilt(Kind.DARK, FIRST)
    assert abs(dark.astype(int) - DARK).max() <= 2
    np.testing.assert_array_equal(spoilt(Kind.STUCK, FIRST), IMAGE[::-1])
    assert 0 < (spoilt(Kind.HOT_PIXELS, FIRST) == HIGHEST).sum() < IMAGE.size / 4
    struck = [(spoilt(Kind.COSMIC_RAYS, index) == HIGHEST).sum() for index in range(FIRST, FIRST + FRAMES)]
    assert 0 < np.count_nonzero(struck) < FRAMES / 2
    assert max(struck) <= TRACK_PIXELS
    assert IMAGE.max() == 399, "what was given is left alone"


def test_what_is_on_the_wire() -> None:
    sound = image(IMAGE, 0, "sensor")
    message = sound.SerializeToString()
    end = message.index(sound.data) + len(sound.data)
    assert spoilt(Kind.WRONG_SIZE, FIRST).shape == (19, 19)
    cutting = Fault(Kind.TRUNCATED, FIRST, 5000, 5)
    short = [cutting.payload(index, message, end) for index in range(FIRST, FIRST + 5000)]
    assert all(message.startswith(one) and decode_frame(one, 1, 0).pixels is None for one in short)
    assert len({fault(Kind.RANDOM).payload(index, message, end) for index in range(FIRST, FIRST + 50)}) == 50


@pytest.mark.parametrize("kind", [Kind.DUPLICATED, Kind.REORDERED, Kind.LATE, Kind.OLD_SEQUENCE, Kind.TRUNCATED])
def test_what_is_published(kind: Kind) -> None:
    hub, clock = MemoryHub(), FakeClock(EARLIER_S * 10**10)
    camera, reader = MemoryBus(hub, "camera", clock), MemoryBus(hub, "controller", clock)
    got: list[Sample] = []
    reader.subscribe(FRAME, got.append)
    faulty = FaultyFrames(Fault(kind, 10, 10), camera.publisher(FRAME), DARK, HIGHEST)
    for index in range(90):
        envelope = faulty.put(index, faulty.message(index, IMAGE + np.uint16(index), index), 1000 + index)
        assert count_of(envelope.sequence) == index
    start_s = start_of(got[0].sequence)
    for sample in got:
        index = count_of(sample.sequence)
        struck = 10 <= index < 20
        earlier_s = EARLIER_S if kind is Kind.OLD_SEQUENCE and struck else 0
        assert start_of(sample.sequence) == start_s - earlier_s
        frame = decode_frame(sample.payload, sample.sequence, 0)
        if kind is Kind.TRUNCATED and struck:
            assert frame.pixels is None
        else:
            assert frame.pixels is not None
            np.testing.assert_array_equal(frame.pixels, IMAGE + np.uint16(index))
    counts = Counter(count_of(sample.sequence) for sample in got)
    assert set(counts) == set(range(90))
    assert sum(counts.values()) == (100 if kind is Kind.DUPLICATED else 90)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "[1]",
        '{"kind": "lost"}',
        '{"kind": "bent", "first": 1, "frames": 1}',
        '{"kind": "lost", "first": 0, "frames": 1}',
    ],
)
def test_a_file_of_a_fault_that_is_none(tmp_path: Path, content: str) -> None:
    (tmp_path / "fault.json").write_text(content)
    with pytest.raises(ConfigurationError, match="not a fault"):
        read_fault(tmp_path / "fault.json")


def test_a_file_of_a_fault(tmp_path: Path) -> None:
    (tmp_path / "fault.json").write_text(json.dumps({"kind": "dark", "first": 3, "frames": 4, "seed": 5}))
    assert read_fault(tmp_path / "fault.json") == Fault(Kind.DARK, 3, 4, 5)
