"""Workers: this process, worker processes, or a Dask cluster.

A chunk of items is submitted to a `concurrent.futures.Executor`, and its results are collected.
Where a worker dies, its items run again with nothing else in their worker.
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
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, wait
from concurrent.futures.process import ProcessPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field
from numbers import Integral
from typing import Any, Final, Generic, TypeVar

from merge_sumo.errors import UserError, WorkersLostError, notice
from merge_sumo.scratch import ScratchFolder
from merge_sumo.spawning import forget_safe_path, without_cwd, without_main

MAX_CHUNK: Final = 500
"""Items that a worker takes at a time; what bounds its memory."""
DASK_TIMEOUT_S: Final = 30.0
HERE_S: Final = 3.0
"""Seconds of work in this process before worker processes are started by default. Starting them
takes about as long on a busy machine, so that work takes at most twice the least time."""
TRIED: Final = 8
"""Items of the first chunk in this process, where it is not known how long they take."""
CHUNKS_AHEAD: Final = 16
"""Chunks for each worker that `Workers.run` submits before it collects the first."""

LOOK_S: Final = 5.0
LOST: Final = "lost the connection to the Dask workers; check the cluster"

T = TypeVar("T")
R = TypeVar("R")


@dataclass(slots=True)
class Job(Generic[T, R]):
    """Chunks that were submitted together.

    Attributes:
        function: gives a result for each item of a chunk.
        chunks: the chunks.
        lost: gives the result of an item that ended its worker each time.
        futures: of the chunks, in their order; fewer where chunks wait for this process.
        retried: places of items that ran again, because a worker had died.
    """

    function: Callable[[Sequence[T]], Sequence[R]]
    chunks: Sequence[Sequence[T]]
    lost: Callable[[T], R]
    futures: list[Future[Sequence[R]]]
    retried: set[int] = field(default_factory=set)


class Workers(AbstractContextManager["Workers"]):
    """Runs functions on chunks of items; to be closed, or used in `with`.

    Example:
        with open_workers(2) as workers:
            job = workers.submit(simulate, chunks, lost)
            results = workers.collect(job)

    Attributes:
        count: number of workers.
    """

    def __init__(
        self,
        open_executor: Callable[[int], Executor] | None,
        count: int,
        *,
        died: tuple[type[Exception], ...] = (BrokenExecutor,),
        gone: tuple[type[Exception], ...] = (CancelledError,),
        here_s: float = 0.0,
        on_close: Callable[[], None] = lambda: None,
        is_lost: Callable[[], bool] = lambda: False,
    ) -> None:
        """Open an executor.

        Args:
            open_executor: opens an executor of a number of workers; None for this process.
            count: number of workers.
            died: what a future raises when its worker is dead.
            gone: what a future raises when no worker can be reached.
            here_s: seconds of work in this process before the executor is opened.
            on_close: called when the executor is closed.
            is_lost: returns whether the connection to all workers has ended.
        """
        self._is_lost = is_lost
        self.count = count
        self._open, self._on_close = open_executor, on_close
        self._died, self._gone = died, gone
        self._here_s, self._worked_s, self._worked = here_s, 0.0, 0
        self._executor: Executor | None = None
        self._go_on_in_workers()

    @property
    def here(self) -> bool:
        """True as long as the work is done in this process."""
        return self._executor is None

    def chunk_size(self, items: int) -> int:
        """Return the number of items that a worker takes at a time."""
        share = math.ceil(items / self.count)
        if self._open is not None and self._executor is None:
            # The number for which there is time in this process.
            left_s = self._here_s - self._worked_s
            most = int(self._worked * left_s / self._worked_s) if self._worked_s else TRIED
            share = min(items, max(most, TRIED))
        return max(1, min(MAX_CHUNK, share))

    def submit(
        self,
        function: Callable[[Sequence[T]], Sequence[R]],
        chunks: Iterable[Sequence[T]],
        lost: Callable[[T], R],
    ) -> Job[T, R]:
        """Submit chunks of items. In this process they run when they are collected.

        Args:
            function: gives a result for each item of a chunk; it is found by its name in other
                processes, and may run twice.
            chunks: the chunks.
            lost: gives the result of an item that ends its worker whenever it runs.
        """
        job = Job(function, list(chunks), lost, [])
        self._start(job)
        return job

    def collect(self, job: Job[T, R]) -> list[R]:
        """Return the results of all items of a job, in their order.

        Raises:
            WorkersLostError: if no worker can be reached.
            Exception: what the function raises.
        """
        results: list[R] = []
        for number, chunk in enumerate(job.chunks):
            if self._executor is None:
                start_s = time.perf_counter()
                results += job.function(chunk)
                self._worked_s += time.perf_counter() - start_s
                self._worked += len(chunk)
                job.futures.append(Future())
                self._go_on_in_workers()
                continue
            self._start(job)
            try:
                # A cluster that goes away just now may leave a future without an end.
                while not wait([job.futures[number]], timeout=LOOK_S).done:
                    if self._is_lost():
                        raise WorkersLostError(LOST)
                results += job.futures[number].result()
            except self._died:
                job.retried |= set(range(len(results), len(results) + len(chunk)))
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
    ) -> Generator[tuple[int, R], None, None]:
        """Yield (place in `items`, result) in order.

        Args:
            function: as of `submit`.
            items: the items.
            lost: as of `submit`.
            chunk: items that a worker takes at a time; by default `chunk_size`.
        """
        jobs: deque[tuple[int, Job[T, R]]] = deque()
        first = 0
        while jobs or first < len(items):
            ahead = 1 if self.here else CHUNKS_AHEAD * self.count
            while first < len(items) and len(jobs) < ahead:
                end = first + (chunk or self.chunk_size(len(items) - first))
                jobs.append((first, self.submit(function, [items[first:end]], lost)))
                first = end
            place, job = jobs.popleft()
            yield from enumerate(self.collect(job), start=place)

    def _go_on_in_workers(self) -> None:
        """Open the executor when work in this process has taken its time."""
        if self._open is not None and self._worked_s >= self._here_s:
            self._executor = self._open(self.count)

    def _start(self, job: Job[Any, Any]) -> None:
        """Give the executor, if it is open, the chunks of a job that wait."""
        if self._executor is None or self._open is None:
            return
        for chunk in job.chunks[len(job.futures) :]:
            try:
                future = self._executor.submit(job.function, chunk)
            except self._died:  # earlier
                self._executor.shutdown()
                self._executor = self._open(self.count)
                future = self._executor.submit(job.function, chunk)
            except self._gone as error:
                raise WorkersLostError(LOST) from error
            job.futures.append(future)

    def _retry(self, job: Job[T, R], items: Sequence[T]) -> list[R]:
        """Run items with nothing else in their worker; halve them where it dies."""
        assert self._open is not None, "this process outlives its cases"  # noqa: S101
        try:
            with self._open(1) as executor:
                return list(executor.submit(job.function, items).result())
        except self._gone as error:
            raise WorkersLostError(LOST) from error
        except self._died:
            if len(items) == 1:
                return [job.lost(items[0])]
        half = len(items) // 2
        return self._retry(job, items[:half]) + self._retry(job, items[half:])

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Close the executor; where the program is to stop at once, end the workers."""
        try:
            if isinstance(self._executor, LocalProcesses):
                self._executor.end(at_once=kind is not None and not issubclass(kind, Exception))
            elif self._executor is not None:
                self._executor.shutdown(wait=kind is None)
            else:
                end_worker()
        finally:
            self._on_close()


AnyWorkers = int | str | None
"""A number of processes, the address of a Dask scheduler, or None for a process a core."""


def workers_or_cores(workers: int | None) -> int:
    """Return the number of workers: the given one, or one for each core."""
    if workers is not None and (not isinstance(workers, Integral) or workers < 1):
        raise UserError(f"`workers` is {workers!r}: it must be a whole number, 1 or more")
    return workers or os.cpu_count() or 1


def open_workers(workers: AnyWorkers = None, *, here_s: float = 0.0) -> Workers:
    """Return the workers of the cluster at an address, or else local ones.

    One local worker is this process; more are processes of their own.

    Args:
        workers: a number, an address, or None for one a core.
        here_s: seconds of work in this process before local processes are started.
    """
    if isinstance(workers, str):
        return dask_workers(workers)
    count = workers_or_cores(workers)
    if count > 1 and is_daemonic():
        notice(
            "note: the cases run in this process, as a daemonic process, such as a worker of "
            "multiprocessing.Pool, starts no others"
        )
        count = 1
    return Workers(None if count == 1 else LocalProcesses, count, here_s=here_s)


def workers_or_here(workers: Workers | None) -> AbstractContextManager[Workers]:
    """Give workers, which stay open, or this process as the only one."""
    return open_workers(1) if workers is None else nullcontext(workers)


def is_daemonic() -> bool:
    """Return whether `multiprocessing` lets this process start no others."""
    return multiprocessing.current_process().daemon


DASK_LOGGERS: Final = ("distributed", "distributed.client", "tornado.application")
"""As distributed's setting `logging` names them."""


@contextmanager
def _quiet(names: Sequence[str]) -> Iterator[None]:
    """Log nothing: what matters to a user is a sentence of ours."""
    loggers = list(map(logging.getLogger, names))
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


def dask_workers(address: str) -> Workers:
    """Return the workers of a running Dask cluster; `UserError` when there are none."""
    if "://" not in address:
        raise UserError(
            f"workers is {address!r}: give a number of processes, or the address of a Dask "
            "scheduler, tcp://HOST:PORT"
        )
    try:
        from distributed import Client, KilledWorker
        from distributed.client import ClosedClientError
    except ModuleNotFoundError as error:
        raise UserError(
            f"workers at {address} need Dask: run `pip install merge-sumo[dask]`"
        ) from error
    with ExitStack() as opened:
        opened.enter_context(_quiet(DASK_LOGGERS))
        try:
            client = Client(address, timeout=DASK_TIMEOUT_S, set_as_default=False)
        except (OSError, ValueError, TypeError, ImportError) as error:
            raise UserError(f"there is no Dask scheduler at {address}: {error}") from error
        opened.callback(client.close)
        count = len(client.scheduler_info(n_workers=-1)["workers"])
        if count == 0:
            raise UserError(f"the Dask scheduler at {address} has no workers: start `dask worker`")
        return Workers(
            lambda _: client.get_executor(pure=False),
            count,
            died=(KilledWorker,),
            gone=(CancelledError, ClosedClientError),
            is_lost=lambda: client.status in ("closing", "closed"),
            on_close=opened.pop_all().close,
        )


class LocalProcesses(ProcessPoolExecutor):
    """Worker processes that leave Ctrl-C to their parent and do not outlive it.

    They are spawned, because libsumo's simulation must not be forked.
    """

    def __init__(self, workers: int) -> None:
        """Start them."""
        # A worker that is killed leaves its temporary files behind.
        self._scratch = ScratchFolder()
        with without_cwd():  # its locks have a process of their own
            spawn = multiprocessing.get_context("spawn")
            super().__init__(workers, spawn, _begin_worker, (self._scratch.name,))
        with _sigint_blocked(), without_main(), without_cwd():
            self.submit(int)  # with the first task they start

    def end(self, *, at_once: bool) -> None:
        """Wait for what runs, or end the workers `at_once`."""
        if at_once:
            for process in list((self._processes or {}).values()):
                process.kill()
        self.shutdown(cancel_futures=True)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let the workers end; remove what they have left."""
        super().shutdown(wait, cancel_futures=cancel_futures)
        if wait:
            self._scratch.cleanup()


_endings: list[Callable[[], None]] = []


def when_worker_ends(ending: Callable[[], None]) -> None:
    """Have something called when the work of this process as a worker is over."""
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
