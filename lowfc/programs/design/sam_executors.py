"""Executors for the independent chains of a mask search: this process, local processes, or workers of Dask."""

import logging
import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from threading import Thread
from typing import Any

from lowfc.adapters.process.child import interrupt_blocked
from lowfc.adapters.process.extras import package_required
from lowfc.contract.errors import ConfigurationError, raised_as

DASK_TIMEOUT_S = 10.0


class InProcessExecutor(Executor):
    """Runs submitted calls immediately in this process."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run the call; KeyboardInterrupt propagates to the caller."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class Pool(ProcessPoolExecutor):
    """Local processes, started by `submit`; only the search's own process handles Ctrl-C."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit the call, as in the base class."""
        with interrupt_blocked():
            return super().submit(fn, *args, **kwargs)


@contextmanager
def open_executor(jobs: int, scheduler: str | None) -> Iterator[Executor]:
    """Open an executor with this number of processes, or that of a Dask scheduler if its address is given."""
    if scheduler is not None:
        with _dask(scheduler) as executor:
            yield executor
    elif jobs == 1:
        yield InProcessExecutor()
    else:
        pool = Pool(jobs, multiprocessing.get_context("spawn"), _begin_worker)
        try:
            yield pool
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _begin_worker() -> None:
    """Make this worker end with the search, even if the search is killed."""
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None  # noqa: S101  # this is a worker
    parent.join()
    os._exit(1)


def is_lost(error: BaseException) -> bool:
    """Whether the error means that the workers died, not that their work failed."""
    from_dask = type(error).__module__.partition(".")[0] == "distributed"
    return from_dask or isinstance(error, (BrokenExecutor, CancelledError, OSError))


@contextmanager
def _dask(address: str) -> Iterator[Executor]:
    with (
        raised_as(ConfigurationError, (OSError, ValueError), f"no Dask scheduler answers at {address!r}"),
        package_required("--scheduler requires Dask", "cluster"),
    ):
        client: Any = import_module("distributed").Client(address, timeout=DASK_TIMEOUT_S)
    for name in ("distributed", "distributed.client"):  # a lost scheduler is reported by us, without a traceback
        logging.getLogger(name).setLevel(logging.CRITICAL)
    try:
        yield client.get_executor(pure=False)
    finally:
        client.close()
