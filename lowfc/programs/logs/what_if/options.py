"""What a what-if changes: the words of the command line, the law they make, a user's own controller."""

import contextlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np

from lowfc.adapters.files.factory import settings
from lowfc.arrays import Single
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError, nearest
from lowfc.control.calibration.calibration import ESTIMATORS
from lowfc.control.laws.law import Law
from lowfc.control.laws.what_if import Controller

TILTS = (2, 3)
LAW_KEYS = ("gain", "leak", "limit_nm")
KEYS = (*LAW_KEYS, *(f"tilt_{key}" for key in LAW_KEYS), "estimator")


@dataclass(frozen=True, slots=True)
class WhatIf:
    """What shall be different from the logged run; nothing, where all is left out.

    Attributes:
        figures: gain, leak and limit_nm of all modes; tilt_gain, tilt_leak and tilt_limit_nm of tip and tilt over them.
        estimator: another reconstructor made from the same calibration.
        config: file whose [control] section says gains, leaks, limits, and the estimator where no calibration is
            named; the others go over it.
        calibration: FITS file of another calibration of the same modes, frames and mirror.
        controller: FILE.py:NAME of a function `step(state, error_nm) -> (state, command_nm)` in place of the
            integrator and its limits; the state is None at first, both arrays are (modes,) nm of wavefront rms.
    """

    figures: Mapping[str, float] = field(default_factory=dict)
    estimator: str | None = None
    config: Path | None = None
    calibration: Path | None = None
    controller: str | None = None


def wanted(
    text: str | None = None,
    config: Path | None = None,
    calibration: Path | None = None,
    controller: str | None = None,
) -> WhatIf:
    """What the options of the command line ask for; `text` is like "gain=0.6,leak=0.01".

    Raises:
        ConfigurationError: an unknown key, a value that is none, or a text that asks for nothing.
    """
    values: dict[str, str] = {}
    for part in filter(None, (part.strip() for part in (text or "").split(","))):
        key, equals, value = (word.strip() for word in part.partition("="))
        if key not in KEYS:
            raise ConfigurationError(f"--set: unknown key {key!r}{nearest(key, KEYS)}; known are {', '.join(KEYS)}")
        if not (equals and value):
            raise ConfigurationError(f"--set: {key} needs a value, as in {key}=...")
        if key in values:
            raise ConfigurationError(f"--set: {key} is there twice")
        values[key] = value
    if not values and all(one is None for one in (config, calibration, controller)):
        raise ConfigurationError(
            f"a what-if changes something; give --set KEY=VALUE, such as gain=0.3; known are {', '.join(KEYS)}"
        )
    estimator = values.pop("estimator", None)
    if estimator not in (None, *ESTIMATORS):
        raise ConfigurationError(f"--set: estimator must be {' or '.join(ESTIMATORS)}, got {estimator!r}")
    if controller is not None and values:
        raise ConfigurationError(f"--set: {', '.join(values)} are the integrator's, not of your own controller")
    figures = {key: _number(key, value) for key, value in values.items()}
    return WhatIf(figures, estimator, config, calibration, controller)


def law(what: WhatIf, config: Configuration | None, noll: tuple[int, ...], logged: Law) -> Law:
    """The law of the what-if: the logged one, or the configuration's, and single figures over it.

    Raises:
        ConfigurationError: a figure is out of range.
    """
    base = settings(config).law(noll) if config is not None else logged
    tilts = np.isin(noll, TILTS)
    changed: dict[str, Single] = {}
    for key in LAW_KEYS:
        values: Single = getattr(base, key).copy()
        values[:] = what.figures.get(key, values)
        values[tilts] = what.figures.get(f"tilt_{key}", values[tilts])
        changed[key] = values
    try:
        return Law(**changed)
    except ValueError as error:
        raise ConfigurationError(f"--set: {error}") from None


def user_controller(where: str) -> Controller:
    """The function at FILE.py:NAME, with its mistakes made plain.

    Raises:
        ConfigurationError: there is no such file or function, the file cannot be run, or, when it is called, the
            function fails or returns something else than a state and a command.
    """
    file, _, name = where.rpartition(":")
    spec = spec_from_file_location("what_if_controller", file)
    if not file.endswith(".py") or spec is None or spec.loader is None:
        raise ConfigurationError(f"--controller must be FILE.py:NAME, got {where!r}")
    if not Path(file).is_file():
        raise ConfigurationError(f"--controller: there is no file {file}")
    module = sys.modules[spec.name] = module_from_spec(spec)  # where its dataclasses look for it
    try:
        with contextlib.redirect_stdout(sys.stderr):
            spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        raise ConfigurationError(f"--controller: {file} cannot be run: {type(error).__name__}: {error}") from None
    function = getattr(module, name, None)
    if not callable(function):
        functions = [one for one, value in vars(module).items() if callable(value)]
        raise ConfigurationError(f"--controller: {file} has no function {name!r}{nearest(name, functions)}")
    calls = 0

    def step(state: Any, error_nm: Single, _pol_nm: Single) -> tuple[Any, Single]:
        nonlocal calls
        calls += 1
        try:
            with contextlib.redirect_stdout(sys.stderr):  # standard output is for the figures
                state, command = function(state, error_nm.copy())
            command_nm = np.array(command, np.float32)
        except (Exception, SystemExit) as error:
            raise ConfigurationError(
                f"--controller: {where}, call {calls}: {type(error).__name__}: {error}; "
                "step(state, error_nm) must return (state, command_nm)"
            ) from None
        if command_nm.shape != error_nm.shape or not np.isfinite(command_nm).all():
            got = f"shape {command_nm.shape}" if command_nm.shape != error_nm.shape else command_nm.tolist()
            raise ConfigurationError(
                f"--controller: {where}, call {calls}: command_nm must be {len(error_nm)} finite numbers, got {got}"
            )
        return state, command_nm

    return step


def _number(key: str, value: str) -> float:
    try:
        return float(value)
    except ValueError:
        raise ConfigurationError(f"--set: {key} must be a number, got {value!r}") from None
