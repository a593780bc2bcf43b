"""Checks of the configuration's files and gains; requests for its flat map and law at the controller's start."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from lowfc.adapters.files import factory, law_file
from lowfc.adapters.files.mirror_maps import active_actuators, flat_nm
from lowfc.adapters.files.sensors import coronagraph_from
from lowfc.adapters.process import compiled
from lowfc.adapters.process.latch import Latch
from lowfc.arrays import Single
from lowfc.contract.codecs.input_file import user_path
from lowfc.contract.configuration import Configuration
from lowfc.contract.errors import ConfigurationError, DataFileError, LowfcError, raised_as
from lowfc.control.kernel.tables import NUMPY
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.laws.margins import check_law
from lowfc.control.loop.command_channels import ADOPTED, FLAT
from lowfc.control.loop.gains import check_gains
from lowfc.control.loop.inputs import Request
from lowfc.control.loop.loading import ADOPTED_NM
from lowfc.control.loop.safety import Limit, LoopMode, limit
from lowfc.control.loop.state import Settings, State

MIN_FLAT_SHARE = 0.5
"""Share of the flat map in the mirror's shape (1: all of it) above which the mirror is assumed to have it already."""


def check_files(config: Configuration) -> None:
    """Open the files of [sensor], [mirror] and [control], and check the gains; ConfigurationError lists all faults."""
    checks: tuple[Callable[[Configuration], object], ...] = (
        lambda config: factory.sensor(config, lambda _: None),
        lambda config: coronagraph_from(config.sensor),
        active_actuators,
        _checked_flat_nm,
        _check_law_modes,
        _check_gains,
    )
    faults = []
    for check in checks:
        try:
            check(config)
        except LowfcError as fault:
            faults.append(str(fault))
    if faults:
        raise ConfigurationError("\n".join(dict.fromkeys(faults)))


def _configured_law(config: Configuration) -> LinearLaw | None:
    """The law of `control.law`, checked for the loop's delay and rate; None for the integrator."""
    file = config.control.law
    if not file:
        return None
    try:
        linear_law = law_file.load(user_path(file))
        settings = factory.settings(config)
        check_law(linear_law, settings.delay_frames, settings.rate_hz)
    except DataFileError as fault:
        raise ConfigurationError(f"control.law: {fault}") from None
    except ValueError as fault:
        raise ConfigurationError(f"control.law = {file!r}: {fault}") from None
    return linear_law


def settings_at_start(latch: Latch, config: Configuration, event: Callable[..., None]) -> Settings:
    """The settings of a configuration with its kernel loaded; the loop starts in safe mode if the latch is set.

    If the latch cannot be stored, the loop starts open and stays open until an operator closes it. An event reports a
    kernel other than numpy, or a missing one.
    """
    configured = config.realtime.kernel
    settings = replace(factory.settings(config), kernel=compiled.kernel(configured, config.realtime.threads))
    if settings.kernel.name != configured:
        event("KERNEL_MISSING", advice=compiled.advice())
    elif settings.kernel is not NUMPY:
        event("KERNEL", kernel=configured)
    if latch.safe:
        return replace(settings, start_mode=LoopMode.SAFE)
    return settings if latch.writable else replace(settings, start_mode=LoopMode.OPEN)


class StartUp:
    """The configured flat map and control law, requested at the start."""

    def __init__(self, config: Configuration) -> None:
        self._flat_file, self._flat_nm = config.mirror.flat, _checked_flat_nm(config)
        self._law_file, self._law = config.control.law, _configured_law(config)
        _check_gains(config)

    def requests(self, state: State, time_ns: int) -> list[Request]:
        """The requests in the order to send them, once the mirror's shape is known.

        If the mirror already has the flat map, from an earlier controller, the flat map is subtracted from the adopted
        shape and added as a channel of its own, so that nothing moves. A lease may have been granted before the
        mirror's shape was known: the requests carry its identity, so that they are not refused.
        """
        lease = state.conditions.lease
        lease_id = 0 if lease is None or lease.ended or lease.expired(time_ns, 0) else lease.id
        request = partial(Request, time_ns, requester="the configuration", lease_id=lease_id)
        requests: list[Request] = []
        if self._law is not None:
            requests.append(request("law", law=self._law))
        if self._flat_nm is not None:
            adopted_nm = _adopted_nm(state, self._flat_nm)
            if adopted_nm is not None:
                remainder_nm = (adopted_nm - self._flat_nm).reshape(-1)
                if np.abs(remainder_nm).max() <= ADOPTED_NM:
                    remainder_nm[:] = 0
                requests.append(request("channel", text=ADOPTED, actuators_nm=remainder_nm))
            requests.append(request("channel", text=FLAT, actuators_nm=self._flat_nm.reshape(-1)))
        return requests

    def handle_refusal(self, request: Request, why: str) -> None:
        """Raise if a refused request leaves the loop different from the configuration.

        An adopted shape that cannot be split stays whole; the later requests are then not sent.
        """
        if request.text == ADOPTED:
            return
        key, file = ("control.law", self._law_file) if request.name == "law" else ("mirror.flat", self._flat_file)
        raise ConfigurationError(f"{key} = {file!r}: {why}")


def _adopted_nm(state: State, flat_nm: Single) -> Single | None:
    """The shape (rows, columns) adopted from the mirror, if it contains the flat map apart from controlled modes."""
    loop = state.loop
    if loop is None or loop.command_channels is None:
        return None
    shapes = [channel.shape_nm for channel in loop.command_channels.channels if channel.name == ADOPTED]
    if not shapes:
        return None
    vectors = shapes[0].reshape(-1), flat_nm.reshape(-1)
    adopted, flat = (shape - loop.to_actuators @ (loop.inverse @ shape) for shape in vectors)
    return shapes[0] if float(adopted @ flat) > MIN_FLAT_SHARE * float(flat @ flat) else None


def _checked_flat_nm(config: Configuration) -> Single | None:
    shape_nm = flat_nm(config)
    if shape_nm is not None:
        acting = limit(factory.settings(config).limits, shape_nm, shape_nm).reasons
        # The mirror approaches the flat map in steps within the slew limit.
        names = [reason.name.lower() for reason in acting if reason is not Limit.SLEW]
        if names:
            raise ConfigurationError(
                f"mirror.flat = {config.mirror.flat!r}: beyond the limits of [safety]: {', '.join(names)}"
            )
    return shape_nm


def _check_gains(config: Configuration) -> None:
    settings = factory.settings(config)
    for key, gain, leak in zip(("tilt_gain", "gain"), settings.gain, settings.leak, strict=True):
        with raised_as(ConfigurationError, ValueError, f"control.{key}"):
            check_gains([gain], [leak], settings.delay_frames)


def _check_law_modes(config: Configuration) -> None:
    linear_law = _configured_law(config)
    if linear_law is not None and linear_law.noll != config.noll:
        raise ConfigurationError(
            f"control.law = {config.control.law!r}: this law is for modes {_modes(linear_law.noll)}, but the sensor's "
            f"{config.sensor.modes} modes are {_modes(config.noll)}"
        )


def _modes(noll: tuple[int, ...]) -> str:
    return f"Z{noll[0]} to Z{noll[-1]}" if noll == tuple(range(noll[0], noll[-1] + 1)) else str(list(noll))
