"""The gain knobs: one for all modes, one for each radial order. A knob at 1 is the configured gain."""

import math
import time
from collections.abc import Sequence

import numpy as np
from rich.text import Text
from textual import events
from textual.message import Message
from textual.widgets import Static

from lowfc.arrays import Single
from lowfc.programs.console.feed import Reading
from lowfc.programs.console.panels import BOLD, DIM, style
from lowfc.programs.view.draw.colours import BLUE, GREY

HIGHEST = 1.5
STEP = 0.05
_BAR = 10
_BEFORE = 11  # columns before the bar
_PENDING_S = 1.0  # after which the controller's state has what was asked


class Gains(Static):
    """The knobs; one is chosen, and turned by keys or by a click on its bar."""

    class Turned(Message):
        """Somebody turned a knob: these gains are wanted for these modes."""

        def __init__(self, modes: tuple[int, ...], values: list[float]) -> None:
            super().__init__()
            self.modes, self.values = modes, values

    def __init__(self) -> None:
        super().__init__(id="gains")
        self._chosen = 0
        self._noll: tuple[int, ...] = ()
        self._base = self._gain = np.zeros(0, np.float32)
        self._shown: Text | None = None
        self._pending: dict[int, tuple[float, float]] = {}

    def show(self, reading: Reading) -> None:
        """Take in the gains of the run."""
        state = reading.state.controller_state
        gain = np.array(state.gain if state is not None else (), np.float32)
        known = 0 < len(gain) == len(reading.noll) == len(reading.base_gain)
        self._noll, self._base, self._gain = (
            (reading.noll, reading.base_gain, gain) if known else ((), np.zeros(0, np.float32), np.zeros(0, np.float32))
        )
        self._draw()

    def choose(self, by: int) -> None:
        """Choose the knob so many lines below."""
        self._chosen = (self._chosen + by) % max(1, len(groups(self._noll)))
        self._draw()

    def turn(self, steps: int) -> None:
        """Turn the chosen knob."""
        if self._noll:
            self._want(self._chosen, self._knob(self._chosen) + steps * STEP)

    def forget(self) -> None:
        """What was asked has been refused: the knobs are where the controller's gains are."""
        self._pending.clear()

    def on_click(self, event: events.Click) -> None:
        """Choose a knob, and turn it to where its bar was clicked."""
        if 0 <= event.y < len(groups(self._noll)):
            self._chosen = event.y
            if _BEFORE <= event.x <= _BEFORE + _BAR:
                self._want(self._chosen, (event.x - _BEFORE) / _BAR * HIGHEST)
            self._draw()

    def _want(self, number: int, knob: float) -> None:
        knob = min(max(round(knob / STEP) * STEP, 0.0), HIGHEST)
        _, modes = groups(self._noll)[number]
        places = [self._noll.index(mode) for mode in modes]
        before = ratio(self._gain[places], self._base[places])
        gains = self._base[places] * knob if before <= 0 else self._gain[places] / before * knob
        self._pending[number] = knob, time.monotonic() + _PENDING_S
        self.post_message(self.Turned(modes, [float(f"{value:.4g}") for value in gains.tolist()]))

    def _knob(self, number: int) -> float:
        knob, until_s = self._pending.get(number, (0.0, 0.0))
        if time.monotonic() < until_s:
            return knob
        places = [self._noll.index(mode) for mode in groups(self._noll)[number][1]]
        return ratio(self._gain[places], self._base[places])

    def _draw(self) -> None:
        lines = []
        for number, (name, modes) in enumerate(groups(self._noll)):
            knob = self._knob(number)
            at = min(round(knob / HIGHEST * _BAR), _BAR)
            gain = sorted({float(self._gain[self._noll.index(mode)]) for mode in modes})
            ends = dict.fromkeys(f"{value:.3g}" for value in (gain[0], gain[-1]))
            chosen = number == self._chosen
            lines.append(
                Text.assemble(
                    (f"{'▸' if chosen else ' '}{name:{_BEFORE - 1}}", BOLD if chosen else DIM),
                    ("━" * at, style(BLUE)),
                    ("●", BOLD),
                    ("━" * (_BAR - at), style(GREY)),
                    f" {knob:.2f} {'-'.join(ends)}",
                )
            )
        text = Text("\n").join(lines) if lines else Text("gains are not known yet", DIM)
        if text != self._shown:
            self._shown = text
            self.update(text, layout=False)


def ratio(gain: Single, base: Single) -> float:
    """Gains by the configured ones: of the means, so that modes may differ."""
    return float(gain.mean() / base.mean()) if base.any() else 0.0


def groups(noll: Sequence[int]) -> list[tuple[str, tuple[int, ...]]]:
    """All modes, and those of each radial order, by a name."""
    orders: dict[int, list[int]] = {}
    for mode in noll:
        orders.setdefault((math.isqrt(8 * mode - 7) - 1) // 2, []).append(mode)
    named = [(_name(order, modes), tuple(modes)) for order, modes in orders.items()]
    return [("gain, all", tuple(noll)), *named] if noll else []


def _name(order: int, modes: list[int]) -> str:
    if order == 1:
        return "tip, tilt"
    return f"Z{modes[0]}" if len(modes) == 1 else f"Z{modes[0]}-{modes[-1]}"
