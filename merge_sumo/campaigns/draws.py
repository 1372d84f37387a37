"""Repeats among the picks of a sampler: further draws of cases that it has proposed.

A repeat is a case as any other (`Case.draw`), so records, workers and resuming need not know of it.
Which cases repeat follows from what was told, proposed and is pending, as all that a sampler does.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import ceil, inf, log2
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from merge_sumo.coverage.fmc import radius_for
from merge_sumo.samplers.base import Sampler
from merge_sumo.scenario.case import Case, FloatArray, to_unit
from merge_sumo.verdict.chance import MOST_RUNS, RunsOfCase, runs_needed
from merge_sumo.verdict.prediction import Prediction
from merge_sumo.verdict.score import Outcome

ONE_IN: Final = 8
"""While no chance was seen, a case repeats in every eighth place of a campaign at most,"""
EARLY: Final = 5
"""and after so many repeats"""
EARLY_CASES: Final = ONE_IN * EARLY
"""in the first cases one more whenever the cases have doubled."""
FEWEST: Final = 3
"""Runs of a failing case where chance was seen and none is tolerated: does it always fail?"""
LEAST_GAIN: Final = 0.05
"""Of a decision on a case in the midst of decided failing cases, as a share of one far from all."""


class RepeatingSampler(Sampler):
    """A sampler that puts repeats among the picks of another one."""

    draws: int = 1
    """How often each pick of the other sampler runs at once."""

    def __init__(self, sampler: Sampler) -> None:
        """Take a sampler that was told nothing."""
        super().__init__(sampler.pool, sampler.seed)
        self._sampler = sampler
        self.learns, self.overlaps = sampler.learns, sampler.overlaps  # type: ignore[misc]
        self.uses_predictions = sampler.uses_predictions  # type: ignore[misc]
        self._places: list[int | None] = []
        """By the place in the last batch, the place among the other sampler's picks."""
        self._drawn: dict[Case, int] = {}
        """Draws proposed of each case by its start, but for those that are pending."""

    @abstractmethod
    def repeats(self, n: int) -> list[Case]:
        """Return the repeats of the next `n` cases, at most so many."""

    def ask(self, n: int) -> list[Case]:
        """Return the next `n` cases: repeats, then the other sampler's picks with their draws."""
        repeats = self.repeats(n)
        rest = n - len(repeats)
        own = self._sampler.ask(ceil(rest / self.draws)) if rest else []
        pairs = [(number, draw) for number in range(len(own)) for draw in range(self.draws)][:rest]
        self._places = [*(None for _ in repeats), *(n if draw == 0 else None for n, draw in pairs)]
        return [*repeats, *(replace(own[number], draw=draw) for number, draw in pairs)]

    def prediction(self, place: int) -> Prediction | None:
        """Return the prediction of a case of the last batch; None for a repeat."""
        number = self._places[place]
        return None if number is None else self._sampler.prediction(number)

    def batch_size(self) -> int:
        """Return the preferred number of cases of the next batch."""
        return self.draws * ceil(self._sampler.batch_size() / self.draws)

    def tell(
        self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None = None
    ) -> None:
        """Take outcomes, also those of repeats."""
        super().tell(outcomes, motions)
        self._sampler.tell(outcomes, motions)
        _count(self._drawn, (outcome.case for outcome in outcomes))

    def pend(self, cases: Iterable[Case]) -> None:
        """Take the cases that run at present."""
        super().pend(cases)
        self._sampler.pend(self._pending)

    def skip(self, cases: Iterable[Case]) -> None:
        """Count cases as proposed whose outcomes will not be told."""
        skipped = list(cases)
        super().skip(skipped)
        self._sampler.skip(skipped)
        _count(self._drawn, skipped)

    def drawn(self) -> dict[Case, int]:
        """Return how many draws of each case were proposed, by its start."""
        drawn = dict(self._drawn)
        _count(drawn, self._pending)
        return drawn


def _count(drawn: dict[Case, int], cases: Iterable[Case]) -> None:
    """Count the draws up to those of the cases: draws are proposed in their order."""
    for case in cases:
        start = case.start
        drawn[start] = max(drawn.get(start, 0), case.draw + 1)


def _further(case: Case, first: int, count: int) -> list[Case]:
    return [replace(case, draw=draw) for draw in range(first, first + count)]


class EachCaseRepeated(RepeatingSampler):
    """Every case runs the same number of times."""

    def __init__(self, sampler: Sampler, draws: int) -> None:
        """Take a sampler that was told nothing, and the runs of each case."""
        super().__init__(sampler)
        self.draws = draws

    def repeats(self, n: int) -> list[Case]:
        """Return the draws that are missing of the last cases."""
        drawn = {case: count for case, count in self.drawn().items() if count < self.draws}
        cases = sorted(drawn, key=lambda case: (case.level, case.starts(), case.svo_rad or 0.0))
        missing = (_further(case, drawn[case], self.draws - drawn[case]) for case in cases)
        return [case for draws in missing for case in draws][:n]


class RepeatedWhereItMatters(RepeatingSampler):
    """Cases repeat to see whether chance decides, and then where it decides on a failing case.

    *Recognition.* Chance is seen where two runs of a case differ in a measure. Until then few cases
    run a second time: failing ones, those far from other failures first, as a failure by chance is;
    then those nearest to failing.

    *Decision.* Where chance was seen, cases that failed run again until it is decided whether they
    fail in more than the tolerated share of their runs (`runs_needed`): those first that take few
    runs for the coverage that they may add. At most every other place of the campaign is a repeat.
    """

    def __init__(self, sampler: Sampler, tolerated: float, *, known: bool = False) -> None:
        """Take a sampler that was told nothing, and the tolerated share of failing runs.

        `known` is whether chance is known to decide, before it is seen.
        """
        super().__init__(sampler)
        self.learns = True  # type: ignore[misc]
        self._tolerated = tolerated
        self._runs: dict[Case, dict[int, Outcome]] = {}
        """Outcomes with a verdict by start and index."""
        self._chance = known

    def tell(
        self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None = None
    ) -> None:
        """Take outcomes, and see whether two runs of a case differ."""
        super().tell(outcomes, motions)
        for outcome in outcomes:
            if outcome.margin is None:
                continue
            runs = self._runs.setdefault(outcome.case.start, {})
            self._chance |= any(one.measures != outcome.measures for one in runs.values())
            runs[outcome.index] = outcome

    def repeats(self, n: int) -> list[Case]:
        """Return repeats for some of the next `n` places of the campaign."""
        first, every = self.proposed(), 2 if self._chance else ONE_IN
        places = (first + n) // every - first // every
        if not places:
            return []
        drawn = self.drawn()
        if self._chance:
            return self._to_decide(drawn)[:places]
        known = len(drawn)
        wanted = known // ONE_IN
        if known > EARLY_CASES:
            wanted = EARLY + int(log2(known / EARLY_CASES))
        wanted -= sum(drawn.values()) - known
        return self._to_recognise(drawn)[: min(places, max(wanted, 0))]

    def _to_recognise(self, drawn: Mapping[Case, int]) -> list[Case]:
        """Return second draws of the cases that ran once, the most telling first."""
        cases = self._cases()
        failing = [one for one in cases if one.failures]
        distance = dict(zip((one.case for one in failing), _isolation(failing), strict=True))
        keys = {
            one.case: (
                not one.failures,
                -distance.get(one.case, 0.0),
                abs(one.outcomes[0].margin or 0.0),
                one.outcomes[0].index,
            )
            for one in cases
            if drawn[one.case] == 1
        }
        return [replace(case, draw=1) for case in sorted(keys, key=keys.__getitem__)]

    def _to_decide(self, drawn: Mapping[Case, int]) -> list[Case]:
        """Return the draws that decisions on failing cases need, the most rewarding first."""
        failing = [one for one in self._cases() if one.failures]
        needed = [self._needed(one) for one in failing]
        decided = [
            one
            for one, runs in zip(failing, needed, strict=True)
            if not runs and one.share > self._tolerated
        ]
        waiting = Counter(case.start for case in self._pending)
        ranked = []
        for one, runs, gain in zip(failing, needed, _gains(failing, decided), strict=True):
            further = min(runs - waiting[one.case], MOST_RUNS - drawn[one.case])
            if further > 0:
                rank = runs / max(gain, LEAST_GAIN), one.outcomes[0].index
                ranked.append((rank, _further(one.case, drawn[one.case], further)))
        return [case for _, draws in sorted(ranked, key=lambda pair: pair[0]) for case in draws]

    def _needed(self, one: RunsOfCase) -> int:
        """Return how many further runs of a failing case its decision takes at least."""
        if not self._tolerated:
            return max(FEWEST - one.runs, 0)
        return runs_needed(one.failures, one.runs, self._tolerated)

    def _cases(self) -> list[RunsOfCase]:
        """Return the runs of the cases, whatever the order in which they were told."""
        cases = [
            RunsOfCase(case, tuple(runs[index] for index in sorted(runs)))
            for case, runs in self._runs.items()
        ]
        return sorted(cases, key=lambda one: one.outcomes[0].index)


def _isolation(cases: Sequence[RunsOfCase]) -> list[float]:
    """Return of each case the distance to the nearest other one at its level, (n,)."""
    isolation = np.full(len(cases), inf)
    for places, points in _by_level(cases):
        if len(places) > 1:
            isolation[places] = cKDTree(points).query(points, k=[2])[0][:, 0]
    return [float(one) for one in isolation]


def _gains(cases: Sequence[RunsOfCase], decided: Sequence[RunsOfCase]) -> list[float]:
    """Return what a ball around each case may add to those of decided ones, as a share, (n,).

    Estimated by the distance to the nearest one, in radii of the FMC.
    """
    gains = np.ones(len(cases))
    known = {decided[places[0]].case.level: points for places, points in _by_level(decided)}
    for places, points in _by_level(cases):
        others = known.get(cases[places[0]].case.level)
        if others is not None:
            distance = cKDTree(others).query(points)[0]
            gains[places] = np.minimum(distance / radius_for(points.shape[1]), 1.0)
    return [float(gain) for gain in gains]


def _by_level(cases: Sequence[RunsOfCase]) -> list[tuple[list[int], FloatArray]]:
    """Return by level the places of its cases, and these in the unit cube, (m, d)."""
    places: dict[int, list[int]] = {}
    for place, one in enumerate(cases):
        places.setdefault(one.case.level, []).append(place)
    return [
        (own, to_unit((cases[place].case for place in own), level, cases[own[0]].case.scenario))
        for level, own in sorted(places.items())
    ]
