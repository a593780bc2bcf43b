"""The other processes of a run, as a recorder needs them: how they are, and the states that the logs depend on."""

from concurrent.futures import Future, ThreadPoolExecutor

from lowfc.adapters.bus.bus import Bus, Sample, name_in, states
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import HEALTH, TOPICS, wire


class Others:
    """Who is there, and the newest of each calibration and state, as heard or as answered when asked for it.

    Attributes:
        kept: calibrations and states by key, with which a log begins.
    """

    def __init__(self, bus: Bus) -> None:
        """Nobody has been heard yet."""
        self.kept: dict[str, Sample] = {}
        self._bus = bus
        self._states: dict[str, tuple[int, str]] = {}
        self._newcomers = False
        self._asked: set[tuple[str, int]] = set()
        self._asker = ThreadPoolExecutor(1, "ask")
        self._answers: Future[list[Sample]] | None = None

    def hear(self, sample: Sample, health: wire.Health) -> None:
        """Take note of how a process is; what an earlier start of it says comes too late."""
        name, start_s = name_in(HEALTH, sample.key), start_of(sample.sequence)
        known_s, _ = self._states.get(name, (-1, ""))
        self._newcomers |= start_s > known_s
        if start_s >= known_s:
            self._states[name] = start_s, health.state

    def stopped(self, but: str) -> bool:
        """Whether all have said their last words, but for the process of that name."""
        return all(state == "stopped" for name, (_, state) in self._states.items() if name != but)

    def keep(self, sample: Sample) -> None:
        """Take note of a calibration or state that was received, unless a newer one is known."""
        kept = self.kept.get(sample.key)
        if kept is None or kept.sequence <= sample.sequence:
            self.kept[sample.key] = sample

    def was_asked(self, sample: Sample) -> bool:
        """Whether a message that is heard now was had already, when it was asked for; says so once."""
        there = (sample.key, sample.sequence)
        known = there in self._asked
        self._asked.discard(there)
        return known

    def ask(self) -> list[Sample]:
        """Get what was not heard: calibration and states from before this process was there, or lost on their way."""
        return self._new(self._get())

    def ask_again(self) -> None:
        """Something may have been lost on its way: ask at the next opportunity."""
        self._newcomers = True

    def ask_meanwhile(self, *, more: bool) -> list[Sample]:
        """Ask, if there is `more` to come, when somebody is new: in a thread, for one who is frozen answers late.

        Returns:
            What was answered since the last call and not heard.
        """
        if more and self._newcomers and self._answers is None:
            self._answers = self._asker.submit(self._get)
            self._newcomers = False
        if self._answers is None or not self._answers.done():
            return []
        answers, self._answers = self._answers, None
        return self._new(answers.result())

    def _get(self) -> list[Sample]:
        return [sample for _, sample in states(self._bus, TOPICS)]

    def _new(self, answers: list[Sample]) -> list[Sample]:
        new = []
        for sample in answers:
            kept = self.kept.get(sample.key)
            if kept is None or kept.sequence < sample.sequence:
                self.keep(sample)
                self._asked.add((sample.key, sample.sequence))
                new.append(sample)
        return new
