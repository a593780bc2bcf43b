"""What the configuration has in files: read, checked, and asked of the controller when it starts."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from lowfc.adapters.files import factory, law_file
from lowfc.adapters.files.mirror_maps import active_actuators, flat_nm
from lowfc.adapters.process import compiled
from lowfc.adapters.process.latch import Latch
from lowfc.arrays import Single
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError, DataFileError, LowfcError
from lowfc.control.kernel.tables import NUMPY
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.laws.margins import check_law
from lowfc.control.loop.command_channels import ADOPTED, FLAT
from lowfc.control.loop.inputs import Request
from lowfc.control.loop.loading import ADOPTED_NM
from lowfc.control.loop.safety import Limit, LoopMode, limit
from lowfc.control.loop.state import Settings, State

LIKENESS = 0.5
"""Of a mirror's shape to the flat map, from which on it is taken to be there already."""


def check_files(config: Configuration) -> None:
    """Open every file that a configuration names; ConfigurationError has a line for each that cannot be used."""
    checks: tuple[Callable[[Configuration], object], ...] = (
        lambda config: factory.sensor(config, lambda _: None),
        active_actuators,
        _flat_within_limits,
        _law_of_modes,
    )
    faults = []
    for check in checks:
        try:
            check(config)
        except LowfcError as fault:
            faults.append(str(fault))
    if faults:
        raise ConfigurationError("\n".join(dict.fromkeys(faults)))


def law(config: Configuration) -> LinearLaw | None:
    """The law of `control.law`, which suits the loop; None for the integrator."""
    file = config.control.law
    if not file:
        return None
    try:
        found = law_file.load(Path(file).expanduser())
        settings = factory.settings(config)
        check_law(found, settings.delay_frames, settings.rate_hz)
    except DataFileError as fault:
        raise ConfigurationError(f"control.law: {fault}") from None
    except ValueError as fault:
        raise ConfigurationError(f"control.law = {file!r}: {fault}") from None
    return found


def settings_under(latch: Latch, config: Configuration, event: Callable[..., None]) -> Settings:
    """The settings of a configuration, its kernel ready; what was made safe stays so when the controller dies.

    Where that could not be remembered, nothing is driven until somebody is there. An `event` says which kernel computes
    where it is not numpy's, or ought not to be.
    """
    wanted = config.realtime.kernel
    found = replace(factory.settings(config), kernel=compiled.kernel(wanted, config.realtime.threads))
    if found.kernel.name != wanted:
        event("KERNEL_MISSING", advice=compiled.missing())
    elif found.kernel is not NUMPY:
        event("KERNEL", kernel=wanted)
    if latch.safe:
        return replace(found, start_mode=LoopMode.SAFE)
    return found if latch.kept else replace(found, start_mode=LoopMode.OPEN)


class StartUp:
    """What a configuration puts on the mirror, and the law that it chooses."""

    def __init__(self, config: Configuration) -> None:
        self._file, self._flat_nm = config.mirror.flat, _flat_within_limits(config)
        self._law_file, self._law = config.control.law, law(config)

    def requests(self, state: State, time_ns: int) -> list[Request]:
        """What to ask, in this order, once it is known where the mirror is.

        A mirror that has the flat map already, since another controller put it there, goes on with it: it is taken out
        of the shape that was adopted as it comes in under its own name, so that nothing moves.
        """
        asks = partial(Request, time_ns, requester="the configuration")
        asked: list[Request] = []
        if self._law is not None:
            asked.append(asks("law", law=self._law))
        if self._flat_nm is not None:
            there_nm = _adopted_nm(state, self._flat_nm)
            if there_nm is not None:
                rest_nm = (there_nm - self._flat_nm).reshape(-1)
                if np.abs(rest_nm).max() <= ADOPTED_NM:
                    rest_nm[:] = 0
                asked.append(asks("channel", text=ADOPTED, actuators_nm=rest_nm))
            asked.append(asks("channel", text=FLAT, actuators_nm=self._flat_nm.reshape(-1)))
        return asked

    def refused(self, request: Request, why: str) -> None:
        """Raise where a request was refused without which the loop would not be as configured.

        A shape that was adopted and cannot be taken apart stays one: what comes after is then not asked.
        """
        if request.text == ADOPTED:
            return
        key, file = ("control.law", self._law_file) if request.name == "law" else ("mirror.flat", self._file)
        raise ConfigurationError(f"{key} = {file!r}: {why}")


def _adopted_nm(state: State, flat_nm: Single) -> Single | None:
    """The shape (rows, columns) adopted from the mirror if the flat map is in it; what modes can make is left aside."""
    drive = state.drive
    if drive is None or drive.command_channels is None:
        return None
    shapes = [one.wanted_nm for one in drive.command_channels.channels if one.name == ADOPTED]
    if not shapes:
        return None
    beside = [
        shape - drive.to_actuators @ (drive.inverse @ shape) for shape in (shapes[0].reshape(-1), flat_nm.reshape(-1))
    ]
    there = float(beside[0] @ beside[1]) > LIKENESS * float(beside[1] @ beside[1])
    return shapes[0] if there else None


def _flat_within_limits(config: Configuration) -> Single | None:
    found = flat_nm(config)
    if found is not None:
        acting = limit(factory.settings(config).limits, found, found).reasons
        reasons = [reason for reason in acting if reason is not Limit.SLEW]  # the mirror takes its time
        if reasons:
            raise ConfigurationError(
                f"mirror.flat = {config.mirror.flat!r}: beyond the limits of [safety]: "
                f"{', '.join(reason.name.lower() for reason in reasons)}"
            )
    return found


def _law_of_modes(config: Configuration) -> None:
    found = law(config)
    if found is not None and found.noll != config.noll:
        raise ConfigurationError(
            f"control.law = {config.control.law!r}: it is of the modes {_modes(found.noll)}, the sensor's "
            f"{config.sensor.modes} are {_modes(config.noll)}"
        )


def _modes(noll: tuple[int, ...]) -> str:
    return f"Z{noll[0]} to Z{noll[-1]}" if noll == tuple(range(noll[0], noll[-1] + 1)) else str(list(noll))
