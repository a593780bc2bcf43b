"""The results of the acceptance tests: a verdict of each mode, and of all of them."""

from collections.abc import Sequence

from lowfc.programs.cli.result import Result, figure


class ModeResult(Result):
    """A mode, and whether it does what is required of it."""

    noll: int = figure("mode")
    name: str = figure("name")
    passed: bool = figure()
    too_noisy: bool = figure(default=False)

    def remarks(self) -> Sequence[str]:
        """What stands behind its row: the verdict, where it is not good."""
        return [] if self.passed else ["too noisy" if self.too_noisy else "FAILED"]


class AcceptanceResult(Result):
    """What a test found; it passed where every mode did."""

    test: str = figure()
    passed: bool = figure()

    @property
    def verdict(self) -> str:
        """In a few words."""
        return f"{self.test}: {'passed' if self.passed else 'FAILED'}"

    def remarks(self) -> Sequence[str]:
        """The verdict at the end."""
        return ["", self.verdict]
