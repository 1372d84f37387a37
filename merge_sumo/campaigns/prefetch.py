"""Cases that run before they are asked for.

Where outcomes do not decide what a sampler proposes, nobody has to wait for a batch to end: cases
go to the workers in chunks of a size that suits them, and are handed out batch by batch. What is
proposed, told and recorded is the same, and the journal holds whole batches in their order.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, islice
from typing import Final, Self

from merge_sumo.campaigns.journal import Batch
from merge_sumo.engine.simulator import MAX_CORRIDORS, CaseResult, OnWorkers
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


class Ahead:
    """Runs batches on workers, those ahead before they are asked for; to be used in `with`."""

    def __init__(
        self, run: OnWorkers, ahead: Iterable[Sequence[Case]], cases: float = math.inf
    ) -> None:
        """Take the batches that will be asked for, in that order, and of how many cases they are.

        Where there are none, nothing runs ahead.
        """
        self._run = run
        self._cases = cases
        self._chunks = run.chunks(self._cut(chain.from_iterable(ahead)))
        self._sent: dict[int, Case] = {}
        """Cases that were not asked for yet, by their place,"""
        self._ran: dict[int, CaseResult] = {}
        """and what became of those that have ended."""
        self._asked = self._ended = 0
        self._start_s = time.perf_counter()

    def __call__(self, cases: Sequence[Case]) -> Iterator[tuple[int, CaseResult]]:
        """Run the next batch; yield (place in `cases`, what became of the case)."""
        first = self._asked
        self._asked += len(cases)
        for place, case in enumerate(cases):
            while first + place not in self._ran:
                chunk = next(self._chunks, None)
                if chunk is None:
                    yield from self._run(cases)
                    return
                self._ran.update(enumerate(chunk[1], start=chunk[0]))
                self._ended += len(chunk[1])
            assert self._sent.pop(first + place) == case, "what it proposes is sure"  # noqa: S101
            yield place, self._ran.pop(first + place)

    def together(self, batches: Iterable[Batch]) -> Iterator[list[Batch]]:
        """Yield the batches that this has run, those that ended at the same time together."""
        ended: list[Batch] = []
        for batch in batches:
            ended.append(batch)
            if self._asked + len(batch) - 1 not in self._ran:
                yield ended
                ended = []
        if ended:
            yield ended

    def _cut(self, cases: Iterator[Case]) -> Iterator[list[Case]]:
        """Yield chunks that grow as far as workers are quick."""
        first = 0
        while True:
            rate = self._ended / (time.perf_counter() - self._start_s) / self._run.workers.count
            # Smaller ones at the end, so that workers end at the same time.
            share = min(CHUNK_S * rate, (self._cases - first) / self._run.workers.count)
            size = min(max(MAX_CORRIDORS, round(share)), MAX_CHUNK)
            chunk = list(islice(cases, size))
            if not chunk:
                return
            self._sent.update(enumerate(chunk, start=first))
            first += len(chunk)
            yield chunk

    def __enter__(self) -> Self:
        """Return what runs cases."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave what runs ahead, where somebody stopped."""
        self._chunks.close()
