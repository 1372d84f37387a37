"""Cases that run before they are requested.

Where outcomes do not decide what a sampler proposes, nobody has to wait for a batch to end: cases
go to the workers in chunks of a size that suits them, and are handed out batch by batch. What is
proposed, told and recorded is the same, and the journal holds whole batches in their order.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from itertools import chain, islice
from typing import Final, Self

from merge_sumo.campaigns.store import Batch
from merge_sumo.engine.evaluate import CaseResult
from merge_sumo.engine.plan import MAX_CORRIDORS
from merge_sumo.samplers.base import Sampler
from merge_sumo.system.workers import MAX_CHUNK
from merge_sumo.values.case import Case
from merge_sumo.values.score import Outcome

CHUNK_S: Final = 0.5
"""Seconds of work in a chunk: little to wait for, and much beside what it costs to send it."""


def proposals(
    sampler: Sampler, history: Sequence[Outcome], cases: int, batch: int | None
) -> Iterator[list[Case]]:
    """Yield the batches that a sampler proposes after a history, up to so many cases in all.

    One that learns has to be told what became of a batch before it is asked for the next.
    """
    if sampler.learns:
        return
    sampler.tell(history)
    first = len(history)
    while first < cases:
        proposed = sampler.ask(min(batch or sampler.batch_size(), cases - first))
        yield proposed
        sampler.skip(proposed)
        first += len(proposed)


ChunkResults = Generator[tuple[int, Sequence[CaseResult]], None, None]
RunChunks = Callable[[Iterable[Sequence[Case]]], ChunkResults]
"""Runs chunks of cases; yields (place of the first case, results) in any order."""


class Prefetch:
    """Runs batches on workers before they are requested; to be used in `with`."""

    def __init__(
        self,
        run_chunks: RunChunks,
        workers: int,
        proposed: Iterable[Sequence[Case]],
        cases: float = math.inf,
        chunk_size: Callable[[int], int] | None = None,
    ) -> None:
        """Take what runs chunks on a number of workers, and the batches that will be requested.

        `cases` is how many cases they are. Without such batches, each runs when it is requested, in
        chunks of a size that follows from its number of cases: by default one for each worker.
        """
        self._chunk_size = chunk_size or (lambda n: min(MAX_CHUNK, math.ceil(n / workers)))
        self._run_chunks, self._workers = run_chunks, workers
        self._cases = cases
        self._chunks = run_chunks(self._cut(chain.from_iterable(proposed)))
        self._sent: dict[int, Case] = {}
        """Cases that were not requested yet, by their place."""
        self._ran: dict[int, CaseResult] = {}
        """Results of those that have ended."""
        self._requested = self._ended = 0
        self._start_s = time.perf_counter()

    def run(self, cases: Sequence[Case]) -> Iterator[tuple[int, CaseResult]]:
        """Run the next batch; yield (place in `cases`, result)."""
        first = self._requested
        self._requested += len(cases)
        for place, case in enumerate(cases):
            while first + place not in self._ran:
                chunk = next(self._chunks, None)
                if chunk is None:
                    yield from self._run_now(cases)
                    return
                self._ran.update(enumerate(chunk[1], start=chunk[0]))
                self._ended += len(chunk[1])
            sent = self._sent.pop(first + place)
            assert sent == case, "what it proposes is sure"  # noqa: S101
            yield place, self._ran.pop(first + place)

    def _run_now(self, cases: Sequence[Case]) -> Iterator[tuple[int, CaseResult]]:
        size = self._chunk_size(len(cases))
        chunks = (cases[first : first + size] for first in range(0, len(cases), size))
        for first, results in self._run_chunks(chunks):
            yield from enumerate(results, start=first)

    def together(self, batches: Iterable[Batch]) -> Iterator[list[Batch]]:
        """Yield the batches that this has run, those that ended at the same time together."""
        ended: list[Batch] = []
        for batch in batches:
            ended.append(batch)
            if self._requested + len(batch) - 1 not in self._ran:
                yield ended
                ended = []
        if ended:
            yield ended

    def _cut(self, cases: Iterator[Case]) -> Iterator[list[Case]]:
        """Yield chunks that grow as far as workers are quick."""
        first = 0
        while True:
            rate = self._ended / (time.perf_counter() - self._start_s) / self._workers
            # Smaller ones at the end, so that workers end at the same time.
            share = min(CHUNK_S * rate, (self._cases - first) / self._workers)
            size = min(max(MAX_CORRIDORS, round(share)), MAX_CHUNK)
            chunk = list(islice(cases, size))
            if not chunk:
                return
            self._sent.update(enumerate(chunk, start=first))
            first += len(chunk)
            yield chunk

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """Leave what still runs, where the campaign was stopped."""
        self._chunks.close()
