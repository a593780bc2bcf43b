"""The paper's figures 1 to 10."""

from lowfc.programs.paper.cases import Case
from lowfc.programs.paper.figures import aberration, light, modes, screens

_ALL = {**aberration.CASES, **light.CASES, **modes.CASES, **screens.CASES}

FIGURES: dict[str, Case] = {name: _ALL[name] for name in sorted(_ALL, key=lambda name: int(name.removeprefix("fig")))}
