"""A search whose model of the controller is confident and wrong."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.histories import ended

from merge_sumo.metrics.outcome import Outcome
from merge_sumo.samplers.coverage import CoverageSampler
from merge_sumo.scenario.case import FloatArray, Pool, to_unit
from merge_sumo.scenario.scenario import US23


def band_m(points: FloatArray) -> FloatArray:
    """Return gaps at M, (n,): those of a slanted band of failures."""
    return np.asarray(200.0 * (0.6 * points[:, 0] + 0.8 * points[:, 1] - 0.7))


def jump_m(points: FloatArray) -> FloatArray:
    """Return gaps at M, (n,), that jump over the band: no case fails."""
    return np.where(band_m(points) < 0.0, -60.0, 60.0)


class Confident:
    """Predicts the band, whatever the outcomes; its members agree within .04 of the limit."""

    members = 8

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Learn nothing."""

    def can_predict(self, level: int) -> bool:
        """Return that it can."""
        return True

    def predict(self, points, member=None) -> dict[int, FloatArray]:
        """Return the gaps of cases by level."""
        numbers = np.arange(self.members) if member is None else np.array([member])
        off = 0.005 * (numbers[:, None] - 4)
        return {level: band_m(of) / US23.dx_crash_m + off for level, of in points.items()}


def search(true_m, cases: int, seed: int) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the cases, (n, 2), of a search that `Confident` guides, and which failed, (n,)."""
    sampler = CoverageSampler(Pool(levels=(0,), scenario=US23), seed, Confident())
    done: list[Outcome] = []
    while len(done) < cases:
        asked = sampler.ask(sampler.batch_size())
        gaps = true_m(to_unit(asked, 0, scenario=US23)).tolist()
        ran = []
        for place, (case, dx_m) in enumerate(zip(asked, gaps, strict=True)):
            score = -600.0 if abs(dx_m) < US23.dx_crash_m else -50.0
            one = ended(case, score, len(done) + place, len(done), dx_m=dx_m)
            ran.append(replace(one, prediction=sampler.prediction(place)))
        sampler.tell(ran, {})
        done += ran
    points = to_unit([outcome.case for outcome in done], 0, scenario=US23)
    return points, np.array([outcome.failed for outcome in done])


@pytest.mark.parametrize("seed", [1, 2])
def test_looks_everywhere_where_predicted_failures_do_not_come(seed):
    points, failed = search(jump_m, 60, seed)
    assert not failed.any()
    in_band = np.abs(band_m(points)) < 15.0
    assert in_band[:20].mean() > 0.5
    assert in_band[20:].mean() < 0.75, "the band has 18 % of the pool"


def test_follows_predictions_that_come_true():
    _, failed = search(band_m, 40, 1)
    assert failed[20:].mean() > 0.6
