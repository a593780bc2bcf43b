"""A memory-mapped ImageStreamIO stream: opened or created, read and written within its bounds."""

import mmap
import os
import stat
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import psutil

from lowfc.adapters.image_stream.layout import (
    HEADER,
    HEADER_BYTES,
    KEYWORD,
    MATH_DATA,
    NEWEST,
    NEWEST_START,
    NUMBERS,
    TIMES,
    VERSION,
    Layout,
)
from lowfc.adapters.image_stream.semaphores import Semaphores
from lowfc.contract.errors import LowfcError

SEMAPHORES = 10
"""Number of semaphores of a stream created here; this number and those below are the C library's."""
TRACES = 10  # number of records of accesses by processes
_MAX_NAME_BYTES = 79
_MODE = 0o666
_NS = 1_000_000_000


class StreamError(LowfcError):
    """A stream cannot be used."""


class StreamAbsentError(StreamError):
    """The stream does not exist, or is being created."""


def stream_path(name: str) -> Path:
    """File of a stream, in the first existing folder: $MILK_SHM_DIR, /milk/shm or /tmp; StreamError for a bad name."""
    if not name.isprintable() or "/" in name or not 0 < len(name.encode()) <= _MAX_NAME_BYTES:
        limit = f"1 to {_MAX_NAME_BYTES} bytes without '/', all printable"
        raise StreamError(f"a stream's name has {limit}; got {name!r}")
    names = (os.environ.get("MILK_SHM_DIR"), "/milk/shm", "/tmp")  # noqa: S108
    folders = (Path(folder) for folder in names if folder)
    return next(folder for folder in folders if folder.is_dir() or folder == Path("/tmp")) / f"{name}.im.shm"  # noqa: S108


class Newest(NamedTuple):
    """Header fields of the newest image: its `atime` (two fields), number of images written so far, and its plane.

    `writing` is set while an image is being written, and stays set if its writer dies meanwhile.
    """

    seconds: int
    nanoseconds: int
    number: int
    plane: int
    writing: int

    @property
    def acquired_ns(self) -> int:
        """Acquisition time, ns since the epoch."""
        return _since_epoch_ns(self.seconds, self.nanoseconds)


class Stream:
    """A stream of images in shared memory.

    Attributes:
        layout: positions of the stream's parts, as declared in its header when it was opened.
        data: (planes, rows, columns) view of the pixels.
        semaphores: semaphores, one for each reader.
        readers: (semaphores,) view of the id of the process that waits for each semaphore; 0 or less for none.
        writers: (semaphores,) view of the id of the process that last posted each semaphore.
        identity: device, inode and size of the file; they differ for another file of the same name.
    """

    def __init__(self, path: Path) -> None:
        """Map an existing stream.

        StreamAbsentError if it does not exist yet; StreamError if it has another layout, or cannot be opened.
        """
        self.path, self._file = path, os.fspath(path)
        self.name = path.name.removesuffix(".im.shm")
        try:
            with path.open("r+b", buffering=0) as file:
                status = os.fstat(file.fileno())
                if not stat.S_ISREG(status.st_mode):
                    raise StreamError(f"stream {self.name!r} is not a file: {path}")
                if status.st_size < HEADER_BYTES:
                    raise StreamAbsentError(f"stream {self.name!r} is being created: {path} is still too short")
                self._mapping = mmap.mmap(file.fileno(), status.st_size)
        except FileNotFoundError:
            raise StreamAbsentError(f"there is no stream {self.name!r} ({path})") from None
        except OSError as fault:
            raise StreamError(f"stream {self.name!r} cannot be opened: {path}: {fault.strerror}") from None
        self.identity = _identity(status)
        self._header = np.frombuffer(self._mapping, HEADER, 1)
        header = self._header.copy()[0]
        if not header["version"]:
            raise StreamAbsentError(f"stream {self.name!r} is being created: its header has no version yet")
        try:
            self.layout = layout = Layout.of(header, status.st_size)
        except ValueError as fault:
            raise StreamError(f"stream {self.name!r} {fault} ({path})") from None
        starts, count = layout.starts, layout.semaphores
        self.data = np.ndarray(layout.shape, layout.dtype, self._mapping, starts["data"])
        self.semaphores = Semaphores(self._mapping, starts["semaphores"], count)
        self._log_semaphore = Semaphores(self._mapping, starts["log"], 1)
        self.readers = np.ndarray(count, "<i4", self._mapping, starts["readers"])
        self.writers = np.ndarray(count, "<i4", self._mapping, starts["writers"])
        self._cnt0, self._write = self._header["cnt0"], self._header["write"]
        if not self.semaphores.usable():
            raise StreamError(f"stream {self.name!r} has semaphores of another C library ({path})")

    @classmethod
    def create(cls, path: Path, shape: tuple[int, int], dtype: npt.DTypeLike) -> "Stream":
        """Create a stream of images (rows, columns) atomically.

        StreamError if it exists already, or cannot be created.
        """
        rows, columns = shape
        pixel = np.dtype(dtype)
        layout = Layout.computed(pixel, (1, rows, columns), 0, SEMAPHORES, TRACES, 0)
        header = np.zeros(1, HEADER)
        fields: dict[str, Any] = {"version": VERSION.encode(), "name": path.name.removesuffix(".im.shm").encode()}
        fields |= {"axes": 2, "size": (columns, rows, 0), "elements": rows * columns, "type": NUMBERS[pixel]}
        fields |= {"kind": MATH_DATA, "creator": os.getpid(), "shared": 1, "location": -1, "semaphores": SEMAPHORES}
        fields |= {"traces": TRACES, "data_bytes": rows * columns * pixel.itemsize}
        fields |= {"created": _now_tai(), "accessed": _now_tai()}
        try:
            with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}-") as file:
                fields["inode"] = os.fstat(file.fileno()).st_ino
                for name, value in fields.items():
                    header[name] = value
                file.truncate(layout.file_bytes)
                file.write(header.tobytes())
                for part in ("readers", "writers"):
                    file.seek(layout.starts[part])
                    file.write(np.full(SEMAPHORES, -1, "<i4").tobytes())
                file.flush()
                with mmap.mmap(file.fileno(), layout.file_bytes) as mapping:
                    for start, count in ((layout.starts["semaphores"], SEMAPHORES), (layout.starts["log"], 1)):
                        Semaphores(mapping, start, count).initialise()
                os.fchmod(file.fileno(), _MODE)
                os.link(file.name, path)
        except FileExistsError:
            raise StreamError(f"stream {path.name.removesuffix('.im.shm')!r} exists already: {path}") from None
        except OSError as fault:
            raise StreamError(f"stream {path} cannot be created: {fault.strerror}") from None
        return cls(path)

    def current(self) -> bool:
        """Whether its path still leads to this file at its full size; otherwise the mapping must not be accessed."""
        try:
            return _identity(os.stat(self._file)) == self.identity  # noqa: PTH116  # twice as fast as Path.stat
        except OSError:
            return False

    @property
    def count(self) -> int:
        """Number of images written so far."""
        return int(self._cnt0[0])

    @property
    def writing(self) -> bool:
        """Whether an image is being written, or its writer died meanwhile."""
        return bool(self._write[0])

    @property
    def newest(self) -> Newest:
        """Header fields of the newest image."""
        return Newest._make(NEWEST.unpack_from(self._mapping, NEWEST_START))

    def keywords(self) -> dict[str, float | str]:
        """Values of the stream's keywords, by name."""
        records = np.frombuffer(self._mapping, KEYWORD, self.layout.keywords, self.layout.starts["keywords"]).copy()
        fields = {b"L": "integer", b"D": "real", b"S": "text"}
        values = {}
        for record in records:
            field = fields.get(bytes(record["type"]))
            if field is not None:
                value = record[field].item()
                values[_text(record["name"])] = _text(value) if isinstance(value, bytes) else value
        return values

    def put(self, image: npt.NDArray[np.generic], acquired_ns: int | None = None) -> None:
        """Write an image (rows, columns) to the first plane, and post the semaphores; TypeError if it does not fit."""
        if (image.dtype, image.shape) != (self.layout.dtype, self.layout.shape[1:]):
            raise TypeError(f"stream {self.name!r} does not hold images of {image.shape} {image.dtype}")
        self._write[0] = 1
        self.data[0] = image
        if self.layout.ring:
            self._put_in_ring()
        now = _now_tai()
        acquired = now if acquired_ns is None else divmod(acquired_ns + _tai_ahead_ns(), _NS)
        TIMES.pack_into(self._mapping, NEWEST_START, *acquired, *now)
        self._cnt0[0] += 1
        self._write[0] = 0
        pid = os.getpid()
        for index in self.semaphores.post_all():
            self.writers[index] = pid
        self._log_semaphore.post_all()

    def _put_in_ring(self) -> None:
        """Copy the image to the next place of the circular buffer."""
        following = int(self._header["ring_index"][0]) + 1
        index = following if following < self.layout.ring else 0
        image = self.data.reshape(-1).view(np.uint8)
        start = self.layout.starts["ring"] + index * image.size
        np.ndarray(image.size, np.uint8, self._mapping, start)[:] = image
        self._header["ring_cycle"] += np.uint64(index != following)
        self._header["ring_index"] = index

    def take_semaphore(self) -> int:
        """Reserve a semaphore for this process; StreamError if living processes hold all of them."""
        pid = os.getpid()
        holders = self.readers.tolist()
        free = (index for index, holder in enumerate(holders) if holder == pid or not alive(holder))
        index = holders.index(pid) if pid in holders else next(free, None)
        if index is None:
            raise StreamError(f"stream {self.name!r} has {len(holders)} semaphores, and processes {holders} hold them")
        self.readers[index] = pid
        self.semaphores.drain(index)
        return index

    def release_semaphore(self, index: int) -> None:
        """Release a semaphore for other processes."""
        if self.readers[index] == os.getpid():
            self.readers[index] = 0

    def other_writer(self) -> int:
        """Process id of another living process that has written this stream; 0 if there is none."""
        return next((pid for pid in set(self.writers.tolist()) - {os.getpid()} if self._wrote(pid)), 0)

    def _wrote(self, pid: int) -> bool:
        """Whether the living process `pid` wrote the stream, rather than an ended one with the same process id."""
        try:
            written_ns = _since_epoch_ns(*self._header["writetime"][0].tolist())
            return alive(pid) and psutil.Process(pid).create_time() * _NS <= written_ns + _NS
        except psutil.Error:
            return alive(pid)


def alive(pid: int) -> bool:
    """Whether a process with that id exists."""
    try:
        os.getpgid(pid if pid > 0 else -1)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # no permission: it exists
        return True
    return True


def _identity(status: os.stat_result) -> tuple[int, int, int]:
    return status.st_dev, status.st_ino, status.st_size


def _text(raw: bytes) -> str:
    return raw.partition(b"\0")[0].decode("ascii", "backslashreplace")


def _since_epoch_ns(seconds: int, nanoseconds: int) -> int:
    """Convert a recent time of a header to ns since the epoch, UTC.

    A time ahead of the wall clock by more than half of TAI - UTC is TAI, as the C library writes it; others are UTC.
    """
    time_ns, ahead_ns = seconds * _NS + nanoseconds, _tai_ahead_ns()
    return time_ns - ahead_ns if ahead_ns and time_ns > time.time_ns() + ahead_ns // 2 else time_ns


def _now_tai() -> tuple[int, int]:
    """Present TAI, seconds and nanoseconds."""
    return divmod(time.clock_gettime_ns(time.CLOCK_TAI), _NS)


def _tai_ahead_ns() -> int:
    """Lead of TAI over the wall clock on this host, ns, rounded to whole seconds."""
    return round((time.clock_gettime_ns(time.CLOCK_TAI) - time.time_ns()) / _NS) * _NS
