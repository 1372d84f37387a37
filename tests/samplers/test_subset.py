"""Subset simulation: its regions and its chains."""

from __future__ import annotations

import numpy as np
from support.histories import history_of

from merge_sumo.samplers.history import LevelHistory
from merge_sumo.samplers.subset import STAGE_SIZE, SubsetSampler, SubsetState, replay
from merge_sumo.scenario.case import Pool
from merge_sumo.scenario.scenario import US23

FloatArray = np.ndarray


def margin_at(points: FloatArray) -> FloatArray:
    """Return a margin that falls towards a corner of the square and passes 0 at the line."""
    return 0.8 * (points.sum(axis=1) - 0.1)


def in_batches(points: FloatArray, batch: FloatArray) -> LevelHistory:
    return history_of(points, margin_at(points), batch=batch)


def simulate(seed: int, batches: int, n: int = 20) -> LevelHistory:
    sampler = SubsetSampler(Pool(levels=(0,), scenario=US23), seed)
    history = in_batches(np.empty((0, 2)), np.empty(0, dtype=np.int64))
    for batch in range(batches):
        rng = np.random.default_rng([seed, batch])
        points = np.vstack([history.points, sampler.propose(history, n, rng, 0)])
        history = in_batches(points, np.append(history.batch, np.full(n, batch)))
    return history


def stages() -> list[SubsetState]:
    history = simulate(3, batches=20)
    ends = range(20, len(history.points) + 1, 20)
    return [replay(in_batches(history.points[:end], history.batch[:end])) for end in ends]


def test_goes_through_ever_lower_regions_to_the_failures():
    seen = stages()
    for stage in seen:
        assert np.all(margin_at(stage.chains) <= stage.threshold)
    assert seen[0].number == 0
    assert seen[STAGE_SIZE // 20 - 1].number == 1
    assert np.all(np.diff([stage.threshold for stage in seen[4:]]) <= 0.0)
    assert seen[-1].threshold < 0.0


def test_a_rejected_move_leaves_its_chain_where_it_is():
    history = simulate(3, batches=5)
    before = replay(history)
    far = np.full((3, 2), 0.99)
    points = np.vstack([history.points, far])
    after = replay(in_batches(points, np.append(history.batch, [5, 5, 5])))
    assert after.moved == 3
    np.testing.assert_array_equal(after.chains, before.chains)
