"""The paper's figures 1 to 10."""

from lowfc.programs.validate import figures_aberration, figures_light, figures_modes, figures_screens
from lowfc.programs.validate.cases import Case

_ALL = {**figures_aberration.CASES, **figures_light.CASES, **figures_modes.CASES, **figures_screens.CASES}

FIGURES: dict[str, Case] = {name: _ALL[name] for name in sorted(_ALL, key=lambda name: int(name.removeprefix("fig")))}
