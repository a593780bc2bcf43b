"""The other processes of a run, as a recorder needs them: their Health, and the states that the logs depend on."""

from concurrent.futures import Future, ThreadPoolExecutor

from lowfc.adapters.bus.bus import Bus, Sample, name_in, states
from lowfc.contract.envelope import start_of
from lowfc.contract.messages import HEALTH, TOPICS, wire


class Peers:
    """Processes by their last Health, and `kept`: the newest of each calibration and state, with which a log begins."""

    def __init__(self, bus: Bus) -> None:
        self.kept: dict[str, Sample] = {}
        self._bus = bus
        self._states: dict[str, tuple[int, str]] = {}
        self._newcomers = False
        self._queried: set[tuple[str, int]] = set()
        self._thread = ThreadPoolExecutor(1, "query")
        self._answers: Future[list[Sample]] | None = None

    def note(self, sample: Sample, health: wire.Health) -> None:
        """Keep the state of a process, unless a later start of it has reported already."""
        name, start_s = name_in(HEALTH, sample.key), start_of(sample.sequence)
        known_s, _ = self._states.get(name, (-1, ""))
        self._newcomers |= start_s > known_s
        if start_s >= known_s:
            self._states[name] = start_s, health.state

    def stopped(self, but: str) -> bool:
        """Whether all have reported that they stopped, except the process of that name."""
        return all(state == "stopped" for name, (_, state) in self._states.items() if name != but)

    def keep(self, sample: Sample) -> bool:
        """Keep a calibration or state, and return whether it is new; not where a newer one is known."""
        kept = self.kept.get(sample.key)
        if kept is None or kept.sequence <= sample.sequence:
            self.kept[sample.key] = sample
        return kept is None or kept.sequence < sample.sequence

    def already_received(self, sample: Sample) -> bool:
        """Whether a query brought this message before the bus did; true once."""
        known = (sample.key, sample.sequence) in self._queried
        self._queried.discard((sample.key, sample.sequence))
        return known

    def query(self) -> list[Sample]:
        """Calibration and states from before this process started, or lost on their way."""
        return self._new(self._get())

    def query_soon(self) -> None:
        """Query at the next opportunity: something may have been lost on its way."""
        self._newcomers = True

    def query_meanwhile(self, *, more: bool) -> list[Sample]:
        """Query where a process is new, unless no `more` is wanted; what is new among answers since the last call.

        That is done in a thread, for a frozen process answers late.
        """
        if more and self._newcomers and self._answers is None:
            self._answers = self._thread.submit(self._get)
            self._newcomers = False
        if self._answers is None or not self._answers.done():
            return []
        answers, self._answers = self._answers, None
        return self._new(answers.result())

    def _get(self) -> list[Sample]:
        return [sample for _, sample in states(self._bus, TOPICS)]

    def _new(self, answers: list[Sample]) -> list[Sample]:
        new = [sample for sample in answers if self.keep(sample)]
        self._queried.update((sample.key, sample.sequence) for sample in new)
        return new
