"""An operator's requests to a running loop, from Python."""

import contextlib
import math
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from operator import index
from types import TracebackType
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
from google.protobuf.message import DecodeError, Message

from lowfc.adapters.bus.bus import ALL, UNREADABLE, Bus, Publisher, Sample
from lowfc.adapters.bus.names import Names
from lowfc.adapters.bus.run import DEFAULT_RUN, open_run
from lowfc.adapters.bus.zenoh_bus import ZenohBus
from lowfc.adapters.process.clock import HostClock
from lowfc.adapters.process.host import by_this_process, program_name
from lowfc.arrays import Single
from lowfc.client.answer import Answer
from lowfc.client.arguments import ARGUMENT_ERRORS, checked_type, floats, real
from lowfc.client.bench import bench_message
from lowfc.client.lease import Lease, new_identity
from lowfc.client.mirror_watch import MirrorWatch
from lowfc.client.requests import BY_NAME
from lowfc.client.runs import absence, the_run
from lowfc.client.stream import BUFFERED_MESSAGES, DEFAULT_TIMEOUT_S, Frame, Stream, frame_of, step_of
from lowfc.contract.codecs.calibration_codec import camera_settings, decode_calibration, encode_calibration
from lowfc.contract.codecs.codec import max_bytes
from lowfc.contract.codecs.law_codec import wire_law
from lowfc.contract.errors import BusError, LowfcError, RequestRefusedError, raised_as
from lowfc.contract.messages import (
    BENCH,
    CALIBRATION,
    CAMERA_STATE,
    CONTROLLER_STATE,
    FRAME,
    HEALTH,
    LAW,
    RECORD_KEY,
    REQUEST_KEY,
    STEP,
    Role,
    Topic,
    wire,
)
from lowfc.contract.published import Published
from lowfc.control.calibration.calibration import Calibration
from lowfc.control.laws.linear_law import LinearLaw
from lowfc.control.loop.camera import CameraSettings
from lowfc.control.loop.command_channels import MIRROR, OFFSET
from lowfc.control.loop.inputs import Step
from lowfc.control.loop.interlocks import Value
from lowfc.control.loop.wording import AUTO

Modes = int | np.integer[Any] | Sequence[int] | npt.NDArray[np.integer[Any]]
M = TypeVar("M", bound=Message)

CONNECT_S = 1.0  # longest wait of a new client for its first peer, and time for which it repeats a query
ANSWER_S = 2.0  # answer timeout
SLOW_ANSWER_S = 30.0
"""Answer timeout for a large request, such as a calibration, and for the start and the end of a log."""
LARGE_BYTES = 100_000
"""Size of a request above which the longer timeout applies."""


def _request_method(name: str) -> Callable[["Client"], Answer]:
    """Make the method of a request without fields, with its declared description as docstring."""

    def ask(client: "Client") -> Answer:
        return client.ask(name)

    ask.__doc__ = BY_NAME[name].description
    return ask


class Client:
    """A connection to a loop until `disconnect`, for use by one thread (the client's own thread renews a reservation).

    Only the process that answers a request has to be running.

    Every request is carried out between two frames or refused; the answer has the sequence of the first frame for which
    it is in force. A refused request raises RequestRefusedError, an unanswered one BusError.
    """

    def __init__(self, run: str | None = None, *, bus: Bus | None = None) -> None:
        """Join a run.

        `run` None selects the only run on this host. With a `bus`, `run` is only a name in messages, and `disconnect`
        does not close the bus.

        Raises:
            BusError: there is no such run, none at all, or more than one to choose from; or its router refuses this
                host's certificate.
            DataFileError: the run's directory is damaged; across hosts, the operator has no valid certificate here.
        """
        self.run_id = the_run(run) if bus is None else run or DEFAULT_RUN
        self._requester = by_this_process(program_name())
        self._own_bus = self._joined = None
        if bus is None:
            self._joined = open_run(self.run_id, ())
            bus = self._own_bus = ZenohBus(self._joined.links, Role.OPERATOR, HostClock())
            deadline_s = time.monotonic() + CONNECT_S
            while not bus.peers() and time.monotonic() < deadline_s:
                time.sleep(0.01)
        self._bus = bus
        self._grid: tuple[int, int] | None = None
        self._lease: Lease | None = None
        self._bench: dict[str, Publisher] = {}

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        self.disconnect()

    def disconnect(self) -> None:
        """Leave the run; the loop continues unchanged."""
        if self._own_bus is not None:
            self._own_bus.close()
            self._bench.clear()  # new publishers on the closed bus raise BusError, old ones would raise zenoh's error

    status = _request_method("status")
    open_loop = _request_method("open")
    close_loop = _request_method("close")
    pause = _request_method("pause")
    safe = _request_method("safe")
    clear = _request_method("clear")
    reset = _request_method("reset")
    stop = _request_method("stop")

    def gain(self, values: npt.ArrayLike, modes: Modes = ()) -> Answer:
        """Set integrator gains: one value, or one for each of `modes` (a Noll index or several, all when empty)."""
        return self.ask("gain", modes, values)

    def automatic_gain(self, modes: Modes = ()) -> Answer:
        """Let the controller choose integrator gains from its measurements (Noll indices; all when empty)."""
        return self.ask("gain", modes, text=AUTO)

    def leak(self, values: npt.ArrayLike, modes: Modes = ()) -> Answer:
        """Set integrator leaks: one value, or one for each mode, (modes,), as in `gain`."""
        return self.ask("leak", modes, values)

    def limit(self, values: npt.ArrayLike, modes: Modes = ()) -> Answer:
        """Set the modal limits (modes,), nm rms of wavefront, as in `gain`."""
        return self.ask("limit", modes, values)

    def step(self, frames: int) -> Answer:
        """Close the loop until this number of frames has been used; it then opens automatically."""
        return self.ask("step", values=frames)

    def offset(self, values: npt.ArrayLike = (), modes: Modes = ()) -> Answer:
        """Set the loop's target (modes,), nm rms of wavefront, as in `gain`; zero without values."""
        return self.ask("offset", modes, values)

    def channel(self, name: str, actuators_nm: npt.ArrayLike | None = None) -> Answer:
        """Add a shape to the mirror, (rows, columns) nm of surface, as channel `name`; None removes the channel.

        The sensor's zero point shifts with the shape, so that the loop does not undo it; the channel "flat" does not
        shift the zero point.
        """
        shape = floats("channel", () if actuators_nm is None else actuators_nm)
        if actuators_nm is not None and shape.shape != self.mirror_grid():
            got = f"got an array of shape {shape.shape}"
            raise RequestRefusedError(f"channel refused: the mirror has actuators of shape {self.mirror_grid()}, {got}")
        return self.ask("channel", text=name, actuators_nm=shape)

    def play(self, basis_nm: npt.ArrayLike, table: npt.ArrayLike) -> Answer:
        """Play a probe sequence: shapes added to the mirror frame by frame, unknown to the control law.

        Args:
            basis_nm: (shapes, actuators) or (shapes, rows, columns), nm of surface.
            table: (frames, shapes), factors of the shapes in each frame, starting with the frame of the answer.
        """
        basis, factors = floats("play", basis_nm), floats("play", table)
        basis = basis.reshape(len(basis), math.prod(basis.shape[1:])) if basis.ndim == 3 else basis
        if basis.ndim != 2 or factors.ndim != 2 or factors.shape[1] != len(basis):
            raise RequestRefusedError(
                "play refused: it takes shapes (shapes, actuators) and a table (frames, shapes), got arrays of shape "
                f"{basis.shape} and {factors.shape}"
            )
        return self.ask("play", text=MIRROR, actuators_nm=basis, table=factors)

    def play_offset(self, table_nm: npt.ArrayLike) -> Answer:
        """Play a probe sequence of the loop's target: (frames, modes), nm rms of wavefront, added frame by frame."""
        table = floats("play", table_nm)
        if table.ndim != 2:
            raise RequestRefusedError(f"play refused: it takes a table (frames, modes), got shape {table.shape}")
        return self.ask("play", text=OFFSET, table=table)

    def load(self, calibration: Calibration) -> Answer:
        """Use another calibration; a closed loop must be opened first."""
        return self.ask("load", calibration=calibration)

    def law(self, law: LinearLaw | None = None) -> Answer:
        """Let a linear law drive the mirror; None for the integrator."""
        return self.ask("law", law=law)

    @contextlib.contextmanager
    def reserved(self, purpose: str, duration_s: float | None = None) -> Iterator[Lease]:
        """Reserve the loop: until the end of the block, other clients' requests that would change it are refused.

        `safe` from anyone, and `open`, `pause` or `stop` from another client, end the reservation: see `check_lease`.
        `duration_s` is the expected duration, shown to other clients; the reservation does not end after it.
        """
        lockstep = bool(tomllib.loads(self.configuration()).get("lockstep"))
        self._lease = lease = Lease(self.ask, purpose, duration_s, lockstep=lockstep)
        try:
            yield lease
        finally:
            self._lease = None
            lease.release()

    def check_lease(self) -> None:
        """Check that this client's reservation, if it has one, is in force; CalibrationError with the reason if not."""
        if self._lease is not None:
            self._lease.check()

    def permit(self, purpose: str, hold_s: float | None = None, lease_id: int = 0) -> Answer:
        """Ask permission to move something on the bench; with `hold_s`, the loop holds its command: see `held`.

        `lease_id` identifies the hold when it is released; 0 for a new identity.
        """
        values = () if hold_s is None else hold_s
        return self.ask("permit", values=values, text=by_this_process(purpose), lease_id=lease_id or new_identity())

    @contextlib.contextmanager
    def held(self, purpose: str, hold_s: float) -> Iterator[None]:
        """Hold the loop for at most `hold_s` while something on the bench moves; a closed loop then resumes.

        Until the end of the hold, requests that would change the loop are refused, also those of this client, except
        `open`, `pause`, `stop` and `safe`, which end the hold. Within `reserved` a hold is refused: use `pause` and
        `close_loop` there.
        """
        identity = new_identity()
        self.permit(purpose, hold_s, identity)
        try:
            yield
        finally:
            with contextlib.suppress(LowfcError):  # the hold expires anyway
                self.ask("release", lease_id=identity)

    def bench(self, name: str, value: Value) -> None:
        """Publish a value of another device on the bench, for interlocks: repeat it before it becomes too old.

        Raises:
            ConfigurationError: the name or the value is invalid.
        """
        message = bench_message(name, value, HostClock().now_ns())
        if name not in self._bench:
            self._bench[name] = self._bus.publisher(BENCH, name)
        self._bench[name].put(message)

    def note(self, text: str) -> Answer:
        """Write a note to the log."""
        return self.ask("note", text=text)

    def record(self, on: bool) -> Answer:
        """Start the next log, if none is being recorded, or finish the current one; the answer's text is its path."""
        key = RECORD_KEY.format(name="start" if on else "stop")
        return self._answer("record", self._get(key, b"", SLOW_ANSWER_S, Role.RECORDER))

    def configuration(self) -> str:
        """The configuration that the controller was started with, as TOML."""
        return self.ask("configuration").reply

    def calibration(self) -> Calibration:
        """The calibration in use; BusError if there is none, or the answer is not a calibration."""
        # While no calibration is in use, the last published one may be one that the controller refused.
        if not self._get_message(CONTROLLER_STATE, wire.ControllerState, Role.CONTROLLER).calibration_id:
            remedy = "`lowfc ctl load FILE` loads one, `lowfc commission` measures one"
            raise BusError(f"no calibration is loaded in run {self.run_id!r}: {remedy}")
        sample = self._get(CALIBRATION.key, b"", ANSWER_S)
        with raised_as(BusError, (DecodeError, ValueError), f"the answer to {CALIBRATION.key} is not a calibration"):
            return decode_calibration(wire.Calibration.FromString(sample.payload))

    def mirror_grid(self) -> tuple[int, int]:
        """Rows and columns of the mirror's actuators, also without a calibration; BusError if no controller answers."""
        if self._grid is None:  # fixed within a run
            state = self._get_message(CONTROLLER_STATE, wire.ControllerState, Role.CONTROLLER)
            self._grid = (state.mirror_rows, state.mirror_columns) if state.mirror_rows else self.calibration().grid
        return self._grid

    def camera(self) -> CameraSettings | None:
        """Camera settings as the controller last received them, to store with a measurement; None without any."""
        state = self.status().state
        if state is None or not state.HasField("camera"):
            return None
        return replace(camera_settings(state.camera), start_s=0)

    def camera_state(self) -> wire.CameraState:
        """Camera settings as the camera publishes them; BusError if no camera answers."""
        return self._get_message(CAMERA_STATE, wire.CameraState, Role.CAMERA)

    def processes(self) -> dict[str, wire.Health]:
        """Health of each process of the run, by name."""
        reports, names = {}, Names()
        for sample in self._bus.get(HEALTH.at(ALL), timeout_s=ANSWER_S):
            with contextlib.suppress(*UNREADABLE):
                name, health = names.health(sample.key, sample.payload)
                reports[name] = health
        return reports

    def laws(self) -> dict[str, LinearLaw]:
        """The control law published last, by its identity, whether or not it drives the mirror; empty without any."""
        published = Published()
        for sample in self._bus.get(LAW.key, timeout_s=ANSWER_S):
            published.store(LAW, sample.payload)
        return published.laws

    def frames(self, count: int | None = None, patience_s: float = DEFAULT_TIMEOUT_S) -> Stream[Frame]:
        """Stream sensor images from now on, `count` of them or without end; BusError if none comes for `patience_s`."""
        return Stream(self._bus.ring(FRAME, BUFFERED_MESSAGES), frame_of, "frame", count, patience_s)

    def steps(self, count: int | None = None, patience_s: float = DEFAULT_TIMEOUT_S) -> Stream[Step]:
        """Stream control steps, one for each frame, from now on, `count` of them or without end; see `frames`."""
        return Stream(self._bus.ring(STEP, BUFFERED_MESSAGES), step_of, "step", count, patience_s)

    def mirror_watch(self) -> MirrorWatch:
        """Watch the mirror's reports from now on; see `MirrorWatch`."""
        return MirrorWatch(self._bus)

    def ask(
        self,
        name: str,
        modes: Modes = (),
        values: npt.ArrayLike = (),
        *,
        text: str = "",
        actuators_nm: Single | None = None,
        table: Single | None = None,
        law: LinearLaw | None = None,
        calibration: Calibration | None = None,
        lease_id: int | None = None,
    ) -> Answer:
        """Send any request, with the fields of `lowfc.v1.Request`: `values` (modes,), `actuators_nm` in nm of surface.

        Raises:
            BusError: no controller is running, or it is too slow.
            RequestRefusedError: the controller refused, with its reason.
        """
        with raised_as(RequestRefusedError, ARGUMENT_ERRORS, f"{name} refused"):
            message = wire.Request(
                name=name,
                modes=[index(mode) for mode in np.atleast_1d(modes).tolist()] if np.size(modes) else [],
                values=np.atleast_1d(np.asarray(real(values), np.float64)).tolist(),
                text=checked_type(name, text, str),
                actuators=b"" if actuators_nm is None else actuators_nm.tobytes(),
                table=b"" if table is None else table.tobytes(),
                columns=0 if table is None else table.shape[1],
                law=None if law is None else wire_law(checked_type(name, law, LinearLaw)),
                lease_id=(self._lease.id if self._lease is not None else 0) if lease_id is None else lease_id,
                requester=self._requester,
            )
        if calibration is not None:
            message.calibration.MergeFromString(encode_calibration(checked_type(name, calibration, Calibration), 0))
        payload = message.SerializeToString()
        if len(payload) > max_bytes(name):
            remedy = ": send it in parts" if name in ("play", "note") else ""
            raise RequestRefusedError(
                f"{name} refused: at most {max_bytes(name):,} bytes, got {len(payload):,}{remedy}"
            )
        timeout_s = SLOW_ANSWER_S if len(payload) > LARGE_BYTES else ANSWER_S
        return self._answer(name, self._get(REQUEST_KEY.format(name=name), payload, timeout_s))

    def _get(self, key: str, payload: bytes, answer_s: float, role: Role = Role.CONTROLLER) -> Sample:
        """Query one process; retry for a second, as the links of a new client may not be complete yet."""
        deadline_s = time.monotonic() + CONNECT_S
        while True:
            begun_s = time.monotonic()
            if answers := self._bus.get(key, payload, answer_s):
                return answers[0]
            now_s = time.monotonic()
            if now_s - begun_s >= answer_s * 0.9:
                raise BusError(
                    f"the {role} of run {self.run_id!r} did not answer within {answer_s:g} s: it hangs or is too slow; "
                    "the log and `lowfc ctl status` show whether the request was carried out"
                )
            if now_s >= deadline_s:
                raise BusError(absence(self.run_id, role, self._joined))
            time.sleep(0.05)

    def _get_message(self, topic: Topic, kind: type[M], role: Role) -> M:
        """The last message that a process published on a topic; BusError if there is none."""
        with raised_as(BusError, DecodeError, f"the answer to {topic.key} is not a {kind.DESCRIPTOR.full_name}"):
            return kind.FromString(self._get(topic.key, b"", ANSWER_S, role).payload)

    def _answer(self, name: str, sample: Sample) -> Answer:
        with raised_as(BusError, DecodeError, f"the answer to {name} is not a lowfc.v1.Request"):
            message = wire.Request.FromString(sample.payload)
        if not message.accepted:
            raise RequestRefusedError(f"{name} refused: {message.reply} (run {self.run_id})")
        state = message.state if message.HasField("state") else None
        return Answer(True, message.reply, message.frame_sequence, message.text, state, self.run_id)
