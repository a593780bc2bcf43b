"""Keys in the order in which they were typed, each to where the one before has led."""

from collections import deque
from functools import partial

from textual import events
from textual.app import App
from textual.dom import DOMNode
from textual.screen import Screen

AT_ONCE = "f12"
_PATIENCE_S = 1.0
"""Seconds after which a key waits no longer for the one before."""
_LOOK_S = 0.02


class OrderedKeys(App[str]):
    """An application in which a form that a key opens receives the keys after it, however fast they come.

    Textual hands each key to what has the focus as it arrives, though the key before may be about to move it: over a
    slow line, where several arrive at once, a form would lose its first letters, and a Tab would come too late.
    """

    def __init__(self) -> None:
        super().__init__()
        self._typed: deque[events.Key] = deque()
        self._turn = 0
        self._under_way = False

    def awaits_focus(self, screen: Screen[object]) -> bool:
        """Whether a screen that is new will have the focus somewhere, and has not yet."""
        return False

    async def on_event(self, event: events.Event) -> None:
        """Let keys queue; `AT_ONCE` does not."""
        if not isinstance(event, events.Key) or event.is_forwarded or event.key == AT_ONCE:
            await super().on_event(event)
            return
        self._typed.append(event)
        if not self._under_way:
            await self._hand_on(self._turn)

    async def _hand_on(self, turn: int) -> None:
        """Hand the next key on, unless the key of this turn is followed already."""
        if turn != self._turn:
            return
        self._turn += 1
        self._under_way = bool(self._typed)
        if self._typed:
            target = self.focused or self.screen
            await super().on_event(self._typed.popleft())
            self._follow(target, self._turn)
            self.set_timer(_PATIENCE_S, partial(self._hand_on, self._turn))

    def _follow(self, node: DOMNode, turn: int) -> None:
        """Wait behind the key in the queue of each widget that it comes to, up to the application's own."""
        if node is self or not node.call_later(self._follow, node.parent or self, turn):
            self.call_later(self._settle, turn)

    async def _settle(self, turn: int) -> None:
        """Go on with the next key once what the last one opened has the focus."""
        if turn == self._turn and self.awaits_focus(self.screen):
            self.set_timer(_LOOK_S, partial(self._settle, turn))
        else:
            await self._hand_on(turn)
