"""The loop of a campaign: it asks, submits, collects, stores, tells.

Cases are proposed in groups. Those whose outcomes the sampler was not told yet are pending. Before
the loop asks the sampler again, it tells it the oldest groups, only those that make room for the
next one:

    a batch       waits for the one before
    in flight     N cases may be pending, in groups of a third, of a sampler that `overlaps`
    ahead         a sampler that does not learn is asked long before its cases run

What a group depends on follows from settings and outcomes, and neither from the number of workers
nor from the time that a case takes. Groups that a journal has are told again, and do not run.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby
from typing import Final

from merge_sumo.metrics.outcome import Episode, Outcome, Prediction
from merge_sumo.metrics.regression import regression
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.controller_model import ControllerModelPair
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.simulation.evaluate import lost, simulate_part, with_measures
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import MAX_CHUNK, Job, Workers

GROUPS: Final = 3
"""Groups in flight: the sampler is asked for one while the cases of others keep workers busy."""
AGE: Final = 16
"""For each AGE cases that were proposed, one more case may be in flight."""
AHEAD_S = 0.5
"""Seconds of work for each worker that are submitted together, where the sampler does not learn."""

Groups = list[list[Episode]]
"""The episodes of groups that were submitted together."""


@dataclass(slots=True)
class _Group:
    """Cases that were proposed together, and their episodes when they have run."""

    number: int
    first: int
    cases: Sequence[Case]
    predictions: Sequence[Prediction | None] = ()
    episodes: list[Episode] = field(default_factory=list)


class SearchLoop:
    """Keeps groups of cases in flight, and tells a sampler their outcomes in order.

    Example:
        SearchLoop(make_sampler("uniform", pool, seed), plan, 100).run(on_groups)
    """

    def __init__(
        self,
        sampler: Sampler,
        plan: SimulationPlan,
        cases: int,
        *,
        workers: Workers | None = None,
        batch: int | None = None,
        draws: int = 1,
        in_flight: int | None = None,
        stop: Callable[[Sequence[Outcome]], bool] | None = None,
        history: Iterable[Episode] = (),
    ) -> None:
        """Take a sampler that was told nothing.

        Args:
            sampler: proposes the cases.
            plan: how they run.
            cases: number of cases after which the search ends.
            workers: where they run; by default in this process, whose simulator stays open.
            batch: cases of a group; by default the number that the sampler wants.
            draws: runs of each case that the sampler proposes. All are in one group.
            in_flight: most cases in flight; by default one group.
            stop: whether the outcomes with a verdict end the search.
            history: whole groups that ran before, in order.
        """
        self._sampler, self._cases, self._stop = sampler, cases, stop
        self._simulate = partial(simulate_part, plan, keep=with_measures)
        self._lost = partial(lost, plan)
        self._workers = Workers() if workers is None else workers
        self._batch, self._draws, self._in_flight = batch, draws, in_flight
        self._ahead = not sampler.learns and stop is None
        self._overlaps = in_flight is not None and sampler.overlaps
        groups = groupby(history, key=lambda episode: episode.outcome.batch)
        self._history = deque(list(group) for _, group in groups)
        self._pending: list[_Group] = []
        self._proposed = self._ran = 0
        self._groups = 0
        self._start_s = time.perf_counter()

    def run(self, on_groups: Callable[[Groups], None]) -> None:
        """Ask, run, store and tell until all cases have run.

        Args:
            on_groups: stores groups whose cases have run, before the sampler is told; may raise to
                stop the search.
        """
        running: deque[tuple[list[_Group], Job[Case, Episode] | None]] = deque()
        while True:
            while self._has_room(len(running)) and (groups := self._ask()):
                job = None
                if not groups[0].episodes:
                    cases = [case for group in groups for case in group.cases]
                    job = self._workers.submit(self._simulate, cases, self._lost)
                running.append((groups, job))
            if not running:
                return
            groups, job = running.popleft()
            if job is not None:
                self._collect(groups, job)
                on_groups([group.episodes for group in groups])
            for group in groups:
                tell(self._sampler, group.episodes)
            del self._pending[: len(groups)]
            self._pend()

    def _has_room(self, running: int) -> bool:
        """Return whether the sampler is asked before it is told the oldest group."""
        if self._ahead:
            return running < GROUPS
        if self._overlaps and running:
            pending = sum(len(group.cases) for group in self._pending)
            return pending + self._size() <= self._most()
        return not running

    def _ask(self) -> list[_Group]:
        """Return the groups to submit next; none where the search has ended."""
        if self._history:
            known = self._history.popleft()
            cases = [episode.outcome.case for episode in known]
            return [self._add(_Group(self._groups, self._proposed, cases, episodes=known))]
        if self._stop is not None and self._stop(self._sampler.observed()):
            self._cases = self._proposed
        end = min(self._cases, self._proposed + self._cases_ahead())
        groups = []
        while self._proposed < end:
            cases, predictions = [], []
            for place, case in enumerate(self._sampler.ask(max(1, self._size() // self._draws))):
                for draw in range(self._draws):
                    cases.append(replace(case, draw=draw))
                    predictions.append(None if draw else self._sampler.prediction(place))
            left = self._cases - self._proposed
            group = _Group(self._groups, self._proposed, cases[:left], predictions[:left])
            groups.append(self._add(group))
        return groups

    def _cases_ahead(self) -> int:
        """Return how many cases are submitted together at least: more where workers are quick."""
        if not self._ahead:
            return 1
        rate = self._ran / (time.perf_counter() - self._start_s)
        return max(1, min(round(AHEAD_S * rate), MAX_CHUNK * self._workers.count))

    def _size(self) -> int:
        """Return the number of cases of the next group."""
        if self._history:
            return len(self._history[0])
        if self._in_flight is None:
            size = self._batch or self._sampler.batch_size()
        elif self._overlaps:
            size = max(1, self._most() // GROUPS)
        else:
            size = self._most()
        return min(size, self._cases - self._proposed)

    def _most(self) -> int:
        """Return how many cases may be in flight by now.

        Fewer than N in a young search: the less is known, the more is the next outcome worth.
        """
        assert self._in_flight is not None, "N is given"  # noqa: S101
        return min(self._in_flight, self._sampler.batch_size() + self._proposed // AGE)

    def _add(self, group: _Group) -> _Group:
        """Count a group as proposed."""
        self._groups += 1
        self._proposed += len(group.cases)
        self._pending.append(group)
        self._pend()
        return group

    def _pend(self) -> None:
        self._sampler.pend([case for group in self._pending for case in group.cases])

    def _collect(self, groups: Sequence[_Group], job: Job[Case, Episode]) -> None:
        """Collect the episodes of groups; note which ran again because a worker had died."""
        episodes = self._workers.collect(job)
        self._ran += len(episodes)
        for place in job.retried:
            episodes[place] = replace(episodes[place], again=True)
        rest = iter(episodes)
        for group in groups:
            for index, prediction in enumerate(group.predictions, group.first):
                group.episodes.append(next(rest).at(index, group.number, prediction))


def tell(sampler: Sampler, episodes: Sequence[Episode]) -> None:
    """Tell a sampler the outcomes of episodes, or where they ran with two versions, regressions."""
    earlier = [episode.earlier for episode in episodes if episode.earlier is not None]
    outcomes = [episode.outcome for episode in episodes]
    if earlier:
        if isinstance(sampler.predictor, ControllerModelPair):
            sampler.predictor.tell_old([one.outcome for one in earlier], motions_of(earlier))
        pairs = zip(outcomes, earlier, strict=True)
        outcomes = [regression(new, old.outcome, old.outcome.prediction) for new, old in pairs]
    sampler.tell(outcomes, motions_of(episodes))


def motions_of(episodes: Iterable[Episode]) -> dict[int, FloatArray]:
    """Return the motions of episodes, (T + 1, A, 3), by index."""
    return {episode.outcome.index: episode.trajectory.motion for episode in episodes}
