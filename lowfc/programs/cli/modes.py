"""Noll indices on the command line."""

from collections.abc import Sequence
from typing import Annotated

import typer

from lowfc.contract.errors import ConfigurationError

Modes = Annotated[
    list[str] | None,
    typer.Option("--modes", "--mode", help="Noll indices, as in 2,3 or 4-11. Default: all.", show_default=False),
]

HIGHEST = 1000
"""Highest Noll index accepted, far above any controlled mode."""


def noll_of(arguments: Sequence[str] | None) -> tuple[int, ...]:
    """Noll indices of arguments such as "2,3" and "4-11", without duplicates; without arguments empty: all modes."""
    if not arguments:
        return ()
    indices: list[int] = []
    joined = ",".join(arguments).replace(" ", "")
    parts = [part for part in joined.split(",") if part]
    for part in parts or [joined]:  # commas alone are refused
        first, dash, last = part.partition("-")
        last = last if dash else first
        if not (first.isdecimal() and last.isdecimal() and 0 < int(first) <= int(last) <= HIGHEST):
            raise ConfigurationError(f"--modes takes Noll indices, as in 2,3 or 4-11; got {part!r}")
        indices += range(int(first), int(last) + 1)
    return tuple(dict.fromkeys(indices))
