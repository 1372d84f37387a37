"""Where predictions do not come true, cases from anywhere stand in for picks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from merge_sumo.metrics.prediction import Prediction
from merge_sumo.metrics.score import Measures, Outcome
from merge_sumo.samplers import coverage
from merge_sumo.samplers.coverage import CoverageSampler
from merge_sumo.samplers.prediction_skill import PredictionSkill
from merge_sumo.scenario.case import FloatArray, Pool, to_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End

EXPERTS, GROUPS = 2, 4


def band_m(points: FloatArray) -> FloatArray:
    """Return gaps at M, (n,): those of a slanted band of failures."""
    return np.asarray(200.0 * (0.6 * points[:, 0] + 0.8 * points[:, 1] - 0.7))


def shell_m(points: FloatArray) -> FloatArray:
    """Return gaps at M, (n,): the band is jumped over, and failures are in a thin shell far off."""
    away = np.where(band_m(points) < 0.0, -60.0, 60.0)
    return np.where(np.abs(points[:, 0] - 0.92) < 0.02, 0.0, away)


class Confident:
    """Predicts the band, whatever it is told; its members agree within .04 of the limit."""

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Learn nothing."""

    def can_predict(self, level: int) -> bool:
        """Return that it can."""
        return True

    def predict(self, level, points, *, screening=None, held_out=()) -> FloatArray:
        """Return the gaps of cases."""
        gap = band_m(points) / US23.dx_crash_m
        if held_out:
            return np.tile(gap, (EXPERTS, 1))
        if screening is not None:
            return gap[None, None]
        off = np.linspace(-0.02, 0.02, EXPERTS * GROUPS).reshape(EXPERTS, GROUPS, 1)
        return gap + off


def search(true_m, cases: int, seed: int) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the cases, (n, 2), of a search that `Confident` guides, and which failed, (n,)."""
    sampler = CoverageSampler(Pool(levels=(0,), scenario=US23), seed, Confident())
    done: list[Outcome] = []
    while len(done) < cases:
        asked = sampler.ask(sampler.batch_size())
        gaps = true_m(to_unit(asked, 0, scenario=US23)).tolist()
        ended = []
        for place, (case, dx_m) in enumerate(zip(asked, gaps, strict=True)):
            score = -600.0 if abs(dx_m) < US23.dx_crash_m else -50.0
            measures = Measures(end=End.MERGED, score=score, t_end_s=8.3, dx_m=dx_m)
            index = len(done) + place
            ended.append(Outcome(index, len(done), case, measures, sampler.prediction(place)))
        sampler.tell(ended, {})
        done += ended
    points = to_unit([outcome.case for outcome in done], 0, scenario=US23)
    return points, np.array([outcome.failed for outcome in done])


@pytest.mark.parametrize("seed", [1, 2])
def test_looks_everywhere_where_what_is_predicted_does_not_come(seed):
    points, failed = search(shell_m, 60, seed)
    assert failed.sum() >= 3, "the shell has 4 % of the pool"
    in_band = np.abs(band_m(points[20:])) < 15.0
    assert in_band.mean() < 0.5, "the band has 18 % of the pool"


def test_changes_nothing_where_predictions_come_true(monkeypatch):
    def asked(*_: object) -> None:
        raise AssertionError("nobody has to ask for the base rate")

    monkeypatch.setattr(coverage, "BaseRate", asked)
    _, failed = search(band_m, 40, 1)
    assert failed[20:].mean() > 0.6


def said(p_fail: float) -> Prediction:
    return Prediction.of(np.zeros((1, 1)), p_fail, p_fail, p_fail)


@pytest.mark.parametrize("seed", range(100, 112))
def test_comes_everywhere_also_where_the_margin_leads_astray(seed):
    assert search(shell_m, 60, seed)[1].any()


def test_promises_are_broken_where_less_than_half_of_them_came():
    def skill(came: int) -> PredictionSkill:
        cases = Pool(levels=(0,), scenario=US23).cases(np.full((20, 2), 0.5), 0)
        verdicts = [
            Measures(end=End.MERGED, score=score, t_end_s=8.3, dx_m=0.0)
            for score in (-600.0, -50.0)
        ]
        outcomes = [
            Outcome(i, i, case, verdicts[i >= came], said(0.8)) for i, case in enumerate(cases)
        ]
        return PredictionSkill(outcomes, 0, US23.dx_crash_m)

    assert skill(came=4).breaks_promises
    assert not skill(came=14).breaks_promises
