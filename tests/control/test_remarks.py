"""Values that are allowed and probably not meant: carried out, and said so."""

import numpy as np
import pytest

from lowfc.control.laws.stability import highest_gain
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Reply, Request
from lowfc.control.loop.state import State
from tests.support.toy import GRID, NOLL, loaded, settings

USUAL = settings()


def asked(state: State, name: str, *values: float, modes: tuple[int, ...] = (), text: str = "") -> tuple[State, Reply]:
    after, outputs = advance(USUAL, state, Request(1, name, modes, values, text))
    assert outputs.reply is not None
    return after, outputs.reply


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("gain", 0.5, ""),
        ("gain", 1.2, "margins are below the 1.8 in gain and 45 degrees in phase that `lowfc tune` keeps"),
        ("gain", 0.0, "a mode with a gain of 0 is not corrected"),
        ("gain", 0.001, "below 0.01, the least that `lowfc tune` chooses"),
        ("limit", 100.0, ""),
        ("limit", 0.0, "a mode with a limit of 0 nm is not corrected"),
        ("limit", 1e9, "nm the stroke of 700 nm limits mode 3 first"),
        ("leak", 0.0, ""),
    ],
)
def test_a_foolish_value_is_granted_and_said_so(name: str, value: float, said: str) -> None:
    after, reply = asked(loaded(USUAL), name, value, modes=(3,))
    assert reply.accepted
    attribute = {"gain": "gain", "limit": "limit_nm", "leak": "leak"}[name]
    assert getattr(after.drive.law, attribute)[NOLL.index(3)] == np.float32(value)
    assert reply.text.startswith(f"{name} is now ")
    assert said in reply.text
    assert (":" in reply.text) == bool(said)


def test_the_remark_begins_where_tune_ends() -> None:
    highest = highest_gain(USUAL.delay_frames)
    texts = [asked(loaded(USUAL), "gain", factor * highest)[1].text for factor in (0.999, 1.001)]
    assert ["lowfc tune" in text for text in texts] == [False, True]


def test_a_channel_that_is_not_there_is_said_so_and_one_that_is_there_is_removed() -> None:
    state = loaded(USUAL)
    after, reply = asked(state, "channel", text="dark-hole")
    assert (reply.accepted, reply.text) == (True, "there is no channel 'dark-hole' to remove; there are none")
    assert after.drive.additions is None
    shape = Request(1, "channel", text="dark-hole", actuators_nm=np.full(GRID, 2.0, np.float32).reshape(-1))
    state, _ = advance(USUAL, state, shape)
    assert asked(state, "channel", text="hole")[1].text == "there is no channel 'hole' to remove; there are dark-hole"
    assert asked(state, "channel", text="dark-hole")[1].text == "channel dark-hole: 0 nm rms of surface"
    assert "letter first" in asked(state, "channel", text="Dark Hole")[1].text


def test_an_offset_beyond_its_limit_names_its_mode() -> None:
    _, reply = asked(loaded(USUAL), "offset", 80.0, modes=(4,))
    assert (reply.accepted, reply.text) == (False, "offset of mode 4: at most its limit, 50 nm; asked for 80 nm")
