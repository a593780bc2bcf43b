"""Text of unknown origin, such as an operator's note, made fit for a terminal."""

import unicodedata

_HIDDEN = frozenset(("Cc", "Cf", "Cs", "Zl", "Zp"))
"""Unicode categories of characters that do something instead of being seen."""

LINES = "\n\t"
"""What may stay in a text of several lines."""


def printable(text: str, keep: str = "") -> str:
    """Text in which control characters, but for those to `keep`, are shown as escapes, as in a Python string."""
    if text.isprintable():
        return text
    return "".join(
        character.encode("unicode_escape").decode()
        if unicodedata.category(character) in _HIDDEN and character not in keep
        else character
        for character in text
    )
