"""The files (parts) of one recording: find those that belong together, find the newest log, read them as one log."""

import contextlib
import os
import re
from collections.abc import Callable, Generator, Iterator, Sequence
from operator import itemgetter
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Metadata

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.chunk import Chunk
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.records import LogFile
from lowfc.adapters.logs.writer import PART
from lowfc.contract.configuration import Recorder
from lowfc.contract.envelope import start_of
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.messages import topic_of

LAST = "last"
"""Name that stands for the newest log on a command line."""

Parts = tuple[Path, ...]
"""Files of one log, in order."""
LogFiles = Path | Sequence[Path]
"""A log to read: its file, or its files in order."""

_LOG_NAME = re.compile(r"(\d{8}T\d{6}Z)(?:-(\d+))?(-[a-z].*)?\.mcap(\.part)?", re.ASCII)


class Repeated:
    """Detects messages that a file of a log repeats at its start from earlier files, such as calibrations and states.

    Two lockstep runs may have the same sequences, so times of publication are compared too.
    """

    def __init__(self) -> None:
        self._newest: dict[tuple[str, int], tuple[int, int]] = {}
        self._earlier: dict[tuple[str, int], tuple[int, int]] = {}

    def next_file(self) -> None:
        """Begin the next file."""
        self._earlier = dict(self._newest)

    def __call__(self, message: Sample) -> bool:
        """Whether this message was in an earlier file."""
        with contextlib.suppress(KeyError):
            if topic_of(message.key).queryable:
                publisher = message.key, start_of(message.sequence)  # a topic may have several publishers
                sequence, publish_ns = self._earlier.get(publisher, (-1, -1))
                if message.sequence <= sequence and message.publish_time_ns <= publish_ns:
                    return True
                newest = message.sequence, message.publish_time_ns
                self._newest[publisher] = max(newest, self._newest.get(publisher, newest), key=itemgetter(1))
        return False


class WholeLog(LogReader):
    """Reads the files of a log as one and leaves out damaged stretches.

    Messages repeated at the start of a file are delivered once.

    Attributes:
        path: path of the first file.
        schemas, channels: those of the present file; all other attributes cover all files.
        parts: readers of the files so far.
    """

    def __init__(self, log: LogFiles, progress: Callable[[int, int], None] | None = None, **options: Any) -> None:
        """Read a log; `progress` and `options` as for `LogReader`."""
        paths = (log,) if isinstance(log, Path) else tuple(log)
        super().__init__(paths[0], progress, skip_damaged=True, **options)
        self.paths = paths
        self.parts: list[LogReader] = []
        self._options = options

    def __iter__(self) -> Generator[Sample, None, None]:
        """Messages in recorded order; to be called once.

        Raises:
            DataFileError: a file is no log.
        """
        if len(self.paths) == 1:
            self.parts.append(self)
            yield from super().__iter__()
            return
        with contextlib.ExitStack() as opened:
            files = [opened.enter_context(LogFile(path)) for path in self.paths]
        self.size, self.finished = sum(file.size for file in files), all(file.finished for file in files)
        earlier: list[Metadata | Attachment] = []
        repeated = Repeated()
        earlier_bytes = 0
        for path, file in zip(self.paths, files, strict=True):
            part = LogReader(path, skip_damaged=True, **self._options)
            self.parts.append(part)
            self.schemas, self.channels = part.schemas, part.channels
            repeated.next_file()
            try:
                for message in part:
                    if len(self.records) != len(earlier) + len(part.records):
                        self.records = earlier + part.records
                    if self.position != earlier_bytes + part.position:
                        self.position = earlier_bytes + part.position
                        if self.progress is not None:
                            self.progress(self.position, self.size)
                    if not repeated(message):
                        yield message
            finally:  # also if the caller stops reading
                self.records = earlier = earlier + part.records
                for damage in part.damage:
                    damage.why += f" ({path.name})"
                self.damage += part.damage
                self.unreadable += part.unreadable
            earlier_bytes += file.size
        self.position = self.size
        self.complete = all(part.complete for part in self.parts)


def named_logs(names: Sequence[Path], out: Path | None = None, *, as_json: bool = False) -> list[Parts]:
    """Logs named on a command line, each with all of its named files.

    `last` is the newest log in the default folder, with all files of its recording; FOLDER/last is the newest log in
    another folder. An existing file named `last` has precedence.

    Args:
        names: names on the command line.
        out: output file, if the command writes a single one.
        as_json: whether the command prints a single JSON object.

    Raises:
        ConfigurationError: several logs are named for a single output, or a part is named twice.
        DataFileError: `last` is named, and the folder contains no log.
    """
    logs: dict[tuple[str, ...], dict[int, Path]] = {}
    for path in _files(names):
        alone = [path] == list(names)  # the only file named: its number in a recording does not matter
        key, number = ((), 1) if alone else _recording_and_number(path)
        parts = logs.setdefault(key or (str(path.absolute()),), {})
        if number in parts:
            raise ConfigurationError(f"{parts[number]} and {path} are the same part of one log: name one of them")
        parts[number] = path
    sorted_logs = [tuple(parts[number] for number in sorted(parts)) for parts in logs.values()]
    _refuse_several(sorted_logs, out, as_json=as_json)
    return sorted_logs


def named_log(names: Sequence[Path]) -> Parts:
    """The single log named on a command line; see `named_logs`.

    Raises:
        ConfigurationError: several logs are named.
        DataFileError: `last` is named, and the folder contains no log.
    """
    logs = named_logs(names)
    if len(logs) > 1:
        raise ConfigurationError(f"this command reads one log: name one, not {_listed(logs)}; the newest is `{LAST}`")
    return logs[0]


def named_files(names: Sequence[Path], out: Path | None = None, *, as_json: bool = False) -> list[Path]:
    """Files of all named logs: logs in the order named, files of a recording in their own order; see `named_logs`."""
    files = [path for parts in named_logs(names) for path in parts]
    _refuse_several([(path,) for path in files], out, as_json=as_json)
    return files


def titled(paths: Parts) -> str:
    """Short text that names the files of a log."""
    return str(paths[0]) if len(paths) == 1 else f"{paths[0]} to {paths[-1].name} ({len(paths)} files)"


def missing_between(paths: Sequence[Path]) -> int:
    """Number of files missing between the first and the last file of each recording, summed over the recordings."""
    numbers: dict[tuple[str, ...], list[int]] = {}
    for recording, number in map(_recording_and_number, paths):
        numbers.setdefault(recording, []).append(number)
    return sum(max(present) - min(present) + 1 - len({*present}) for present in numbers.values())


def metadata_at_start(path: Path) -> dict[str, dict[str, str]]:
    """Metadata before the messages of a log, by name; DataFileError if the log cannot be read."""
    metadata: dict[str, dict[str, str]] = {}
    with LogFile(path) as file:
        for record in file.parts():
            if isinstance(record, Chunk):
                break
            if isinstance(record, Metadata):
                metadata[record.name] = record.metadata
    return metadata


def _refuse_several(logs: Sequence[Parts], out: Path | None, *, as_json: bool) -> None:
    if len(logs) > 1 and (as_json or out is not None):
        limit = "--json prints one object" if as_json else "--out is one file"
        raise ConfigurationError(f"{limit}: name one log, not {_listed(logs)}")


def _listed(logs: Sequence[Parts]) -> str:
    return f"{len(logs)} ({', '.join(parts[0].name for parts in logs[:3])}{', ...' if len(logs) > 3 else ''})"


def _files(names: Sequence[Path]) -> Iterator[Path]:
    for name in names:
        if name.name == LAST and not os.access(name, os.F_OK):  # without permission, Path.exists raises an error
            yield from _newest(name.parent if len(name.parts) > 1 else Path(Recorder().folder))
        else:
            yield name


def _newest(folder: Path) -> list[Path]:
    """Files of the newest log of a folder, in order; the newest log has the latest time in its name."""
    hint = f"the newest log of another folder is FOLDER/{LAST}"
    try:
        files = {path: match for path in folder.iterdir() if (match := _LOG_NAME.fullmatch(path.name))}
    except OSError as fault:
        raise DataFileError(
            f"`{LAST}` is the newest log in {folder}, which cannot be read: {fault.strerror}; {hint}"
        ) from None
    if not files:
        raise DataFileError(f"`{LAST}` is the newest log in {folder}, and there is none; {hint}")
    rank = {}
    for path, match in files.items():
        time, repeat, suffix, part = match.groups()
        rank[path] = time, int(repeat or 1), not (suffix or part), suffix == "-recovered", bool(part)
    # Of several files with the same time and number, prefer a finished log, then a recovered one, then an unfinished.
    preferred = {rank[path][:2]: path for path in sorted(files, key=rank.__getitem__)}
    newest = preferred.pop(max(preferred))
    recording, number = _recording_and_number(newest)
    parts = {number: newest}
    for path in preferred.values():
        if number > 1 and path.name >= recording[-1].partition("Z")[0]:  # not older than the recording
            key, other = _recording_and_number(path)
            if key == recording:
                parts[other] = path
    return [parts[part] for part in sorted(parts)]


def _recording_and_number(path: Path) -> tuple[tuple[str, ...], int]:
    """Recording of a file, and the file's number in it; () and 1 for a file that is unreadable or of version 0.1."""
    try:
        metadata = metadata_at_start(path)
    except DataFileError:
        return (), 1  # reading the file raises this again
    entries = metadata.get(PART, {})
    number, recording = entries.get("number", ""), entries.get("of", "")
    if not recording or not re.fullmatch("[1-9][0-9]{0,8}", number):
        return (), 1
    return (metadata.get("lowfc", {}).get("run", ""), recording), int(number)
