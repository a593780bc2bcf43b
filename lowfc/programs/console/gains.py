"""The gain knobs: one for all modes, one for each radial degree. A knob shows the largest gain of its modes."""

import math
import time
from collections.abc import Callable, Sequence

import numpy as np
from rich.text import Text
from textual import events

from lowfc.arrays import Mask
from lowfc.programs.console.feed import Reading
from lowfc.programs.console.lines import Lines
from lowfc.programs.console.panels import BOLD, DIM, style
from lowfc.programs.view.draw.colours import BLUE, GREY

HIGHEST = 1.5  # gain at the right end of a knob's bar
STEP, FINE_STEP = 0.05, 0.01
FINE_BELOW = 0.1
"""Knobs below this gain are turned in fine steps."""
_BAR = 8  # columns of the bar without its mark
_BAR_START = 11  # columns before the bar
_PENDING_S = 1.0  # time for which a knob shows the requested gain; then it shows the reported one


class Gains(Lines):
    """The knobs, scrolled to the chosen one. Keys or a click turn a knob; the gains of its modes keep their ratios."""

    def __init__(self, send: Callable[[Sequence[int], Sequence[float]], None]) -> None:
        """Make the knobs; `send` receives a knob's modes and their new gains, or an empty list for automatic gains."""
        super().__init__("gains")
        self._send = send
        self._chosen = self._top = 0  # index of the chosen knob, and of the first knob on the screen
        self._noll: tuple[int, ...] = ()
        self._gain = np.zeros(0, np.float32)
        self._automatic: Mask = np.zeros(0, bool)
        self._pending: dict[int, tuple[float, float]] = {}  # by knob: requested gain, and time until which it is shown

    def update(self, reading: Reading) -> None:
        """Show the gains of the run."""
        state, noll = reading.state.snapshot.controller, reading.state.snapshot.noll
        lengths = set() if state is None else {len(state.gain), len(state.automatic or state.gain)}
        if state is None or lengths != {len(noll)} or not np.isfinite(list(state.gain)).all():
            self._noll = ()
        else:
            self._noll, self._gain = noll, np.array(state.gain, np.float32)
            self._automatic = np.array(state.automatic or [False] * len(state.gain), bool)
            self._chosen = min(self._chosen, max(0, len(knobs(noll)) - 1))
        self._draw()

    def choose(self, lines: int) -> None:
        """Choose the knob this number of lines below the present one; the first one follows the last."""
        self._chosen = (self._chosen + lines) % max(1, len(knobs(self._noll)))
        self._draw()

    def turn(self, steps: int) -> None:
        """Turn the chosen knob up by this number of steps: `FINE_STEP` for a small gain, otherwise `STEP`."""
        if self._noll:
            gain = round(self._shown_gain(self._chosen), 3)  # the controller's gains are float32
            fine = gain < FINE_BELOW or (steps < 0 and gain <= FINE_BELOW)
            self._request(self._chosen, gain + steps * (FINE_STEP if fine else STEP))

    def automatic(self) -> None:
        """Request automatic gains for the chosen knob."""
        if self._noll:
            self._send(knobs(self._noll)[self._chosen][1], [])

    def discard_pending(self) -> None:
        """Discard the requested gains after a refusal: the knobs return to the controller's gains."""
        self._pending.clear()

    def on_click(self, event: events.Click) -> None:
        """Choose a knob, and turn it to where its bar was clicked."""
        if 0 <= event.y < len(knobs(self._noll)) - self._top:
            self._chosen = self._top + event.y
            if _BAR_START <= event.x <= _BAR_START + _BAR:
                self._request(self._chosen, (event.x - _BAR_START) / _BAR * HIGHEST)
            self._draw()

    def _request(self, number: int, gain: float) -> None:
        gain = round(min(max(gain, 0.0), max(HIGHEST, self._shown_gain(number))), 3)
        present = self._gain[self._indices(number)]
        gains = np.full(len(present), gain) if not present.any() else present / present.max() * gain
        self._pending[number] = gain, time.monotonic() + _PENDING_S
        self._send(knobs(self._noll)[number][1], [float(f"{value:.4g}") for value in gains.tolist()])

    def _indices(self, number: int) -> list[int]:
        return [self._noll.index(mode) for mode in knobs(self._noll)[number][1]]

    def _shown_gain(self, number: int) -> float:
        gain, until_s = self._pending.get(number, (0.0, 0.0))
        return gain if time.monotonic() < until_s else float(self._gain[self._indices(number)].max())

    def _draw(self) -> None:
        lines = []
        for number, (name, _) in enumerate(knobs(self._noll)):
            gain, indices = self._shown_gain(number), self._indices(number)
            filled = round(min(max(gain / HIGHEST, 0.0), 1.0) * _BAR)
            lowest = float(self._gain[indices].min())
            range_start = "" if lowest >= 0.99 * gain else f"{lowest:.2g}-"
            chosen = number == self._chosen
            lines.append(
                Text.assemble(
                    (f"{'▸' if chosen else ' '}{name:{_BAR_START - 1}}", BOLD if chosen else DIM),
                    ("━" * filled, style(BLUE)),
                    ("●", BOLD),
                    ("━" * (_BAR - filled), style(GREY)),
                    f" {range_start}{gain:.2g}" if range_start else f" {gain:.3g}",
                    (" auto" if self._automatic[indices].all() else "", DIM),
                )
            )
        height = self.size.height or len(lines)
        self._top = min(max(self._top, self._chosen + 1 - height), self._chosen, max(0, len(lines) - height))
        self.show(lines[self._top :] or [Text("gains are not known yet", DIM)])


def knobs(noll: Sequence[int]) -> list[tuple[str, tuple[int, ...]]]:
    """Name and modes of each knob: all modes, then those of each radial degree."""
    by_degree: dict[int, list[int]] = {}
    for mode in noll:
        by_degree.setdefault((math.isqrt(8 * mode - 7) - 1) // 2, []).append(mode)
    named = [(_name(degree, modes), tuple(modes)) for degree, modes in by_degree.items()]
    return [("gain, all", tuple(noll)), *named] if noll else []


def _name(degree: int, modes: list[int]) -> str:
    if degree == 1:
        return "tip, tilt"
    return f"Z{modes[0]}" if len(modes) == 1 else f"Z{modes[0]}-{modes[-1]}"
