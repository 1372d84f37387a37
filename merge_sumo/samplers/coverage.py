"""The default sampler: each batch maximises the expected new failure mode coverage.

A case is worth P(fail) (`belief.py`) times the share of its ball (radius rho of the FMC) that is
not covered yet. Candidates are uniform, near failures, and near where the merging order changes;
the batch is picked from them greedily.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Final

import numpy as np

from merge_sumo.metrics.fmc import radius_for
from merge_sumo.metrics.prediction import Prediction
from merge_sumo.metrics.summary import by_case
from merge_sumo.samplers.allocation import even_shares
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.base_rate import BaseRate
from merge_sumo.samplers.belief import Belief, Calibration, nearness
from merge_sumo.samplers.candidates import REFINED_REACH, around, of_belief, spread_out
from merge_sumo.samplers.gpr import exploiting
from merge_sumo.samplers.greedy import EVEN_IF_COVERED, Proposal, covered_grid, greedy
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.samplers.prediction_skill import PredictionSkill, Predictor
from merge_sumo.samplers.twin_guided import FEWEST, twin_guided_batch
from merge_sumo.scenario.case import Case, FloatArray, to_unit

FIRST_BATCH: Final = 10
YOUNG: Final = 60
YOUNG_BATCH: Final = 5
"""Cases of the first batch; cases of a level up to which its batches are small, and their size: the
first outcomes change the next proposals most."""
BATCHES: Final = ((100, 10, 5), (400, 20, 10), (math.inf, 40, 20))
"""Later batches: cases up to which a size holds, the size, and the least number per level."""
REPLAYED: Final = 40
"""Last cases of a level on which the predictor is evaluated."""
REFINED_QUERIES: Final = 600
BEST: Final = 150
"""Candidates around the best ones, and the number of these."""
SHORTLIST: Final = 2000
"""Candidates among which the batch is picked."""
NEAREST: Final = 3
"""Fewest failures to aim at failures alone; otherwise as many nearest cases stand in for them."""
PATIENCE: Final = 40
"""Cases before near misses stand in for failures."""


class CoverageSampler(Sampler):
    """Maximises the expected new coverage over all levels.

    Gains are in balls, not in volumes: volumes of two and of three dimensions do not compare, and
    level 2 would get no case.
    """

    about = "asks for the batch that promises the most new coverage"
    colour = "#D55E00"
    uses_predictions = True
    overlaps = True

    def ask(self, n: int) -> list[Case]:
        """Return the next `n` cases, level by level."""
        from threadpoolctl import threadpool_limits

        # One thread: rounding must not depend on the number of cores.
        with threadpool_limits(1):
            proposals = {level: self._propose(level, n) for level in self.pool.levels}
        shares = self._shares(proposals, n)
        self._predictions = [
            prediction
            for level, share in shares.items()
            for prediction in proposals[level].predictions[:share]
        ]
        return [
            case
            for level, share in shares.items()
            for case in self.pool.cases(proposals[level].points[:share], level)
        ]

    def prediction(self, place: int) -> Prediction | None:
        """Return the prediction of a case of the last batch, by its place in the batch."""
        return self._predictions[place]

    def batch_size(self) -> int:
        """Return the size of the next batch: small while each outcome changes the model most."""
        proposed, levels = self.proposed(), len(self.pool.levels)
        if not proposed:
            return max(FIRST_BATCH, YOUNG_BATCH * levels)
        if proposed < YOUNG * levels:
            return YOUNG_BATCH * levels
        most, a_level = next(sizes for until, *sizes in BATCHES if proposed < until)
        return max(most, a_level * levels)

    def _propose(self, level: int, n: int) -> Proposal:
        history, rng, pending = self.history(level), self.rng(level), self.pending(level)
        few = len(history.points) < FEWEST
        if self.predictor is None or not self.predictor.can_predict(level):
            if few:
                chance = np.ones(n)
                # The next points of the sequence that the pending ones began.
                begun = len(pending)
                told = self.proposed() - len(self._pending)
                rng = np.random.default_rng([self.seed, told, level])
                spread = spread_out(begun + n, history.dims, rng)[begun:]
                return Proposal(spread, chance, chance, (None,) * n)
            return _LevelBatch(history, pending, rng, n).batch(n)
        skill = self._skill(self.predictor, level)
        base_rate = None
        if skill.breaks_promises and not few:
            base_rate = self._base_rate(level, history, pending, n)
        if skill.is_worthless and not few:
            batch = _LevelBatch(history, pending, rng, n).batch(n, base_rate)
            return skill.annotated(batch, self.predictor.predict(level, batch.points))
        return twin_guided_batch(self.predictor, history, pending, n, rng, level, skill, base_rate)

    def _base_rate(
        self, level: int, history: LevelHistory, pending: FloatArray, n: int
    ) -> BaseRate:
        """Return the base rate of a level, with the sequence of its first batch."""
        # A case is judged by what was predicted of its first run.
        predictions = [case.outcomes[0].prediction for case in by_case(self.observed(level))]
        errors = [
            outcome.case
            for outcome in self._outcomes.values()
            if outcome.margin is None and outcome.case.level == level
        ]
        unknown = np.concatenate([pending, to_unit(errors, level, self.pool.scenario)])
        begins = np.random.default_rng([self.seed, 0, level])
        by_margin = partial(exploiting, history, pending)
        return BaseRate(history, predictions, unknown, n, self.proposed(level), begins, by_margin)

    def _skill(self, predictor: Predictor, level: int) -> PredictionSkill:
        """Return the skill of the predictions so far, of all levels."""
        last = self.observed(level)[-REPLAYED:]
        replayed: dict[int, FloatArray] = {}
        if last:
            indices = [outcome.index for outcome in last]
            points = to_unit((outcome.case for outcome in last), level, self.pool.scenario)
            gaps = predictor.predict(level, points, held_out=indices)
            replayed = dict(zip(indices, gaps.T, strict=True))
        return PredictionSkill(self.observed(), level, self.pool.scenario.dx_crash_m, replayed)

    def _shares(self, proposals: dict[int, Proposal], n: int) -> dict[int, int]:
        """Return how many cases each level gets: half of them evenly, the rest by the next gain.

        A level with rare failures has hardly any expected gain before its first failure.
        """
        proposed = {level: self.proposed(level) for level in self.pool.levels}
        if min(len(self.observed(level)) for level in self.pool.levels) < 2:
            return even_shares(proposed, n)
        shares = even_shares(proposed, max(min(n, len(proposed)), n // 2))
        for _ in range(n - sum(shares.values())):
            best = max(shares, key=lambda level: proposals[level].gain[shares[level]])
            shares[best] += 1
        return shares


class _LevelBatch:
    """One batch at one level."""

    def __init__(
        self, history: LevelHistory, pending: FloatArray, rng: np.random.Generator, n: int
    ) -> None:
        self._grid = covered_grid(history, pending)
        limit, calibration = _limit(history), Calibration(history)
        belief = Belief(history, limit)
        candidates = of_belief(history, belief, rng, n)
        aim, balls = (
            calibration.of(belief.of(candidates), candidates),
            self._grid.balls(candidates),
        )
        worth = aim * self._grid.new(balls)
        best = candidates[np.argsort(-worth, kind="stable")[:BEST]]
        refined = around(best, REFINED_QUERIES, REFINED_REACH * radius_for(history.dims), rng)
        candidates = np.concatenate([candidates, refined])
        aim = np.concatenate([aim, calibration.of(belief.of(refined), refined)])
        balls = np.concatenate([balls, self._grid.balls(refined)])
        worth = aim * (self._grid.new(balls) + EVEN_IF_COVERED)
        kept = np.argsort(-worth, kind="stable")[: max(SHORTLIST, n)]
        self._candidates, self._aim = candidates[kept], aim[kept]
        self._calibration = calibration
        self._belief = belief if limit is None else Belief(history)
        self._above = self._aim
        if limit is not None:
            self._above = calibration.of(self._belief.of(self._candidates), self._candidates)

    def batch(self, n: int, base_rate: BaseRate | None = None) -> Proposal:
        """Return the greedy batch of `n` cases, with a base rate where its picks promise more."""
        picks, gain = greedy(self._grid, self._candidates, self._aim, self._above, n)
        points, unknown = self._candidates[picks], (None,) * n
        batch = Proposal(points, gain, self._above[picks], unknown)
        if base_rate is None:
            return batch
        following = base_rate.following
        return base_rate.mixed(batch, Proposal(following, gain, self._chance(following), unknown))

    def _chance(self, points: FloatArray) -> FloatArray:
        """Return the calibrated P(fail) of points, (m, d), as (m,)."""
        return self._calibration.of(self._belief.of(points), points)


def _limit(history: LevelHistory) -> float | None:
    """Return the gap, or the margin, that the search aims at; None for that of a failure.

    With few failures, the nearest misses guide the search, as in subset simulation.
    """
    if history.ever_failed.sum() >= NEAREST or len(history.points) < PATIENCE:
        return None
    return float(np.partition(nearness(history), NEAREST - 1)[NEAREST - 1])
