"""A batch of `coverage` when a twin of the VUT predicts cases before they run."""

from __future__ import annotations

from typing import Final

import numpy as np

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
from merge_sumo.samplers.coverage_grid import CoverageGrid
from merge_sumo.samplers.greedy import EVEN_IF_COVERED, PICKED, Proposal, greedy
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.samplers.prediction_skill import PredictGaps, PredictionSkill
from merge_sumo.values.case import FloatArray
from merge_sumo.values.fmc import radius_for
from merge_sumo.values.prediction import Prediction

ANYWHERE: Final = 1000
ON_FACES: Final = 0.15
NEAR: Final = 300
BETWEEN: Final = 200
"""Candidates that one member of an expert screens: uniform with a share on the faces, near
failures, and between safe cases of the two merging orders."""
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
    history: LevelHistory,
    n: int,
    rng: np.random.Generator,
    predict: PredictGaps,
    skill: PredictionSkill,
) -> Proposal:
    """Return a batch of `n` cases of a level that the predictor can predict.

    P(fail) of a candidate is that of the twin and that of the surrogate, weighted by the skill of
    the predictions so far. Without outcomes at the level there is no surrogate, and half of the
    batch is spread over the cube.
    """
    dims = history.dims
    reach = radius_for(dims)
    failing = history.points[history.failed]
    grid = CoverageGrid(dims)
    grid.cover(grid.balls(failing), 1.0)
    belief = Belief(history) if len(history.points) >= FEWEST else None
    calibration = Calibration(history) if skill.is_doubted else None

    def surrogate_chance(belief: Belief, points: FloatArray) -> FloatArray:
        return belief.of(points) if calibration is None else calibration.of(belief, points)

    def best(points: FloatArray, probability: FloatArray, most: int) -> FloatArray:
        """Return the candidates with the largest expected gain of their own."""
        worth = probability * (grid.new(grid.balls(points)) + EVEN_IF_COVERED)
        return points[np.argsort(-worth, kind="stable")[:most]]

    def predicted(points: FloatArray) -> tuple[FloatArray, ...]:
        """Return gaps, (E, G, m), and P(fail) of twin, surrogate and both, (m,) each."""
        gaps_m = predict(points)
        p_twin = skill.chance(gaps_m)
        p_surrogate = p_twin if belief is None else surrogate_chance(belief, points)
        return gaps_m, p_twin, p_surrogate, skill.mixed(gaps_m, p_twin, p_surrogate)

    uniform = anywhere(ANYWHERE, dims, ON_FACES, rng)
    screened, chosen = [uniform], [uniform[:AT_RANDOM]]
    if belief is not None:
        screened.append(between(belief, BETWEEN, rng))
        proposed = rng.permutation(of_belief(history, belief, rng, n))[:SURROGATE_CANDIDATES]
        chosen.append(best(proposed, surrogate_chance(belief, proposed), OF_SURROGATE))
    if len(failing):
        screened.append(around(failing, NEAR, LOCAL_REACH * reach, rng))
    candidates = np.concatenate(screened)
    expert = skill.expert(rng)
    near = skill.chance(predict(candidates, expert), expert)
    chosen.append(best(candidates, near, SCREENED))
    points = np.concatenate(chosen)
    known = predicted(points)
    for _ in range(ROUNDS):
        batch, _ = greedy(grid.copy(), points, known[-1], known[-1], n)
        centres = np.concatenate([best(points, known[-1], n), points[batch]])
        fresh = around(centres, REFINED, REFINED_REACH * reach, rng)
        points = np.concatenate([points, fresh])
        known = tuple(
            np.concatenate(pair, axis=-1) for pair in zip(known, predicted(fresh), strict=True)
        )
    first: list[int] = []
    if belief is None:
        spread = spread_out(n - n // 2, dims, rng)
        first = [*range(len(points), len(points) + len(spread))]
        points = np.concatenate([points, spread])
        known = tuple(
            np.concatenate(pair, axis=-1) for pair in zip(known, predicted(spread), strict=True)
        )
        grid.cover(grid.balls(spread), PICKED)
    gaps_m, p_twin, p_surrogate, p_fail = known
    explores = n >= EXPLORES_FROM and not skill.is_doubted
    information = skill.disagreement(gaps_m) if explores else None
    picks, gain = greedy(grid, points, p_fail, p_fail, n - len(first), information)
    picks, gain = first + picks, np.concatenate([np.ones(len(first)), gain])
    predictions = tuple(
        Prediction.of(gaps_m[..., i], p_twin[i], p_surrogate[i], p_fail[i]) for i in picks
    )
    return Proposal(points[picks], gain * skill.trust, p_fail[picks], predictions)
