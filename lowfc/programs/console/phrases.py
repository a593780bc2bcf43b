"""Replies and events as the console shows them: keys in place of `lowfc` commands, ranges in place of long lists."""

import re

from lowfc.programs.console.actions import ALL_ACTIONS
from lowfc.programs.view.verdicts.tile import numbers

_KEYS = {name: action.key for name, action in ALL_ACTIONS.items()} | {
    "law integrator": "i",
    "record start": "r",
    "record stop": "v",
}
_COMMAND = re.compile(r"`lowfc ctl (\w+)(?: (\w+))?( --modes [^` ]*)?[^`]*`")
_NUMBER = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"
_LIST = re.compile(rf"(?<![\w.]){_NUMBER}(?: {_NUMBER}){{3,}}(?![\w.])")  # four numbers or more


def phrased(text: str) -> str:
    """Text with the console's keys in place of commands, and the ranges of long lists of numbers."""
    return _LIST.sub(lambda match: numbers([float(word) for word in match[0].split()]), _COMMAND.sub(_key, text))


def _key(match: re.Match[str]) -> str:
    two_words = f"{match[1]} {match[2]}"
    name = two_words if two_words in _KEYS else match[1]
    if name not in _KEYS:
        return match[0]
    values = f" {match[2]}, {match[3].removeprefix(' --')}" if match[3] else ""
    return f"{name}{values} (key {_KEYS[name]})"
