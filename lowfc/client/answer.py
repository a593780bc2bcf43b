"""What a client gets for a request."""

from typing import NamedTuple

from lowfc.contract.envelope import count_of
from lowfc.contract.messages import wire


class Answer(NamedTuple):
    """What was answered to a request that was carried out; one that was refused raises RequestRefusedError.

    Attributes:
        accepted: always true.
        reply: the sentence.
        frame_sequence: of the first frame for which the request is in force.
        text: path of the log, of `record`.
        state: the controller's, of `status`.
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
        """Number of that frame among those of its camera."""
        return count_of(self.frame_sequence)

    @property
    def sentence(self) -> str:
        """The answer as people read it."""
        run = f" (run {self.run})" if self.run else ""
        return f"{self.reply}, from frame {self.frame} on{run}"
