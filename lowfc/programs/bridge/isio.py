"""`lowfc bridge isio`: write control steps to ImageStreamIO streams, and report other programs' shapes to the loop."""

import contextlib
import sys
import time
from collections.abc import Sequence
from typing import Annotated

import numpy as np
import typer
from google.protobuf.message import DecodeError

from lowfc.adapters.bus.bus import Bus
from lowfc.adapters.bus.run import open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.image_stream.channels import OtherChannels, fits, other_channel_names, sum_name
from lowfc.adapters.image_stream.stream import Stream, StreamAbsentError, StreamError, stream_path
from lowfc.adapters.process.clock import Clock, HostClock
from lowfc.adapters.process.realtime import lower_priority
from lowfc.adapters.process.terminal import AnyRun
from lowfc.client import Client
from lowfc.client.runs import the_known_run
from lowfc.client.stream import step_of
from lowfc.contract.errors import ConfigurationError, LowfcError, RequestRefusedError
from lowfc.contract.messages import CONTROLLER_STATE, STEP, Role, wire
from lowfc.contract.printable import printable
from lowfc.control.loop.command_channels import EXTERNAL

RING_STEPS = 2000
"""Length of the ring buffer of steps: two seconds at 1 kHz."""
_POLL_S = 0.005
_REQUEST_PERIOD_S = 0.1
"""Shortest time between two requests for a channel that changes continuously."""
_RETRY_S = 2.0
"""Time from a refusal to the next request: long, because each refused request is in the log."""


def bridge_isio(
    run: AnyRun = None,
    prefix: Annotated[str, typer.Option(help="Prefix of the streams' names.")] = "lowfc",
    beside: Annotated[
        str, typer.Option(help="The loop's own channel; the loop does not undo the other channels of its mirror.")
    ] = "",
    external: Annotated[list[str] | None, typer.Option(help="Channel not undone by the loop; may be repeated.")] = None,
    nm_per_unit: Annotated[float, typer.Option(min=1e-9, max=1e9, help="Surface per unit of a channel, nm.")] = 1000.0,
) -> None:
    """Publish modal error, command, residual and flux as ImageStreamIO streams, until Ctrl-C.

    With --beside or --external the loop also receives other programs' shapes on the mirror, and does not undo them.

    Example: lowfc bridge isio --run bench --beside dm00disp03
    """
    names = (*(external or ()), *other_channel_names(beside))
    if beside and not other_channel_names(beside):
        raise ConfigurationError(
            f"--beside must be a channel such as dm00disp03, got {beside!r}; give other channels with --external"
        )
    if beside in names:
        raise ConfigurationError(f"{beside} is the loop's own channel (--beside): leave out --external {beside}")
    for name in names:
        if sum_name(f"{name}00") == name:  # such as dm00disp, the sum that contains dm00disp00
            raise ConfigurationError(
                f"--external {name} is a sum, which may contain the loop's own channel: name single channels"
            )
    lower_priority()
    run_id, clock = the_known_run(run), HostClock()
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            joined = open_run(run_id, ())
            with contextlib.closing(ZenohBus(joined.links, Role.OPERATOR, clock, monitor=True)) as bus:
                steps = StepStreams(bus, clock, prefix)
                others = ExternalChannels(Client(run_id, bus=bus), bus, names, nm_per_unit) if names else None
                streams = f"{prefix}_error, _command, _residual and _flux"
                sys.stderr.write(f"publishing run {run_id!r} as streams {streams}; Ctrl-C ends this\n")
                while not joined.restarted():
                    steps.write_new_steps()
                    if others is not None:
                        others.report_changes()
                    time.sleep(_POLL_S)


class StepStreams:
    """Writes each step of the control law into streams."""

    def __init__(self, bus: Bus, clock: Clock, prefix: str) -> None:
        """Write into the streams PREFIX_error, PREFIX_command, PREFIX_residual and PREFIX_flux.

        Raises StreamError if these cannot be names of streams.
        """
        stream_path(f"{prefix}_residual")  # the longest name
        self._ring = bus.ring(STEP, RING_STEPS)
        self._clock = clock
        self._prefix = prefix
        self._streams: dict[str, Stream] = {}

    def write_new_steps(self) -> None:
        """Write the steps that have arrived.

        Raises:
            StreamError: another process writes a stream of this name, or the stream cannot be created.
        """
        for sample in self._ring.drain():
            step = step_of(sample)
            if step is None:
                continue
            values = {"command": step.command_nm, "flux": np.array([step.flux_dn], np.float32)}
            if step.error_nm is not None:
                values |= {"error": step.error_nm, "residual": np.linalg.norm(step.error_nm, axis=0, keepdims=True)}
            wall_ns = step.time_ns - self._clock.ahead_ns()
            for name, numbers in values.items():
                if numbers.size:
                    self._stream(f"{self._prefix}_{name}", numbers.size).put(numbers[np.newaxis], wall_ns)

    def _stream(self, name: str, columns: int) -> Stream:
        stream = self._streams.get(name)
        if stream is None or not stream.current() or stream.layout.shape[2] != columns:
            stream = self._streams[name] = _open_or_create(name, columns)
        return stream


class ExternalChannels:
    """Sum of other programs' shapes on the mirror, reported to the loop when it changes or a controller starts."""

    def __init__(self, client: Client, bus: Bus, names: Sequence[str], nm_per_unit: float) -> None:
        """Watch these channels, in units of `nm_per_unit` nm of surface; StreamError for an impossible name."""
        self._client = client
        self._states = bus.ring(CONTROLLER_STATE, 1)
        self._nm_per_unit = np.float32(nm_per_unit)
        for name in names:
            stream_path(name)
        self._names = names
        self._others: OtherChannels | None = None  # None until a controller has reported the mirror's grid
        self._controller_shape = b""  # of the channel `external`, as last reported or requested
        self._next_request_s = 0.0
        self._last_report = ""

    def report_changes(self) -> None:
        """Request a new shape for the controller's channel `external` if the sum differs from the channel's shape."""
        for sample in self._states.drain():
            with contextlib.suppress(DecodeError):
                channels = wire.ControllerState.FromString(sample.payload).channels
                self._controller_shape = next((one.actuators for one in channels if one.name == EXTERNAL), b"")
        if (now_s := time.monotonic()) < self._next_request_s:
            return
        try:
            if self._others is None:
                self._others = OtherChannels(self._names, self._client.mirror_grid())
            shape_nm = self._others.sum() * self._nm_per_unit
            requested = shape_nm.tobytes() if shape_nm.any() else b""
            if requested != self._controller_shape:
                self._client.channel(EXTERNAL, shape_nm if requested else None)
                self._controller_shape, self._next_request_s = requested, now_s + _REQUEST_PERIOD_S
            report = "; left out: ".join((", ".join(self._others.names) or "none yet", *self._others.unusable))
        except LowfcError as error:
            report = f"not reported to the loop: {error}"
            self._next_request_s = now_s + (_RETRY_S if isinstance(error, RequestRefusedError) else _REQUEST_PERIOD_S)
        if report != self._last_report:
            self._last_report = report
            sys.stderr.write(f"other channels: {printable(report)}\n")


def _open_or_create(name: str, columns: int) -> Stream:
    """The one-row stream that this process writes: an existing one if its size fits, otherwise a new one."""
    path = stream_path(name)
    with contextlib.suppress(StreamAbsentError):
        stream = Stream(path)
        if pid := stream.other_writer():
            raise StreamError(f"process {pid} writes stream {name!r}: stop it first, or use another --prefix")
        if not fits(stream, (1, stream.layout.shape[2])):
            raise StreamError(f"stream {name!r} belongs to another program ({path}): use another --prefix")
        if stream.layout.shape[2] == columns:
            return stream
        path.unlink(missing_ok=True)
    return Stream.create(path, (1, columns), np.float32)
