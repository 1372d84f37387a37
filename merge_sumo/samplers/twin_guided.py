"""A batch of `coverage` when a twin of the VUT predicts cases before they run."""

from __future__ import annotations

from typing import Final

import numpy as np

from merge_sumo.metrics.fmc import radius_for
from merge_sumo.samplers.base_rate import BaseRate
from merge_sumo.samplers.belief import Belief, Calibration
from merge_sumo.samplers.candidates import (
    LOCAL_REACH,
    REFINED_REACH,
    anywhere,
    around,
    between,
    of_belief,
    spread_out,
)
from merge_sumo.samplers.greedy import EVEN_IF_COVERED, PICKED, Proposal, covered_grid, greedy
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.samplers.prediction_skill import PredictionSkill, Predictor
from merge_sumo.scenario.case import FloatArray

ANYWHERE: Final = 1000
ANYWHERE_ABOVE_3D: Final = 5000
ON_FACES: Final = 0.15
NEAR: Final = 300
BETWEEN: Final = 200
"""Candidates that one member of an expert screens: uniform with a share on the faces, near
failures, and between safe cases of the two merging orders. With more than three coordinates, where
failures leave many gaps, more are uniform (measured with design 2 on us23-traffic, one seed: after
400 and 800 cases a covered share of .86 and .98 at level 1, .89 and .95 at level 2; with 1,000 it
is .77 and .90, .78 and .88)."""
SURROGATE_CANDIDATES: Final = 1500
"""Candidates of the surrogate, evaluated by the surrogate alone."""
SCREENED: Final = 80
OF_SURROGATE: Final = 40
AT_RANDOM: Final = 20
"""Candidates that all members predict: the best screened ones, the best of the surrogate, and
uniform ones."""
ROUNDS: Final = 3
REFINED: Final = 60
"""Rounds of candidates around the best ones and around the batch that would be picked."""
FEWEST: Final = 2
"""Fewest cases for a surrogate."""
EXPLORES_FROM: Final = 5
"""Size of a batch from which its last case is the most informative one."""


def twin_guided_batch(
    predictor: Predictor,
    history: LevelHistory,
    pending: FloatArray,
    n: int,
    rng: np.random.Generator,
    level: int,
    skill: PredictionSkill,
    base_rate: BaseRate | None = None,
) -> Proposal:
    """Return a batch of `n` cases of a level that the predictor can predict.

    `pending` are cases, (m, d), that run and have no outcome yet.

    P(fail) of a candidate is that of the twin and that of the surrogate, weighted by the skill of
    the predictions so far. Without outcomes at the level there is no surrogate, and half of the
    batch is spread over the cube. With a base rate, picks that promise less than that give way.
    """
    candidates = _Candidates(predictor, history, pending, level, skill)
    first_points = _first_candidates(candidates, history, n, rng)
    candidates.add(first_points)
    reach = REFINED_REACH * radius_for(history.dims)
    # What does not come true is not refined.
    for _ in range(ROUNDS if base_rate is None else 0):
        batch, _ = greedy(
            candidates.grid.copy(), candidates.points, candidates.p_fail, candidates.p_fail, n
        )
        best = candidates.best(candidates.points, candidates.p_fail, n)
        centres = np.concatenate([best, candidates.points[batch]])
        candidates.add(around(centres, REFINED, reach, rng))
    first: list[int] = []
    if candidates.surrogate is None:
        spread = spread_out(n - n // 2, history.dims, rng)
        first = [*range(len(candidates.points), len(candidates.points) + len(spread))]
        candidates.add(spread)
        candidates.grid.cover(candidates.grid.balls(spread), PICKED)
    explores = n >= EXPLORES_FROM and not skill.is_doubted
    information = skill.disagreement(candidates.gaps) if explores else None
    p_fail = candidates.p_fail
    picks, gain = greedy(
        candidates.grid, candidates.points, p_fail, p_fail, n - len(first), information
    )
    gain = np.concatenate([np.ones(len(first)), gain])
    if base_rate is None:
        return candidates.proposal(first + picks, gain * skill.trust)
    picked = candidates.proposal(first + picks, gain)
    spread_from = len(candidates.points)
    candidates.add(base_rate.following)
    following = [*range(spread_from, len(candidates.points))]
    return base_rate.mixed(picked, candidates.proposal(following, gain))


class _Candidates:
    """Candidates of a batch with their predictions.

    Attributes:
        grid: coverage by the failures so far, and by the pending cases.
        surrogate: None without outcomes at the level.
        points: candidates, (m, d).
        gaps: predicted gaps at M, (E, G, m).
        p_fail: P(fail) of each, (m,).
    """

    def __init__(
        self,
        predictor: Predictor,
        history: LevelHistory,
        pending: FloatArray,
        level: int,
        skill: PredictionSkill,
    ) -> None:
        self.predictor, self.level, self.skill = predictor, level, skill
        self.grid = covered_grid(history, pending)
        self.surrogate = Belief(history) if len(history.points) >= FEWEST else None
        self._calibration = Calibration(history) if skill.is_doubted else None
        self.points = np.empty((0, history.dims))
        self._predictions: tuple[FloatArray, ...] = ()

    @property
    def gaps(self) -> FloatArray:
        return self._predictions[0]

    @property
    def p_fail(self) -> FloatArray:
        return self._predictions[-1]

    def add(self, points: FloatArray) -> None:
        """Add candidates, (k, d), with the predictions of all members."""
        gaps = self.predictor.predict(self.level, points)
        p_twin = self.skill.chance(gaps)
        p_surrogate = p_twin if self.surrogate is None else self.corrected(points)
        p_fail = self.skill.mixed(gaps, p_twin, p_surrogate)
        fresh = gaps, p_twin, p_surrogate, p_fail
        self._predictions = (
            tuple(
                np.concatenate(pair, axis=-1) for pair in zip(self._predictions, fresh, strict=True)
            )
            if self._predictions
            else fresh
        )
        self.points = np.concatenate([self.points, points])

    def corrected(self, points: FloatArray) -> FloatArray:
        """Return P(fail) of points, (m,), by the surrogate, calibrated where due."""
        assert self.surrogate is not None, "there are outcomes"  # noqa: S101
        chance = self.surrogate.of(points)
        return chance if self._calibration is None else self._calibration.of(chance, points)

    def best(self, points: FloatArray, probability: FloatArray, most: int) -> FloatArray:
        """Return the `most` points with the largest expected gain of their own."""
        worth = probability * (self.grid.new(self.grid.balls(points)) + EVEN_IF_COVERED)
        return points[np.argsort(-worth, kind="stable")[:most]]

    def proposal(self, picks: list[int], gain: FloatArray) -> Proposal:
        """Return the batch of some candidates, by index, with their gains."""
        gaps, p_twin, p_surrogate, p_fail = self._predictions
        predictions = tuple(
            self.skill.prediction(gaps[..., i], p_twin[i], p_surrogate[i], p_fail[i]) for i in picks
        )
        return Proposal(self.points[picks], gain, p_fail[picks], predictions)


def _first_candidates(
    candidates: _Candidates, history: LevelHistory, n: int, rng: np.random.Generator
) -> FloatArray:
    """Return the candidates, (m, d), that all members predict first.

    One member of one expert screens many; the surrogate chooses among its own.
    """
    skill, surrogate = candidates.skill, candidates.surrogate
    failing = history.points[history.failed]
    count = ANYWHERE_ABOVE_3D if history.dims > 3 else ANYWHERE
    uniform = anywhere(count, history.dims, ON_FACES, rng)
    screened, chosen = [uniform], [uniform[:AT_RANDOM]]
    if surrogate is not None:
        screened.append(between(surrogate, BETWEEN, rng))
        own = rng.permutation(of_belief(history, surrogate, rng, n))[:SURROGATE_CANDIDATES]
        chance = candidates.corrected(own)
        chosen.append(candidates.best(own, chance, OF_SURROGATE))
    if len(failing):
        screened.append(around(failing, NEAR, LOCAL_REACH * radius_for(history.dims), rng))
    points = np.concatenate(screened)
    expert = skill.expert(rng)
    gaps = candidates.predictor.predict(candidates.level, points, screening=expert)
    chance = skill.chance(gaps, expert)
    chosen.append(candidates.best(points, chance, SCREENED))
    return np.concatenate(chosen)
