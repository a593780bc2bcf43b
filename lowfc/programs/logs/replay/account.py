"""The account of a replay: what was checked, what differed, what could not be checked."""

from collections import Counter
from dataclasses import asdict, dataclass, field, fields
from typing import Any

from lowfc.programs.logs.replay.difference import Difference


@dataclass(slots=True)
class Account:
    """What a replay has found; the names are those of `--json`.

    Attributes:
        frames: steps that were checked; `commands`, `states` and `requests` likewise.
        unchecked_because: steps of the log that could not be checked, by why.
        inputs_missing: inputs of the controller that the log does not have, by the input number of a later state.
        commands_missing: commands that the replay sends and the log does not have.
        steps: in the log.
        different: messages that differ by more than the tolerance, of them the first, and the largest difference of any
            number in nm.
        other_kernel: arithmetic of the replay where the log's was another; empty where it was the same.
        rules_changed: inputs of another version's log that this version answers otherwise on purpose, by the rule.
    """

    frames: int = 0
    commands: int = 0
    states: int = 0
    requests: int = 0
    unchecked_because: Counter[str] = field(default_factory=Counter)
    inputs_missing: int = 0
    commands_missing: int = 0
    steps: int = 0
    different: int = 0
    first_difference: Difference | None = None
    largest_difference_nm: float = 0.0
    other_kernel: str = ""
    rules_changed: Counter[str] = field(default_factory=Counter)

    @property
    def unchecked(self) -> int:
        """Steps of the log that could not be checked."""
        return self.unchecked_because.total()

    @property
    def identical(self) -> bool:
        """Whether steps and commands were checked by the log's own arithmetic, and nothing differed."""
        same = not self.different and not self.other_kernel
        return self.frames > 0 and same and (self.commands > 0 or not self.commands_missing)

    def add(self, other: "Account") -> None:
        """Add what was found in the next share."""
        for one in fields(self):
            mine, more = getattr(self, one.name), getattr(other, one.name)
            if one.name == "largest_difference_nm":
                setattr(self, one.name, max(mine, more))
            else:
                either = one.name in ("first_difference", "other_kernel")
                setattr(self, one.name, mine or more if either else mine + more)

    def figures(self) -> dict[str, Any]:
        """For a program."""
        found = {one.name: getattr(self, one.name) for one in fields(self)}
        found["first_difference"] = self.first_difference and asdict(self.first_difference)
        return found | {"unchecked": self.unchecked, "identical": self.identical}

    def leave_out(self, why: str, steps: int) -> None:
        """Count steps that cannot be checked."""
        if steps:
            self.unchecked_because[why] += steps

    def enter(self, found: Difference | None, tolerance_nm: float) -> None:
        """Account for two messages that are not the same bytes, and for what differs in them."""
        if found is None:
            return
        self.largest_difference_nm = max(self.largest_difference_nm, found.largest_nm)
        if not found.within(tolerance_nm):
            self.different += 1
            self.first_difference = self.first_difference or found
