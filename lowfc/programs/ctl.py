"""The operator's hand: requests to a running controller."""

import time
from pathlib import Path

from lowfc.adapters.clock import HostClock
from lowfc.adapters.run import open_run, runtime_base
from lowfc.adapters.zenoh_bus import ZenohBus
from lowfc.contract.errors import BusError, RequestRefusedError
from lowfc.contract.messages import REQUEST_KEY, Role, wire

CONNECT_S = 1.0
ANSWER_S = 2.0


def running(base: Path | None = None) -> list[str]:
    """Names of the runs on this host whose controller listens; a run that was killed leaves its directory behind."""
    folder = runtime_base() if base is None else base
    found = (path.parent.name for path in folder.glob("*/links.json"))
    return sorted(name for name in found if Role.CONTROLLER in open_run(name, ()).links.live())


def the_run(name: str | None) -> str:
    """The run of that name, or the only one there is.

    Raises:
        BusError: there is no such run, none at all, or more than one to choose from.
    """
    runs = running()
    if name is None and len(runs) == 1:
        return runs[0]
    if name in runs and name is not None:
        return name
    there = f"there are {', '.join(runs)}" if runs else "no loop is running on this host"
    if name is not None:
        raise BusError(f"there is no run {name!r}: {there}")
    raise BusError(f"say which run with --run: {there}" if runs else there)


def the_known_run(name: str | None) -> str:
    """The run of that name, whether its controller is there or not, or the only one there is.

    Raises:
        BusError: there is no such run, none at all, or more than one to choose from.
    """
    if name is None:
        return the_run(None)
    if not (runtime_base() / name).is_dir():
        raise BusError(
            f"there is no run {name!r}: start its processes first; running are {', '.join(running()) or 'none'}"
        )
    return name


def ask(run_id: str, name: str, modes: tuple[int, ...] = (), values: tuple[float, ...] = ()) -> wire.Request:
    """Send one request and return it with its answer.

    Raises:
        BusError: no controller is there, or it is too slow.
        RequestRefusedError: the controller refused, and says why.
    """
    bus = ZenohBus(open_run(run_id, ()).links, Role.OPERATOR, HostClock())
    try:
        deadline_s = time.monotonic() + CONNECT_S
        while not bus.peers() and time.monotonic() < deadline_s:
            time.sleep(0.01)
        payload = wire.Request(name=name, modes=modes, values=values).SerializeToString()
        while True:
            begun_s = time.monotonic()
            answers = bus.get(REQUEST_KEY.format(name=name), payload, ANSWER_S)
            if answers or time.monotonic() >= deadline_s:
                break
            time.sleep(0.05)  # a link that is just being made answers at once that nobody is there
    finally:
        bus.close()
    if not answers:
        if time.monotonic() - begun_s < ANSWER_S * 0.9:
            raise BusError(f"no controller is there in run {run_id!r}: start one with `lowfc controller`")
        raise BusError(
            f"the controller of run {run_id!r} did not answer within {ANSWER_S:g} s: it hangs or is too slow"
        )
    answer = wire.Request.FromString(answers[0].payload)
    if not answer.accepted:
        raise RequestRefusedError(f"{name} refused: {answer.reply}")
    return answer
