"""The controller's answer to a request."""

from typing import NamedTuple

from lowfc.contract.envelope import count_of
from lowfc.contract.messages import wire


class Answer(NamedTuple):
    """Answer to a request that was carried out; a refused request raises RequestRefusedError.

    Attributes:
        accepted: always true.
        reply: what was done, or the configuration as TOML (`configuration` only).
        frame_sequence: sequence of the first frame for which the request is in force.
        text: path of the log (`record`); for other requests the text that was sent.
        state: the controller's state (`status` only).
        run: name of the run that answered.
    """

    accepted: bool
    reply: str
    frame_sequence: int
    text: str = ""
    state: wire.ControllerState | None = None
    run: str = ""

    @property
    def frame(self) -> int:
        """Number, counted from its camera's start, of the first frame for which the request is in force."""
        return count_of(self.frame_sequence)

    @property
    def sentence(self) -> str:
        """The answer as one sentence."""
        run = f" (run {self.run})" if self.run else ""
        return f"{self.reply}, from frame {self.frame} on{run}"
