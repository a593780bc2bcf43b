"""Every reader of foreign bytes, fed with damage: it says what is wrong, and neither crashes, hangs nor swells."""

import pytest

from tests.support.fuzzing import MOST_GROWTH_BYTES, fuzz, shares
from tests.support.targets import Target, targets

FEW, MANY = 8_000, 1_000_000


@pytest.fixture(scope="module")
def every(tmp_path_factory: pytest.TempPathFactory) -> list[Target]:
    return targets(tmp_path_factory.mktemp("fuzz"))


def test_what_is_whole_is_read(every: list[Target]) -> None:
    """Or all that follows would be refused at the door."""
    for target in every:
        for data in target.corpus:
            target.read(data)


@pytest.mark.parametrize(("card", "instead"), [(b"KIND    = '", b"KIND    = &"), (b"XTENSION=", b"XTENSAON=")])
def test_a_header_that_was_damaged_is_refused(every: list[Target], card: bytes, instead: bytes) -> None:
    for target in every:
        for data in target.corpus if target.name in ("calibration file", "law file") else ():
            damaged = data.replace(card, instead)
            assert damaged != data
            with pytest.raises(target.errors, match="not a whole"):
                target.read(damaged)


def test_an_input_is_made_from_its_number_alone(every: list[Target]) -> None:
    for target in every:
        assert target.input(5) == target.input(5)
        assert len({target.input(number) for number in range(20)}) > 1


def test_a_reader_that_crashes_or_hangs_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.support.fuzzing.HANG_S", 0.05)

    def read(data: bytes) -> None:
        if data.startswith(b"\xff"):
            raise KeyError(data)
        while data.startswith(b"\0"):
            pass

    found = fuzz(Target("bad", (b"\xff" * 4, b"\0" * 4, b"good"), read), range(60))
    assert found["crashes"]
    assert found["hangs"]


def _check(every: list[Target], inputs: int) -> None:
    counts = shares(every, inputs)
    for target in every:
        found = fuzz(target, range(counts[target.name]))
        assert found["crashes"] == [], target.name
        assert found["hangs"] == [], target.name
        assert found["grown_bytes"] < MOST_GROWTH_BYTES, target.name


def test_damaged_inputs(every: list[Target]) -> None:
    _check(every, FEW)


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_million_damaged_inputs(every: list[Target]) -> None:
    _check(every, MANY)
