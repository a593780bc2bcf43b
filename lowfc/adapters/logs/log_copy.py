"""Copying logs message by message to a new log that is complete and indexed."""

import contextlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import IO

from mcap.records import Attachment, Metadata

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.files.whole_file import being_written
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.writer import begun_writer
from lowfc.contract.envelope import count_of, start_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.printable import encodable


class LogCopy:
    """A new log, to which the files of other logs are copied in turn.

    Attributes:
        messages: number of messages written so far.
        read: number of messages read from the files so far.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self.messages = self.read = 0
        self._channels: dict[tuple[str, int], int] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._writer = begun_writer(file)

    def add_metadata(self, name: str, entries: dict[str, str]) -> None:
        """Write a metadata record."""
        self._writer.add_metadata(name, {key: encodable(value) for key, value in entries.items()})

    def add_file(
        self,
        reader: LogReader,
        *,
        include: Callable[[Sample], bool] = lambda message: True,
        include_record: Callable[[Metadata | Attachment], bool] = lambda record: True,
    ) -> None:
        """Copy a file's messages, metadata and attachments, in their order.

        Args:
            reader: new reader of the file.
            include: decides whether to copy a message.
            include_record: decides whether to copy metadata or an attachment.
        """
        added = 0
        for message in reader:
            self._add_records(reader.records[added:], include_record)
            added = len(reader.records)
            self.read += 1
            if include(message):
                self._add_message(reader, message)
        self._add_records(reader.records[added:], include_record)

    def finish(self) -> None:
        """Write the index."""
        self._writer.finish()  # type: ignore[no-untyped-call]

    def _add_records(
        self, records: Sequence[Metadata | Attachment], include_record: Callable[[Metadata | Attachment], bool]
    ) -> None:
        for record in filter(include_record, records):
            if isinstance(record, Metadata):
                self._writer.add_metadata(record.name, record.metadata)
            else:
                self._writer.add_attachment(
                    record.create_time, record.log_time, record.name, record.media_type, record.data
                )

    def _add_message(self, reader: LogReader, message: Sample) -> None:
        publisher = message.key, start_of(message.sequence)
        if publisher not in self._channels:
            channel = reader.channels[publisher]
            schema_id = 0  # a channel of another tool may have no schema
            if channel.schema_id:
                schema = reader.schemas[channel.schema_id]
                identity = schema.name, schema.data
                if identity not in self._schemas:
                    self._schemas[identity] = self._writer.register_schema(schema.name, schema.encoding, schema.data)
                schema_id = self._schemas[identity]
            self._channels[publisher] = self._writer.register_channel(
                channel.topic, channel.message_encoding, schema_id, channel.metadata
            )
        self._writer.add_message(
            channel_id=self._channels[publisher],
            log_time=message.receive_time_ns,
            publish_time=message.publish_time_ns,
            sequence=count_of(message.sequence),
            data=message.payload,
        )
        self.messages += 1


def refuse_existing(path: Path) -> None:
    """Raise DataFileError if the file to be written exists already: a log is never overwritten."""
    if os.access(path, os.F_OK):
        raise DataFileError(f"{path} already exists; a log is never overwritten; name another one with --out")


@contextlib.contextmanager
def new_log(path: Path, source: Path) -> Iterator[IO[bytes]]:
    """Yield a file with the permissions of `source` that is renamed to `path` on success and removed on failure.

    Raises:
        DataFileError: the file exists already, or cannot be written.
    """
    refuse_existing(path)
    with being_written(path, source) as part, part.open("wb") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
        refuse_existing(path)  # created by another process meanwhile
    with contextlib.suppress(OSError):  # not every file system has permissions
        path.chmod(source.stat().st_mode & 0o666)
