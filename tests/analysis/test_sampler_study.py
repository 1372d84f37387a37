"""Truths in the cache, and samplers in comparison with each other and with a truth."""

# mypy: no-strict-optional

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest
from support.histories import ended
from support.plans import POVS, plan_for
from support.vut_contract import factory

from merge_sumo.analysis.sampler_study import (
    SamplerRun,
    SamplerStudy,
    SamplerSummary,
    Spread,
)
from merge_sumo.analysis.truth import Truth, ground_truth, truth_path
from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.spec import ControllerOptions
from merge_sumo.metrics.fmc import fmc
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.scenario.case import from_unit, to_unit
from merge_sumo.scenario.scenario import US23


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def truth(cache):
    return ground_truth(plan_for("design1"), 0, 300, cache=cache)


def test_a_truth_is_kept_and_a_torn_file_is_made_again(truth, cache, monkeypatch):
    (path,) = cache.glob("truth-*.npz")
    counted: list[int] = []
    again = ground_truth(plan_for("design1"), 0, 300, cache=cache, on_case=counted.append)
    assert np.array_equal(again.margin, truth.margin)
    assert counted == []
    path.write_bytes(path.read_bytes()[:100])
    remade = ground_truth(plan_for("design1"), 0, 300, cache=cache, on_case=counted.append)
    assert np.array_equal(remade.margin, truth.margin)
    assert len(counted) == 300


def test_the_key_of_the_cache_names_what_the_truth_depends_on():
    plan = plan_for("design1")
    hasty = ControllerOptions(policies=POVS.policies, deadline_s=1.0)
    path = truth_path(plan, 0, 300)
    assert path == truth_path(plan_for("design1"), 0, 300)
    assert path != truth_path(plan_for("design2"), 0, 300)
    assert path != truth_path(plan_for(load("design1", hasty)), 0, 300)
    assert path != truth_path(plan, 1, 300)


def truth_of(vut: str, cache, **options) -> int:
    """Return in how many cases a VUT had to drive for its truth of four cases."""
    counted: list[int] = []
    ground_truth(plan_for(factory(vut, **options)), 0, 4, cache=cache, on_case=counted.append)
    return len(counted)


READER = """
import pathlib
import gain_of_mine
HERE = pathlib.Path(__file__).parent
class Vut:
    def act(self, seen):
        (HERE / "ran").touch()
        if seen.t_s == 5.0:
            import late_gain
        return float((HERE / "gain.txt").read_text()) if seen.t_s > 2.0 else gain_of_mine.gain
"""


def test_a_truth_is_of_the_code_that_the_vut_loaded_also_while_it_drove(tmp_path):
    for file, content in {
        "my_vut.py": READER,
        "gain_of_mine.py": "gain = 1.0",
        "late_gain.py": "",
        "gain.txt": "1.0",
    }.items():
        (tmp_path / file).write_text(content)
    vut = f"{tmp_path / 'my_vut.py'}:Vut"
    assert truth_of(vut, tmp_path / "cache") == 4
    (tmp_path / "ran").unlink()
    assert truth_of(vut, tmp_path / "cache") == 0
    assert not (tmp_path / "ran").exists()
    (tmp_path / "late_gain.py").write_text("# changed")
    assert truth_of(vut, tmp_path / "cache") == 4
    assert truth_of(vut, tmp_path / "cache") == 0


def searched(points_by_batch: list[list[tuple[float, float]]]) -> SamplerRun:
    """Return a search at level 0 with failures at points, and one safe case in each batch."""
    outcomes: list[Outcome] = []
    curve = []
    for batch, points in enumerate(points_by_batch):
        for failed, point in [(False, (0.0, 0.0)), *((True, point) for point in points)]:
            (case,) = from_unit(np.array([point]), 0, scenario=US23)
            outcomes.append(ended(case, -600.0 if failed else -1.0, len(outcomes), batch))
        curve.append(fmc(to_unit([o.case for o in outcomes if o.failed], 0, scenario=US23)))
    return SamplerRun(outcomes, curve)


def truth_with(*points: tuple[float, float], failures: int = 2) -> Truth:
    """Return a truth with some failures at each of some points: two of them are large enough."""
    at = np.array(points * failures or [(0.5, 0.5)])
    return Truth(at, np.full(len(at), -0.2 if failures else 0.9))


TWO = truth_with((0.2, 0.2), (0.8, 0.8))
SMALL = truth_with((0.2, 0.2), (0.8, 0.8), failures=1)
HALF = searched([[], [(0.2, 0.24)]])  # 1 case, then 3
MOST = searched([[(0.2, 0.2)], [(0.8, 0.8)]])  # 2 cases, then 4


def study_of(*searches: SamplerRun, truth: Truth = TWO, **more) -> SamplerStudy:
    return SamplerStudy({"mine": list(searches)}, {0: truth}, **more)


def summary(*searches: SamplerRun, **more) -> SamplerSummary:
    return study_of(*searches, **more).samplers["mine"]


class TestASamplerByHand:
    def test_has_medians_and_quartiles_over_the_seeds(self):
        found = summary(MOST, HALF)
        assert found.regions_found == Spread(1.5, 1.25, 1.75)
        assert found.failures == Spread(1.5, 1.25, 1.75)
        assert astuple(found.fmc_over_truth) == pytest.approx((0.75, 0.625, 0.875))
        low, median, high = found.fmc_by_batch
        disc = fmc(np.zeros((1, 2)))
        assert (low[0], median[0], high[0]) == pytest.approx((disc / 4, disc / 2, disc * 3 / 4))

    def test_covers_a_share_of_the_failures_of_the_truth(self):
        assert summary(HALF, truth=SMALL).covered_share.median == 0.5
        assert summary(MOST, truth=SMALL).covered_share.median == 1.0
        dense = {0: truth_with((0.2, 0.2), (0.8, 0.8), (0.5, 0.5), (0.9, 0.1))}
        assert summary(HALF, truth=SMALL, dense=dense).covered_share.median == 0.25
