"""Damaged and rewritten logs: reading neither crashes, nor yields a message that was never sent, nor hides a loss."""

import dataclasses
import io
import os
import struct
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC as MAGIC
from mcap.writer import CompressionType, Writer

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs.log_copy import LogCopy
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.records import LogFile
from lowfc.adapters.logs.recovery import recover
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import STEP
from lowfc.programs.logs.survey import survey
from tests.support.mutated_logs import (
    ATTACHMENTS,
    METADATA,
    MISPLACED,
    MUTATIONS,
    boundaries,
    changed,
    chunks_of,
    flipped,
    mutated,
    small_log,
    small_samples,
)

SENT = small_samples()


def read_of(reader: LogReader) -> tuple[list[Sample], str]:
    """Messages that a reader delivers, and the text of its error; an empty text without an error."""
    read: list[Sample] = []
    try:
        read.extend(reader)
    except DataFileError as error:
        return read, str(error)
    return read, ""


@pytest.mark.parametrize("finished", [True, False])
def test_a_damaged_log_yields_no_false_message_and_no_silent_loss(tmp_path: Path, finished: bool) -> None:
    data = small_log(tmp_path / "whole.mcap", finished=finished).read_bytes()
    assert len(boundaries(data)) > 50
    path, delivered = tmp_path / "mutated.mcap", 0
    for number in range(finished, MUTATIONS, 2):
        kind, content = mutated(data, number)
        path.write_bytes(content)
        case = f"mutation {number}: {kind}"
        read_strictly, strict_error = read_of(LogReader(path))
        reader = LogReader(path, skip_damaged=True)
        read, error = read_of(reader)
        assert not strict_error or str(path) in strict_error, case
        assert not error or (strict_error and not read and "is not an MCAP file" in error), case
        assert read_strictly == read[: len(read_strictly)], case
        assert set(SENT).issuperset(read), case
        assert len(set(read)) == len(read), case
        delivered += len(read)
        assert bool(strict_error) == bool(error or reader.damage or reader.unreadable), case
        assert strict_error or not (finished and reader.complete), f"{case}: the log should not count as intact"
        if read != SENT and (finished or kind not in MISPLACED):
            truncated = not reader.complete and read == SENT[: len(read)]
            assert strict_error or truncated, f"{case}: the loss should be reported"
    assert delivered > 0.5 * len(SENT) * MUTATIONS / 2, "too little was read for a meaningful test"


def chunk_headers(size: int, content: bytes) -> bytes:
    """A chunk header every 64 bytes, each of a chunk that begins with `content` and is said to end near the end."""
    file = b""
    for at in range(0, size, 64):
        length = max(size - at - 9, 43)
        fields = struct.pack("<QQQII3sQ", 0, 0, length, 0, 3, b"lz4", length - 43)
        file += (struct.pack("<BQ", 6, length) + fields + content).ljust(64, b"\0")
    return file


def chunks_and_long_records(size: int, chunk: bytes) -> bytes:
    """Copies of an intact chunk, each followed by a record whose stated length is almost the rest of the file."""
    file = b""
    while len(file) < size:
        file += chunk
        file += struct.pack("<BQ", 12, max(size - len(file) - 100, 0))
    return file


@pytest.mark.parametrize("kind", ["headers", "headers and LZ4 frames", "chunks and long records", "chunks and zeros"])
def test_a_malicious_file_is_read_only_a_few_times(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    data = small_log(tmp_path / "whole.mcap", finished=False).read_bytes()
    chunk = min((data[a:b] for a, b in pairwise(boundaries(data)) if data[a] == 6), key=len)
    size = 1 << 19
    hostile = {
        "headers": chunk_headers(size, b""),
        "headers and LZ4 frames": chunk_headers(size, b"\x04\x22\x4d\x18"),
        "chunks and long records": chunks_and_long_records(size, chunk),
        "chunks and zeros": (chunk + bytes(100)) * (size // (len(chunk) + 100)),
    }[kind]
    path = tmp_path / "hostile.mcap"
    path.write_bytes(MAGIC + b"\x7f" + hostile)
    bytes_read, read = 0, LogFile._read

    def counted(file: LogFile, at: int, length: int) -> bytes:
        nonlocal bytes_read
        data = read(file, at, length)
        bytes_read += len(data)
        return data

    monkeypatch.setattr(LogFile, "_read", counted)
    reader = LogReader(path, skip_damaged=True)
    read_of(reader)
    assert not reader.complete
    assert bytes_read < 12 * path.stat().st_size


def rewritten(source: Path, out: Path, options: dict[str, Any]) -> Path:
    """The same log, written by Python's MCAP library with other options."""
    with out.open("wb") as stream:
        copy = LogCopy(io.BytesIO())
        copy._writer = Writer(stream, chunk_size=8192, **{k: v for k, v in options.items() if k != "library"})
        copy._writer.start(library=options.get("library", "another tool"))
        copy.add_file(LogReader(source))
        copy.finish()
    return out


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return small_log(tmp_path / "source.mcap")


NO_CRCS = {"enable_crcs": False}
NO_CHUNKS = {"use_chunking": False}


@pytest.mark.parametrize(
    "options",
    [
        *({"compression": compression} for compression in CompressionType),
        *({"compression": compression} | NO_CRCS for compression in CompressionType),
        {"compression": CompressionType.ZSTD, "use_statistics": False, "use_summary_offsets": False},
        NO_CHUNKS,
        NO_CHUNKS | NO_CRCS,
        NO_CHUNKS | {"enable_data_crcs": True},
        NO_CHUNKS | {"library": "lowfc 0.1.0"},  # the header names the library that wrote the original
        {"compression": CompressionType.ZSTD, "library": "lowfc 0.1.0"},
    ],
    ids=str,
)
def test_a_rewritten_log_is_read_as_the_original(tmp_path: Path, source: Path, options: dict[str, Any]) -> None:
    path = rewritten(source, tmp_path / "rewritten.mcap", options)
    reader = LogReader(path)
    assert sorted(reader) == sorted(SENT)
    assert (reader.damage, reader.unreadable, reader.finished, reader.complete) == ([], 0, True, True)
    assert reader.metadata == METADATA | {"recording": {"messages": str(len(SENT))}}
    assert reader.attachments == {attachment.name: attachment.data for attachment in ATTACHMENTS}
    assert survey(path)["state"] == "complete"
    assert recover(path, tmp_path / "recovered.mcap").recovered is None


def test_a_channel_that_another_tool_added_without_a_schema_is_read_and_copied(tmp_path: Path) -> None:
    path = tmp_path / "merged.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start(library="another tool")
        channel = writer.register_channel("/diagnostics", "json", 0)
        writer.add_message(channel, 5, b"{}", 5)
        writer.finish()
    path.write_bytes(path.read_bytes()[:-1])  # unfinished
    copied = recover(path, tmp_path / "copied.mcap").recovered
    for log in (path, copied):
        (message,) = (reader := LogReader(log))
        assert (message.key, message.payload, reader.schema_of(message)) == ("diagnostics", b"{}", "")
    assert survey(copied)["state"] == "complete"


def test_a_log_is_recovered_on_a_file_system_without_permissions(
    tmp_path: Path, source: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On FAT, for example, chmod fails."""
    os.truncate(source, source.stat().st_size - 1)
    out, chmod = tmp_path / "recovered.mcap", Path.chmod
    refused = Mock(side_effect=PermissionError(1, "Operation not permitted"))
    monkeypatch.setattr(Path, "chmod", lambda path, mode: (refused if path == out else chmod)(path, mode))
    assert recover(source, out).messages == len(SENT)
    assert refused.called


@pytest.mark.parametrize("compression", CompressionType)
@pytest.mark.parametrize("at", [8, 60])  # offset in the chunk's record: of its length, or of its content
@pytest.mark.parametrize("finished", [True, False])
def test_only_the_damaged_chunk_of_a_rewritten_log_is_lost(
    tmp_path: Path, source: Path, compression: CompressionType, at: int, finished: bool
) -> None:
    path = rewritten(source, tmp_path / "rewritten.mcap", {"compression": compression})
    chunks = chunks_of(path)
    assert len(chunks) > 10
    if not finished:
        os.truncate(path, chunks[-1][1])
    changed(path, chunks[5][0] + at, b"\xff")
    reader = LogReader(path, skip_damaged=True)
    read = list(reader)
    assert set(SENT).issuperset(read)
    assert len(SENT) / 2 < len(read) < len(SENT)
    assert reader.damage[0].position == chunks[5][0]
    assert sum(damage.length for damage in reader.damage) < chunks[6][0] - chunks[5][0] + 1
    recovered = recover(path, tmp_path / "recovered.mcap").recovered
    assert list(LogReader(recovered)) == read


@pytest.mark.parametrize(
    ("opcode", "at", "new"),
    [
        (Opcode.SCHEMA, 1, (1 << 40).to_bytes(8, "little")),
        (Opcode.SCHEMA, 1, (1 << 63).to_bytes(8, "little")),
        (Opcode.CHUNK_INDEX, 1, (1 << 40).to_bytes(8, "little")),
        (Opcode.CHUNK_INDEX, 41, b"\xff" * 4),  # size of its list of message indexes
    ],
)
def test_a_summary_without_checksum_is_used_up_to_a_damaged_record(
    tmp_path: Path, source: Path, opcode: Opcode, at: int, new: bytes
) -> None:
    path = rewritten(source, tmp_path / "rewritten.mcap", NO_CRCS)
    data = path.read_bytes()
    changed(path, next(start for start in boundaries(data) if data[start] == opcode) + at, new)
    assert sorted(LogReader(path)) == sorted(SENT)
    with LogFile(path) as file:
        assert list(file.index()) == []


@pytest.mark.parametrize("bytes_cut_from_each", [(0, 0), (0, 500), (40_000, 0), (40_000, 500), (60_000, 100_000)])
def test_of_two_logs_in_one_file_the_first_is_read_and_the_second_reported(
    tmp_path: Path, source: Path, bytes_cut_from_each: tuple[int, int]
) -> None:
    """The second log is not read with the channels of the first, even if the first was cut when its recorder died."""
    first = (whole := source.read_bytes())[: len(whole) - bytes_cut_from_each[0]]
    second = rewritten(source, tmp_path / "second.mcap", {}).read_bytes()
    second = second[: len(second) - bytes_cut_from_each[1]]
    source.write_bytes(first)
    expected = list(LogReader(source))
    source.write_bytes(first + second)
    reader = LogReader(source, skip_damaged=True)
    assert list(reader) == expected
    damage = reader.damage[-1]
    assert len(reader.damage) == 1 + bool(bytes_cut_from_each[0])
    assert (damage.position, damage.length) == (len(first), len(second))
    command = f"`tail -c +{len(first) + 1} {source.name} > second.mcap`"
    assert damage.why == f"it is another log, appended to this one; {command} copies it"


def test_a_file_appended_to_a_log_is_damage(source: Path) -> None:
    log = source.read_bytes()
    source.write_bytes(log + b"no log" + log[-8:])
    reader = LogReader(source, skip_damaged=True)
    assert list(reader) == SENT
    assert [damage.why for damage in reader.damage] == ["the summary is damaged, or another file was appended"]


def test_a_message_index_of_an_impossible_length_is_damage_even_if_chunks_are_skipped(source: Path) -> None:
    data = source.read_bytes()
    begin = next(start for start in boundaries(data) if data[start] == Opcode.MESSAGE_INDEX)
    changed(source, begin + 1, (1 << 63).to_bytes(8, "little"))
    reader = LogReader(source, topics=(STEP,), sparse=True, skip_damaged=True)
    assert sum(1 for _ in reader)
    assert [damage.why for damage in reader.damage] == ["a record has an impossible length"]


def test_unchunked_messages_are_covered_by_the_data_checksum_and_read_up_to_a_truncation(
    tmp_path: Path, source: Path
) -> None:
    path = rewritten(source, tmp_path / "rewritten.mcap", NO_CHUNKS | {"enable_data_crcs": True})
    flipped(path, middle := path.stat().st_size // 2)
    reader = LogReader(path, skip_damaged=True)
    assert len(list(reader)) == len(SENT)
    assert [damage.why.partition(",")[0] for damage in reader.damage] == ["its parts are intact"]
    os.truncate(path, middle)
    reader = LogReader(path)
    read = list(reader)
    assert len(SENT) / 4 < len(read) < len(SENT)
    assert set(SENT).issuperset(read)
    assert not reader.complete


@pytest.mark.parametrize("skip_damaged", [True, False])
def test_an_unsupported_compression_is_reported_with_its_name(tmp_path: Path, source: Path, skip_damaged: bool) -> None:
    path, builder = tmp_path / "rewritten.mcap", RecordBuilder()
    with rewritten(source, path, {}).open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            if isinstance(record, Chunk):
                record = dataclasses.replace(record, compression="brotli")
            record.write(builder)
    path.write_bytes(MAGIC + builder.end() + MAGIC)
    with pytest.raises(DataFileError) as caught:
        list(LogReader(path, skip_damaged=skip_damaged))
    assert str(caught.value) == (
        f"{path} is compressed with 'brotli'; lz4, zstd and no compression are supported: "
        "compress it again with `mcap compress --compression zstd`"
    )
