"""Workers: this process, worker processes, or a Dask cluster.

A chunk of items is submitted to a `concurrent.futures.Executor`, and its results are collected.
Where a worker dies, its items run again one by one, with nothing else in their worker.
"""

from __future__ import annotations

import logging
import math
import multiprocessing
import multiprocessing.util
import os
import signal
import sys
import tempfile
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, wait
from concurrent.futures.process import ProcessPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any, Generic, TypeVar

from merge_sumo.errors import UserError, WorkersLostError, notice
from merge_sumo.files import ScratchFolder
from merge_sumo.spawning import forget_safe_path, without_cwd, without_main

MAX_CHUNK = 500
"""Maximum number of items that a worker takes at a time; it bounds the memory."""
DASK_TIMEOUT_S = 30.0
CHUNKS_AHEAD = 16
"""Chunks for each worker that `Workers.run` submits before it collects the first."""
POLL_S = 5.0
"""Time between two looks at the connection while a result is waited for."""
LOST = "lost the connection to the Dask workers; check the cluster"

T = TypeVar("T")
R = TypeVar("R")


class SerialExecutor(Executor):
    """Runs everything in this process, as it is submitted."""

    def submit(self, function: Callable[..., R], /, *args: Any, **kwargs: Any) -> Future[R]:
        """Run a function now.

        Args:
            function: the function; its exceptions are raised by this call.
            args: its arguments.
            kwargs: its keywords.

        Returns:
            A future with its result.
        """
        future: Future[R] = Future()
        future.set_result(function(*args, **kwargs))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Release what this process kept from one chunk to the next.

        Args:
            wait: without effect.
            cancel_futures: without effect.
        """
        end_worker()


@dataclass(slots=True)
class Job(Generic[T, R]):
    """Chunks that were submitted together.

    Attributes:
        function: gives a result for each item of a chunk.
        chunks: the chunks.
        lost: gives the result of an item that ended its worker twice.
        futures: of the chunks, in their order.
        ran_again: places of items that ran again, because a worker had died.
    """

    function: Callable[[Sequence[T]], Sequence[R]]
    chunks: Sequence[Sequence[T]]
    lost: Callable[[T], R]
    futures: list[Future[Sequence[R]]] = field(default_factory=list)
    ran_again: set[int] = field(default_factory=set)


class Workers(AbstractContextManager["Workers"]):
    """Runs functions on chunks of items; to be closed, or used in `with`.

    Example:
        with open_workers(2) as workers:
            job = workers.submit(function, items, lost)
            results = workers.collect(job)

    Attributes:
        count: number of workers.
    """

    def __init__(
        self,
        open_executor: Callable[[int], Executor] = lambda _: SerialExecutor(),
        count: int = 1,
        *,
        died: type[Exception] = BrokenExecutor,
        gone: tuple[type[Exception], ...] = (CancelledError,),
        is_lost: Callable[[], bool] = lambda: False,
    ) -> None:
        """Open an executor.

        Args:
            open_executor: opens an executor of a number of workers; by default in this process.
            count: number of workers.
            died: exception of a future whose worker is dead.
            gone: exceptions of a future when no worker can be reached.
            is_lost: returns whether the connection to all workers has ended.
        """
        self.count = count
        self._open, self._died, self._gone, self._is_lost = open_executor, died, gone, is_lost
        self._executor = open_executor(count)
        self.on_close = ExitStack()

    def chunk_size(self, items: int) -> int:
        """Return the number of items that a worker takes at a time.

        Args:
            items: number of all items.
        """
        return max(1, min(MAX_CHUNK, math.ceil(items / self.count)))

    def submit(
        self,
        function: Callable[[Sequence[T]], Sequence[R]],
        items: Sequence[T],
        lost: Callable[[T], R],
        chunk: int | None = None,
    ) -> Job[T, R]:
        """Submit items in chunks.

        Args:
            function: gives a result for each item of a chunk; it is found by its name in other
                processes, and may run twice.
            items: the items.
            lost: gives the result of an item that ends its worker twice.
            chunk: items that a worker takes at a time; by default a share of them.

        Returns:
            What `collect` takes.

        Raises:
            WorkersLostError: no worker can be reached.
        """
        size = chunk or self.chunk_size(len(items))
        chunks = [items[first : first + size] for first in range(0, len(items), size)]
        job = Job(function, chunks, lost)
        for part in job.chunks:
            try:
                future = self._executor.submit(function, part)
            except self._died:  # earlier
                self._executor.shutdown()
                self._executor = self._open(self.count)
                future = self._executor.submit(function, part)
            except self._gone as error:
                raise WorkersLostError(LOST) from error
            job.futures.append(future)
        return job

    def collect(self, job: Job[T, R]) -> list[R]:
        """Return the results of all items of a job, in their order.

        Args:
            job: what `submit` has returned.

        Raises:
            WorkersLostError: no worker can be reached.
            Exception: any exception of the function.
        """
        results: list[R] = []
        for chunk, future in zip(job.chunks, job.futures, strict=True):
            try:
                # A cluster that goes away just now may leave a future without an end.
                while not wait([future], timeout=POLL_S).done:
                    if self._is_lost():
                        raise WorkersLostError(LOST)
                results += future.result()
            except self._died:
                job.ran_again.update(range(len(results), len(results) + len(chunk)))
                results += self._retry(job, chunk)
            except self._gone as error:  # nothing is cancelled whose result is collected
                raise WorkersLostError(LOST) from error
        return results

    def run(
        self,
        function: Callable[[Sequence[T]], Sequence[R]],
        items: Sequence[T],
        lost: Callable[[T], R],
        *,
        chunk: int | None = None,
    ) -> Iterator[R]:
        """Run a function on items, some chunks ahead of the one whose results are read.

        Args:
            function: as of `submit`.
            items: the items.
            lost: as of `submit`.
            chunk: items that a worker takes at a time; by default `chunk_size`.

        Yields:
            The results, in the order of the items.
        """
        size = chunk or self.chunk_size(len(items))
        ahead = CHUNKS_AHEAD * self.count if self.count > 1 else 1
        jobs: deque[Job[T, R]] = deque()
        first = 0
        while jobs or first < len(items):
            while first < len(items) and len(jobs) < ahead:
                jobs.append(self.submit(function, items[first : first + size], lost, size))
                first += size
            yield from self.collect(jobs.popleft())

    def _retry(self, job: Job[T, R], items: Sequence[T]) -> list[R]:
        """Run items one by one, with nothing else in their worker."""
        results: list[R] = []
        while len(results) < len(items):
            with self._open(1) as executor:
                try:
                    for item in items[len(results) :]:
                        results += executor.submit(job.function, [item]).result()
                except self._died:
                    results.append(job.lost(items[len(results)]))
                except self._gone as error:
                    raise WorkersLostError(LOST) from error
        return results

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the executor; after an exception the workers end at once."""
        with self.on_close:
            self._executor.shutdown(wait=kind is None)


AUTO = "auto"
AnyWorkers = int | str | None
"""A number of processes, the address of a Dask scheduler, or "auto" (None) for one a core."""


def number_of_workers(requested: AnyWorkers) -> int:
    """Return a number of worker processes; one for each core for "auto" and None.

    Args:
        requested: the number, "auto" or None.

    Raises:
        UserError: it is another value.
    """
    if requested in (None, AUTO):
        return os.cpu_count() or 1
    if not isinstance(requested, Integral) or requested < 1:
        raise UserError(f"`workers` is {requested!r}: it must be a whole number, 1 or more")
    return int(requested)


def open_workers(workers: AnyWorkers = AUTO) -> Workers:
    """Return the workers of the cluster at an address, or else local ones.

    One local worker is this process; more are processes of their own. `SimulationPlan.workers`
    decides how many a plan has.

    Args:
        workers: number, address, or "auto".

    Raises:
        UserError: no cluster answers at the address, or the value is of another kind.
    """
    if isinstance(workers, str) and workers != AUTO:
        return dask_workers(workers)
    count = number_of_workers(workers)
    if count > 1 and multiprocessing.current_process().daemon:
        notice(
            "the cases run in this process, because a daemonic process, such as a worker of "
            "multiprocessing.Pool, cannot start others"
        )
        count = 1
    return Workers() if count == 1 else Workers(LocalProcesses, count)


def dask_workers(address: str) -> Workers:
    """Return the workers of a running Dask cluster.

    Args:
        address: address of its scheduler, tcp://HOST:PORT.

    Raises:
        UserError: Dask is missing, or the cluster has no workers.
    """
    if "://" not in address:
        raise UserError(
            f"`workers` is {address!r}: give a number of processes, or the address of a Dask "
            "scheduler, tcp://HOST:PORT"
        )
    try:
        from distributed import Client, KilledWorker
        from distributed.client import ClosedClientError
    except ModuleNotFoundError as error:
        raise UserError(
            f"the workers at {address} need Dask: run `pip install merge-sumo[dask]`"
        ) from error
    with ExitStack() as opened:
        # A user reads one sentence of merge-sumo, and not the log of the library.
        for name in ("distributed", "distributed.client", "tornado.application"):
            logger = logging.getLogger(name)
            opened.callback(logger.setLevel, logger.level)
            logger.setLevel(logging.CRITICAL + 1)
        try:
            client = Client(address, timeout=DASK_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError, TypeError, ImportError) as error:
            raise UserError(f"no Dask scheduler answers at {address}: {error}") from error
        opened.callback(client.close)
        count = len(client.scheduler_info(n_workers=-1)["workers"])
        if count == 0:
            raise UserError(
                f"the Dask scheduler at {address} has no workers: start one with `dask worker`"
            )
        workers = Workers(
            lambda _: client.get_executor(pure=False),
            count,
            died=KilledWorker,
            gone=(CancelledError, ClosedClientError),
            is_lost=lambda: client.status in ("closing", "closed"),
        )
        workers.on_close = opened.pop_all()
        return workers


class LocalProcesses(ProcessPoolExecutor):
    """Worker processes that leave Ctrl-C to their parent and do not outlive it.

    They are spawned, because libsumo's simulation must not be forked.
    """

    def __init__(self, workers: int) -> None:
        """Start the processes.

        Args:
            workers: their number.
        """
        # A worker that is killed leaves its temporary files behind.
        self._scratch = ScratchFolder()
        with without_cwd():  # its locks have a process of their own
            spawn = multiprocessing.get_context("spawn")
            super().__init__(workers, spawn, _begin_worker, (self._scratch.name,))
        with _sigint_blocked(), without_main(), without_cwd():
            self.submit(int)  # with the first task they start

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let the workers end, or without `wait` kill them; remove their temporary files.

        Args:
            wait: whether their work ends first.
            cancel_futures: without effect: what has not begun is dropped.
        """
        if not wait:
            for process in list((self._processes or {}).values()):
                process.kill()
        super().shutdown(cancel_futures=True)
        self._scratch.cleanup()


_endings: list[Callable[[], None]] = []


def when_worker_ends(ending: Callable[[], None]) -> None:
    """Have a function called when the work of this process as a worker is over.

    Args:
        ending: the function.
    """
    if ending not in _endings:
        _endings.append(ending)


def end_worker() -> None:
    """Release what this process kept from one chunk to the next."""
    while _endings:
        _endings.pop()()


# Processes of multiprocessing end without atexit; in others this is one.
multiprocessing.util.Finalize(None, end_worker, exitpriority=100)


def _begin_worker(scratch: str) -> None:
    """Set up a worker process."""
    tempfile.tempdir = os.environ["TMPDIR"] = scratch
    forget_safe_path()
    leave_signals_to_parent()
    import numpy as np  # noqa: F401 (its libraries are limited as they are loaded)
    from threadpoolctl import threadpool_limits

    # As many threads as workers keep all cores busy. A library that is loaded later has no limit.
    threadpool_limits(1)


def leave_signals_to_parent() -> None:
    """Leave Ctrl-C to the parent of this process, and end with it however it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()

    def end_with_parent() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Block SIGINT in this thread, and in the threads and processes that it starts."""
    if sys.platform == "win32":
        yield
        return
    before: Iterable[Any] = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
