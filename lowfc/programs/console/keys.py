"""Keys processed one at a time: each goes to the widget that has the focus after the previous key."""

from collections import deque
from functools import partial

from textual import events
from textual.app import App
from textual.dom import DOMNode

IMMEDIATE_KEY = "f12"
"""Key that does not wait for the others."""
_TIMEOUT_S = 1.0
"""Longest time that a key waits for the previous one."""
_POLL_S = 0.02


class OrderedKeys(App[str]):
    """An application in which a form opened by a key receives the next keys, however fast they arrive.

    Textual sends a key to the widget that has the focus when it arrives, even if the previous key is about to move the
    focus. Over a slow line several keys arrive at once: a form would lose its first letters, and Tab would act too
    late.
    """

    def __init__(self) -> None:
        super().__init__()
        self._waiting: deque[events.Key] = deque()
        self._turn = 0  # number of the key in progress
        self._busy = False

    async def on_event(self, event: events.Event) -> None:
        """Queue keys, except `IMMEDIATE_KEY`."""
        if not isinstance(event, events.Key) or event.is_forwarded or event.key == IMMEDIATE_KEY:
            await super().on_event(event)
            return
        self._waiting.append(event)
        if not self._busy:
            await self._next_key(self._turn)

    async def _next_key(self, turn: int) -> None:
        """Send the next key, unless another call has sent it since `turn`."""
        if turn != self._turn:
            return
        self._turn += 1
        self._busy = bool(self._waiting)
        if self._waiting:
            target = self.focused or self.screen
            await super().on_event(self._waiting.popleft())
            self._follow(target, self._turn)
            self.set_timer(_TIMEOUT_S, partial(self._next_key, self._turn))

    def _follow(self, node: DOMNode, turn: int) -> None:
        """In `node` and each of its parents, queue a call behind the key; behind the last of them, call `_settle`."""
        if node is self or not node.call_later(self._follow, node.parent or self, turn):
            self.call_later(self._settle, turn)

    async def _settle(self, turn: int) -> None:
        """Send the next key once the form opened by the last one has the focus."""
        if turn == self._turn and self.screen.AUTO_FOCUS is not None and self.screen.focused is None:
            self.set_timer(_POLL_S, partial(self._settle, turn))
        else:
            await self._next_key(turn)
