"""The loop of a search: which cases run next, and when the sampler is told what became of them.

    Scheduler.ask -> Case -> evaluate -> Episode -> Scheduler.tell -> Journal.append

Cases are proposed in groups. Those that were proposed, and whose outcomes the sampler was not told
yet, are *in flight*. Before it is asked for a group, it is told the oldest groups, of as few as
leave room for the new one; the cases of the others are pending. There is room

    for one group   of the batch's size: a batch waits for the one before
    for N cases     (`in_flight`), in groups of a third, of a sampler that `overlaps`; others wait
    for any number  of a sampler that does not learn: it runs ahead, and nobody waits

What a group depends on follows from settings and outcomes, and neither from the number of workers
nor from the time that a case takes; whole groups in a journal are all that it takes to go on.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, groupby, islice
from typing import Final

from merge_sumo.engine.evaluate import THIS_PROCESS, evaluate_chunks
from merge_sumo.engine.plan import MAX_CORRIDORS, SimulationPlan
from merge_sumo.samplers.base import Sampler
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.system.workers import MAX_CHUNK, Workers, cut
from merge_sumo.verdict.episode import Episode
from merge_sumo.verdict.prediction import Prediction
from merge_sumo.verdict.score import Outcome

GROUPS: Final = 3
"""Groups in flight: the sampler is asked for one while the cases of others keep workers busy."""
AGE: Final = 16
"""Cases for each of which one more may be in flight than the sampler wants in a batch."""
CHUNK_S: Final = 0.5
"""Seconds of work in a chunk that runs ahead: little to wait for, and much beside sending it."""

Evaluate = Callable[
    [Iterable[Sequence[Case]]], Generator[tuple[int, Sequence[Episode]], None, None]
]
"""Runs chunks of cases; yields (place of the first case, episodes) in any order. After an empty
chunk it takes the next one when a case has ended."""
OnCase = Callable[[Outcome], None]
"""Called with every case as it ends, in the order in which cases end."""
Stop = Callable[[Sequence[Outcome]], bool]
"""Says of the outcomes with a verdict that the sampler was told whether the search is over."""
Tell = Callable[[Sequence[Episode]], None]
"""Tells the sampler the episodes of a group."""


@dataclass(slots=True)
class _Group:
    """Cases that were proposed together, and the episodes of those that have ended, by index."""

    number: int
    first: int
    cases: Sequence[Case]
    predictions: Sequence[Prediction | None] = ()
    ended: dict[int, Episode] = field(default_factory=dict)

    @property
    def has_ended(self) -> bool:
        """Whether all cases have ended."""
        return len(self.ended) == len(self.cases)

    def episodes(self) -> list[Episode]:
        """Return the episodes in the order of the cases."""
        return [self.ended[self.first + place] for place in range(len(self.cases))]


class Scheduler:
    """Keeps groups of cases in flight, and tells a sampler what became of them, in order."""

    def __init__(
        self,
        sampler: Sampler,
        cases: int,
        *,
        batch: int | None = None,
        first: int | None = None,
        in_flight: int | None = None,
        stop: Stop | None = None,
        tell: Tell | None = None,
        on_case: OnCase = lambda _: None,
        history: Iterable[Episode] = (),
    ) -> None:
        """Take a sampler that was told nothing.

        Args:
            sampler: proposes the cases.
            cases: number of cases after which the search ends.
            batch: cases of a group; by default as many as the sampler wants,
            first: and at most so many in the first group.
            in_flight: most cases in flight; by default one group.
            stop: ends the search before.
            tell: tells the sampler a group; by default the outcomes and their motions.
            on_case: called with every outcome.
            history: whole groups that ran before, in order. Only a sampler that uses predictions
                needs their motions.
        """
        self._sampler, self._cases, self._stop = sampler, cases, stop
        self._batch, self._first, self._in_flight = batch, first, in_flight
        self._tell, self._on_case = tell or self._tell_outcomes, on_case
        self._ahead = not sampler.learns and stop is None
        self._overlaps = in_flight is not None and sampler.overlaps
        self._untold: deque[_Group] = deque()
        self._running: deque[_Group] = deque()
        self._group_of: dict[int, _Group] = {}
        """Running groups by the indices of their cases that have not ended."""
        self._proposed = self._told = self._groups = self._ended = 0
        # As if the groups that ran before were proposed again, one after the other.
        for _, group in groupby(history, key=lambda episode: episode.outcome.batch):
            known = {episode.outcome.index: episode for episode in group}
            cases_of = [episode.outcome.case for episode in known.values()]
            self._make_room(len(cases_of))
            self._add(_Group(self._groups, self._proposed, cases_of, ended=known))
        self._begun, self._start_s = self._proposed, time.perf_counter()

    def run(
        self, evaluate: Evaluate, workers: Workers, *, whole: bool = False
    ) -> Generator[list[list[Episode]], None, None]:
        """Ask, run and tell; yield groups in order, those that ended at the same time together.

        Args:
            evaluate: runs the cases.
            workers: where it does.
            whole: whether it takes a group as one chunk.
        """
        with closing(evaluate(self._chunks(workers, whole=whole))) as ran:
            for place, episodes in ran:
                if groups := self.tell(place, episodes):
                    yield groups

    def ask(self) -> list[Case] | None:
        """Return the next group; an empty one where a case has to end first, None for no more."""
        left = self._cases - self._proposed
        if not left:
            return None
        if not self._make_room(min(self._size(), left) if self._overlaps else 0):
            return []
        if self._stop is not None and self._stop(self._sampler.observed()):
            self._cases = self._proposed
            return None
        cases = self._sampler.ask(min(self._size(), left))
        predictions = [self._sampler.prediction(place) for place in range(len(cases))]
        group = _Group(self._groups, self._proposed, cases, predictions)
        self._running.append(group)
        self._group_of |= dict.fromkeys(range(group.first, group.first + len(cases)), group)
        self._add(group)
        return cases

    def tell(self, place: int, episodes: Sequence[Episode]) -> list[list[Episode]]:
        """Take the episodes of cases by the place of the first one among those that were asked for.

        Returns the groups that have ended, in order and once: an earlier one holds others up.
        """
        self._ended += len(episodes)
        for index, episode in enumerate(episodes, start=self._begun + place):
            group = self._group_of.pop(index)
            ended = episode.at(index, group.number, group.predictions[index - group.first])
            group.ended[index] = ended
            self._on_case(ended.outcome)
        groups = []
        while self._running and self._running[0].has_ended:
            groups.append(self._running.popleft().episodes())
        return groups

    def _size(self) -> int:
        """Return the number of cases of the next group."""
        if self._in_flight is None:
            size = self._batch or self._sampler.batch_size()
            return size if self._batch or self._first is None else min(size, self._first)
        most = self._most()
        return max(1, most // GROUPS) if self._overlaps else most

    def _most(self) -> int:
        """Return how many cases may be in flight by now.

        Fewer than N in a young search: the less is known, the more is the next outcome worth.
        """
        assert self._in_flight is not None, "N is given"  # noqa: S101
        return min(self._in_flight, self._sampler.batch_size() + self._proposed // AGE)

    def _make_room(self, wanted: int) -> bool:
        """Tell the sampler as few groups as make room for so many cases; return whether they do."""
        pending = max(0, self._most() - wanted) if self._overlaps else 0
        while self._proposed - self._told > pending:
            if not self._untold[0].has_ended:
                return False
            oldest = self._untold.popleft()
            self._tell(oldest.episodes())
            self._told += len(oldest.cases)
            self._pend()
        return True

    def _tell_outcomes(self, episodes: Sequence[Episode]) -> None:
        outcomes = [episode.outcome for episode in episodes]
        self._sampler.tell(outcomes, motions_of(episodes))

    def _add(self, group: _Group) -> None:
        """Count a group as proposed."""
        self._first = None
        self._groups, self._proposed = group.number + 1, self._proposed + len(group.cases)
        if self._ahead:
            self._sampler.skip(group.cases)
            self._told = self._proposed
        else:
            self._untold.append(group)
            self._pend()

    def _pend(self) -> None:
        self._sampler.pend([case for group in self._untold for case in group.cases])

    def _chunks(self, workers: Workers, *, whole: bool) -> Iterator[Sequence[Case]]:
        """Yield the cases as they are proposed, in chunks as workers want them."""
        groups = iter(self.ask, None)
        if self._ahead:
            cases = chain.from_iterable(groups)
            while chunk := list(islice(cases, self._ahead_size(workers.count))):
                yield chunk
        for group in groups:
            # Where a case has to end first, the group is empty, and so is the chunk.
            yield from [group] if whole or not group else cut(group, workers.chunk_size(len(group)))

    def _ahead_size(self, workers: int) -> int:
        """Return the cases of a chunk that runs ahead, which grows as far as workers are quick."""
        rate = self._ended / (time.perf_counter() - self._start_s)
        # Smaller ones at the end, so that workers end at the same time.
        share = min(CHUNK_S * rate, self._cases - self._proposed) / workers
        return min(max(MAX_CORRIDORS, round(share)), MAX_CHUNK)


def groups_here(
    plan: SimulationPlan, sampler: Sampler, cases: int, batch: int | None = None
) -> Iterator[list[Episode]]:
    """Run a search in the simulator that this process keeps; yield its groups in order.

    The arguments are those of `Scheduler`.
    """
    run = partial(evaluate_chunks, plan, workers=THIS_PROCESS)
    return chain.from_iterable(Scheduler(sampler, cases, batch=batch).run(run, THIS_PROCESS))


def motions_of(episodes: Iterable[Episode]) -> dict[int, FloatArray]:
    """Return the motions of episodes, (T + 1, A, 3), by index."""
    return {episode.outcome.index: episode.trajectory.motion for episode in episodes}
