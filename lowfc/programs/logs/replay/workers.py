"""Replay of log files; long logs are replayed in segments on several processors."""

import contextlib
import gc
import multiprocessing
import os
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path

from threadpoolctl import threadpool_limits

from lowfc import __version__
from lowfc.adapters.logs.parts import WholeLog
from lowfc.adapters.logs.reader import LogReader
from lowfc.adapters.logs.records import LogFile
from lowfc.adapters.logs.writer import declaration
from lowfc.adapters.process.child import interrupt_blocked
from lowfc.contract import published
from lowfc.contract.errors import ConfigurationError, DataFileError
from lowfc.contract.messages import FRAME, STEP
from lowfc.programs.logs.replay.account import Account
from lowfc.programs.logs.replay.controller_replay import PATIENCE_NS, WHOLE, Segment
from lowfc.programs.logs.replay.fold import TOPICS, Replay
from lowfc.programs.logs.replay.former import FormerVersion

_MIN_SEGMENT_BYTES = 50_000_000
"""Smallest size of a segment; starting a process for a smaller one would take longer than it saves."""
_SEGMENTS_PER_JOB = 4  # for steady progress, and short idle times at the end
_PROGRESS_EVERY = 5000  # messages

Progress = Callable[[int], None]


def replay_files(
    paths: Sequence[Path], tolerance_nm: float, jobs: int, progress: Progress, kernel: str = ""
) -> Account:
    """Replay consecutive logs in at most `jobs` processes (0: one per processor).

    `progress` is called with the bytes replayed so far. ConfigurationError if a log is named twice or begins before the
    previous one ends, DataFileError if a log cannot be replayed.
    """
    chunk_ends_ns = [_chunk_ends_ns(path) for path in paths]
    ends_ns = sorted(end_ns for ends in chunk_ends_ns for end_ns in ends)  # a chunk of states alone may end earlier
    if len({path.resolve() for path in paths}) < len(paths):
        raise ConfigurationError("a log is named twice; name each log once, in the order of recording")
    if len(paths) > 1:
        _refuse_disorder(paths, chunk_ends_ns)
    size = sum(path.stat().st_size for path in paths)
    jobs = jobs or len(os.sched_getaffinity(0))
    segment_count = min(_SEGMENTS_PER_JOB * jobs, size // _MIN_SEGMENT_BYTES) if ends_ns and jobs > 1 else 1
    if segment_count < 2:
        accounts = [_replay_segment(paths, tolerance_nm, kernel, WHOLE, progress)]
    else:
        inner_ns = (ends_ns[len(ends_ns) * number // segment_count] for number in range(1, segment_count))
        edges_ns = [0, *inner_ns, WHOLE.until_ns]
        segments = [Segment(from_ns, until_ns) for from_ns, until_ns in pairwise(edges_ns)]
        accounts = []
        with interrupt_blocked():  # only the parent handles Ctrl-C; it ends its workers
            workers = multiprocessing.get_context("spawn").Pool(min(jobs, segment_count))
        with workers as pool:
            for account in pool.imap(partial(_replay_segment, paths, tolerance_nm, kernel), segments):
                accounts.append(account)
                progress(size * len(accounts) // segment_count)
    total = accounts[0]
    for account in accounts[1:]:
        total.add(account)
    unaccounted = total.steps - total.frames - total.unchecked
    total.count_unchecked("without a state of the controller before them", max(0, unaccounted))
    total.log_s = (total.span_ns[1] - total.span_ns[0]) * 1e-9
    return total


def _chunk_ends_ns(path: Path) -> list[int]:
    """Log times of the last message in each chunk of a log, by its summary; none for an unfinished log."""
    with LogFile(path) as file:
        return [chunk.message_end_time for chunk in file.index()]


def _refuse_disorder(paths: Sequence[Path], chunk_ends_ns: Sequence[Sequence[int]]) -> None:
    """Raise ConfigurationError if a log's first frame is more than `PATIENCE_NS` before the end of the previous log."""
    end_ns, previous = 0, paths[0]
    for path, ends_ns in zip(paths, chunk_ends_ns, strict=True):
        frames = WholeLog(path, topics=(FRAME,))  # the states at a log's start may be old
        with contextlib.closing(iter(frames)) as messages:
            begin_ns = next((frame.receive_time_ns for frame in messages), None)
        if begin_ns is not None and begin_ns < end_ns - PATIENCE_NS:
            raise ConfigurationError(
                f"{path} begins {(end_ns - begin_ns) / 1e9:.1f} s before {previous} ends; "
                "name the logs in the order of recording, and replay logs of the same time separately"
            )
        end_ns, previous = max([end_ns, begin_ns or 0, *ends_ns]), path


def _replay_segment(
    paths: Sequence[Path], tolerance_nm: float, kernel: str, segment: Segment, progress: Progress = lambda done: None
) -> Account:
    """Replay a segment, on one thread like the live loop: several threads sum in another order."""
    replay = Replay(tolerance_nm, segment, kernel)
    log = WholeLog(paths, topics=TOPICS, from_ns=max(0, segment.from_ns - PATIENCE_NS), always=published.TOPICS)
    part = None
    gc.disable()
    try:
        with threadpool_limits(1), contextlib.closing(iter(log)) as messages:
            for number, message in enumerate(messages):
                if part is not log.parts[-1]:
                    part = log.parts[-1]
                    _refuse_thinned(part)
                    replay.begin_file(part.metadata)
                    replay.context.former = FormerVersion(part.schemas) if _is_former(part) else None
                replay.add(message)
                if number % _PROGRESS_EVERY == 0:
                    progress(log.position)
                if replay.done:
                    break
            account = replay.finish()
    finally:
        gc.enable()
    named_metadata = [(part.path.name, part.metadata) for part in log.parts]
    account.complete, account.recorded_on = log.complete, named_metadata[0][1].get("lowfc", {})
    account.finished = log.finished
    account.damaged = [f"byte {one.position}: {one.why}" for one in log.damage]
    account.runs = sorted({metadata.get("lowfc", {}).get("run", "?") for _, metadata in named_metadata})
    stopped = [(name, metadata.get("recording", {}).get("stopped")) for name, metadata in named_metadata]
    account.stopped = [f"{name}: {why}" for name, why in stopped if why]
    return account


def _is_former(reader: LogReader) -> bool:
    """Whether another version recorded a log; judged by its schemas if its beginning, with the version, is lost."""
    if version := reader.metadata.get("lowfc", {}).get("lowfc"):
        return version != __version__
    present = declaration(STEP.message).SerializeToString()
    return any(one.name.startswith("lowfc.") and one.data != present for one in reader.schemas.values())


def _refuse_thinned(reader: LogReader) -> None:
    if not reader.selection.has_every_frame:
        raise DataFileError(
            f"{reader.path} cannot be replayed, because it does not have every frame ({reader.selection.description}): "
            "steps are recomputed from the frames; use `lowfc what-if` or `lowfc report`"
        )
