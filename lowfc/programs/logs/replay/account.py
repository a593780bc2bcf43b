"""The result of a replay: what was checked, what differed, what could not be checked."""

from collections import Counter
from collections.abc import Sequence
from typing import Any

from pydantic import Field, computed_field

from lowfc.adapters.logs.recovery import faults
from lowfc.contract.envelope import count_of
from lowfc.control.loop.wording import counted
from lowfc.programs.cli.result import Result
from lowfc.programs.logs.replay.difference import Difference


class Account(Result):
    """Result of a replay, and the state of the logs.

    Attributes:
        frames: number of steps checked; `commands`, `states` and `requests` count the checked messages of these kinds.
        unchecked_because: number of steps that could not be checked, by reason.
        inputs_missing: number of controller inputs missing from the log, found by the input number of a later state.
        commands_missing: number of commands that the replay sends but the log does not have.
        steps: number of steps in the log.
        different: number of messages that differ by more than the tolerance; `first_difference` is the first of them,
            `largest_difference_nm` the largest difference of a number in nm.
        other_kernel: kernel of the replay if it differs from the log's; otherwise empty.
        rules_changed: number of inputs that this version handles differently on purpose, by rule.
        version: lowfc version of the first log.
        host_differs: versions and processor features that differ between the first log's host and this one.
        log_s: time from the first frame to the last; `speed` is `log_s` divided by the duration of the replay.
        complete: whether every log has its end and summary.
        no_end: sentence on why a log has no end; empty if the recorder ended every log.
        damaged: parts of the logs that were left out.
        runs: names of the runs in the logs.
        stopped: reasons why a recording ended early.
    """

    frames: int = 0
    commands: int = 0
    states: int = 0
    requests: int = 0
    unchecked_because: Counter[str] = Field(default_factory=Counter)
    inputs_missing: int = 0
    commands_missing: int = 0
    steps: int = 0
    different: int = 0
    first_difference: Difference | None = None
    largest_difference_nm: float = 0.0
    other_kernel: str = ""
    rules_changed: Counter[str] = Field(default_factory=Counter)
    version: str = ""
    tolerance_nm: float = 0.0
    log_s: float = 0.0
    speed: float = 0.0
    complete: bool = True
    no_end: str = ""
    damaged: list[str] = Field([])
    runs: list[str] = Field([])
    stopped: list[str] = Field([])
    host_differs: dict[str, tuple[str, str]] = Field({})
    recorded_on: dict[str, str] = Field({}, exclude=True)
    """Versions and host in the first log."""
    finished: bool = Field(True, exclude=True)
    """Whether the recorder ended every log."""
    span_ns: tuple[int, int] = Field((0, 0), exclude=True)
    """Log times of the first frame and the last frame; (0, 0) without a frame."""

    @computed_field  # type: ignore[prop-decorator]
    @property
    def unchecked(self) -> int:
        """Steps of the log that could not be checked."""
        return self.unchecked_because.total()

    @computed_field  # type: ignore[prop-decorator]
    @property
    def identical(self) -> bool:
        """Whether steps and commands were checked with the log's kernel, and no message differs beyond tolerance."""
        same = not self.different and not self.other_kernel
        return self.frames > 0 and same and (self.commands > 0 or not self.commands_missing)

    def add(self, later: "Account") -> None:
        """Add the account of the next segment, whose worker has read further and knows the later state of the logs."""
        for name, field in type(self).model_fields.items():
            if field.annotation in (int, Counter[str]):
                setattr(self, name, getattr(self, name) + getattr(later, name))
        self.span_ns = self.span_ns[0] or later.span_ns[0], later.span_ns[1] or self.span_ns[1]
        self.first_difference = self.first_difference or later.first_difference
        self.other_kernel = self.other_kernel or later.other_kernel
        self.largest_difference_nm = max(self.largest_difference_nm, later.largest_difference_nm)
        self.damaged = sorted({*self.damaged, *later.damaged})
        self.complete, self.finished = later.complete, later.finished
        self.runs, self.stopped = later.runs, later.stopped

    def json_object(self) -> dict[str, Any]:
        """All fields, whether set or not."""
        return self.model_dump()

    def count_unchecked(self, why: str, steps: int) -> None:
        """Count steps that cannot be checked."""
        if steps:
            self.unchecked_because[why] += steps

    def add_difference(self, found: Difference | None, tolerance_nm: float) -> None:
        """Count the difference between two messages."""
        if found is None:
            return
        self.largest_difference_nm = max(self.largest_difference_nm, found.largest_nm)
        if not found.within(tolerance_nm):
            self.different += 1
            self.first_difference = self.first_difference or found

    def head(self) -> Sequence[str]:
        """Verdict, and counts of what was checked."""
        frames = counted(self.frames, "frame")
        if not self.frames:
            return ["nothing could be replayed"]
        if self.other_kernel:
            verdict = f"{frames}, computed by {self.other_kernel}: not the same kernel as the log's"
        elif self.identical:
            within = f" within {self.tolerance_nm:g} nm" if self.tolerance_nm else ""
            verdict = f"{frames}, commands identical{within}"
        elif not self.different:
            verdict = f"{frames}, steps identical, but no command is in the log"
        else:
            verdict = f"{frames}, {counted(self.different, 'message differs', 'messages differ')}"
        return (
            f"{verdict}, largest difference {self.largest_difference_nm:.3g} nm",
            f"also compared      {counted(self.commands, 'command')}, {counted(self.states, 'state')}, "
            f"{counted(self.requests, 'answer')}",
        )

    def remarks(self) -> Sequence[str]:
        """Remarks on what could not be checked, what differs, and the speed."""
        missing = ((self.inputs_missing, "input"), (self.commands_missing, "command"))
        since = f"since {self.version or 'a former version'}"
        lines = [f"rule changed       {since}, {counted(n, 'input')}: {rule}" for rule, n in self.rules_changed.items()]
        lines += [f"unchecked          {counted(n, 'step')} {why}" for why, n in self.unchecked_because.items()]
        lines += [f"missing            the log lacks {counted(n, what)} of the controller" for n, what in missing if n]
        lines += faults(self.damaged, self.no_end)
        lines += [f"recording stopped  {why}" for why in self.stopped]
        if len(self.runs) > 1:
            lines.append(f"several runs       {', '.join(self.runs)}")
        if first := self.first_difference:
            lines.append(
                f"first difference   {first.message} of frame {count_of(first.frame_sequence)} "
                f"(sequence {first.frame_sequence}), input {first.taken} of the controller"
            )
            lines += [f"                   {line}" for line in first.fields]
        for key, (logged, present) in self.host_differs.items():
            lines.append(f"{key:18} {logged or 'none'} in the log, {present or 'none'} on this host")
        speed = f"speed              {self.log_s:.1f} s of log, {self.speed:.1f} times as fast as recorded"
        return [*lines, speed] if self.frames else lines
