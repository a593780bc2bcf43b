"""`lowfc recover`: the intact part of a damaged log becomes a complete log for every reader."""

from collections import Counter
from pathlib import Path
from unittest.mock import Mock

import pytest
from mcap.reader import make_reader

import lowfc.adapters.logs.recovery as recovery
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.recovery import recover, recovered_path
from lowfc.contract.errors import DataFileError
from tests.support.loops import json_of, lowfc
from tests.support.mutated_logs import ATTACHMENTS, flipped, mutated, small_log, small_samples
from tests.support.other_readers import foxglove, rerun

MUTATIONS = 120  # of complete and of unfinished logs together


@pytest.fixture(scope="module")
def recovered(tmp_path_factory: pytest.TempPathFactory) -> dict[Path, Counter[str]]:
    """Recovered logs, and the number of readable messages of each topic in the damaged ones."""
    folder = tmp_path_factory.mktemp("recovered")
    logs = {}
    for finished in (True, False):
        data = small_log(folder / f"whole-{finished}.mcap", finished=finished).read_bytes()
        for number in range(MUTATIONS // 2):
            kind, changed = mutated(data, number)
            source = folder / f"{finished}-{number}-{kind}.mcap"
            source.write_bytes(changed)
            reader = LogReader(source, skip_damaged=True)
            try:
                counts = Counter("/" + message.key for message in reader)
            except DataFileError:
                with pytest.raises(DataFileError):
                    recover(source, recovered_path(source))
                continue
            done = recover(source, recovered_path(source))
            assert source.read_bytes() == changed
            assert (done.messages, done.damage) == (counts.total(), reader.damage)
            logs[recovered_path(source)] = counts
    assert len(logs) > 0.9 * MUTATIONS
    return logs


def test_recovered_logs_are_complete(recovered: dict[Path, Counter[str]]) -> None:
    for path, counts in recovered.items():
        reader = LogReader(path)
        assert Counter("/" + message.key for message in reader) == counts
        assert reader.complete
        assert reader.metadata["recovery"]["messages"] == str(counts.total())
        with path.open("rb") as file:
            other = make_reader(file, validate_crcs=True)
            assert Counter(channel.topic for _, channel, _ in other.iter_messages()) == counts, path.name
            statistics = other.get_summary().statistics
            assert statistics.message_count == counts.total()
            assert statistics.attachment_count == len(list(other.iter_attachments()))


@pytest.mark.node
def test_foxglove_reads_recovered_logs_completely(recovered: dict[Path, Counter[str]]) -> None:
    logs = foxglove(recovered)
    assert [(log["counts"], log["counted"]) for log in logs] == [(sent, sent.total()) for sent in recovered.values()]
    assert all("recovery" in log["metadata"] for log in logs)


def test_rerun_reads_recovered_logs_completely(recovered: dict[Path, Counter[str]]) -> None:
    for path, counts in [(path, counts) for path, counts in recovered.items() if counts][::4]:
        checked = rerun("check", path)
        lines = [line.split() for line in rerun("info", path).splitlines()]
        assert ["Messages", str(counts.total())] in lines
        assert ["Summary", "embedded"] in lines
        listed: Counter[str] = Counter()
        for columns in lines:
            if len(columns) > 2 and columns[1].startswith("/"):
                listed[columns[1]] += int(columns[2])
        assert listed == counts
        assert all(topic in checked for topic in counts)


def test_an_unfinished_log_is_completed(tmp_path: Path) -> None:
    part = small_log(tmp_path / "caf\udce9.mcap", finished=False)
    before = part.read_bytes()
    new = tmp_path / "caf\udce9-recovered.mcap"
    assert json_of("recover", part) == {
        "log": str(part),
        "bytes": len(before),
        "finished": False,
        "recovered": str(new),
        "messages": len(small_samples()),
        "unreadable": 0,
        "damage": [],
    }
    assert part.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["caf\udce9-recovered.mcap", "caf\udce9.mcap.part"]
    old, copy = LogReader(part), LogReader(new)
    assert list(copy) == list(old) == small_samples()
    assert copy.records[:-1] == old.records
    assert copy.attachments == {attachment.name: attachment.data for attachment in ATTACHMENTS}
    assert copy.metadata.keys() == {"lowfc", "recovery"}
    for reader in (old, copy):  # each file assigns its own numbers
        for channel in reader.channels.values():
            channel.schema_id = reader.schemas[channel.schema_id].data
            channel.id = 0
    assert copy.channels == old.channels


def test_parts_left_out_are_reported(tmp_path: Path) -> None:
    path = small_log(tmp_path / "night.mcap")
    middle = path.stat().st_size // 2
    flipped(path, middle)
    out = tmp_path / "else" / "saved.mcap"
    out.parent.mkdir()
    done = lowfc("recover", path, "--out", out)
    assert done.exit_code == 0, done.output
    first, last = done.stdout.splitlines()
    saved = LogReader(out)
    kept = len(list(saved))
    assert 0 < kept < len(small_samples())
    assert first.startswith("left out at byte ")
    assert "s between the messages around it" in first
    assert last == f"{out}: {kept} messages"
    assert saved.metadata["recovery"]["source"] == "night.mcap"
    assert "left out " + saved.metadata["recovery"]["left_out 1"] == first
    damage = json_of("recover", path)["damage"]
    assert len(damage) == 1
    assert damage[0]["position"] < middle < damage[0]["position"] + damage[0]["length"]


def test_an_intact_log_is_not_recovered(tmp_path: Path) -> None:
    path = small_log(tmp_path / "night.mcap")
    done = lowfc("recover", path)
    assert (done.exit_code, done.stdout) == (0, f"{path} is intact; there is nothing to recover\n")
    assert json_of("recover", path)["recovered"] is None
    assert [path.name for path in tmp_path.iterdir()] == ["night.mcap"]
    part = path.rename(tmp_path / "night.mcap.part")  # its recorder died before renaming it
    assert lowfc("recover", part).stdout == f"{part} is intact; rename it to night.mcap\n"


def test_an_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    part = small_log(tmp_path / "night.mcap", finished=False)
    existing = recovered_path(part)
    existing.write_text("mine")
    for out in (existing, part):
        with pytest.raises(DataFileError, match="never overwritten"):
            recover(part, out)
    assert existing.read_text() == "mine"


@pytest.mark.parametrize("fault", [KeyboardInterrupt(), OSError(28, "No space left on device")])
def test_a_failed_recovery_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: BaseException
) -> None:
    part = small_log(tmp_path / "night.mcap", finished=False)
    monkeypatch.setattr(recovery, "origin", Mock(side_effect=fault))  # after all messages are written
    with pytest.raises((KeyboardInterrupt, DataFileError)) as caught:
        recover(part, tmp_path / "new.mcap")
    assert isinstance(caught.value, KeyboardInterrupt) or "cannot be written: No space left" in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == [part.name]
