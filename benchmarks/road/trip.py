"""One run of the real loop, in a process of its own that is switched as the loop's processes are."""

import multiprocessing
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from benchmarks.road.patches import apply
from lowfc.adapters.run import Run, open_run
from lowfc.contract.configuration import Configuration, load
from lowfc.contract.errors import LowfcError
from lowfc.contract.messages import Role
from lowfc.programs.latency import run as latency_run
from lowfc.programs.latency.figures import STAGES

ROOT = Path(__file__).parents[2]
SITE = Path(__file__).parent / "site"
PERCENTILES = ("p50", "p99", "p99_9", "max")
DUE, MIRROR = "due_p99_9", "mirror_p50"

_PATIENCE_S = 45.0
_STOP_S = 20.0
_CONFIG, _AS_IT_IS = "config.toml", "as_it_is.toml"


class TripError(Exception):
    """A run fell for a reason of ours."""


@contextmanager
def prepared(settings: Configuration) -> Iterator[Run]:
    """A run whose calibration and frames serve all trips."""
    with latency_run.prepared(settings) as run:
        (run.path / _AS_IT_IS).write_text(settings.to_toml(), encoding="utf-8")
        yield run


def trip(
    run: Run,
    seconds: float,
    keys: Mapping[str, Any] | None = None,
    variables: Mapping[str, str] | None = None,
    *,
    record: bool = False,
) -> dict[str, Any]:
    """Run the loop once.

    Args:
        run: of `prepared`.
        seconds: measured, after the warm-up.
        keys: of the configuration that are others.
        variables: of the environment of every process.
        record: with the recorder.

    Returns:
        p50, p99, p99_9 and max of frame to command, due_p99_9 (from when the frame was due), mirror_p50 (of frame to
        mirror), us; frames, frames_without_command; stages_us (medians); granted. Or `refused`: why there are none.

    Raises:
        TripError: it fell otherwise than by one of lowfc's own errors.
    """
    settings = load(run.path / _AS_IT_IS, dict(keys or {}))
    (run.path / _CONFIG).write_text(settings.to_toml(), encoding="utf-8")
    context = multiprocessing.get_context("fork")  # everything is imported already
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_travel, args=(sender, run.run_id, settings, seconds, variables or {}, record))
    process.start()
    sender.close()
    try:
        found = receiver.recv() if receiver.poll(seconds + _PATIENCE_S) else {"refused": "it hangs"}
    except EOFError:
        raise TripError("a run ended without a word; see above") from None
    finally:
        _end(process)
    return dict(found)


def _end(process: Any) -> None:
    """Wait for its end, and see to it: told to, it stops the loop's processes first."""
    process.join(_STOP_S / 4)
    for end in (process.terminate, process.kill):
        if process.is_alive():
            end()
            process.join(_STOP_S)


def _travel(
    sender: Connection,
    run_id: str,
    settings: Configuration,
    seconds: float,
    variables: Mapping[str, str],
    record: bool,
) -> None:
    """In the new process: change it, run, and send what was found."""
    os.environ.update(variables)
    others = filter(None, [os.environ.get("PYTHONPATH")])
    os.environ["PYTHONPATH"] = os.pathsep.join([str(SITE), str(ROOT), *others])
    try:
        if "LOWFC_ROAD" in variables:
            apply(variables["LOWFC_ROAD"])
        with tempfile.TemporaryDirectory(prefix="lowfc-road-") as folder:
            os.chdir(folder)  # a log is written here
            run = open_run(run_id, (settings.mirror.name,), listeners=(Role.LAUNCHER,))
            asked = latency_run.Asked(settings, seconds, 1, record=record)
            sender.send(_figures(latency_run._loop(asked, run)))  # noqa: SLF001  # without what it is set against
            os.chdir(ROOT)
    except LowfcError as fault:
        sender.send({"refused": _reason(str(fault).splitlines())})
    except KeyboardInterrupt:
        with suppress(OSError):
            sender.send({"refused": "interrupted"})
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    os._exit(0)  # what other processes inherited of this one's is theirs to end


def _reason(lines: Sequence[str]) -> str:
    """What is said last is why."""
    return f"{lines[0].split(';')[0]}: {lines[-1].strip()}" if len(lines) > 1 else lines[0]


def _figures(found: Mapping[str, Any]) -> dict[str, Any]:
    latency_us = found["latency_us"]["frame_to_command"]
    return {
        **{at: latency_us[at] for at in PERCENTILES},
        DUE: found["latency_us"]["due_to_command"]["p99_9"],
        MIRROR: found["latency_us"]["frame_to_mirror"]["p50"],
        "frames": found["frames"],
        "frames_without_command": found["frames_without_command"],
        "stages_us": {stage: found["latency_us"][stage]["p50"] for stage in ("frame_to_receive", *STAGES)},
        "granted": found["granted"],
    }
