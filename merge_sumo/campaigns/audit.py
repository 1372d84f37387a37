"""Audit cases of a campaign: uniform cases among those that its sampler picks.

Which cases of a campaign they are follows from its number of cases, and what they are from its
seed: from no outcome. The sampler is told them as any case. `analysis/audit.py` says what follows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from merge_sumo.analysis.audit import AuditCase, MissedShare, audit_cases, missed_share
from merge_sumo.campaigns.store import Batch
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.wrapper import SamplerWrapper
from merge_sumo.values.audit_mark import AuditMark
from merge_sumo.values.case import Case, FloatArray, Pool, to_unit
from merge_sumo.values.score import Outcome

STREAM: Final = 0x61756469
"""Key of the random stream: more than a campaign has cases, so that it is none of a sampler's."""


@dataclass(frozen=True, slots=True)
class Audit:
    """Which cases of a campaign are audit cases, and what they are.

    Attributes:
        number: audit cases.
        cases: cases of the campaign, over which they are spread evenly.
        pool: where they are drawn from; its levels take turns.
        seed: of the campaign.
    """

    number: int
    cases: int
    pool: Pool
    seed: int

    def __contains__(self, index: int) -> bool:
        """Return whether the case of an index is one."""
        return self._before(index + 1) > self._before(index)

    def _before(self, index: int) -> int:
        return index * self.number // self.cases

    def case(self, index: int) -> Case:
        """Return the audit case of an index."""
        number = self._before(index)
        level = self.pool.levels[number % len(self.pool.levels)]
        rng = np.random.default_rng([self.seed, STREAM, number])
        point = rng.random((1, len(self.pool.scenario.dimensions(level))))
        return self.pool.cases(point, level)[0]

    def mark(self, outcomes: Sequence[Outcome], before: Iterable[Outcome]) -> list[Outcome]:
        """Return the outcomes of a batch with marks, by the failures of the batches before it."""
        audited = [o for o in outcomes if o.index in self and o.audit is None]
        if not audited:
            return list(outcomes)
        failing = [outcome.case for outcome in before if outcome.failed]
        marks = {}
        for level in {outcome.case.level for outcome in audited}:
            own = [outcome for outcome in audited if outcome.case.level == level]
            points = to_unit((o.case for o in own), level, self.pool.scenario)
            known = to_unit((c for c in failing if c.level == level), level, self.pool.scenario)
            nearest = cKDTree(known).query(points)[0].tolist() if len(known) else [None] * len(own)
            for outcome, distance in zip(own, nearest, strict=True):
                marks[outcome.index] = AuditMark(nearest_failure=distance)
        return [replace(o, audit=marks[o.index]) if o.index in marks else o for o in outcomes]

    def mark_batches(self, batches: Sequence[Batch], before: Sequence[Outcome]) -> list[Batch]:
        """Return batches, in order, with marks."""
        marked, so_far = [], list(before)
        for batch in batches:
            outcomes = self.mark([outcome for outcome, _ in batch], so_far)
            so_far += outcomes
            trajectories = (trajectory for _, trajectory in batch)
            marked.append(list(zip(outcomes, trajectories, strict=True)))
        return marked

    def missed(self, outcomes: Sequence[Outcome]) -> MissedShare | None:
        """Return the bound after marked outcomes that have a verdict.

        Audit cases without one count as missed failures.
        """
        known = {case.index: case for case in audit_cases(outcomes)}
        last = max((outcome.index for outcome in outcomes), default=-1)
        cases = [
            known.get(index) or AuditCase(index, self.case(index).level, missed=True)
            for index in range(last + 1)
            if index in self
        ]
        return missed_share(cases, self.pool.levels)


class AuditedSampler(SamplerWrapper):
    """A sampler among whose picks audit cases are."""

    def __init__(self, sampler: Sampler, audit: Audit) -> None:
        """Take a sampler that was told nothing."""
        super().__init__(sampler)
        self._audit = audit

    def ask(self, n: int) -> list[Case]:
        """Return the next `n` cases, audit cases in their places."""
        first = self.proposed()
        audited = {place for place in range(n) if first + place in self._audit}
        own = self._sampler.ask(n - len(audited)) if len(audited) < n else []
        numbers = iter(range(len(own)))
        self._places = [None if place in audited else next(numbers) for place in range(n)]
        return [
            self._audit.case(first + place) if number is None else own[number]
            for place, number in enumerate(self._places)
        ]

    def tell(
        self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None = None
    ) -> None:
        """Take outcomes, of whole batches; those of audit cases are marked from here on."""
        super().tell(self._audit.mark(outcomes, self._outcomes.values()), motions)
