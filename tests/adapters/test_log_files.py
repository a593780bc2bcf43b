import resource
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Attachment as AttachmentRecord
from mcap.records import Channel, Chunk, Metadata
from mcap.stream_reader import StreamReader
from mcap_protobuf.decoder import DecoderFactory

from lowfc.adapters.bus import Sample
from lowfc.adapters.envelope import sequence_of
from lowfc.adapters.log_reader import LogReader
from lowfc.adapters.log_writer import UNFINISHED, Attachment, LogWriter, log_path
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import COMMAND, EVENT, FRAME, STEP, TOPICS, image, timestamp, wire

START_S = 1_767_225_600
START_NS = START_S * 10**9
METADATA = {"lowfc": {"run": "night", "seed": "3"}}
ATTACHMENTS = (
    Attachment("lowfc.toml", "application/toml", b"[loop]\n"),
    Attachment("h.fits", "application/fits", b"F"),
)


def samples(count: int, start_s: int = START_S) -> list[Sample]:
    rng = np.random.default_rng(1)
    made = []
    for number in range(count):
        now = START_NS + number * 1_000_000
        frame = image(rng.integers(0, 4000, (80, 80), dtype=np.uint16), now, "sensor")
        step = wire.ControlStep(timestamp=timestamp(now), frame_sequence=number, error_nm=[1.5, -2.0])
        sequence = sequence_of(start_s, number)
        made += [
            Sample(FRAME.key, frame.SerializeToString(), sequence, now, now + 200),
            Sample(STEP.key, step.SerializeToString(), sequence, now + 300, now + 400),
        ]
    return made


def written(path: Path, messages: list[Sample]) -> Path:
    log = LogWriter(path, START_NS, METADATA, ATTACHMENTS)
    for sample in messages:
        log.write(sample)
    assert not path.exists()
    return log.finish({"recording": {"messages": str(log.messages)}})


@pytest.fixture
def small_disk() -> Iterator[int]:
    """A disk that takes no file above this size."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    limit = 1_000_000
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    yield limit
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    messages = samples(60) + samples(3, START_S + 1)
    reader = LogReader(written(tmp_path / "logs" / "a.mcap", messages))
    read = list(reader)
    assert [(m.key, m.payload, m.sequence, m.publish_time_ns, m.log_time_ns) for m in read] == [
        (s.key, s.payload, s.sequence, s.publish_time_ns, s.receive_time_ns) for s in messages
    ]
    assert {m.schema for m in read} == {"foxglove.RawImage", "lowfc.v1.ControlStep"}
    assert reader.complete
    assert reader.metadata == {**METADATA, "recording": {"messages": "126"}}
    assert reader.attachments == {"lowfc.toml": b"[loop]\n", "h.fits": b"F"}
    assert [path.name for path in (tmp_path / "logs").iterdir()] == ["a.mcap"]


def test_another_reader_understands_every_topic_from_the_log_alone(tmp_path: Path) -> None:
    messages = [
        Sample(topic.at("dm"), topic.message().SerializeToString() or b"", sequence_of(START_S, 5), START_NS, START_NS)
        for topic in TOPICS
    ] + samples(1)
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
    assert command.metadata == {
        "description": COMMAND.sentence,
        "publisher": "controller",
        "start_s": str(START_S),
    }
    assert all(schema.encoding == "protobuf" and schema.data for schema in summary.schemas.values())


def test_what_describes_a_log_stands_at_its_start_and_chunks_are_small(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", samples(80))
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


def test_a_log_cut_anywhere_yields_its_whole_chunks(tmp_path: Path) -> None:
    data = written(tmp_path / "whole.mcap", samples(60)).read_bytes()
    cut, found = tmp_path / "cut.mcap", []
    for size in [*range(40), *range(40, len(data), 3001), *range(len(data) - 40, len(data))]:
        cut.write_bytes(data[:size])
        reader = LogReader(cut)
        found.append(len(list(reader)))
        assert not reader.complete or size >= len(data) - 8  # without its last magic it lacks nothing
    assert found == sorted(found)
    assert (found[0], found[-1]) == (0, 120)
    assert len(set(found)) > 3


def test_what_was_flushed_survives_a_kill(tmp_path: Path) -> None:
    program = f"""
import os, sys
sys.path[:0] = {[str(Path(__file__).parent)]!r}
from pathlib import Path
from test_log_files import *
log = LogWriter(Path({str(tmp_path / "a.mcap")!r}), START_NS, METADATA, ATTACHMENTS)
for number, sample in enumerate(samples(50)):
    log.write(sample)
    if number == 79:
        log.flush()
os.kill(os.getpid(), 9)
"""
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == -9
    reader = LogReader(tmp_path / f"a.mcap{UNFINISHED}")
    assert 80 <= len(list(reader)) < 100
    assert (reader.complete, reader.metadata, len(reader.attachments)) == (False, METADATA, 2)


def test_damage_is_found_and_can_be_left_out(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", samples(60))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    with pytest.raises(DataFileError, match=r"is damaged \(crc"):
        list(LogReader(path))
    reader = LogReader(path, skip_damaged=True)
    assert 60 < len(list(reader)) < 120
    assert (reader.damaged_chunks, reader.unreadable) == (1, 0)


def test_messages_of_an_undeclared_channel_are_counted(tmp_path: Path) -> None:
    path = written(tmp_path / "a.mcap", samples(60))
    data = bytearray(path.read_bytes())
    with path.open("rb") as file:
        stream = StreamReader(file, emit_chunks=True)
        first = next(record for record in stream.records if isinstance(record, Chunk))
    data[data.index(first.data) + len(first.data) // 2] ^= 0x10  # the first chunk declares both channels
    path.write_bytes(data)
    reader = LogReader(path, skip_damaged=True)
    assert list(reader) == []
    assert reader.damaged_chunks == 1
    assert 0 < reader.unreadable < 120


def test_a_full_disk_is_one_error_and_leaves_a_readable_log(tmp_path: Path, small_disk: int) -> None:
    log = LogWriter(tmp_path / "a.mcap", START_NS, METADATA, ATTACHMENTS)
    messages = samples(200)

    def fill_up() -> None:
        for number, sample in enumerate(messages):
            log.write(sample)
            if number % 40 == 39:
                log.flush()

    with pytest.raises(DataFileError, match=r"a\.mcap\.part cannot be written \(File too large\)"):
        fill_up()
    part = tmp_path / f"a.mcap{UNFINISHED}"
    assert part.stat().st_size == log.bytes_written <= small_disk
    read = list(LogReader(part))
    assert len(read) >= 40
    assert [m.payload for m in read] == [s.payload for s in messages[: len(read)]]


def test_a_log_is_never_overwritten(tmp_path: Path) -> None:
    paths = []
    for _ in range(3):
        paths.append(log_path(tmp_path, START_NS))
        written(paths[-1], [])
    assert [path.name for path in paths] == [
        "20260101T000000Z.mcap",
        "20260101T000000Z-2.mcap",
        "20260101T000000Z-3.mcap",
    ]
    LogWriter(tmp_path / "b.mcap", START_NS, {}).abandon()
    for name in (paths[0].name, "b.mcap"):
        with pytest.raises(DataFileError, match="never overwritten"):
            LogWriter(tmp_path / name, START_NS, {})


def test_files_that_cannot_be_used_are_errors(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("this is not an MCAP file, by far")
    with pytest.raises(DataFileError, match="is not an MCAP file"):
        list(LogReader(tmp_path / "text"))
    with pytest.raises(DataFileError, match="cannot be read: No such file"):
        list(LogReader(tmp_path / "gone"))
    with pytest.raises(DataFileError, match="cannot be made"):
        LogWriter(tmp_path / "text" / "a.mcap", START_NS, {})


def test_an_unknown_key_is_refused(tmp_path: Path) -> None:
    log = LogWriter(tmp_path / "a.mcap", START_NS, {})
    with pytest.raises(KeyError, match="lowfc/nothing"):
        log.write(Sample("lowfc/nothing", b"", 0, 0, 0))
    log.write(Sample(EVENT.key, b"", 0, 0, 0))
    assert len(list(LogReader(log.finish({})))) == 1
