"""A thousand damaged logs: no crash, no hang, no message that was not sent, and nothing is missing without a word."""

import struct
from itertools import pairwise
from pathlib import Path

import pytest
from mcap.writer import MCAP0_MAGIC as MAGIC

from lowfc.adapters.logs.reader import Logged, LogReader
from lowfc.adapters.logs.records import LogFile
from lowfc.contract.errors import DataFileError
from tests.support.mutated_logs import MISPLACED, MUTATIONS, boundaries, identity, mutations, small_log, small_samples

Message = tuple[str, bytes, int, int, int]
SENT: list[Message] = identity(small_samples())


def read_of(reader: LogReader) -> tuple[list[Message], str]:
    """What a reader delivers, and how it complains."""
    read: list[Logged] = []
    try:
        read.extend(reader)
    except DataFileError as error:
        return identity(read), str(error)
    return identity(read), ""


@pytest.mark.parametrize("finished", [True, False])
def test_no_damage_passes_for_a_message(tmp_path: Path, finished: bool) -> None:
    data = small_log(tmp_path / "whole.mcap", finished=finished).read_bytes()
    assert len(boundaries(data)) > 50
    path, kept = tmp_path / "mutated.mcap", 0
    for number, kind, changed in mutations(data, range(finished, MUTATIONS, 2)):
        path.write_bytes(changed)
        case = f"mutation {number}: {kind}"
        strictly, refusal = read_of(LogReader(path))
        reader = LogReader(path, skip_damaged=True)
        read, nothing = read_of(reader)
        assert not refusal or str(path) in refusal, case
        assert not nothing or (refusal and not read and "is not an MCAP file" in nothing), case
        assert strictly == read[: len(strictly)], case
        assert set(SENT).issuperset(read), case
        assert len(set(read)) == len(read), case
        kept += len(read)
        assert bool(refusal) == bool(nothing or reader.damage or reader.unreadable), case
        assert refusal or not (finished and reader.complete), f"{case}: it passes for whole"
        if read != SENT and (finished or kind not in MISPLACED):
            broken_off = not reader.complete and read == SENT[: len(read)]
            assert refusal or broken_off, f"{case}: something is missing without a word"
    assert kept > 0.5 * len(SENT) * MUTATIONS / 2, "nearly nothing was read: the test is of no use"


def heads(size: int, magic: bytes) -> bytes:
    """Heads of chunks, one every 64 bytes, each of a chunk that takes almost the rest of the file."""
    made = b""
    for at in range(0, size, 64):
        length = max(size - at - 9, 43)
        told = struct.pack("<QQQII3sQ", 0, 0, length, 0, 3, b"lz4", length - 43)
        made += (struct.pack("<BQ", 6, length) + told + magic).ljust(64, b"\0")
    return made


def between(size: int, sound: bytes) -> bytes:
    """Sound chunks, each followed by a record that takes almost the rest of the file."""
    made = b""
    while len(made) < size:
        made += sound
        made += struct.pack("<BQ", 12, max(size - len(made) - 100, 0))
    return made


@pytest.mark.parametrize("kind", ["heads", "heads of frames", "sound chunks between", "sound chunks and zeros"])
def test_a_file_made_to_mislead_is_read_only_a_few_times(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    data = small_log(tmp_path / "whole.mcap", finished=False).read_bytes()
    sound = min((data[a:b] for a, b in pairwise(boundaries(data)) if data[a] == 6), key=len)
    size = 1 << 19
    hostile = {
        "heads": heads(size, b""),
        "heads of frames": heads(size, b"\x04\x22\x4d\x18"),
        "sound chunks between": between(size, sound),
        "sound chunks and zeros": (sound + bytes(100)) * (size // (len(sound) + 100)),
    }[kind]
    path = tmp_path / "hostile.mcap"
    path.write_bytes(MAGIC + b"\x7f" + hostile)
    total, read = 0, LogFile._read

    def counted(file: LogFile, at: int, length: int) -> bytes:
        nonlocal total
        found = read(file, at, length)
        total += len(found)
        return found

    monkeypatch.setattr(LogFile, "_read", counted)
    reader = LogReader(path, skip_damaged=True)
    read_of(reader)
    assert not reader.complete
    assert total < 12 * path.stat().st_size
