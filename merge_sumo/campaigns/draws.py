"""Repetitions of the cases that a sampler proposes: each case runs with several draws.

A repetition is a case as any other (`Case.draw`), so records, workers and resuming need not know
of it. Which cases repeat follows from what was told, proposed and is pending, as all that a sampler
does.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from math import ceil

from merge_sumo.metrics.outcome import Outcome, Prediction
from merge_sumo.samplers.base import Sampler
from merge_sumo.scenario.case import Case, FloatArray


class RepeatingSampler(Sampler):
    """A sampler that runs every case of another one the same number of times."""

    def __init__(self, sampler: Sampler, draws: int) -> None:
        """Take a sampler that was told nothing, and the runs of each case."""
        super().__init__(sampler.pool, sampler.seed)
        self.draws = draws
        self._sampler = sampler
        self.learns, self.overlaps = sampler.learns, sampler.overlaps  # type: ignore[misc]
        self.uses_predictions = sampler.uses_predictions  # type: ignore[misc]
        self._picks: list[int | None] = []
        """By the index in the last batch, the index among the other sampler's picks."""
        self._drawn: dict[Case, int] = {}
        """Draws proposed of each case by its start, but for those that are pending."""

    def ask(self, n: int) -> list[Case]:
        """Return the next `n` cases: draws that are missing, then the other sampler's picks."""
        cases = self._missing()[:n]
        self._picks = [None] * len(cases)
        picks = self._sampler.ask(ceil((n - len(cases)) / self.draws)) if len(cases) < n else []
        for pick, case in enumerate(picks):
            for draw in range(self.draws):
                cases.append(replace(case, draw=draw))
                self._picks.append(None if draw else pick)
        return cases[:n]

    def _missing(self) -> list[Case]:
        """Return the draws that are missing of the cases proposed so far."""
        drawn = dict(self._drawn)
        _count(drawn, self._pending)
        cases = []
        for case in sorted(drawn, key=lambda one: (one.level, one.starts(), one.svo_rad or 0.0)):
            for draw in range(drawn[case], self.draws):
                cases.append(replace(case, draw=draw))
        return cases

    def prediction(self, place: int) -> Prediction | None:
        """Return the prediction of a case of the last batch; None for a repetition."""
        pick = self._picks[place]
        return None if pick is None else self._sampler.prediction(pick)

    def batch_size(self) -> int:
        """Return the preferred number of cases of the next batch."""
        return self.draws * ceil(self._sampler.batch_size() / self.draws)

    def tell(
        self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None = None
    ) -> None:
        """Take outcomes, also those of repetitions."""
        super().tell(outcomes, motions)
        self._sampler.tell(outcomes, motions)
        _count(self._drawn, (outcome.case for outcome in outcomes))

    def pend(self, cases: Iterable[Case]) -> None:
        """Take the cases that run at present."""
        super().pend(cases)
        self._sampler.pend(self._pending)


def _count(drawn: dict[Case, int], cases: Iterable[Case]) -> None:
    """Count the draws up to those of the cases: draws are proposed in their order."""
    for case in cases:
        drawn[case.start] = max(drawn.get(case.start, 0), case.draw + 1)
