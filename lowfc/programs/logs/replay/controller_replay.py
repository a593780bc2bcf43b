"""One controller of a log, run again: its inputs in the order it took them, every result compared."""

import contextlib
from collections import deque
from copy import deepcopy
from dataclasses import dataclass, field

from google.protobuf.message import Message

from lowfc.adapters.bus.bus import Sample
from lowfc.adapters.process import compiled
from lowfc.contract.codecs import codec
from lowfc.contract.codecs.state_codec import controller_state, decode_state
from lowfc.contract.errors import DataFileError
from lowfc.contract.messages import from_timestamp, wire
from lowfc.contract.published import Published
from lowfc.control.kernel.tables import Kernel
from lowfc.control.loop.advance import advance
from lowfc.control.loop.inputs import Input, Outputs, Request
from lowfc.control.loop.requests import prepared
from lowfc.control.loop.state import Settings, State
from lowfc.programs.logs.replay.account import Account
from lowfc.programs.logs.replay.difference import Difference, difference
from lowfc.programs.logs.replay.former import Former, changed_rule
from lowfc.programs.logs.replay.frames import Frames

PATIENCE_NS = 2_000_000_000
"""Messages of several publishers are recorded in the order they arrive; what is later than this is missing."""
_STATES_KEPT = 256
_BEFORE = "recorded before the first complete state of the controller"


@dataclass(slots=True)
class _Entry:
    """What the log has of one input of the controller, `taken`, and of the command that it gave rise to."""

    receive_time_ns: int
    taken: wire.ControlStep | wire.Request | wire.ControlInput | None = None
    taken_bytes: bytes = b""
    command: wire.MirrorCommand | None = None
    command_bytes: bytes = b""

    @property
    def commands(self) -> bool:
        """Whether a controller with a calibration sends a command."""
        taken = self.taken
        return isinstance(taken, wire.ControlStep) or (isinstance(taken, wire.ControlInput) and taken.HasField("tick"))


@dataclass(frozen=True, slots=True)
class Share:
    """The part of a log that one worker replays: from the first state at `from_ns` to the first one at `until_ns`.

    Log times; a worker is given the messages around its share too.
    """

    from_ns: int = 0
    until_ns: int = 1 << 63


WHOLE = Share()


@dataclass(slots=True)
class Context:
    """What the controllers of a replay have in common.

    Attributes:
        tolerance_nm: differences up to this are none.
        kernel: that computes; empty for the log's own.
        former: what is compared of the log of another version; to be set before the first message.
    """

    tolerance_nm: float = 0.0
    share: Share = WHOLE
    frames: Frames = field(default_factory=Frames)
    published: Published = field(default_factory=Published)
    account: Account = field(default_factory=Account)
    kernel: str = ""
    former: Former | None = None


class ControllerReplay:
    """One start of a controller: its inputs in the order it took them, folded again.

    Attributes:
        done: the state where the next share begins has been reached.
        retry_pending: a state or a calibration has come since it was last tried to go on from one.
    """

    def __init__(self, context: Context, begun_ns: int) -> None:
        """A controller whose first message has the log time `begun_ns`: of the share in which that is."""
        self.done = begun_ns >= context.share.until_ns
        self.retry_pending = False
        self._context, self._account = context, context.account
        self._last: int | None = None
        self._lost_at: int | None = None
        self._forgotten = 0
        self._began = 0
        self._first: int | None = None  # of the inputs in the log
        self._form: tuple[int, str] | None = None
        self._entries: dict[int, _Entry] = {}
        self._states: dict[int, wire.ControllerState] = {}
        self._settings: Settings | None = None
        self._state: State | None = None
        self._past: deque[State] = deque(maxlen=_STATES_KEPT)
        self._why = _BEFORE if begun_ns >= context.share.from_ns else ""
        self._counts = bool(self._why)

    def take(self, message: Sample, kind: type[Message]) -> None:
        """Take one of the controller's messages; the fold goes on as far as it can."""
        if self.done:
            return
        body = kind.FromString(message.payload)
        if isinstance(body, wire.ControllerState):
            self._take_state(body, message.receive_time_ns)
        else:
            number: int = body.input_number  # type: ignore[attr-defined]  # all others of the controller have it
            if not number:  # a request that could not be read, a command of somebody else
                if kind is wire.ControlStep:
                    raise DataFileError(
                        "the steps in this log are not numbered: it was recorded by a version before replay, or by "
                        "another controller; `lowfc what-if` and `lowfc report` read it"
                    )
                return
            self._first = number if self._first is None else min(number, self._first)
            if self._state is not None and number <= self._state.input_number:
                self._come_late(number, body)
                return
            entry = self._entries.get(number)
            if entry is None:
                entry = self._entries[number] = _Entry(message.receive_time_ns)
            if isinstance(body, wire.MirrorCommand):  # what it was made from comes after it
                entry.command, entry.command_bytes = body, message.payload
                return
            entry.taken, entry.taken_bytes = body, message.payload  # type: ignore[assignment]  # one of the three
            if isinstance(body, wire.ControlStep):
                self._context.frames.note_step(body)
        self.go_on(message.receive_time_ns)

    def _come_late(self, number: int, body: Message) -> None:
        """A message of an input that is behind: from before the state that was begun with, or there a second time."""
        if number <= self._began:
            if self._counts:
                self._account.leave_out(_BEFORE, int(isinstance(body, wire.ControlStep)))
        elif not isinstance(body, wire.MirrorCommand) and self._state is not None:
            name = body.DESCRIPTOR.name
            second = Difference(name, number, self._state.frame_sequence, [f"a second one of input {number}"])
            second.otherwise = True
            self._account.enter(second, self._context.tolerance_nm)
            self._account.frames += isinstance(body, wire.ControlStep)

    def go_on(self, now_ns: int, *, ended: bool = False) -> None:
        """Take every input that is complete, or too old to become so; all that is left when the log has `ended`."""
        while (self._entries or self._states) and not self.done:
            if self._state is None and not self._adopt():
                if not self.done:
                    self._forget(now_ns, ended=ended)
                return
            assert self._state is not None  # noqa: S101  # adopted
            number = self._state.input_number + 1
            entry = self._entries.get(number)
            if entry is None:
                waiting = next(iter(self._entries.values()), None)
                if waiting is None or not (ended or now_ns - waiting.receive_time_ns > PATIENCE_NS):
                    return
                earlier = self._first is not None and number < self._first  # than the recording
                self._lose(_BEFORE if earlier else "after an input that the log does not have")
                continue
            late = ended or now_ns - entry.receive_time_ns > PATIENCE_NS
            if not late and entry.command is None and entry.commands and self._state.drive is not None:
                return
            rule = changed_rule(entry.taken) if self._context.former is not None else ""
            if rule and number not in self._states and not late:
                return  # the state after it is what may have to be gone on from
            taken = self._input(entry, late=late)
            if taken is not None and rule and number in self._states:
                del self._entries[number]
                self._go_on_by_rule(rule, taken, self._states.pop(number))
            elif taken is not None:
                del self._entries[number]
                self._check(entry, taken)
            elif late:
                self._lose(f"after {'an input' if entry.taken is None else 'a frame'} that the log does not have")
            else:
                return

    def _take_state(self, message: wire.ControllerState, receive_time_ns: int) -> None:
        if receive_time_ns < self._context.share.from_ns:
            return
        if receive_time_ns >= self._context.share.until_ns:
            self._last = message.input_number if self._last is None else min(self._last, message.input_number)
        past = next((state for state in self._past if state.input_number == message.input_number), None)
        if past is not None:
            self._compare_state(past, message)
        elif self._state is None or message.input_number > self._state.input_number:
            self._states[message.input_number] = message
            self.retry_pending = True

    def _adopt(self) -> bool:
        """Go on from the earliest complete state whose calibration is known."""
        if not self.retry_pending:
            return False
        self.retry_pending = False
        for number in sorted(self._states):
            message = self._states[number]
            try:
                settings, state = self._decoded(message)
            except ValueError as error:
                self._why = self._why and f"not replayed: {error}"
                continue
            self._states = {later: state for later, state in self._states.items() if later > number}
            self._settings, self._state, self._began = settings, state, number
            self._past.append(state)
            self._counts = bool(self._why)
            self._leave_out(number)
            if self._lost_at is not None:
                self._account.inputs_missing += number - self._lost_at - self._forgotten
                self._lost_at = None
            self.done = number == self._last
            return not self.done
        return False

    def _decoded(self, message: wire.ControllerState) -> tuple[Settings, State]:
        known = self._context.published
        calibration = known.calibrations.get(message.calibration_id)
        return decode_state(message, calibration, known.laws, known.plays, self._kernel)

    def _kernel(self, name: str) -> Kernel:
        """The kernel to replay with, under the log's name for it."""
        found = compiled.kernel(self._context.kernel or name)
        if found.name != name:
            self._account.other_kernel = found.name
        return found._replace(name=name)

    def _leave_out(self, upto: int) -> None:
        for number in [number for number in self._entries if number <= upto]:
            taken = self._entries.pop(number).taken
            self._forgotten += taken is not None
            if self._why:  # else they are another share's
                self._account.leave_out(self._why, int(isinstance(taken, wire.ControlStep)))

    def _forget(self, now_ns: int, *, ended: bool) -> None:
        """While there is no state to go on from, forget what the next one will not need, and states of no use."""
        old = [number for number, entry in self._entries.items() if now_ns - entry.receive_time_ns > 2 * PATIENCE_NS]
        self._leave_out(max(self._entries if ended else old, default=0))
        while len(self._states) > _STATES_KEPT:
            del self._states[min(self._states)]

    def _lose(self, why: str) -> None:
        self._why = why
        self._lost_at = self._state.input_number if self._state is not None and why not in ("", _BEFORE) else None
        self._forgotten = 0
        self._state = None
        self.retry_pending = True
        self._past.clear()

    def _input(self, entry: _Entry, *, late: bool) -> Input | None:
        """What the controller took; None where the log does not have it (yet); nothing more comes when it is `late`."""
        match entry.taken:
            case wire.ControlStep() as step:
                late_ns = 0 if self._settings is None else self._settings.max_frame_age_ns + 1
                age_ns = late_ns if wire.REASON_LATE in step.reasons else 0
                # With no other left, a frame of another time: then the step is wrong, which the comparison finds.
                frame = self._context.frames.frame(
                    step.frame_sequence, from_timestamp(step.timestamp), age_ns, last=late
                )
                if frame is not None and wire.REASON_AHEAD in step.reasons:
                    frame = frame._replace(ahead=True)
                return frame
            case wire.Request() as request:
                with contextlib.suppress(ValueError):
                    time_ns, known = from_timestamp(request.timestamp), self._context.published
                    asked = codec.request(request, request.name, time_ns, known.calibrations, known.laws, known.plays)
                    return asked if self._settings is None else prepared(self._settings, asked)
            case wire.ControlInput() as other:
                with contextlib.suppress(ValueError):
                    return codec.decode_input(other, self._context.published.calibrations)
        return None

    def _go_on_by_rule(self, rule: str, taken: Input, logged: wire.ControllerState) -> None:
        """Take an input for which a rule has changed since; where it makes a difference, go on from the log's state."""
        assert self._settings is not None  # noqa: S101  # there is a state
        assert self._state is not None  # noqa: S101
        state, _ = advance(self._settings, self._state, taken)
        again = controller_state(state, self._settings, from_timestamp(logged.timestamp))
        found = self._difference(state, logged, again)
        if found is None or found.within(self._context.tolerance_nm):
            self._account.states += 1
        else:
            self._account.rules_changed[rule] += 1
            try:
                self._settings, state = self._decoded(logged)
            except ValueError as error:
                self._lose(f"not replayed: {error}")
                return
        self._account.requests += isinstance(taken, Request)
        self._state = state
        self._past.append(state)
        self.done = state.input_number == self._last

    def _difference(self, state: State, logged: Message, replayed: Message | None) -> Difference | None:
        """What differs in all that is compared; None where nothing does."""
        if self._context.former is not None and type(replayed) is type(logged):
            if isinstance(logged, wire.ControllerState):
                logged = self._in_todays_form(logged)
            elif isinstance(logged, wire.Request) and logged.HasField("state"):
                logged = deepcopy(logged)
                logged.state.CopyFrom(self._in_todays_form(logged.state))
            logged, replayed = self._context.former.compared(logged), self._context.former.compared(replayed)
        if replayed == logged and (self._context.former is not None or isinstance(logged, wire.ControllerState)):
            return None  # of other messages the bytes differ
        return difference(state.input_number, state.frame_sequence, logged, replayed)

    def _in_todays_form(self, logged: wire.ControllerState) -> wire.ControllerState:
        """A state with the same content; one that cannot be decoded as it is."""
        with contextlib.suppress(ValueError):
            settings, state = self._decoded(logged)
            return controller_state(state, settings, from_timestamp(logged.timestamp))
        return logged

    def _check(self, entry: _Entry, taken: Input) -> None:
        assert self._settings is not None  # noqa: S101  # there is a state
        assert self._state is not None  # noqa: S101
        state, outputs = advance(self._settings, self._state, taken)
        self._state = state
        self._past.append(state)
        account = self._account
        if outputs.step is not None and entry.taken is not None:
            account.frames += 1
            self._compare(entry.taken, entry.taken_bytes, codec.encode_step(outputs.step, state.input_number))
        if entry.command is not None:
            account.commands += 1
            again = None
            if outputs.command is not None:
                self._form = self._form or (entry.command.valid_for_ns, entry.command.channel)
                again = codec.encode_command(outputs.command, *self._form, state.input_number)
            self._compare(entry.command, entry.command_bytes, again)
        elif outputs.command is not None:
            account.commands_missing += 1
        if isinstance(entry.taken, wire.Request):
            account.requests += 1
            assert isinstance(taken, Request)  # noqa: S101
            self._compare(entry.taken, entry.taken_bytes, self._answer(entry.taken, taken, outputs, state))
        logged = self._states.pop(state.input_number, None)
        if logged is not None:
            self._compare_state(state, logged)

    def _answer(self, request: wire.Request, asked: Request, outputs: Outputs, state: State) -> bytes | None:
        assert self._settings is not None  # noqa: S101
        if outputs.reply is None:
            return None
        shown = controller_state(state, self._settings, asked.time_ns) if request.HasField("state") else None
        return codec.encode_request(asked, outputs.reply, state.input_number, shown)

    def _compare_state(self, state: State, logged: wire.ControllerState) -> None:
        assert self._settings is not None  # noqa: S101
        self._account.states += 1
        self.done = state.input_number == self._last
        replayed = controller_state(state, self._settings, from_timestamp(logged.timestamp))
        found = self._difference(state, logged, replayed)
        if found is None:
            return
        self._account.enter(found, self._context.tolerance_nm)
        if self._state is state and not self.done:  # or what differs here would differ for the rest of the log
            self._states[state.input_number] = logged
            self._lose("")
            self._adopt()

    def _compare(self, logged: Message, logged_bytes: bytes, replayed: bytes | None) -> None:
        if replayed == logged_bytes:
            return
        assert self._state is not None  # noqa: S101
        body = None if replayed is None else type(logged).FromString(replayed)
        self._account.enter(self._difference(self._state, logged, body), self._context.tolerance_nm)
