"""Changes of a what-if: options of the command line, the resulting law, a user's own controller."""

import contextlib
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from runpy import run_path
from typing import Any

import numpy as np

from lowfc.adapters.files.factory import settings
from lowfc.adapters.process.terminal import configuration
from lowfc.arrays import Mask, Single
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError, nearest, raised_as
from lowfc.control.calibration.calibration import ESTIMATORS
from lowfc.control.laws.integrator import TIP_TILT, Integrator
from lowfc.control.laws.what_if import Controller
from lowfc.control.loop.safety import MAX_LIMIT_NM

LAW_KEYS = ("gain", "leak", "limit_nm")
KEYS = (*LAW_KEYS, *(f"tilt_{key}" for key in LAW_KEYS), "estimator")


@dataclass(frozen=True, slots=True)
class WhatIf:
    """Changes with respect to the logged run; by default none.

    Attributes:
        overrides: gain, leak and limit_nm of all modes; tilt_gain, tilt_leak and tilt_limit_nm of tip and tilt only.
        estimator: another reconstructor made from the same calibration.
        config: its [control] section sets gains, leaks, limits and, without `calibration`, the estimator; the other
            attributes take precedence.
        calibration: FITS file of another calibration of the same modes, frames and mirror.
        controller: FILE.py:NAME of `step`, the user's function, which replaces the integrator and its limits.
    """

    overrides: Mapping[str, float] = field(default_factory=dict)
    estimator: str | None = None
    config: Configuration | None = None
    calibration: Path | None = None
    controller: str | None = None
    step: Controller | None = None


def requested_changes(
    assignments: str | None = None,
    config: Path | None = None,
    calibration: Path | None = None,
    controller: str | None = None,
) -> WhatIf:
    """Parse the options of the command line; `assignments` is the text of --set: KEY=VALUE,...

    A controller is FILE.py:NAME of a function `step(state, error_nm) -> (state, command_nm)`; the state is None at
    first; both arrays are (modes,) nm rms of wavefront.
    """
    values: dict[str, str] = {}
    for part in filter(None, (part.strip() for part in (assignments or "").split(","))):
        key, _, value = (piece.strip() for piece in part.partition("="))
        if key not in KEYS:
            raise ConfigurationError(f"--set: unknown key {key!r}{nearest(key, KEYS)}; the keys are {', '.join(KEYS)}")
        if not value or key in values:
            raise ConfigurationError(f"--set: {key} requires one value, as in {key}=...")
        values[key] = value
    if not (values or config or calibration or controller):
        raise ConfigurationError(
            f"nothing to change: give --set KEY=VALUE, such as gain=0.3; the keys are {', '.join(KEYS)}"
        )
    estimator = values.pop("estimator", None)
    if estimator not in (None, *ESTIMATORS):
        raise ConfigurationError(f"--set: estimator must be {' or '.join(ESTIMATORS)}, got {estimator!r}")
    if controller is not None and values:
        raise ConfigurationError(f"--set: {', '.join(values)}: only for the integrator, not for your own controller")
    overrides = {key: _number(key, value) for key, value in values.items()}
    return WhatIf(
        overrides,
        estimator,
        None if config is None else configuration(config),
        calibration,
        controller,
        None if controller is None else user_controller(controller),
    )


def law(changes: WhatIf, noll: tuple[int, ...], logged: Integrator) -> Integrator:
    """The law of the what-if: the logged or the configured one, with the values of `overrides`."""
    base = logged
    if changes.config is not None:
        base = settings(changes.config).integrator(noll)
        base = replace(base, gain=np.where(logged_gains(changes, noll), logged.gain, base.gain))
    tilts = np.isin(noll, TIP_TILT)
    changed = []
    for key in LAW_KEYS:
        values: Single = getattr(base, key).copy()
        values[:] = changes.overrides.get(key, values)
        values[tilts] = changes.overrides.get(f"tilt_{key}", values[tilts])
        changed.append(values)
    with raised_as(ConfigurationError, ValueError, "--set"):
        gain, leak, limit_nm = changed
        return Integrator(gain, leak, limit_nm)


def logged_gains(changes: WhatIf, noll: tuple[int, ...]) -> Mask:
    """Modes (modes,) that keep the logged gain, because `config` makes it automatic and no override sets it."""
    if changes.config is None or "gain" in changes.overrides:
        return np.zeros(len(noll), np.bool_)
    automatic = settings(changes.config).automatic(noll)
    return automatic & ~np.isin(noll, TIP_TILT) if "tilt_gain" in changes.overrides else automatic


def user_controller(location: str) -> Controller:
    """The function at FILE.py:NAME; its output goes to standard error, because standard output is for the results."""
    file, _, name = location.rpartition(":")
    if not file.endswith(".py") or not Path(file).is_file():
        raise ConfigurationError(f"--controller must be FILE.py:NAME of an existing file, got {location!r}")
    try:
        with contextlib.redirect_stdout(sys.stderr):
            function = run_path(file).get(name)
    except (Exception, SystemExit) as error:
        raise ConfigurationError(f"--controller: {file} cannot be run: {type(error).__name__}: {error}") from None
    if not callable(function):
        raise ConfigurationError(f"--controller: {file} has no function {name!r}")

    def step(state: Any, error_nm: Single, _pol_nm: Single) -> tuple[Any, Single]:
        try:
            with contextlib.redirect_stdout(sys.stderr):
                state, command = function(state, error_nm.copy())
            command_nm = np.array(command, np.float32)
            if command_nm.shape != error_nm.shape or not np.isfinite(command_nm).all():
                raise ValueError(f"command_nm must be {len(error_nm)} finite numbers, got {command}")
        except (Exception, SystemExit) as error:
            raise ConfigurationError(
                f"--controller: {location}: {type(error).__name__}: {error}; "
                "step(state, error_nm) must return (state, command_nm)"
            ) from None
        return state, command_nm

    return step


def _number(key: str, value: str) -> float:
    try:
        number = float(value)
    except ValueError:
        raise ConfigurationError(f"--set: {key} must be a number, got {value!r}") from None
    if abs(number) > MAX_LIMIT_NM:  # larger numbers may overflow in single precision
        raise ConfigurationError(f"--set: {key} must be at most {MAX_LIMIT_NM:g} in magnitude, got {value}")
    return number
