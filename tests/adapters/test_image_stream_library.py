"""ImageStreamIO streams, tested with the C library; skipped if the loader does not find libImageStreamIO.so."""

import ctypes
import multiprocessing
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lowfc.adapters.image_stream.reader import StreamReader
from lowfc.adapters.image_stream.stream import Stream

ROWS, COLUMNS = 34, 31
UINT16, FLOAT = 3, 9  # the C library's numbers of pixel types
try:
    LIBRARY = ctypes.CDLL("libImageStreamIO.so")
except OSError:
    pytest.skip("libImageStreamIO.so is not installed", allow_module_level=True)


class Image:
    """An IMAGE structure of the C library: its pointer `md` is at byte 120, its pointer `array` at byte 128."""

    def __init__(self, name: str) -> None:
        self.memory = ctypes.create_string_buffer(512)
        self.name = name.encode()

    def create(self, pixel_type: int, keywords: int = 0, ring: int = 0) -> "Image":
        sizes = (ctypes.c_uint32 * 2)(COLUMNS, ROWS)
        assert not LIBRARY.ImageStreamIO_createIm(self.memory, self.name, 2, sizes, pixel_type, 1, keywords, ring)
        return self

    def open(self) -> "Image":
        assert not LIBRARY.ImageStreamIO_openIm(self.memory, self.name)
        return self

    def pointer(self, offset: int) -> int:
        return ctypes.c_void_p.from_buffer(self.memory, offset).value or 0

    def pixels(self, dtype: str) -> np.ndarray:
        length = ROWS * COLUMNS * np.dtype(dtype).itemsize
        memory = (ctypes.c_char * length).from_address(self.pointer(128))
        return np.frombuffer(memory, dtype).reshape(ROWS, COLUMNS)

    def write(self, image: np.ndarray) -> None:
        ctypes.c_uint8.from_address(self.pointer(120) + 288).value = 1  # field `write`: an image is being written
        self.pixels(image.dtype.str)[:] = image
        assert not LIBRARY.ImageStreamIO_UpdateIm(self.memory)


@pytest.fixture
def path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A stream's path; all tests of this module use one folder, as the library reads MILK_SHM_DIR only once."""
    folder = tmp_path.parent / "milk"
    folder.mkdir(exist_ok=True)
    monkeypatch.setenv("MILK_SHM_DIR", str(folder))
    return folder / f"{tmp_path.name}.im.shm"


def image(seed: int, dtype: str) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 1000, (ROWS, COLUMNS)).astype(dtype)


def test_images_written_by_the_c_library_are_read(path: Path) -> None:
    library = Image(path.name.removesuffix(".im.shm")).create(UINT16, keywords=4)
    reader = StreamReader(path)
    for number in range(1, 100):
        library.write(image(number, "u2"))
        received = reader.next(1)
        assert received.number == number
        assert abs(received.acquired_ns - time.time_ns()) < 10**9
        assert np.array_equal(received.pixels, image(number, "u2"))
    assert LIBRARY.ImageStreamIO_semvalue(library.memory, 9) == 10  # no reader waits on it: it stays at its maximum
    reader.close()
    LIBRARY.ImageStreamIO_destroyIm(library.memory)
    assert reader.next(0.02) is None


def test_the_c_library_does_not_take_the_semaphore_of_a_lowfc_reader(path: Path) -> None:
    library = Image(path.name.removesuffix(".im.shm")).create(UINT16)
    reader = StreamReader(path)
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=lambda: queue.put(LIBRARY.ImageStreamIO_getsemwaitindex(library.memory, 0)))
    child.start()
    child.join()
    assert queue.get() == 1  # the reader holds semaphore 0
    reader.close()


def _receive(name: str, images: int, started: Any, queue: Any) -> None:
    library = Image(name).open()
    index = LIBRARY.ImageStreamIO_getsemwaitindex(library.memory, 5)
    started.set()
    for _ in range(images):
        assert not LIBRARY.ImageStreamIO_semwait(library.memory, index)
        queue.put(library.pixels("f4").copy())


@pytest.mark.parametrize("made_by", ["library", "lowfc"])
def test_images_written_by_lowfc_wake_readers_that_use_the_c_library(path: Path, made_by: str) -> None:
    name = path.name.removesuffix(".im.shm")
    if made_by == "library":
        Image(name).create(FLOAT, ring=3)
        stream = Stream(path)
    else:
        stream = Stream.create(path, (ROWS, COLUMNS), np.float32)
    context = multiprocessing.get_context("fork")
    queue, started = context.SimpleQueue(), context.Event()
    child = context.Process(target=_receive, args=(name, 50, started, queue))
    child.start()
    assert started.wait(5)
    for number in range(50):
        stream.put(image(number, "f4"))
        assert np.array_equal(queue.get(), image(number, "f4"))
    child.join(5)
    assert child.exitcode == 0


def test_lowfc_writes_the_ring_buffer_as_the_c_library_does(path: Path) -> None:
    name = path.name.removesuffix(".im.shm")
    written = []
    for by_library in (True, False):
        library = Image(name).create(FLOAT, ring=3)
        stream = Stream(path)
        put = library.write if by_library else stream.put
        for number in range(1, 6):
            put(image(number, "f4"))
        content, start = path.read_bytes(), stream.layout.starts["ring"]
        written.append((content[start : start + 3 * ROWS * COLUMNS * 4], content[296:312]))  # ring; its index and cycle
    assert written[0] == written[1]
