"""Simulated annealing: chains that end up at one minimum each."""

from __future__ import annotations

import numpy as np
import pytest
from support.histories import history_of

from merge_sumo.samplers.annealing import CHAINS, AnnealingSampler
from merge_sumo.samplers.base import reflect
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import Pool
from merge_sumo.scenario.scenario import US23

FloatArray = np.ndarray


def two_valleys(points: FloatArray) -> FloatArray:
    """Return a margin with two equal minima, far apart."""
    left = np.square(points - [0.2, 0.3]).sum(axis=1)
    right = np.square(points - [0.8, 0.7]).sum(axis=1)
    return 1.0 - 1.8 * np.exp(-np.minimum(left, right) / 0.05)


def anneal(seed: int, batches: int, n: int = 20) -> LevelHistory:
    sampler = AnnealingSampler(Pool(levels=(0,), scenario=US23), seed)
    history = history_of(np.empty((0, 2)), np.empty(0))
    for batch in range(batches):
        rng = np.random.default_rng([seed, batch])
        points = np.vstack([history.points, sampler.propose(history, n, rng, 0)])
        of_batch = np.append(history.batch, np.full(n, batch))
        history = history_of(points, two_valleys(points), batch=of_batch)
    return history


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("chain", range(CHAINS))
def test_each_chain_ends_up_around_one_of_two_minima(seed, chain):
    history = anneal(seed, batches=20)
    last = history.points[-60:][chain::CHAINS]
    to_left = np.linalg.norm(last - [0.2, 0.3], axis=1) < 0.2
    to_right = np.linalg.norm(last - [0.8, 0.7], axis=1) < 0.2
    assert max(to_left.mean(), to_right.mean()) == 1.0
    assert history.failed[:20].mean() < 0.3, "the start must not be there already"
    assert history.failed[-60:].mean() > 0.8


def test_moves_are_reflected_at_the_faces():
    outside = np.array([[-0.1, 1.2], [0.3, 0.4], [2.3, -1.1]])
    assert reflect(outside) == pytest.approx(np.array([[0.1, 0.8], [0.3, 0.4], [0.3, 0.9]]))
