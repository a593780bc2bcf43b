"""Readers of external bytes, with damaged inputs: each raises declared errors only, without a crash, hang or leak."""

from contextlib import suppress

import pytest

from tests.support.fuzzing import MAX_GROWTH_BYTES, fuzz, inputs_by_target
from tests.support.targets import Target, targets


@pytest.fixture(scope="module")
def all_targets(tmp_path_factory: pytest.TempPathFactory) -> list[Target]:
    return targets(tmp_path_factory.mktemp("fuzz"))


def test_undamaged_inputs_are_read(all_targets: list[Target]) -> None:
    """Otherwise all damaged inputs would be refused for the same trivial reason."""
    for target in all_targets:
        for data in target.corpus:
            target.read(data)


@pytest.mark.parametrize(("card", "damage"), [(b"KIND    = '", b"KIND    = &"), (b"XTENSION=", b"XTENSAON=")])
def test_damaged_header_is_refused(all_targets: list[Target], card: bytes, damage: bytes) -> None:
    files = [target for target in all_targets if target.name in ("calibration file", "law file")]
    assert len(files) == 2
    for target in files:
        for data in target.corpus:
            damaged = data.replace(card, damage)
            assert damaged != data
            with pytest.raises(target.errors, match="not a readable"):
                target.read(damaged)


def test_inputs_depend_only_on_their_number(all_targets: list[Target]) -> None:
    for target in all_targets:
        assert target.input(5) == target.input(5)
        assert len({target.input(number) for number in range(20)}) > 1


def test_crashes_and_hangs_of_a_reader_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.support.fuzzing.HANG_S", 0.05)

    def read(data: bytes) -> None:
        if data.startswith(b"\xff"):
            raise KeyError(data)
        with suppress(Exception):  # like a reader that turns every error into an event
            while data.startswith(b"\0"):
                pass

    results = fuzz(Target("bad", (b"\xff" * 4, b"\0" * 4, b"good"), read), range(60))
    assert results["crashes"]
    assert results["hangs"]


@pytest.mark.parametrize(
    "inputs", [8_000, pytest.param(1_000_000, marks=[pytest.mark.slow, pytest.mark.timeout(3600)])]
)
def test_damaged_inputs_neither_crash_nor_hang_a_reader(all_targets: list[Target], inputs: int) -> None:
    counts = inputs_by_target(all_targets, inputs)
    for target in all_targets:
        results = fuzz(target, range(counts[target.name]))
        assert results["crashes"] == [], target.name
        assert results["hangs"] == [], target.name
        assert results["grown_bytes"] < MAX_GROWTH_BYTES, target.name
