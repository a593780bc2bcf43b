"""ImageStreamIO streams, tested with an independent reader and writer made from the layout definition."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lowfc.adapters.image_stream.reader import StreamImage, StreamReader
from lowfc.adapters.image_stream.stream import Stream, StreamAbsentError, StreamError, stream_path
from tests.support.image_streams.plain import FLOAT32, NUMPY_TYPES, UINT16, PlainStream

ROWS, COLUMNS = 6, 9
"""Size of the images. Offsets in `get` and `pack` are bytes in the published layout."""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "camnsv.im.shm"


def new_stream(path: Path, pixel_type: int = UINT16, **options: object) -> PlainStream:
    """Create a stream with pixels of this ImageStreamIO type."""
    return PlainStream.make(path, COLUMNS, ROWS, pixel_type, **options)


def image(seed: int, pixel_type: int = UINT16) -> np.ndarray:
    """A random image with pixels of this ImageStreamIO type."""
    values = np.random.default_rng(seed).integers(0, 100, (ROWS, COLUMNS))
    return values.astype(NUMPY_TYPES[pixel_type])


def newest(reader: StreamReader) -> StreamImage:
    image_ = reader.next(5)
    assert image_ is not None
    return image_


def dead_pid() -> int:
    with subprocess.Popen([sys.executable, "-c", ""]) as child:
        pass
    return child.pid


@pytest.mark.parametrize("pixel_type", NUMPY_TYPES)
def test_images_of_every_type_are_read_and_written(path: Path, pixel_type: int) -> None:
    writer = new_stream(path, pixel_type)
    reader = StreamReader(path)
    writer.write(image(1, pixel_type), 1_700_000_000_123_456_789)
    received = newest(reader)
    assert received.number == 1
    assert received.acquired_ns == 1_700_000_000_123_456_789
    assert received.pixels.dtype == NUMPY_TYPES[pixel_type]
    assert np.array_equal(received.pixels, image(1, pixel_type))
    stream, other = Stream(path), PlainStream(path, COLUMNS, ROWS, pixel_type)
    other.reserve_semaphore(7)
    before_ns = time.clock_gettime_ns(time.CLOCK_TAI)
    stream.put(image(2, pixel_type))
    assert other.wait(7, 1)
    assert other.count == 2
    assert np.array_equal(other.pixels[0], image(2, pixel_type))
    assert [other.get("<i", other.writers + 4 * index) for index in range(10)] == [os.getpid()] * 10
    assert 0 <= other.get("<q", 200) * 10**9 + other.get("<q", 208) - before_ns < 10**9
    with pytest.raises(TypeError):
        stream.put(image(2, pixel_type).astype("c8"))
    assert (other.count, stream.writing) == (2, False)


def test_a_created_stream_is_readable_by_others(path: Path) -> None:
    stream = Stream.create(path, (ROWS, COLUMNS), np.float32)
    other = PlainStream(path, COLUMNS, ROWS, FLOAT32)
    assert (path.stat().st_mode & 0o777, other.get("<Q", 232)) == (0o666, path.stat().st_ino)
    assert [other.get("<I", 116), other.get("<I", 120), other.get("<Q", 128), other.get("B", 136)] == [9, 6, 54, 9]
    other.reserve_semaphore(3)
    stream.put(image(1, FLOAT32), 1_700_000_000_000_000_000)
    assert other.wait(3, 1)
    assert np.array_equal(other.pixels[0], image(1, FLOAT32))
    assert other.get("<q", 184) - 1_700_000_000 == round(time.clock_gettime(time.CLOCK_TAI) - time.time())
    with pytest.raises(StreamError, match="exists already"):
        Stream.create(path, (ROWS, COLUMNS), np.float32)
    assert [file.name for file in path.parent.iterdir()] == [path.name]


def test_keywords_of_every_kind_are_read(path: Path) -> None:
    new_stream(path, keywords={"fps": 500, "tint": 1e-3, "camera": "nsv"})
    assert Stream(path).keywords() == {"fps": 500, "tint": 1e-3, "camera": "nsv"}


@pytest.mark.parametrize(
    ("options", "difference"),
    [
        ({"version": b"1.00"}, "layout version '1.00', expected '2.00'"),
        ({"version": b"1.00\0\xff\n"}, "layout version '1.00'"),
        ({"version": b"\x1b[2J"}, r"layout version '\\x1b\[2J'"),
        ({"header_bytes": 4496}, "DAO_COMPAT"),
        ({"header_bytes": 400}, "built with other options"),
        ({"pixel_type": 12}, "pixels of type 12"),
        ({"location": 0}, "graphics card 0"),
        ({"planes": 3, "axes": 3}, "cube of 3 planes"),
        ({"axes": 1}, "1 axes"),
        ({"axes": 4}, "4 axes"),
    ],
)
def test_a_stream_of_another_layout_is_refused_with_the_difference(
    path: Path, options: dict[str, object], difference: str
) -> None:
    new_stream(path, **options)
    with pytest.raises(StreamError, match=difference) as fault:
        Stream(path)
    assert "camnsv" in str(fault.value)
    assert not isinstance(fault.value, StreamAbsentError)


def test_a_stream_being_created_counts_as_absent(path: Path) -> None:
    with pytest.raises(StreamAbsentError):
        Stream(path)
    path.write_bytes(b"")
    with pytest.raises(StreamAbsentError):
        Stream(path)
    new_stream(path, version=b"")
    with pytest.raises(StreamAbsentError):
        Stream(path)
    path.unlink()
    path.mkdir()
    with pytest.raises(StreamError, match="Is a directory"):
        Stream(path)


def test_the_newest_plane_of_a_stream_is_returned(path: Path) -> None:
    writer = new_stream(path, planes=4, axes=3, kind=0x20001)
    reader = StreamReader(path)
    for number in range(1, 7):
        writer.write(image(number), plane=number % 4)
        received = newest(reader)
        assert np.array_equal(received.pixels, image(number))
    writer.pack("<Q", 272, 2**64 - 1)  # an invalid plane
    writer.pack("<Q", 264, 7)
    newest(reader)


def test_an_image_being_written_is_awaited(path: Path) -> None:
    writer = new_stream(path)
    reader = StreamReader(path)
    writer.write(image(1))
    writer.begin(image(2))
    assert reader.next(0.02) is None
    assert reader.silence_cause() == "its writer is silent, in the middle of an image"
    writer.end()
    received = newest(reader)
    assert received.number == 2
    assert np.array_equal(received.pixels, image(2))
    assert reader.next(0.02) is None
    assert reader.silence_cause() == "its writer is silent"


WRITER = """
import sys, time, numpy as np
from pathlib import Path
from tests.support.image_streams.plain import PlainStream
stream = PlainStream(Path(sys.argv[1]), 64, 64, 3)
print(flush=True)
for number in range(1, 1 << 30):
    stream.write(np.full((64, 64), number % 65536))
"""


def test_no_torn_image_is_returned_and_a_dead_writer_is_reported(path: Path) -> None:
    stream = PlainStream.make(path, 64, 64, UINT16)
    reader = StreamReader(path)
    with subprocess.Popen([sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline()
        numbers = []
        for _ in range(500):
            received = newest(reader)
            assert (received.pixels == received.number % 65536).all()
            numbers.append(received.number)
        writer.send_signal(signal.SIGKILL)
    assert numbers == sorted(set(numbers))
    while reader.next(0.1) is not None:
        pass
    assert reader.silence_cause().startswith(f"its writer (process {writer.pid}) has ended")
    stream.write(np.full((64, 64), stream.count + 1))  # another writer takes over
    received = newest(reader)
    assert (received.pixels == received.number % 65536).all()


def test_a_recreated_stream_is_reopened(path: Path) -> None:
    writer = new_stream(path)
    reader = StreamReader(path)
    writer.write(image(1))
    newest(reader)
    new_stream(path).write(image(2))
    received = newest(reader)
    assert (received.number, received.generation) == (1, 2)
    assert np.array_equal(received.pixels, image(2))
    PlainStream.make(path, 3, 2, FLOAT32).write(np.ones((2, 3)))
    received = newest(reader)
    assert received.generation == 3
    assert received.pixels.shape == (2, 3)
    path.unlink()
    assert reader.next(0.02) is None
    assert reader.silence_cause() == "there is no stream 'camnsv'"
    new_stream(path).write(image(3))
    received = newest(reader)
    assert received.generation == 4
    new_stream(path, version=b"1.00")
    with pytest.raises(StreamError, match="layout version"):
        reader.next(0.02)
    writer = new_stream(path, version=b"")
    writer.map[writer.semaphores + 8] ^= 1  # not yet initialised, although the version is set
    writer.map[:4] = b"2.00"
    assert reader.next(0) is None, "an unusable stream is read once more before it is an error"
    new_stream(path).write(image(4))
    newest(reader)


def test_a_truncated_file_is_no_longer_accessed(path: Path) -> None:
    writer = new_stream(path)
    reader = StreamReader(path)
    writer.write(image(1))
    os.truncate(path, 100)
    assert reader.next(0.02) is None
    os.truncate(path, 0)
    reader.close()


def test_each_reader_has_its_own_semaphore(path: Path) -> None:
    writer = new_stream(path)
    writer.reserve_semaphore(0, os.getppid())
    writer.reserve_semaphore(1, dead_pid())
    reader = StreamReader(path)
    assert writer.get("<i", writer.readers + 4) == os.getpid()  # it has taken the dead process's semaphore
    writer.write(image(1))
    newest(reader)
    assert writer.value(0) == 1  # the parent's semaphore is not consumed
    reader.close()
    assert writer.get("<i", writer.readers + 4) == 0
    for index in range(10):
        writer.reserve_semaphore(index, os.getppid())
    with pytest.raises(StreamError, match=f"processes .*{os.getppid()}.* hold them"):
        StreamReader(path)


def test_semaphores_are_posted_up_to_a_value_of_ten_and_a_full_one_blocks_nothing(path: Path) -> None:
    writer = new_stream(path)
    reader = StreamReader(path)
    stream = Stream(path)
    for number in range(25):
        stream.put(image(number))
    assert [writer.value(index) for index in range(10)] == [10] * 10
    received = newest(reader)
    assert received.number == 25
    assert np.array_equal(received.pixels, image(24))
    assert reader.next(0.02) is None
    stream.put(image(26))
    received = newest(reader)
    assert received.number == 26


def test_another_living_writer_is_detected(path: Path) -> None:
    writer = new_stream(path)
    stream = Stream(path)
    assert not stream.other_writer()
    writer.write(image(1))
    assert not stream.other_writer()  # this process is not another writer
    writer.pack("<i", writer.writers + 4 * 9, dead_pid())
    assert not stream.other_writer()
    writer.pack("<i", writer.writers + 4 * 9, os.getppid())
    assert stream.other_writer() == os.getppid()
    writer.pack("<q", 200, 1_000_000_000)  # written before that process began: its id was reused
    assert not stream.other_writer()


def test_the_first_existing_folder_is_used_and_a_name_that_is_no_file_name_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path))
    assert stream_path("dm00disp03") == tmp_path / "dm00disp03.im.shm"
    monkeypatch.setenv("MILK_SHM_DIR", str(tmp_path / "none"))
    assert stream_path("dm00disp03").parent in (Path("/milk/shm"), Path("/tmp"))  # noqa: S108
    for name in ("", "../shm", "a" * 80, "ä" * 40):  # the header has 80 bytes for the name and its NUL
        with pytest.raises(StreamError, match="a stream's name"):
            stream_path(name)


def test_damaged_headers_cause_no_access_outside_the_stream(path: Path) -> None:
    rng = np.random.default_rng(7)
    writer = new_stream(path, planes=2, axes=3, kind=0x20001, keywords={"tint": 1e-3})
    good = bytes(writer.map)
    # Readers and writers may change eleven semaphores and four arrays of ten int32, but nothing after these.
    after_shared = slice(writer.semaphores + 11 * 32 + 4 * 40, None)
    opened = 0
    for _ in range(1500):
        writer.map[:] = good
        for _ in range(rng.integers(1, 4)):
            at = int(rng.integers(0, 384)) if rng.random() < 0.6 else int(rng.choice((112, 116, 128, 136, 258, 292)))
            writer.map[at] = (
                int(rng.integers(0, 256)) if rng.random() < 0.7 else writer.map[at] ^ (1 << rng.integers(8))
            )
        try:
            stream = Stream(path)
        except StreamError:
            continue
        opened += 1
        for at in rng.integers(0, 384, 3):
            writer.map[int(at)] = int(rng.integers(0, 256))
        header = bytes(writer.map[:184])
        with contextlib.suppress(StreamError):
            StreamReader(path).next(0)
        stream.keywords()
        stream.put(np.zeros(stream.layout.shape[1:], stream.layout.dtype))
        assert isinstance(stream.newest.acquired_ns, int)
        assert bytes(writer.map[:184]) == header
        assert bytes(writer.map[after_shared]) == good[after_shared]
    assert 75 < opened < 1425
