"""Replay one controller of a log: apply its inputs in their order, and compare every result with the log."""

import contextlib
from collections import deque
from copy import deepcopy
from dataclasses import dataclass, field, replace

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
from lowfc.control.loop.inputs import Input, Request
from lowfc.control.loop.requests import prepared
from lowfc.control.loop.state import Settings, State
from lowfc.programs.logs.replay.account import Account
from lowfc.programs.logs.replay.difference import Difference, difference
from lowfc.programs.logs.replay.former import FormerVersion, changed_rule
from lowfc.programs.logs.replay.frames import Frames

PATIENCE_NS = 2_000_000_000
"""Longest log time to wait for a message of another publisher, because a log is in the order of arrival."""
_STATES_KEPT = 256  # newest replayed states; before the replay has adopted a state, newest logged states
_BEFORE_STATE = "recorded before the first complete state of the controller"


@dataclass(slots=True)
class _Entry:
    """One input of the controller as logged, and the command that it led to."""

    receive_time_ns: int
    logged: wire.ControlStep | wire.Request | wire.ControlInput | None = None
    logged_bytes: bytes = b""
    command: wire.MirrorCommand | None = None
    command_bytes: bytes = b""

    @property
    def leads_to_command(self) -> bool:
        """Whether a controller with a calibration may send a command after this input."""
        logged = self.logged
        return isinstance(logged, wire.ControlStep) or (
            isinstance(logged, wire.ControlInput) and logged.HasField("tick")
        )


@dataclass(frozen=True, slots=True)
class Segment:
    """Part of a log that one worker replays: from the first state after `from_ns` to the first after `until_ns`.

    Both are log times; the worker also receives the messages around its segment.
    """

    from_ns: int = 0
    until_ns: int = 1 << 63


WHOLE = Segment()


@dataclass(slots=True)
class Context:
    """Data shared by the controllers of a replay.

    Attributes:
        tolerance_nm: largest difference to ignore.
        kernel: name of the kernel to replay with; empty for the log's own.
        former: fields to compare in a file of another version; None for a file of this version; set for each file.
    """

    tolerance_nm: float = 0.0
    segment: Segment = WHOLE
    frames: Frames = field(default_factory=Frames)
    published: Published = field(default_factory=Published)
    account: Account = field(default_factory=Account)
    kernel: str = ""
    former: FormerVersion | None = None


class ControllerReplay:
    """Replay of a controller from one of its starts on: applies `advance` to its inputs, one after the other.

    Attributes:
        done: whether the state at the start of the next segment has been reached.
        retry_pending: whether a state or calibration has arrived since the last attempt to adopt a state.
    """

    def __init__(self, context: Context, begun_ns: int) -> None:
        """Replay a controller; `begun_ns`, the log time of its first message, decides which segment replays it."""
        self.done = begun_ns >= context.segment.until_ns
        self.retry_pending = False
        self._context, self._account = context, context.account
        self._end_number: int | None = None  # input number of the first state of the next segment
        self._lost_number: int | None = None  # input number at which the state was lost
        self._dropped = 0  # number of inputs dropped since then
        self._start_number = 0  # input number of the adopted state
        self._first_number: int | None = None  # lowest input number in the log
        self._command_form: tuple[int, str] | None = None  # validity, ns, and channel of the log's commands
        self._entries: dict[int, _Entry] = {}
        self._states: dict[int, wire.ControllerState] = {}
        self._settings: Settings  # set with each adopted state
        self._state: State | None = None
        self._recent_states: deque[State] = deque(maxlen=_STATES_KEPT)
        # Why steps are not checked before the next state is adopted; empty if another segment counts them.
        self._unchecked_because = _BEFORE_STATE if begun_ns >= context.segment.from_ns else ""
        self._counts_earlier = bool(self._unchecked_because)  # whether steps before the adopted state are counted

    def add(self, message: Sample, kind: type[Message]) -> None:
        """Add one of the controller's messages, and replay as far as possible."""
        if self.done:
            return
        body = kind.FromString(message.payload)
        if isinstance(body, wire.ControllerState):
            self._add_state(body, message.receive_time_ns)
        else:
            number: int = body.input_number  # type: ignore[attr-defined]  # every kind has it
            if not number:  # an unreadable request, or a command of another program
                if kind is wire.ControlStep:
                    raise DataFileError(
                        "the steps in this log are not numbered: it was recorded by a version without replay, or by "
                        "another controller; use `lowfc what-if` or `lowfc report`"
                    )
                return
            self._first_number = number if self._first_number is None else min(number, self._first_number)
            if self._state is not None and number <= self._state.input_number:
                self._account_for_past(number, body)
                return
            entry = self._entries.get(number)
            if entry is None:
                entry = self._entries[number] = _Entry(message.receive_time_ns)
            if isinstance(body, wire.MirrorCommand):  # the input that led to the command is published later
                entry.command, entry.command_bytes = body, message.payload
                return
            entry.logged, entry.logged_bytes = body, message.payload  # type: ignore[assignment]  # one of the three
            if isinstance(body, wire.ControlStep):
                self._context.frames.note_step(body)
        self.proceed(message.receive_time_ns)

    def _account_for_past(self, number: int, body: Message) -> None:
        """Account for a message of a past input: from before the adopted state, or a duplicate."""
        if number <= self._start_number:
            if self._counts_earlier:
                self._account.count_unchecked(_BEFORE_STATE, int(isinstance(body, wire.ControlStep)))
        elif not isinstance(body, wire.MirrorCommand) and self._state is not None:
            name = body.DESCRIPTOR.name
            duplicate = Difference(name, number, self._state.frame_sequence, [f"a second message of input {number}"])
            duplicate.otherwise = True  # no tolerance applies
            self._account.add_difference(duplicate, self._context.tolerance_nm)
            self._account.frames += isinstance(body, wire.ControlStep)

    def proceed(self, now_ns: int, *, ended: bool = False) -> None:
        """Replay every input that is complete or overdue; all remaining inputs once the log has `ended`."""
        while (self._entries or self._states) and not self.done:
            if self._state is None and not self._adopt():
                if not self.done:
                    self._drop_old(now_ns, ended=ended)
                return
            assert self._state is not None  # noqa: S101  # adopted above
            number = self._state.input_number + 1
            entry = self._entries.get(number)
            if entry is None:
                waiting = next(iter(self._entries.values()), None)
                if waiting is None or not (ended or now_ns - waiting.receive_time_ns > PATIENCE_NS):
                    return
                before_log = self._first_number is not None and number < self._first_number
                self._reset(_BEFORE_STATE if before_log else "after an input that the log does not have")
                continue
            overdue = ended or now_ns - entry.receive_time_ns > PATIENCE_NS
            if not overdue and entry.command is None and entry.leads_to_command and self._state.loop is not None:
                return
            rule = changed_rule(entry.logged) if self._context.former is not None else ""
            if rule and number not in self._states and not overdue:
                return  # the replay may have to continue from the logged state after this input
            input_ = self._input(entry, overdue=overdue)
            if input_ is not None and rule and number in self._states:
                del self._entries[number]
                self._apply_changed_rule(rule, input_, self._states.pop(number))
            elif input_ is not None:
                del self._entries[number]
                self._check(entry, input_)
            elif overdue:
                self._reset(f"after {'an input' if entry.logged is None else 'a frame'} that the log does not have")
            else:
                return

    def _add_state(self, message: wire.ControllerState, receive_time_ns: int) -> None:
        if receive_time_ns < self._context.segment.from_ns:
            return
        if receive_time_ns >= self._context.segment.until_ns:
            number = message.input_number
            self._end_number = number if self._end_number is None else min(self._end_number, number)
        past = next((state for state in self._recent_states if state.input_number == message.input_number), None)
        if past is not None:
            self._compare_state(past, message)
        elif self._state is None or message.input_number > self._state.input_number:
            self._states[message.input_number] = message
            self.retry_pending = True

    def _adopt(self) -> bool:
        """Continue from the first complete state of known calibration; False without one, or at the segment's end."""
        if not self.retry_pending:
            return False
        self.retry_pending = False
        for number in sorted(self._states):
            message = self._states[number]
            try:
                settings, state = self._decoded(message)
            except ValueError as error:
                if self._unchecked_because:
                    self._unchecked_because = f"not replayed: {error}"
                continue
            self._states = {later: state for later, state in self._states.items() if later > number}
            self._settings, self._state, self._start_number = settings, state, number
            self._recent_states.append(state)
            self._counts_earlier = bool(self._unchecked_because)
            self._drop_entries(number)
            if self._lost_number is not None:
                self._account.inputs_missing += number - self._lost_number - self._dropped
                self._lost_number = None
            self.done = number == self._end_number
            return not self.done
        return False

    def _decoded(self, message: wire.ControllerState) -> tuple[Settings, State]:
        published = self._context.published
        calibration = published.calibrations.get(message.calibration_id)
        return decode_state(message, calibration, published.laws, published.plays, self._kernel)

    def _kernel(self, name: str) -> Kernel:
        """The kernel to replay with, renamed to the log's kernel, so that states can be compared."""
        found = compiled.kernel(self._context.kernel or name)
        if found.name != name:
            self._account.other_kernel = found.name
        return found._replace(name=name)

    def _drop_entries(self, last_number: int) -> None:
        for number in [number for number in self._entries if number <= last_number]:
            logged = self._entries.pop(number).logged
            self._dropped += logged is not None
            if self._unchecked_because:  # otherwise the step belongs to another segment
                self._account.count_unchecked(self._unchecked_because, int(isinstance(logged, wire.ControlStep)))

    def _drop_old(self, now_ns: int, *, ended: bool) -> None:
        """Without a state to continue from, drop inputs that the next state will not need, and surplus states."""
        old = [number for number, entry in self._entries.items() if now_ns - entry.receive_time_ns > 2 * PATIENCE_NS]
        self._drop_entries(max(self._entries if ended else old, default=0))
        while len(self._states) > _STATES_KEPT:
            del self._states[min(self._states)]

    def _reset(self, why: str) -> None:
        """Drop the state; steps are unchecked because of `why` until the next state is adopted."""
        self._unchecked_because = why
        lost = self._state if why not in ("", _BEFORE_STATE) else None
        self._lost_number = None if lost is None else lost.input_number
        self._dropped = 0
        self._state = None
        self.retry_pending = True
        self._recent_states.clear()

    def _input(self, entry: _Entry, *, overdue: bool) -> Input | None:
        """The input of an entry; None if the log does not have it (yet). If `overdue`, nothing more will arrive."""
        match entry.logged:
            case wire.ControlStep() as step:
                age_ns = self._settings.max_frame_age_ns + 1 if wire.REASON_LATE in step.reasons else 0
                # If overdue, a frame with another time is used: the step then differs, which the comparison reports.
                frame = self._context.frames.frame(
                    step.frame_sequence, from_timestamp(step.timestamp), age_ns, any_time=overdue
                )
                if frame is not None and wire.REASON_AHEAD in step.reasons:
                    frame = frame._replace(ahead=True)
                return frame
            case wire.Request() as request:
                with contextlib.suppress(ValueError):
                    time_ns, known = from_timestamp(request.timestamp), self._context.published
                    decoded = codec.request(request, request.name, time_ns, known.calibrations, known.laws, known.plays)
                    if self._context.former is not None and not request.accepted:  # this version might accept it
                        decoded = replace(decoded, refusal=request.reply or "refused in the log")
                    return prepared(self._settings, decoded)
            case wire.ControlInput() as other:
                with contextlib.suppress(ValueError):
                    return codec.decode_input(other, self._context.published.calibrations)
        return None

    def _apply_changed_rule(self, rule: str, input_: Input, logged: wire.ControllerState) -> None:
        """Apply an input that the log's version handled by another rule; after a difference, go on from its state."""
        assert self._state is not None  # noqa: S101  # adopted before
        state, _ = advance(self._settings, self._state, input_)
        replayed = controller_state(state, self._settings, from_timestamp(logged.timestamp))
        found = self._difference(state, logged, replayed)
        if found is None or found.within(self._context.tolerance_nm):
            self._account.states += 1
        else:
            self._account.rules_changed[rule] += 1
            try:
                self._settings, state = self._decoded(logged)
            except ValueError as error:
                self._reset(f"not replayed: {error}")
                return
        self._account.requests += isinstance(input_, Request)
        self._state = state
        self._recent_states.append(state)
        self.done = state.input_number == self._end_number

    def _difference(self, state: State, logged: Message, replayed: Message | None) -> Difference | None:
        """Difference between a logged and a replayed message in the compared fields; None if these are equal."""
        if self._context.former is not None and type(replayed) is type(logged):
            if isinstance(logged, wire.ControllerState):
                logged = self._reencoded(logged)
            elif isinstance(logged, wire.Request) and logged.HasField("state"):
                logged = deepcopy(logged)
                logged.state.CopyFrom(self._reencoded(logged.state))
            logged, replayed = self._context.former.compared(logged), self._context.former.compared(replayed)
        if replayed == logged and (self._context.former is not None or isinstance(logged, wire.ControllerState)):
            return None  # for other messages of this version equal fields are not enough: the bytes count
        return difference(state.input_number, state.frame_sequence, logged, replayed)

    def _reencoded(self, logged: wire.ControllerState) -> wire.ControllerState:
        """Re-encode a state in the form of this version; unchanged if it cannot be decoded."""
        with contextlib.suppress(ValueError):
            settings, state = self._decoded(logged)
            return controller_state(state, settings, from_timestamp(logged.timestamp))
        return logged

    def _check(self, entry: _Entry, input_: Input) -> None:
        assert self._state is not None  # noqa: S101  # adopted before
        state, outputs = advance(self._settings, self._state, input_)
        self._state = state
        self._recent_states.append(state)
        account = self._account
        if outputs.step is not None and entry.logged is not None:
            account.frames += 1
            self._compare(entry.logged, entry.logged_bytes, codec.encode_step(outputs.step, state.input_number))
        if entry.command is not None:
            account.commands += 1
            replayed = None
            if outputs.command is not None:
                self._command_form = self._command_form or (entry.command.valid_for_ns, entry.command.channel)
                replayed = codec.encode_command(outputs.command, *self._command_form, state.input_number)
            self._compare(entry.command, entry.command_bytes, replayed)
        elif outputs.command is not None:
            account.commands_missing += 1
        if isinstance(entry.logged, wire.Request):
            account.requests += 1
            assert isinstance(input_, Request)  # noqa: S101
            assert outputs.reply is not None  # noqa: S101  # every request has one
            in_answer = entry.logged.HasField("state")
            answered = controller_state(state, self._settings, input_.time_ns) if in_answer else None
            answer = codec.encode_request(input_, outputs.reply, state.input_number, answered)
            self._compare(entry.logged, entry.logged_bytes, answer)
        logged = self._states.pop(state.input_number, None)
        if logged is not None:
            self._compare_state(state, logged)

    def _compare_state(self, state: State, logged: wire.ControllerState) -> None:
        self._account.states += 1
        self.done = state.input_number == self._end_number
        replayed = controller_state(state, self._settings, from_timestamp(logged.timestamp))
        found = self._difference(state, logged, replayed)
        if found is None:
            return
        self._account.add_difference(found, self._context.tolerance_nm)
        if self._state is state and not self.done:
            # Continue from the logged state, or the difference would persist for the rest of the log.
            self._states[state.input_number] = logged
            self._reset("")
            self._adopt()

    def _compare(self, logged: Message, logged_bytes: bytes, replayed: bytes | None) -> None:
        if replayed == logged_bytes:
            return
        assert self._state is not None  # noqa: S101
        body = None if replayed is None else type(logged).FromString(replayed)
        self._account.add_difference(self._difference(self._state, logged, body), self._context.tolerance_nm)
