"""P(fail) from k failures of n runs of a case."""

# mypy: no-strict-optional

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.histories import CASE, ended

from merge_sumo.samplers.history import LevelHistory
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.samplers.surrogate import Surrogate
from merge_sumo.scenario.case import Case, Pool
from merge_sumo.scenario.scenario import US23

OTHER = replace(CASE, v_pov0_mps=31.0)


def history_of_runs(*runs: tuple[Case, int, float, float], tolerated: float = 0.0) -> LevelHistory:
    """Return the history of runs (case, draw, score, dx)."""
    sampler = make_sampler("uniform", Pool(levels=(0,), scenario=US23), 0)
    sampler.tolerated = tolerated
    for index, (case, draw, score, dx_m) in enumerate(runs):
        sampler.tell([ended(replace(case, draw=draw), score, index, index, dx_m=dx_m)])
    return sampler.history(0)


RUNS = (
    (CASE, 0, -20.0, 40.0),
    (OTHER, 0, -30.0, -50.0),
    (CASE, 1, -700.0, 2.0),
    (CASE, 2, -25.0, 35.0),
    (CASE, 3, -600.0, -3.0),
)


@pytest.mark.parametrize(
    ("tolerated", "failed"),
    [(0.0, True), (0.49, True), (0.5, False)],
)
def test_a_case_has_one_row_with_its_worst_run(tolerated, failed):
    history = history_of_runs(*RUNS, tolerated=tolerated)
    assert len(history.points) == 2
    assert history.runs.tolist() == [4, 1]
    assert history.failures.tolist() == [2, 0]
    assert history.batch.tolist() == [0, 1]
    assert history.margin[0] == pytest.approx(-0.4)
    assert (history.gap[0], history.failed[0]) == (2.0 / 6.0, failed)
    assert history.variance[0] == pytest.approx(np.var([0.96, -0.4, 0.95, -0.2], ddof=1))
    assert np.isnan(history.variance[1])
    assert history.varies


class TestFailureProbability:
    """A strip that fails in three runs of ten, of which each case ran four times."""

    RUNS = 4

    def history(self, tolerated: float) -> tuple[LevelHistory, np.ndarray]:
        rng = np.random.default_rng(4)
        points = rng.random((150, 2))
        inside = np.abs(points[:, 0] - 0.5) < 0.15
        failures = np.where(inside, rng.binomial(self.RUNS, 0.3, 150), 0)
        decides = failures > tolerated * self.RUNS
        margin = np.where(failures > 0, -0.2, 0.96)
        gap = np.where(failures > 0, 0.0, np.where(inside, 5.0, 33.0 * (points[:, 0] - 0.5)))
        runs = np.full(150, self.RUNS)
        variance = np.where((failures > 0) & (failures < self.RUNS), 0.4, 0.0)
        rows = points, margin, decides, gap, np.arange(150) // 10, runs, failures, variance
        return LevelHistory(*rows, varies=True), inside

    def test_is_the_share_of_runs_that_fail(self):
        history, _ = self.history(0.1)
        model = Surrogate(history)
        strip = np.column_stack([np.full(50, 0.5), np.linspace(0.05, 0.95, 50)])
        assert model.predict(strip).mean() == pytest.approx(0.3, abs=0.15)
        assert model.predict(np.array([[0.1, 0.5], [0.9, 0.5]])).max() < 0.05
