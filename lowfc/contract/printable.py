"""Escape control characters in text of unknown origin, such as an operator's note, for a terminal."""

import unicodedata

_HIDDEN = frozenset(("Cc", "Cf", "Cs", "Zl", "Zp"))
"""Unicode categories of invisible characters: controls, formats, surrogates and separators."""

LINES = "\n\t"
"""Control characters to keep in a text of several lines."""


def printable(text: str, keep: str = "") -> str:
    """Text whose control characters, except those in `keep`, have become Python escapes."""
    if text.isprintable():
        return text
    return "".join(
        character.encode("unicode_escape").decode()
        if unicodedata.category(character) in _HIDDEN and character not in keep
        else character
        for character in text
    )


def encodable(text: str) -> str:
    """Text in which bytes that are not UTF-8, as in a file name, have become escapes: messages and logs are UTF-8."""
    return text.encode(errors="backslashreplace").decode()
