"""A batch of `coverage` where games can be played out before their cases run."""

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
from merge_sumo.samplers.prediction_skill import Play, PredictionSkill
from merge_sumo.values.case import FloatArray
from merge_sumo.values.fmc import radius_for
from merge_sumo.values.prediction import Prediction

ANYWHERE: Final = 1000
ON_FACES: Final = 0.15
NEAR: Final = 300
BETWEEN: Final = 200
"""Candidates that one member screens: anywhere, a share of them on faces of the pool, near
failures, and between safe cases on either side."""
ASKED: Final = 1500
"""And candidates of the surrogate's that it is asked about."""
SCREENED: Final = 80
OF_THE_BELIEF: Final = 40
AT_RANDOM: Final = 20
"""Candidates that all members play: the best of these, the best by the surrogate, and some that
nobody has chosen,"""
ROUNDS: Final = 3
REFINED: Final = 60
"""and twice some around the best of these, and around the batch that would be picked from them."""
FEWEST: Final = 2
"""Cases from which a surrogate learns anything."""
EXPLORES_FROM: Final = 5
"""Cases of a batch of which the last one is where there is most to learn."""


def informed_batch(
    history: LevelHistory, n: int, rng: np.random.Generator, play: Play, record: PredictionSkill
) -> Proposal:
    """Return a batch of `n` cases at a level, all of which a predictor can play.

    P(fail) of a candidate is that of the games and that of the surrogate, weighed by the record.
    While nothing is known of the level, there is no surrogate, and half of the batch is spread out.
    """
    dims = history.dims
    reach = radius_for(dims)
    failing = history.points[history.failed]
    ground = CoverageGrid(dims)
    ground.cover(ground.balls(failing), 1.0)
    belief = Belief(history) if len(history.points) >= FEWEST else None
    trust = Calibration(history) if record.is_doubted else None

    def believed(belief: Belief, points: FloatArray) -> FloatArray:
        return belief.of(points) if trust is None else trust.of(belief, points)

    def best(points: FloatArray, probability: FloatArray, most: int) -> FloatArray:
        """Return the candidates that are worth the most by themselves."""
        worth = probability * (ground.new(ground.balls(points)) + EVEN_IF_COVERED)
        return points[np.argsort(-worth, kind="stable")[:most]]

    def played(points: FloatArray) -> tuple[FloatArray, ...]:
        """Return gaps, (E, G, m), and P(fail) by the games, by the surrogate and by both, (m,)."""
        gaps_m = play(points)
        p_twin = record.chance(gaps_m)
        p_surrogate = p_twin if belief is None else believed(belief, points)
        return gaps_m, p_twin, p_surrogate, record.mixed(gaps_m, p_twin, p_surrogate)

    uniform = anywhere(ANYWHERE, dims, ON_FACES, rng)
    screened, chosen = [uniform], [uniform[:AT_RANDOM]]
    if belief is not None:
        screened.append(between(belief, BETWEEN, rng))
        proposed = rng.permutation(of_belief(history, belief, rng, n))[:ASKED]
        chosen.append(best(proposed, believed(belief, proposed), OF_THE_BELIEF))
    if len(failing):
        screened.append(around(failing, NEAR, LOCAL_REACH * reach, rng))
    candidates = np.concatenate(screened)
    expert = record.expert(rng)
    near = record.chance(play(candidates, expert), expert)
    chosen.append(best(candidates, near, SCREENED))
    points = np.concatenate(chosen)
    known = played(points)
    for _ in range(ROUNDS):
        batch, _ = greedy(ground.copy(), points, known[-1], known[-1], n)
        centres = np.concatenate([best(points, known[-1], n), points[batch]])
        fresh = around(centres, REFINED, REFINED_REACH * reach, rng)
        points = np.concatenate([points, fresh])
        known = tuple(
            np.concatenate(pair, axis=-1) for pair in zip(known, played(fresh), strict=True)
        )
    first: list[int] = []
    if belief is None:
        spread = spread_out(n - n // 2, dims, rng)
        first = [*range(len(points), len(points) + len(spread))]
        points = np.concatenate([points, spread])
        known = tuple(
            np.concatenate(pair, axis=-1) for pair in zip(known, played(spread), strict=True)
        )
        ground.cover(ground.balls(spread), PICKED)
    gaps_m, p_twin, p_surrogate, p_fail = known
    explores = n >= EXPLORES_FROM and not record.is_doubted
    curious = record.doubt(gaps_m) if explores else None
    picks, gain = greedy(ground, points, p_fail, p_fail, n - len(first), curious)
    picks, gain = first + picks, np.concatenate([np.ones(len(first)), gain])
    said = tuple(Prediction.of(gaps_m[..., i], p_twin[i], p_surrogate[i], p_fail[i]) for i in picks)
    return Proposal(points[picks], gain * record.trust, p_fail[picks], said)
