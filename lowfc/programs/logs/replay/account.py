"""The account of a replay: what was checked, what differed, what could not be checked."""

from collections import Counter
from dataclasses import dataclass, field

from lowfc.programs.logs.replay.difference import Difference


@dataclass(slots=True)
class Account:
    """What a replay has found.

    Attributes:
        frames: steps that were checked; `commands`, `states` and `requests` likewise.
        unchecked: steps of the log that could not be checked, by why.
        missing: inputs of the controller that the log does not have, as far as a later state tells.
        commands_missing: commands that the replay sends and the log does not have.
        steps: in the log.
        different: messages that differ by more than the tolerance.
        first: the first of them.
        largest_nm: largest difference of any number in nm.
        changed: inputs of another version's log that this version answers otherwise on purpose, by the rule.
    """

    frames: int = 0
    commands: int = 0
    states: int = 0
    requests: int = 0
    unchecked: Counter[str] = field(default_factory=Counter)
    missing: int = 0
    commands_missing: int = 0
    steps: int = 0
    different: int = 0
    first: Difference | None = None
    largest_nm: float = 0.0
    changed: Counter[str] = field(default_factory=Counter)

    @property
    def identical(self) -> bool:
        """Whether steps and commands were checked, and nothing differed."""
        return self.frames > 0 and not self.different and (self.commands > 0 or not self.commands_missing)

    def add(self, other: "Account") -> None:
        """Add what was found in the next share."""
        counts = ("frames", "commands", "states", "requests", "missing", "commands_missing", "steps", "different")
        for count in counts:
            setattr(self, count, getattr(self, count) + getattr(other, count))
        self.unchecked += other.unchecked
        self.changed += other.changed
        self.largest_nm = max(self.largest_nm, other.largest_nm)
        self.first = self.first or other.first

    def leave_out(self, why: str, steps: int) -> None:
        """Count steps that cannot be checked."""
        if steps:
            self.unchecked[why] += steps

    def enter(self, found: Difference | None, tolerance_nm: float) -> None:
        """Account for two messages that are not the same bytes, and for what differs in them."""
        if found is None:
            return
        self.largest_nm = max(self.largest_nm, found.largest_nm)
        if not found.within(tolerance_nm):
            self.different += 1
            self.first = self.first or found
