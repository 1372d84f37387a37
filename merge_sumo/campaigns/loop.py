"""The loop of a campaign: it asks, submits, collects, stores, tells.

Cases are proposed in batches. Those whose outcomes the sampler was not told yet are pending. Before
it asks for a batch, the loop tells the sampler the oldest outcomes, until one more batch may be
pending. How many cases may be pending depends on settings and sampler:

    a batch       waits for the one before
    in flight     N cases may be pending, in batches of a third, of a sampler that `overlaps`
    ahead         a sampler that does not learn is asked long before its cases run

What a batch depends on follows from settings and outcomes, and neither from the number of workers
nor from the time that a case takes. Batches that a journal has are told again, and do not run.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from typing import Final

from merge_sumo.metrics.outcome import Episode, Outcome, Prediction
from merge_sumo.metrics.regression import regression
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.controller_model import ControllerModelPair
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.simulation.evaluate import lost_episode, simulate_part, with_measures
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import MAX_CHUNK, Job, Workers

BATCHES_IN_FLIGHT: Final = 3
"""Batches in flight: the sampler is asked for one while the cases of others keep workers busy."""
AGE: Final = 16
"""For each AGE cases that were proposed, one more case may be in flight."""
AHEAD_S = 0.5
"""Seconds of work for each worker that are submitted together, where the sampler does not learn."""

Batches = list[list[Episode]]
"""The episodes of batches that were submitted together."""


@dataclass(slots=True)
class _Batch:
    """Cases that were proposed together, and their episodes when they have run."""

    number: int
    first_index: int
    cases: Sequence[Case]
    predictions: Sequence[Prediction | None]
    episodes: list[Episode]


class SearchLoop:
    """Keeps batches of cases in flight, and tells a sampler their outcomes in order.

    Example:
        SearchLoop(make_sampler("uniform", pool, seed), plan, 100).run(on_batches)
    """

    def __init__(
        self,
        sampler: Sampler,
        plan: SimulationPlan,
        cases: int,
        *,
        workers: Workers | None = None,
        batch: int | None = None,
        repeat: int = 1,
        in_flight: int = 0,
        stop: Callable[[Sequence[Outcome]], bool] | None = None,
        history: Iterable[Episode] = (),
    ) -> None:
        """Take a sampler that was told nothing.

        Args:
            sampler: proposes the cases.
            plan: how they run.
            cases: number of cases after which the search ends.
            workers: where they run; by default in this process, whose simulator stays open.
            batch: cases of a batch; by default the number that the sampler wants.
            repeat: how often each proposed case runs; all its runs are in one batch.
            in_flight: most cases in flight; 0 for one batch.
            stop: whether the outcomes with a verdict end the search.
            history: whole batches that ran before, in order.
        """
        self._sampler, self._until, self._stop = sampler, cases, stop
        self._simulate = partial(simulate_part, plan, keep=with_measures)
        self._lost = partial(lost_episode, plan)
        self._workers = Workers() if workers is None else workers
        self._batch_size, self._repeat, self._in_flight = batch, repeat, in_flight
        self._ahead = not sampler.learns and stop is None
        self._overlaps = in_flight > 0 and sampler.overlaps
        batches = groupby(history, key=lambda episode: episode.outcome.batch)
        self._history = deque(list(batch) for _, batch in batches)
        self._pending: list[_Batch] = []
        self._cases_proposed = self._cases_ran = 0
        self._batches_proposed = 0
        self._start_s = time.perf_counter()

    def run(self, on_batches: Callable[[Batches], None]) -> None:
        """Ask, run, store and tell until all cases have run.

        Args:
            on_batches: stores batches whose cases have run, before the sampler is told; may raise
                to stop the search.
        """
        running: deque[tuple[list[_Batch], Job[Case, Episode] | None]] = deque()
        while True:
            while self._may_ask(len(running)) and (batches := self._ask()):
                job = None
                if not batches[0].episodes:
                    cases = [case for batch in batches for case in batch.cases]
                    job = self._workers.submit(self._simulate, cases, self._lost)
                running.append((batches, job))
            if not running:
                return
            batches, job = running.popleft()
            if job is not None:
                self._collect(batches, job)
                on_batches([batch.episodes for batch in batches])
            for batch in batches:
                tell(self._sampler, batch.episodes)
            del self._pending[: len(batches)]
            self._set_pending()

    def _may_ask(self, running: int) -> bool:
        """Return whether the sampler may be asked for more now, besides the batches that run."""
        if self._ahead:
            return running < BATCHES_IN_FLIGHT
        if self._overlaps and running:
            pending = sum(len(batch.cases) for batch in self._pending)
            return pending + self._next_size() <= self._most_in_flight()
        return not running

    def _ask(self) -> list[_Batch]:
        """Return the batches to submit next; none where the search has ended."""
        if self._history:
            known = self._history.popleft()
            return [self._add([episode.outcome.case for episode in known], [], known)]
        if self._stop is not None and self._stop(self._sampler.observed()):
            self._until = self._cases_proposed
        end = min(self._until, self._cases_proposed + self._cases_ahead())
        batches = []
        while self._cases_proposed < end:
            cases, predictions = [], []
            size = max(1, self._next_size() // self._repeat)
            for place, case in enumerate(self._sampler.ask(size)):
                for draw in range(self._repeat):
                    cases.append(replace(case, draw=draw))
                    predictions.append(None if draw else self._sampler.prediction(place))
            left = self._until - self._cases_proposed
            batches.append(self._add(cases[:left], predictions[:left], []))
        return batches

    def _cases_ahead(self) -> int:
        """Return how many cases are submitted together at least: more where workers are quick."""
        if not self._ahead:
            return 1
        rate = self._cases_ran / (time.perf_counter() - self._start_s)
        return max(1, min(round(AHEAD_S * rate), MAX_CHUNK * self._workers.count))

    def _next_size(self) -> int:
        """Return the number of cases of the next batch."""
        if self._history:
            return len(self._history[0])
        if not self._in_flight:
            size = self._batch_size or self._sampler.batch_size()
        elif self._overlaps:
            size = max(1, self._most_in_flight() // BATCHES_IN_FLIGHT)
        else:
            size = self._most_in_flight()
        return min(size, self._until - self._cases_proposed)

    def _most_in_flight(self) -> int:
        """Return how many cases may be in flight by now.

        Fewer at the beginning of a search: the less is known, the more the next outcome is worth.
        """
        return min(self._in_flight, self._sampler.batch_size() + self._cases_proposed // AGE)

    def _add(
        self,
        cases: Sequence[Case],
        predictions: Sequence[Prediction | None],
        episodes: list[Episode],
    ) -> _Batch:
        """Return a batch of proposed cases, which is pending."""
        batch = _Batch(self._batches_proposed, self._cases_proposed, cases, predictions, episodes)
        self._batches_proposed += 1
        self._cases_proposed += len(cases)
        self._pending.append(batch)
        self._set_pending()
        return batch

    def _set_pending(self) -> None:
        self._sampler.set_pending([case for batch in self._pending for case in batch.cases])

    def _collect(self, batches: Sequence[_Batch], job: Job[Case, Episode]) -> None:
        """Collect the episodes of batches; note which ran again because a worker had died."""
        episodes = self._workers.collect(job)
        self._cases_ran += len(episodes)
        for place in job.ran_again:
            episodes[place] = replace(episodes[place], ran_again=True)
        rest = iter(episodes)
        for batch in batches:
            for index, prediction in enumerate(batch.predictions, batch.first_index):
                batch.episodes.append(next(rest).at(index, batch.number, prediction))


def tell(sampler: Sampler, episodes: Sequence[Episode]) -> None:
    """Tell a sampler the outcomes of episodes.

    Args:
        sampler: the sampler.
        episodes: episodes in the order of their cases. With episodes of an earlier version, the
            sampler is told regressions.
    """
    earlier = [episode.earlier for episode in episodes if episode.earlier is not None]
    outcomes = [episode.outcome for episode in episodes]
    if earlier:
        earlier_outcomes = [episode.outcome for episode in earlier]
        if isinstance(sampler.predictor, ControllerModelPair):
            sampler.predictor.tell_old(earlier_outcomes, _motions(earlier))
        for place, other in enumerate(earlier_outcomes):
            outcomes[place] = regression(outcomes[place], other, other.prediction)
    sampler.tell(outcomes, _motions(episodes))


def _motions(episodes: Iterable[Episode]) -> dict[int, FloatArray]:
    """Return the motions of episodes, (T + 1, A, 3), by index."""
    return {episode.outcome.index: episode.trajectory.motion for episode in episodes}
