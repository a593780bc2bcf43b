"""Log files: written and read again, damaged, truncated, read while they grow, and never overwritten."""

import dataclasses
import errno
import tracemalloc
import zlib
from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import lz4.frame
import pytest
from mcap.data_stream import RecordBuilder
from mcap.reader import make_reader
from mcap.records import Attachment as AttachmentRecord
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC as MAGIC
from mcap.writer import CompressionType, Writer
from mcap_protobuf.decoder import DecoderFactory

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.logs import writer
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.writer import UNFINISHED, LogWriter, log_path
from lowfc.contract.envelope import sequence_of, start_of
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import COMMAND, STEP, TOPICS
from tests.support.mutated_logs import (
    ATTACHMENTS,
    METADATA,
    START_NS,
    START_S,
    changed,
    chunks_of,
    flipped,
    small_log,
    small_samples,
)

SENT = small_samples()


def written(path: Path, messages: list[Sample]) -> Path:
    log = LogWriter(path, START_NS, METADATA, ATTACHMENTS)
    for sample in messages:
        log.write(sample)
    return log.finish({})


def test_a_written_log_is_read_back(tmp_path: Path) -> None:
    reader = LogReader(small_log(tmp_path / "logs" / "a.mcap"))
    read = list(reader)
    assert read == SENT
    assert {reader.schema_of(m) for m in read} >= {"foxglove.RawImage", "lowfc.v1.ControlStep"}
    assert reader.complete
    assert reader.metadata == {**METADATA, "recording": {"messages": str(len(SENT))}}
    assert reader.attachments == {attachment.name: attachment.data for attachment in ATTACHMENTS}
    assert [path.name for path in (tmp_path / "logs").iterdir()] == ["a.mcap"]


def test_every_topic_is_decodable_by_other_readers_without_lowfc(tmp_path: Path) -> None:
    messages = [
        Sample(topic.at("dm"), topic.message().SerializeToString() or b"", sequence_of(START_S, 5), START_NS, START_NS)
        for topic in TOPICS
    ] + small_samples(2)[:2]
    path = written(tmp_path / "a.mcap", messages)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = list(reader.iter_decoded_messages())
        assert {channel.topic for _, channel, _, _ in decoded} == {"/" + topic.at("dm") for topic in TOPICS}
        assert {m.sequence for _, _, m, _ in decoded} == {0, 5}
        (step,) = (body for _, c, m, body in decoded if c.topic == "/lowfc/control/step" and m.sequence == 0)
        assert list(step.error_nm) == [1.5, -2.0]
        summary = reader.get_summary()
    assert summary.statistics.message_count == len(messages)
    command = next(c for c in summary.channels.values() if c.topic == "/" + COMMAND.at("dm"))
    assert command.metadata == {"description": COMMAND.description, "publisher": "controller", "start_s": str(START_S)}
    assert all(schema.encoding == "protobuf" and schema.data for schema in summary.schemas.values())


def test_metadata_and_attachments_precede_the_messages_and_chunks_are_small(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", small_samples(400))
    with path.open("rb") as file:
        records = list(StreamReader(file, emit_chunks=True, validate_crcs=True).records)
    kinds = [type(record) for record in records]
    assert kinds[1:4] == [Metadata, AttachmentRecord, AttachmentRecord]
    assert kinds.index(Chunk) == 4
    chunks = [record for record in records if isinstance(record, Chunk)]
    assert len(chunks) > 3
    assert all(chunk.uncompressed_size <= 256 * 1024 and chunk.uncompressed_crc for chunk in chunks)
    assert {chunk.compression for chunk in chunks} == {"lz4"}
    assert Channel not in kinds[: kinds.index(Chunk)]


def test_a_truncated_log_yields_its_complete_chunks(tmp_path: Path) -> None:
    data = small_log(tmp_path / "whole.mcap").read_bytes()
    cut, counts = tmp_path / "cut.mcap", []
    for size in [*range(1, 40), *range(40, len(data), 1001), *range(len(data) - 40, len(data) + 1)]:
        cut.write_bytes(data[:size])
        reader = LogReader(cut)
        counts.append(len(list(reader)))
        assert reader.finished == reader.complete == (size == len(data))
    assert counts == sorted(counts)
    assert (counts[0], counts[-1]) == (0, len(SENT))
    assert len(set(counts)) > 3


def serialised(records: Iterable[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return builder.end()


def crafted(path: Path, *records: McapRecord) -> Path:
    """Write an unfinished file of these records."""
    path.write_bytes(MAGIC + serialised(records))
    return path


def chunk(*records: McapRecord, **changes: Any) -> Chunk:
    return lz4_chunk(serialised(records), **changes)


def lz4_chunk(content: bytes, **changes: Any) -> Chunk:
    intact = Chunk("lz4", lz4.frame.compress(content), 0, 0, zlib.crc32(content), len(content))
    return dataclasses.replace(intact, **changes)


STEPS = Schema(id=1, data=b"", encoding="protobuf", name="lowfc.v1.ControlStep")
CHANNEL = Channel(1, "/lowfc/control/step", "protobuf", {"start_s": "7"}, 1)


def message(number: int, channel: int = 1) -> Message:
    return Message(channel, START_NS, b"x", START_NS, number)


def test_damage_is_detected_and_can_be_skipped(tmp_path: Path) -> None:
    path = small_log(tmp_path / "a.mcap")
    begin, end = chunks_of(path)[1]
    flipped(path, (begin + end) // 2, 4)
    error = rf"is damaged at byte {begin} \((the checksum of a chunk is wrong|a chunk cannot be decompressed)\)"
    with pytest.raises(DataFileError, match=error):
        list(LogReader(path))
    reader = LogReader(path, skip_damaged=True)
    read = list(reader)
    assert 60 < len(read) < len(SENT)
    assert (len(reader.damage), reader.unreadable, reader.complete) == (1, 0, True)
    damage = reader.damage[0]
    assert (damage.position, damage.length) == (begin, end - begin)
    times = [m.receive_time_ns for m in read]
    assert (damage.after_ns, damage.before_ns) in pairwise(times)
    assert damage.before_ns - damage.after_ns == max(b - a for a, b in pairwise(times))


def test_the_summary_replaces_the_declarations_of_a_damaged_chunk(tmp_path: Path) -> None:
    path = small_log(tmp_path / "a.mcap")
    (begin, end), *_ = chunks_of(path)
    flipped(path, (begin + end) // 2)  # the first chunk declares frames and steps of the first start
    reader = LogReader(path, skip_damaged=True)
    read = list(reader)
    assert 60 < len(read) < len(SENT)
    assert (len(reader.damage), reader.unreadable) == (1, 0)
    path.write_bytes(path.read_bytes()[: chunks_of(path)[-1][1]])
    reader = LogReader(path, skip_damaged=True)
    assert not any((sample.key, start_of(sample.sequence)) == (STEP.key, START_S) for sample in reader)
    assert len(reader.damage) == 1
    assert reader.unreadable > 20


@pytest.mark.parametrize(
    ("at", "new"),
    [
        (0, b"\x07"),  # opcode of a message index
        (0, b"\x86"),  # opcode of a private record
        (0, b"\x03"),  # opcode of a schema, which outside a chunk has no checksum
        (1, b"\x00"),  # the chunk's length, as in the next three
        (4, b"\x01"),  # 16 MB longer
        (6, b"\xff"),
        (8, b"\xff"),
        (25, bytes(12)),  # size and checksum of an empty chunk
        (32, b"\xff"),  # size: more than the memory
        (33, bytes(4)),  # checksum 0, which means none
        (41, b"zzz"),  # name of the compression
        (44, b"\x00\x01"),  # length of the compressed content
    ],
)
@pytest.mark.parametrize("finished", [True, False])
def test_a_damaged_chunk_header_loses_only_its_chunk(tmp_path: Path, at: int, new: bytes, finished: bool) -> None:
    path = small_log(tmp_path / "a.mcap")
    whole = list(LogReader(path))
    chunks = chunks_of(path)
    if not finished:
        path.write_bytes(path.read_bytes()[: chunks[-1][1]])
    cut = tmp_path / "cut.mcap"
    counts = []
    for end in chunks[3]:
        cut.write_bytes(path.read_bytes()[:end])
        counts.append(len(list(LogReader(cut))))
    before, after = counts
    changed(path, chunks[3][0] + at, new)
    with pytest.raises(DataFileError, match=rf"is damaged at byte {chunks[3][0]} "):
        list(LogReader(path))
    reader = LogReader(path, skip_damaged=True)
    read = list(reader)
    assert reader.damage[0].position == chunks[3][0]
    assert read == whole[:before] + whole[after:]
    assert before < after < len(whole)


def test_a_damaged_attachment_is_left_out_and_damaged_metadata_are_reported(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", SENT[:8])
    data = path.read_bytes()
    flipped(path, data.index(b"[loop]"))
    path.write_bytes(path.read_bytes()[: chunks_of(path)[-1][1]])  # without the summary, which would reveal the damage
    with pytest.raises(DataFileError, match="the checksum of an attachment is wrong"):
        list(LogReader(path))
    reader = LogReader(path, skip_damaged=True)
    assert len(list(reader)) == 8
    assert (list(reader.attachments), len(reader.damage)) == (["h.fits"], 1)
    path.write_bytes(data)
    flipped(path, data.index(b"night"))  # metadata have no checksum of their own
    for sparse in (False, True):  # `sparse` skips no chunk here, because all topics are read
        with pytest.raises(DataFileError, match="its parts are intact, but"):
            list(LogReader(path, sparse=sparse))


DECLARED = chunk(STEPS, CHANNEL, message(0))
DIFFERENT_DECLARATIONS = [
    dataclasses.replace(CHANNEL, topic="/lowfc/camera/frame"),
    dataclasses.replace(CHANNEL, metadata={"start_s": "8"}),
    dataclasses.replace(STEPS, name="lowfc.v1.Truth"),
]
INVALID_STARTS = ["", "-1", "7.0", "seven", "\u0667", "9" * 30, "9" * 10]
INVALID_LENGTHS = [
    b"\x05",
    b"\x05" + b"\xff" * 8,
    b"\x05" + bytes(20),
    b"\x05" + (23).to_bytes(8, "little") + b"\x01" + bytes(21),
    b"\x04\x01" + bytes(8),
    b"\x03" + b"\x7f" * 20,
]


@pytest.mark.parametrize(
    ("records", "error", "delivered"),
    [
        *(
            ([DECLARED, chunk(record, message(1)), chunk(message(2))], "1 is declared a second", [0, 2])
            for record in DIFFERENT_DECLARATIONS
        ),
        *(
            ([chunk(STEPS, dataclasses.replace(CHANNEL, metadata={"start_s": start}), message(0))], "1 has start_s", [])
            for start in INVALID_STARTS
        ),
        ([DECLARED, message(1), chunk(message(2))], "outside the chunks", [0, 2]),
        (
            [chunk(STEPS, CHANNEL, message(0), message(1, channel=2))],
            "the record of a channel or schema is missing",
            [0],
        ),
        *(([DECLARED, lz4_chunk(records), chunk(message(2))], "is damaged", [0, 2]) for records in INVALID_LENGTHS),
    ],
)
def test_contradictory_or_unchecked_records_are_damage(
    tmp_path: Path, records: list[McapRecord], error: str, delivered: list[int]
) -> None:
    """Such a record contradicts the first declaration, or has a bad start, no checksum or an impossible length."""
    path = crafted(tmp_path / "a", *records)
    with pytest.raises(DataFileError, match=error):
        list(LogReader(path))
    reader = LogReader(path, skip_damaged=True)
    assert [(reader.schema_of(sample), sample.sequence) for sample in reader] == [
        ("lowfc.v1.ControlStep", sequence_of(7, count)) for count in delivered
    ]
    assert len(reader.damage) + reader.unreadable == 1


def test_an_invalid_declaration_in_the_summary_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4, enable_data_crcs=True)
        writer.start()
        schema = writer.register_schema(STEPS.name, STEPS.encoding, b"")
        writer.register_channel(CHANNEL.topic, "protobuf", schema, {"start_s": "seven"})
        writer.add_message(1, START_NS, b"x", START_NS)
        writer.finish()
    with pytest.raises(DataFileError, match="channel 1 has start_s 'seven'"):
        list(LogReader(path))
    assert list(LogReader(path, skip_damaged=True)) == []


def test_a_decompression_bomb_does_not_fill_the_memory(tmp_path: Path) -> None:
    zeros = bytes(60_000_000)
    bomb = dataclasses.replace(lz4_chunk(zeros), uncompressed_size=1000)
    oversized = chunk(STEPS, uncompressed_size=1 << 40)
    path = crafted(tmp_path / "a", DECLARED, bomb, oversized)
    del zeros
    long = crafted(tmp_path / "b", DECLARED)
    with long.open("ab") as file:
        file.write(b"\x06" + (300_000_000).to_bytes(8, "little"))
        file.truncate(long.stat().st_size + 300_000_100)
    tracemalloc.start()
    try:
        for log, damaged in ((path, 2), (long, 1)):
            reader = LogReader(log, skip_damaged=True)
            assert len(list(reader)) == 1
            assert len(reader.damage) == damaged
        assert tracemalloc.get_traced_memory()[1] < 20_000_000
    finally:
        tracemalloc.stop()


def test_memory_does_not_grow_with_the_log(tmp_path: Path) -> None:
    peaks = []
    for number, count in enumerate((200, 200, 2000)):  # the first fills caches
        path = written(tmp_path / f"{number}.mcap", messages := small_samples(count))
        tracemalloc.start()
        assert sum(1 for _ in LogReader(path)) == len(messages)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] < 1.1 * peaks[1]


def test_only_requested_topics_are_delivered(tmp_path: Path) -> None:
    path = small_log(tmp_path / "a.mcap")
    everything = list(LogReader(path))
    reader = LogReader(path, topics=(STEP, COMMAND))
    assert list(reader) == [m for m in everything if m.key == STEP.key]
    assert reader.complete
    assert list(LogReader(path, topics=())) == []
    flipped(path, (sum(chunks_of(path)[1]) // 2))
    with pytest.raises(DataFileError, match="is damaged"):
        list(LogReader(path, topics=()))


def test_a_growing_log_is_read_up_to_its_size_at_opening(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "a.mcap", START_NS, METADATA, ATTACHMENTS)
    messages = SENT[:40]
    for sample in messages[:20]:
        log.write(sample)
    log.flush()
    reading = iter(reader := LogReader(tmp_path / f"a.mcap{UNFINISHED}"))
    read = [next(reading)]
    for sample in messages[20:]:
        log.write(sample)
    log.finish({})
    read += reading
    assert [m.payload for m in read] == [s.payload for s in messages[:20]]
    assert (reader.complete, reader.finished, reader.damage) == (False, False, [])


def test_a_log_is_never_overwritten(tmp_path: Path) -> None:
    paths = []
    for _ in range(3):
        paths.append(log_path(tmp_path, START_NS))
        written(paths[-1], [])
    assert [path.name for path in paths] == [f"20260101T000000Z{number}.mcap" for number in ("", "-2", "-3")]
    LogWriter(tmp_path / "b.mcap", START_NS, {}).abandon()
    for name in (paths[0].name, "b.mcap"):
        with pytest.raises(DataFileError, match="never overwritten"):
            LogWriter(tmp_path / name, START_NS, {})


def test_a_log_that_cannot_be_begun_leaves_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")
    monkeypatch.setattr(writer._File, "write", Mock(side_effect=full))
    with pytest.raises(DataFileError, match=r"No space left on device\) after 0 bytes; .*; the file was removed"):
        LogWriter(tmp_path / "a.mcap", START_NS, {})
    assert not list(tmp_path.iterdir())


def test_the_path_of_a_log_finished_meanwhile_is_not_reused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = LogWriter(log_path(tmp_path, START_NS), START_NS, {})
    exists = Path.exists

    def finish_after_check(path: Path) -> bool:
        exists_now = exists(path)
        if not exists(log.path):
            log.finish({})
        return exists_now

    monkeypatch.setattr(Path, "exists", finish_after_check)
    assert log_path(tmp_path, START_NS).name == "20260101T000000Z-2.mcap"
