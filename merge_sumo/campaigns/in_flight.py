"""A search whose sampler is asked while cases run.

At most N cases are *in flight*: proposed, and their outcomes not yet told to the sampler. They are
proposed in groups. Before the sampler is asked for a group, it is told the outcomes of the oldest
groups, of as few as leave room for the new one; the cases of the others are pending. So what a
group depends on follows from N, and neither from the number of workers nor from the time that a
case takes; whole groups in a journal are all that it takes to go on.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Final, Self

from merge_sumo.campaigns.prefetch import RunChunks
from merge_sumo.campaigns.store import Batch
from merge_sumo.engine.evaluate import CaseResult
from merge_sumo.samplers.base import Sampler
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.prediction import Prediction
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import Trajectory

GROUPS: Final = 3
"""Groups in flight: the sampler is asked for one while the cases of others keep workers busy."""
AGE: Final = 16
"""Cases for each of which one more may be in flight than the sampler wants in a batch."""
Stop = Callable[[Sequence[Outcome], int], bool]
"""Says of the outcomes that the sampler was told, and of their number with those without a verdict,
whether the search is over."""


@dataclass(slots=True)
class _Group:
    """Cases that were proposed together, and what has become of them by now.

    Attributes:
        number: number of the group; the batch of its outcomes.
        first: index of the first case.
        cases: the cases.
        predictions: prediction of each case.
        outcomes: outcomes of the cases that have ended, by index.
        motions: motions of these, (T + 1, A, 3), for a sampler that uses predictions.
        trajectories: trajectories of these, until the group is handed out.
    """

    number: int
    first: int
    cases: Sequence[Case]
    predictions: Sequence[Prediction | None] = ()
    outcomes: dict[int, Outcome] = field(default_factory=dict)
    motions: dict[int, FloatArray] = field(default_factory=dict)
    trajectories: dict[int, Trajectory] = field(default_factory=dict)

    @classmethod
    def of(cls, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> Self:
        """Return a group that ran before, in the order of its cases."""
        cases, by_index = [o.case for o in outcomes], {o.index: o for o in outcomes}
        known = {index: motions[index] for index in by_index if index in motions}
        first = outcomes[0]
        return cls(first.batch, first.index, cases, outcomes=by_index, motions=known)

    @property
    def indices(self) -> range:
        """The indices of the cases."""
        return range(self.first, self.first + len(self.cases))

    @property
    def has_ended(self) -> bool:
        """Whether all cases have ended."""
        return len(self.outcomes) == len(self.cases)

    def take(self, index: int, result: CaseResult) -> Outcome:
        """Take what became of a case; return its outcome."""
        outcome = result.outcome(index, self.number, self.predictions[index - self.first])
        self.outcomes[index], self.trajectories[index] = outcome, result.trajectory
        self.motions[index] = result.trajectory.motion
        return outcome

    def hand_out(self) -> Batch:
        """Return outcomes and trajectories in the order of the cases, once."""
        trajectories, self.trajectories = self.trajectories, {}
        return [(self.outcomes[index], trajectories[index]) for index in self.indices]


class Flight:
    """The groups of a search, from their proposal until the sampler is told their outcomes.

    Attributes:
        proposed: number of cases proposed so far.
    """

    def __init__(
        self,
        sampler: Sampler,
        cases: int,
        in_flight: int,
        history: Sequence[Outcome] = (),
        motions: Mapping[int, FloatArray] | None = None,
        stop: Stop | None = None,
    ) -> None:
        """Take a sampler that was told nothing.

        Args:
            sampler: proposes the cases, and is told the outcomes.
            cases: number of cases after which the search ends.
            in_flight: N.
            history: outcomes of whole groups that ran before.
            motions: their motions, (T + 1, A, 3), by index, for a sampler that uses predictions.
            stop: ends the search before.
        """
        self._sampler, self._cases, self._in_flight, self._stop = sampler, cases, in_flight, stop
        self._untold: deque[_Group] = deque()
        self._running: deque[_Group] = deque()
        self._next = self._told = self.proposed = 0
        # As if the groups that ran before were proposed again, one after the other.
        for _, batch in groupby(history, key=lambda outcome: outcome.batch):
            group = _Group.of(list(batch), motions or {})
            self._make_room(len(group.cases), self._most())
            self._add(group)

    def chunks(self, chunk_size: Callable[[int], int]) -> Iterator[Sequence[Case]]:
        """Yield the cases as they are proposed, in chunks; an empty one where one has to end first.

        `chunk_size` gives the number of cases of a chunk for so many cases.
        """
        while self.proposed < self._cases:
            most = self._most()
            size = max(1, most // GROUPS) if self._sampler.overlaps else most
            wanted = min(size, self._cases - self.proposed)
            while not self._make_room(wanted, most):
                yield ()
            if self._stop is not None and self._stop(self._sampler.observed(), self._told):
                return
            cases = self._ask(wanted)
            size = chunk_size(len(cases))
            for first in range(0, len(cases), size):
                yield cases[first : first + size]

    def _most(self) -> int:
        """Return how many cases may be in flight by now.

        Fewer than N in a young search: the less is known, the more is the next outcome worth.
        """
        return min(self._in_flight, self._sampler.batch_size() + self.proposed // AGE)

    def _pend(self) -> None:
        self._sampler.pend([case for group in self._untold for case in group.cases])

    def _make_room(self, wanted: int, most: int) -> bool:
        """Tell the sampler as few groups as make room for so many cases; return whether they do."""
        while self.proposed + wanted - self._told > most:
            oldest = self._untold[0]
            if not oldest.has_ended:
                return False
            outcomes = [oldest.outcomes[index] for index in oldest.indices]
            self._sampler.tell(outcomes, oldest.motions)
            self._told = oldest.indices.stop
            self._untold.popleft()
            self._pend()
        return True

    def _ask(self, wanted: int) -> Sequence[Case]:
        """Ask the sampler for a group."""
        cases = self._sampler.ask(wanted)
        predictions = [self._sampler.prediction(place) for place in range(len(cases))]
        group = _Group(self._next, self.proposed, cases, predictions)
        self._running.append(group)
        self._add(group)
        return cases

    def _add(self, group: _Group) -> None:
        """Count a group as proposed."""
        self._untold.append(group)
        self._next, self.proposed = group.number + 1, group.indices.stop
        self._pend()

    def take(self, index: int, result: CaseResult) -> Outcome:
        """Take what became of a case; return its outcome."""
        (group,) = (group for group in self._running if index in group.indices)
        return group.take(index, result)

    def ended(self) -> list[Batch]:
        """Return the groups that have ended, in order and once; an earlier one holds others up."""
        batches = []
        while self._running and self._running[0].has_ended:
            batches.append(self._running.popleft().hand_out())
        return batches


def conduct_in_flight(
    flight: Flight,
    run_chunks: RunChunks,
    chunk_size: Callable[[int], int],
    on_case: Callable[[Outcome], None] | None = None,
) -> Generator[list[Batch], None, None]:
    """Ask, run and tell while cases are in flight; yield groups in order, as they end.

    Args:
        flight: the search.
        run_chunks: runs its cases. It takes a chunk when a worker may want it, and after an empty
            one the next when a case has ended.
        chunk_size: gives the number of cases of a chunk for so many cases.
        on_case: called with every outcome.
    """
    begun = flight.proposed
    with closing(run_chunks(flight.chunks(chunk_size))) as ran:
        for first, results in ran:
            for index, result in enumerate(results, start=begun + first):
                outcome = flight.take(index, result)
                if on_case is not None:
                    on_case(outcome)
            if batches := flight.ended():
                yield batches


def by_rounds(rule: Callable[[Sequence[Outcome]], bool] | None, in_flight: int) -> Stop | None:
    """Return a stopping rule for which a batch is N cases.

    Groups are too small to say whether a search has converged.
    """
    if rule is None:
        return None

    def stop(outcomes: Sequence[Outcome], told: int) -> bool:
        rounds = told // in_flight
        numbered = ((outcome, outcome.index // in_flight) for outcome in outcomes)
        return rule([replace(o, batch=number) for o, number in numbered if number < rounds])

    return stop
