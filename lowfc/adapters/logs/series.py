"""Consecutive log files of a recording, limited in size, age and disk space."""

import contextlib
import shutil
import stat
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.writer import FILE_MODE, PART, Attachment, LogWriter, log_path
from lowfc.adapters.process.clock import Clock
from lowfc.contract.errors import DataFileError, raised_as


@dataclass(frozen=True, slots=True)
class LogLimits:
    """Limits of a log file, and free space to leave on the disk.

    Attributes:
        largest_bytes: size at which the next file begins.
        longest_s: age at which the next file begins.
        min_free_bytes: free space below which nothing is recorded.
        file_mode: permissions of a file.
    """

    largest_bytes: int = 4_000_000_000
    longest_s: float = 3600.0
    min_free_bytes: int = 500_000_000
    file_mode: int = FILE_MODE


STANDARD = LogLimits()
_STEADY_S = 10.0  # over a shorter time, the metadata and attachments at a file's start falsify its rate of growth


class LogSeries:
    """Writes the log files of recordings to a folder.

    A full file is finished on a separate thread, as the disk may need seconds to store it. If the disk refuses a write,
    methods raise DataFileError; the caller then calls `give_up`.

    Attributes:
        files: paths of the files so far: final names, or names with ".part" of those that could not be finished.
    """

    def __init__(
        self,
        folder: Path,
        clock: Clock,
        metadata: Mapping[str, Mapping[str, str]],
        attachments: Sequence[Attachment],
        limits: LogLimits,
    ) -> None:
        self.files: list[Path] = []
        self._folder = folder
        self._clock = clock
        self._metadata = metadata
        self._attachments = attachments
        self._limits = limits
        self._log: LogWriter | None = None
        self._opened_s = self._recorded_s = 0.0
        self._recording, self._part_number = "", 0
        self._messages = self._bytes = self._longest_write_ns = 0
        self._finisher = ThreadPoolExecutor(1, "finish-log")
        self._finishing: tuple[LogWriter, Future[int]] | None = None

    @property
    def messages(self) -> int:
        """Number of messages written up to the last flush."""
        return self._messages + (self._log.messages_written if self._log else 0)

    @property
    def bytes_written(self) -> int:
        """Size of all files up to the last flush."""
        return self._bytes + (self._log.bytes_written if self._log else 0)

    @property
    def longest_write_ns(self) -> int:
        """Longest duration of a write, ns."""
        return max(self._longest_write_ns, self._log.longest_write_ns if self._log else 0)

    @property
    def bytes_per_s(self) -> float:
        """Growth of the files, bytes per second; 0 during the first 10 s."""
        recorded_s = self._recorded_s + (time.monotonic() - self._opened_s if self._log else 0.0)
        return self.bytes_written / recorded_s if recorded_s >= _STEADY_S else 0.0

    @property
    def full(self) -> bool:
        """Whether the present file has reached its size or age limit."""
        return self._log is not None and (
            self._log.bytes_written >= self._limits.largest_bytes
            or time.monotonic() - self._opened_s >= self._limits.longest_s
        )

    @property
    def finishing(self) -> bool:
        """Whether a file is being finished in parallel."""
        return self._finishing is not None and not self._finishing[1].done()

    def begin(self, first: Iterable[Sample], *, new_recording: bool = True) -> None:
        """Begin a file of a new or the present recording with the messages `first`, which later messages depend on."""
        now_ns = self._clock.host_ns()
        with raised_as(DataFileError, OSError, f"{self._folder} cannot be accessed"):
            path = log_path(self._folder, now_ns)
        if new_recording:
            self._recording, self._part_number = path.stem, 0
        self._part_number += 1
        metadata = {**self._metadata, PART: {"of": self._recording, "number": str(self._part_number)}}
        self._log = LogWriter(path, now_ns, metadata, self._attachments, self._limits.file_mode)
        self._opened_s = time.monotonic()
        self.files.append(self._log.path)
        for sample in first:
            self._log.write(sample)

    def write(self, sample: Sample) -> bool:
        """Write a message; False if no file is open."""
        if self._log is None:
            return False
        self._log.write(sample)
        return True

    def flush(self) -> None:
        """Flush the file; DataFileError also if the previous file could not be finished."""
        if self._log is not None:
            self._log.flush()
        if self._finishing is not None and self._finishing[1].done():
            self._await_finished()

    def end(self, totals: Mapping[str, str], *, wait: bool = True) -> None:
        """Finish the file, with `totals` as its "recording" metadata; without `wait`, return before it is finished."""
        self._await_finished()
        if self._log is not None:
            self._log.flush()
            log = self._detach()
            self._finishing = log, self._finisher.submit(_finish, log, totals)
        if wait:
            self._await_finished()

    def remove(self) -> None:
        """Remove the files; the caller ensures that all are finished and contain only the recorder's own messages."""
        while self.files:
            with raised_as(DataFileError, OSError, f"{self.files[-1]} is empty and cannot be removed"):
                self.files[-1].unlink(missing_ok=True)
            self.files.pop()
        self._messages = self._bytes = 0

    def give_up(self) -> None:
        """Close the file unfinished, truncated to its last flush."""
        if self._log is not None:
            log = self._detach()
            log.abandon()
            self._list_unfinished(log)

    def _detach(self) -> LogWriter:
        assert self._log is not None  # noqa: S101  # for the type checker
        log, self._log = self._log, None
        self._recorded_s += time.monotonic() - self._opened_s
        self._messages += log.messages_written
        self._bytes += log.bytes_written
        self._longest_write_ns = max(self._longest_write_ns, log.longest_write_ns)
        return log

    def _await_finished(self) -> None:
        if self._finishing is None:
            return
        (log, growth_bytes), self._finishing = self._finishing, None
        try:
            self._bytes += growth_bytes.result()
        except DataFileError:
            self._list_unfinished(log)
            raise

    def _list_unfinished(self, log: LogWriter) -> None:
        """List a file under its name with ".part"."""
        self.files[self.files.index(log.path)] = log.part


def _finish(log: LogWriter, totals: Mapping[str, str]) -> int:
    """Finish a file; return its growth in bytes."""
    before_bytes = log.bytes_written
    log.finish({"recording": totals})
    return log.bytes_written - before_bytes  # not the file's size: another program may have moved the file already


def shortage(folder: Path, min_free_bytes: int) -> str:
    """Sentence on too little space on the disk of `folder`, else empty; DataFileError if the folder is inaccessible."""
    with raised_as(DataFileError, OSError, f"{folder} cannot be accessed"):
        while True:
            parent = nearest_existing(folder)
            with contextlib.suppress(FileNotFoundError):  # it has just been removed
                is_folder, free_bytes = stat.S_ISDIR(parent.stat().st_mode), shutil.disk_usage(parent).free
                break
    if not is_folder:
        raise DataFileError(
            f"no log can be recorded in {folder}: {parent} is no folder; name another (recorder.folder)"
        )
    if free_bytes >= min_free_bytes:
        return ""
    return (
        f"the disk of {folder} has {free_bytes / 1e6:.0f} MB free, and recorder.min_free_mb is "
        f"{min_free_bytes / 1e6:.0f}; free some space, record elsewhere (recorder.folder) or lower recorder.min_free_mb"
    )


def nearest_existing(folder: Path) -> Path:
    """The folder, or its nearest existing parent; DataFileError if it cannot be accessed."""
    absolute = folder.absolute()
    with raised_as(DataFileError, OSError, f"{folder} cannot be accessed"):
        return next(path for path in (absolute, *absolute.parents) if path.exists())
