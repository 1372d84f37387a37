"""Workers: this process, worker processes, or a cluster.

What is above submits chunks of its items to a standard `concurrent.futures.Executor` and never
sees which one. A worker that dies takes nothing with it: its chunks run again.
"""

from __future__ import annotations

import atexit
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
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    InvalidStateError,
    wait,
)
from concurrent.futures.process import ProcessPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import dataclass
from importlib import import_module
from multiprocessing.synchronize import Semaphore
from numbers import Integral
from typing import Any, Final, Generic, TypeVar

from merge_sumo.errors import UserError, WorkersLostError, notice
from merge_sumo.system.blame import Blame
from merge_sumo.system.limits import check_threads
from merge_sumo.system.scratch import ScratchFolder
from merge_sumo.system.spawning import forget_safe_path, without_cwd, without_main

MAX_CHUNK: Final = 500
"""Items that a worker takes at a time; what bounds its memory."""
RECYCLE_AFTER: Final = 200
"""Chunks after which a worker process is replaced by a new one: a VUT may leak memory."""
POOL_THREADS: Final = 4
"""Threads and processes that a pool takes, besides its workers."""
WORKER_THREADS: Final = 4
"""Those of a worker and of the process of a VUT, besides one for each core in NumPy."""
DASK_TIMEOUT_S: Final = 30.0
HERE_S: Final = 3.0
"""Seconds of work in this process before worker processes are started, where they may be: about
what starting them takes on a busy machine, so that work takes at most twice the least time."""
TRIED: Final = 8
"""Items of a chunk in this process before it is known how long they take."""

T = TypeVar("T")
R = TypeVar("R")


class Workers(AbstractContextManager["Workers"]):
    """Runs functions on chunks of items through an executor; to be closed, or used in `with`.

    A chunk whose worker dies runs again, alone and then item by item, so that the one item that
    ends its worker each time is found; only that one is given up, when `system/blame.py` says so.
    """

    def __init__(
        self,
        open_executor: Callable[[], Executor],
        count: int,
        *,
        died: tuple[type[Exception], ...] = (BrokenExecutor,),
        gone: tuple[type[Exception], ...] = (CancelledError,),
        recycle_after: int | None = None,
        on_close: Callable[[], None] | None = None,
        here_s: float | None = None,
    ) -> None:
        """Open an executor with `count` workers.

        `died` is what a future raises when its worker is dead, `gone` what it raises when all of
        them are out of reach. The executor is closed and opened anew after a death, and after
        `recycle_after` chunks per worker. With `here_s` it is opened only when work in this process
        has taken so many seconds.
        """
        self.count = count
        self._open = open_executor
        self._here_s, self._here_items = here_s, 0
        """Seconds that this process goes on for, and items that it has begun; None for no more."""
        self._limit_s = here_s or 0.0
        self._died, self._gone = died, gone
        self._recycle_after = recycle_after
        self._on_close = on_close
        self._executor = open_executor() if here_s is None else InProcess()
        self._submitted = 0
        self._broken = False
        self._left: list[Future[Any]] = []

    def run(
        self,
        function: Callable[[Sequence[T]], Sequence[R]],
        items: Sequence[T],
        lost: Callable[[T], R],
        *,
        chunk: int | None = None,
    ) -> Generator[tuple[int, R], None, None]:
        """Yield (place in `items`, result) as chunks of `chunk` items, or `chunk_size`, end.

        `function` gives one result for each item of a chunk, is found by its name in other
        processes, and may run twice; what it raises, this raises, and `WorkersLostError` when the
        executor goes away. `lost` gives the result of an item that is to blame for the deaths of
        its workers.
        """
        chunks = cut(items, chunk or self.chunk_size(len(items)))
        for first, results in self.run_chunks(function, chunks, lost):
            yield from enumerate(results, start=first)

    @property
    def here(self) -> bool:
        """True as long as the work is done in this process."""
        return isinstance(self._executor, InProcess)

    def chunk_size(self, items: int) -> int:
        """Return the number of items that a worker takes at a time."""
        share = math.ceil(items / self.count)
        if self._here_s is not None:
            # As many as there is time for here.
            item_s = (self._limit_s - self._here_s) / max(self._here_items, 1)
            most = int(self._here_s / item_s) if self._here_items and item_s > 0.0 else TRIED
            share = min(items, max(most, TRIED))
        return max(1, min(MAX_CHUNK, share))

    def run_chunks(
        self,
        function: Callable[[Sequence[T]], Sequence[R]],
        chunks: Iterable[Sequence[T]],
        lost: Callable[[T], R],
        *,
        ran_again: Callable[[R], R] | None = None,
    ) -> Generator[tuple[int, Sequence[R]], None, None]:
        """Yield (place of the first item, results) as chunks end; raise as `run` does.

        A chunk is only taken from `chunks` when a worker may want it, and after an empty one the
        next only when a chunk has ended. `ran_again` marks the results of items that ran again
        because a worker had died.
        """
        fresh, blame = _in_a_row(chunks), Blame[int]()
        suspects: deque[_Chunk[T]] = deque()
        running: dict[Future[Sequence[R]], _Chunk[T]] = {}
        try:
            while True:
                # Suspects run one at a time, so that a death is theirs.
                most, alone = (1, not running) if suspects else (2 * self.count, False)
                while len(running) < most and self._ready(running):
                    next_chunk = suspects.popleft() if suspects else next(fresh, None)
                    if next_chunk is None or not next_chunk.items:
                        break
                    running[self._submit(function, next_chunk.items)] = next_chunk
                if not running:
                    return
                done = wait(running, return_when=FIRST_COMPLETED).done
                for future in [one for one in running if one in done]:
                    ended = running.pop(future)
                    try:
                        results = future.result()
                    except self._died:
                        self._broken = True
                        if ended.died(blame, alone, suspects):
                            yield ended.first, [lost(ended.items[0])]
                    except self._gone as error:  # we cancel only what nobody waits for
                        raise WorkersLostError(
                            "the workers went away: look after the cluster"
                        ) from error
                    else:
                        again = ran_again if ended.struck else None
                        yield ended.first, [again(r) for r in results] if again else results
        finally:
            self._left = [future for future in running if not future.cancel()]

    def _ready(self, running: dict[Future[Any], Any]) -> bool:
        """Return whether the executor takes work; reopen it where that is due and possible."""
        most = math.inf if self._recycle_after is None else self._recycle_after * self.count
        if self._here_s is not None:
            stays = self._here_s > 0.0
        else:
            stays = self._submitted < most and not self._broken
        if stays:
            return True
        if running:
            return False
        self._executor.shutdown(wait=True)
        self._executor = self._open()
        self._submitted, self._broken, self._here_s = 0, False, None
        return True

    def _submit(self, function: Callable[[Sequence[T]], R], items: Sequence[T]) -> Future[R]:
        self._submitted += 1
        start_s = time.perf_counter()
        try:
            return self._executor.submit(function, items)
        except (*self._died, *self._gone) as error:
            # It broke between two submissions: as if it had broken a moment later.
            future: Future[R] = Future()
            future.set_exception(error)
            return future
        finally:
            if self._here_s is not None:
                self._here_s -= time.perf_counter() - start_s
                self._here_items += len(items)

    def __exit__(self, *exception: Any) -> None:
        """Close the executor; only where work was left behind does it hear of an exception."""
        left_behind = any(not future.done() for future in self._left)
        try:
            self._executor.__exit__(*(exception if left_behind else (None, None, None)))
        finally:
            if self._on_close is not None:
                self._on_close()


@dataclass(slots=True)
class _Chunk(Generic[T]):
    """Items that go to a worker together, and whether a worker has died of them or beside them."""

    first: int
    items: Sequence[T]
    struck: bool = False

    def died(self, blame: Blame[int], alone: bool, suspects: deque[_Chunk[T]]) -> bool:
        """Take note of a death: return whether it is the one item's doing, else try again.

        A chunk that ended its worker alone is tried item by item.
        """
        self.struck = True
        if len(self.items) > 1 and alone:
            for place in range(len(self.items)):
                item = self.items[place : place + 1]
                suspects.append(_Chunk(self.first + place, item, struck=True))
            return False
        guilty = len(self.items) == 1 and blame.died(self.first, alone=alone)
        if not guilty:
            suspects.append(self)
        return guilty


def cut(items: Sequence[T], size: int) -> Iterator[Sequence[T]]:
    """Yield items in chunks of a size."""
    return (items[first : first + size] for first in range(0, len(items), size))


def _in_a_row(chunks: Iterable[Sequence[T]]) -> Iterator[_Chunk[T]]:
    first = 0
    for items in chunks:
        yield _Chunk(first, items)
        first += len(items)


AnyWorkers = int | str | None
"""A number of processes, the address of a Dask scheduler, or None for a process a core."""


def workers_or_cores(workers: int | None) -> int:
    """Return the number of workers: as asked, or one for each core."""
    if workers is not None and (not isinstance(workers, Integral) or workers < 1):
        raise UserError(f"`workers` is {workers!r}: it must be a whole number, 1 or more")
    return workers or os.cpu_count() or 1


def open_workers(
    workers: AnyWorkers = None,
    *,
    preload: str | None = None,
    here_s: float | None = None,
    apart: bool = False,
) -> Workers:
    """Return the workers of the cluster at an address, or else local ones.

    One local worker is this process itself, unless it is to be `apart`; more are processes of their
    own, which import the module `preload` as they start. None is one a core. With `here_s` they are
    started only when work in this process has taken so many seconds, and where the system lets
    them.
    """
    if isinstance(workers, str):
        return dask_workers(workers)
    count = workers_or_cores(workers)
    if is_daemonic() and (count > 1 or apart):
        notice(
            "note: the cases run in this process, as a daemonic process, such as a worker of "
            "multiprocessing.Pool, starts no others"
        )
        count, apart = 1, False
    if count == 1 and not apart:
        return Workers(InProcess, 1)
    threads = POOL_THREADS + count * ((os.cpu_count() or 1) + WORKER_THREADS)
    if here_s is None:
        check_threads(threads)

    def processes() -> Executor:
        if here_s is not None:
            try:
                check_threads(threads)
            except UserError:
                return InProcess()
        return LocalProcesses(count, preload)

    return Workers(processes, count, recycle_after=RECYCLE_AFTER, here_s=here_s)


def is_daemonic() -> bool:
    """Return whether `multiprocessing` lets this process start no others."""
    return multiprocessing.current_process().daemon


DASK_LOGGERS: Final = ("distributed", "distributed.client", "tornado.application")
"""As distributed's setting `logging` names them."""


@contextmanager
def _quiet(names: Sequence[str]) -> Iterator[None]:
    """Log nothing: what matters to a person is said in a sentence."""
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
            lambda: client.get_executor(pure=False),
            count,
            died=(KilledWorker,),
            gone=(CancelledError, ClosedClientError),
            on_close=opened.pop_all().close,
        )


class InProcess(Executor):
    """An executor of one worker: the process that calls it."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Run at once; the future is done."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # a future holds whatever was raised
            future.set_exception(error)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let go what the worker kept."""
        end_worker()


class LocalProcesses(ProcessPoolExecutor):
    """Worker processes that leave Ctrl-C to their parent and do not outlive it.

    They are spawned, because libsumo's simulation must not be forked. No more of them import their
    modules at a time than there are cores: the first ones work while others wait for that.
    """

    def __init__(self, workers: int, preload: str | None = None) -> None:
        """Start them; RuntimeError where this process may start none."""
        if is_daemonic():
            raise RuntimeError("a daemonic process starts no others")
        spawn = multiprocessing.get_context("spawn")
        with without_cwd():  # its locks have a process of their own
            cores = spawn.Semaphore(os.cpu_count() or 1)
            # A worker that is killed leaves its temporary files behind.
            self._scratch = ScratchFolder()
            given = cores, preload, self._scratch.name
            super().__init__(workers, spawn, _begin_worker, given)
        self.submit(int)  # with the first task they start

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Submit; workers that are started here, now or later, never see SIGINT."""
        with _sigint_blocked(), without_main(), without_cwd():
            future = super().submit(fn, *args, **kwargs)

        def fail(exception: BaseException | None) -> None:
            # The thread that ends a broken pool would die of a future that was cancelled.
            with suppress(InvalidStateError):
                Future.set_exception(future, exception)

        future.set_exception = fail  # type: ignore[method-assign]
        return future

    def __exit__(self, *exception: Any) -> bool | None:
        """Wait for the workers; when the program is to end at once, end them too."""
        if exception[0] is not None and not issubclass(exception[0], Exception):
            self._kill()
        return super().__exit__(*exception)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Let the workers end; remove what they have left."""
        super().shutdown(wait, cancel_futures=cancel_futures)
        if wait:
            self._scratch.cleanup()

    def _kill(self) -> None:
        for process in list((self._processes or {}).values()):
            process.kill()
        # Before 3.11.5 and 3.12, Python waits for ever to write what no worker reads any more:
        # https://github.com/python/cpython/issues/94777
        queue: Any = getattr(self, "_call_queue", None)
        if queue is not None:
            queue._reader.close()


_endings: list[Callable[[], None]] = []


def when_worker_ends(ending: Callable[[], None]) -> None:
    """Have something called when the work of this process as a worker is over."""
    if ending not in _endings:
        _endings.append(ending)
    atexit.unregister(end_worker)  # not to be registered twice
    atexit.register(end_worker)


def end_worker() -> None:
    """Let go what this process kept from one chunk to the next."""
    while _endings:
        _endings.pop()()


def _begin_worker(cores: Semaphore, preload: str | None, scratch: str) -> None:
    """Set up a worker process, when one of the cores is free for that."""
    tempfile.tempdir = os.environ["TMPDIR"] = scratch
    forget_safe_path()
    leave_signals_to_parent()
    # Processes of multiprocessing end without atexit.
    multiprocessing.util.Finalize(None, end_worker, exitpriority=100)
    with cores:
        from threadpoolctl import threadpool_limits

        for module in filter(None, ("numpy", preload)):
            import_module(module)
        # As many threads as workers keep all cores busy. A library that is loaded later has no
        # limit.
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
