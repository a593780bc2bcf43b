"""A thousand damaged logs: no crash, no hang, no message that was not sent, and nothing is missing without a word."""

from pathlib import Path

import pytest
from mutated_logs import MISPLACED, MUTATIONS, boundaries, identity, mutations, small_log, small_samples

from lowfc.adapters.log_reader import Logged, LogReader
from lowfc.contract.errors import DataFileError

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
