"""The maps of the report: which two coordinates come first, and what they show of the others."""

# mypy: no-strict-optional

from __future__ import annotations

import base64
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from handmade import write_run

from merge_sumo.analysis.coordinates import coordinates, described
from merge_sumo.reports.report_maps import PAIR_NODES, explained, maps_of, pairs_of
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.studies.truth import Truth
from merge_sumo.values.case import MergeCase
from merge_sumo.values.scenario import US23

TRAFFIC = named_scenario("us23-traffic")
RANGED = replace(US23, v_vut0_mps=(14.0, 22.0))


class Known:
    """Stands for a surrogate that gives a function of the pool."""

    def __init__(self, dims: int, chance) -> None:
        points = np.random.default_rng(0).random((20_000, dims))
        self.known = points, chance(points)

    def pool(self):
        return self.known

    def chance(self, points):
        return np.zeros(len(points))


def values(grid: dict) -> np.ndarray:
    """Return the values of a grid, rows along the second coordinate, from 0 to 1."""
    packed = np.frombuffer(base64.b64decode(grid["data"]), dtype=np.uint8)
    return packed.reshape(grid["ny"], grid["nx"]) / 255.0


class TestWhatAPairExplains:
    @pytest.mark.parametrize(
        ("chance", "share"),
        [
            (lambda p: p[:, 0] * 1.0, 1.0),
            (lambda p: p[:, 2] * 1.0, 0.0),
            (lambda p: p[:, 0] + p[:, 2], 0.5),
            (lambda p: p[:, 0] + p[:, 1] + p[:, 2] + p[:, 3], 0.5),
            # Of x y: 1/9 - 1/16 = 7/144 in all; of x alone 1/4 * 1/12 = 3/144.
            (lambda p: p[:, 0] * p[:, 2], 3.0 / 7.0),
            (lambda p: np.zeros(len(p)), 0.0),
        ],
        ids=["all", "nothing", "one of two", "two of four", "a product", "nobody fails"],
    )
    def test_is_the_closed_sobol_index(self, chance, share):
        points, chances = Known(4, chance).pool()
        assert explained(points[:, :2], chances) == pytest.approx(share, abs=0.02)

    def test_is_nothing_where_it_is_chance_alone(self):
        rng = np.random.default_rng(1)
        assert explained(rng.random((2000, 2)), rng.random(2000)) < 0.03


class TestPairs:
    def test_of_two_and_three_coordinates_are_the_first_two(self):
        surface: Any = Known(3, lambda p: p[:, 2] * 1.0)
        assert [pair.axes for pair in pairs_of(2, None)] == [(0, 1)]
        assert [pair.axes for pair in pairs_of(3, surface)] == [(0, 1)]

    def test_of_more_are_all_of_them_with_the_one_that_explains_most_first(self):
        surface: Any = Known(5, lambda p: ((p[:, 1] < 0.3) & (p[:, 3] > 0.6)) * 1.0)
        pairs = pairs_of(5, surface)
        assert len(pairs) == 10
        assert pairs[0].axes == (1, 3)
        assert pairs[0].share == pytest.approx(1.0, abs=0.15)
        shares = [pair.share for pair in pairs]
        assert shares == sorted(shares, reverse=True)

    def test_are_in_the_pools_order_where_no_surrogate_tells(self):
        pairs = pairs_of(4, None)
        assert [pair.axes for pair in pairs] == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
        assert {pair.share for pair in pairs} == {None}


class TestAMap:
    def test_of_a_pair_has_the_mean_over_the_other_coordinates(self):
        # Fails where x > 1/2, for half of the values of another coordinate.
        surface: Any = Known(4, lambda p: ((p[:, 0] > 0.5) & (p[:, 3] < 0.5)) * 1.0)
        found = maps_of(TRAFFIC, 0, [], surface, None)
        place = [tuple(pair["axes"]) for pair in found["pairs"]].index((0, 1))
        grid = found["grids"][place]["chance"]
        assert grid["most"] == pytest.approx(0.5, abs=0.1)
        shown = values(grid) * grid["most"]
        middle = PAIR_NODES // 2
        assert shown[:, : middle - 8].max() < 0.01
        assert shown[5:-5, middle + 8 : -5].mean() == pytest.approx(0.5, abs=0.02)
        assert np.median(shown[5:-5, middle]) == pytest.approx(0.25, abs=0.05)

    def test_of_a_pair_has_the_truth_in_its_own_coordinates(self):
        points = np.random.default_rng(1).random((4000, 4))
        truth = Truth(points, np.where(points[:, 2] < 0.5, -0.8, 0.9))
        found = maps_of(TRAFFIC, 1, [], None, truth)
        place = [tuple(pair["axes"]) for pair in found["pairs"]].index((1, 2))
        shown = values(found["grids"][place]["truth"])
        assert shown[:15].min() > 0.95, "rows of a small headway ahead"
        assert shown[-15:].max() < 0.05

    def test_of_more_than_three_coordinates_has_no_balls(self):
        for scenario, level, radius in (
            (US23, 0, 0.05),
            (US23, 2, 0.05),
            (RANGED, 0, 0.05),
            (RANGED, 2, None),
            (TRAFFIC, 0, None),
        ):
            assert maps_of(scenario, level, [], None, None)["radius"] == radius

    def test_moves_through_a_third_coordinate_whatever_it_is(self):
        assert maps_of(US23, 2, [], None, None)["through"] == 2
        assert maps_of(RANGED, 1, [], None, None)["through"] == 2
        assert maps_of(US23, 1, [], None, None)["through"] is None
        assert maps_of(RANGED, 2, [], None, None)["through"] is None

    def test_counts_the_cases_that_are_not_shown_in_each_pair(self, tmp_path):
        run = write_run(tmp_path / "run", 20, levels=(0,), error=None, scenario=TRAFFIC)
        for grid in maps_of(TRAFFIC, 0, run.outcomes, None, None)["grids"]:
            counted = sum(grid["counts"]["safe"]), sum(grid["counts"]["failing"])
            failing = sum(o.failed for o in run.outcomes)
            assert counted == (20 - failing, failing)


def test_a_case_is_described_by_its_coordinates():
    plain = MergeCase(level=2, x_pov0_m=-240.0, v_pov0_mps=30.0, svo_rad=0.5, scenario=US23)
    assert described(plain) == "x_POV0 -240.0 m, v_POV0 30.00 m/s, psi 0.50 rad"
    queued = MergeCase(
        level=0,
        x_pov0_m=-240.0,
        v_pov0_mps=30.0,
        headway_ahead_s=1.25,
        headway_behind_s=2.0,
        scenario=TRAFFIC,
    )
    assert described(queued).endswith("headway ahead 1.25 s, headway behind 2.00 s")
    assert [c.field for c in coordinates(RANGED, (0,))] == ["x_pov0_m", "v_pov0_mps", "v_vut0_mps"]
