"""Where predictions do not come true, cases from anywhere stand in for picks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from numpy.typing import NDArray

from merge_sumo.samplers import coverage
from merge_sumo.samplers.base_rate import PRIOR_CASES, PRIOR_FAILURES, BaseRate
from merge_sumo.samplers.candidates import spread_out
from merge_sumo.samplers.coverage import CoverageSampler
from merge_sumo.samplers.greedy import Proposal
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.samplers.prediction_skill import PredictionSkill, Query
from merge_sumo.values.case import FloatArray, Pool, to_unit
from merge_sumo.values.prediction import Prediction
from merge_sumo.values.scenario import US23
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import End

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

    def predict(self, queries: Sequence[Query]) -> list[FloatArray]:
        """Return the gaps of each query."""
        return [self._answer(query) for query in queries]

    def _answer(self, query: Query) -> FloatArray:
        gap = band_m(query.points) / US23.dx_crash_m
        if query.held_out:
            return np.tile(gap, (EXPERTS, 1))
        if query.screening is not None:
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


def known(points: FloatArray, failed: Sequence[bool], batch: Sequence[int]) -> LevelHistory:
    verdicts = np.array(failed)
    margin, gap = np.where(verdicts, -0.2, 0.9), np.where(verdicts, 0.0, 8.0)
    return LevelHistory(points, margin, verdicts, gap, np.array(batch))


def said(p_fail: float) -> Prediction:
    return Prediction.of(np.zeros((1, 1)), p_fail, p_fail, p_fail)


class TestTheBaseRate:
    """Four cases of the sequence, one of which failed, and two picks at 0.5 that did not."""

    @staticmethod
    def made(n: int = 3) -> tuple[BaseRate, FloatArray]:
        sequence = spread_out(9, 2, np.random.default_rng(3))
        picks = np.array([[0.5, 0.5], [0.51, 0.5]])
        failed = [True, False, False, False, False, False]
        history = known(np.concatenate([sequence[:4], picks]), failed, [0, 0, 0, 0, 1, 1])
        predictions = [None] * 4 + [said(0.5)] * 2
        rng = np.random.default_rng(3)

        def by_margin(points: FloatArray, n: int) -> FloatArray:
            return points[:n]

        made = BaseRate(history, predictions, np.empty((0, 2)), n, 6, rng, by_margin)
        return made, sequence

    def test_is_the_share_of_the_sequence_that_failed(self):
        base_rate, _ = self.made()
        assert base_rate.chance == (1.0 + PRIOR_FAILURES) / (4.0 + PRIOR_CASES)

    def test_goes_on_with_both_arms_by_what_each_has_found(self):
        base_rate, sequence = self.made()
        # The sequence found 1 of 4, the margin nothing of 0: shares of .107 and .05.
        offered = spread_out(4000, 2, np.random.default_rng([4000, 2]))
        wanted = np.array([offered[0], sequence[4], sequence[5]])
        assert base_rate.following == pytest.approx(wanted)

    @pytest.mark.parametrize("seed", range(100, 124))
    def test_comes_everywhere_also_where_the_margin_leads_astray(self, seed):
        assert search(shell_m, 60, seed)[1].any()

    def test_stands_in_for_the_picks_that_are_worth_less(self):
        base_rate, sequence = self.made()
        failure = sequence[0]
        # Promised far from failures: 1, came: 0. Half of a gain there is left, near them all of it.
        assert np.linalg.norm(failure - [0.5, 0.5]) > 0.2
        points = np.array([[0.5, 0.48], failure, [0.52, 0.5]])
        gain = np.array([0.3, 0.12, 0.1])
        picks = Proposal(points, gain, np.array([0.4, 0.2, 0.2]), (said(0.4), said(0.2), None))
        following = Proposal(base_rate.following, gain, np.full(3, 0.03), (None,) * 3)
        mixed = base_rate.mixed(picks, following)
        chance = base_rate.chance
        assert mixed.points == pytest.approx(
            np.array([points[0], points[1], base_rate.following[0]])
        )
        assert mixed.gain.tolist() == pytest.approx([0.15, 0.12, chance])
        assert mixed.probability.tolist() == [0.4, 0.2, 0.03]


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
