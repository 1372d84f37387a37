"""The maps of the report: the coordinates that they show, and what they show of the others."""

# mypy: no-strict-optional

from __future__ import annotations

import base64
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from merge_sumo.reports.report_data import PAIR_NODES, map_data
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import MergeCase
from merge_sumo.scenario.coordinates import coordinates, described
from merge_sumo.scenario.scenario import US23

TRAFFIC = named_scenario("us23-traffic")
RANGED = replace(US23, v_vut0_mps=(14.0, 22.0))


def test_of_a_pair_has_the_mean_over_the_other_coordinates():
    # Fails where x > 1/2, for half of the values of another coordinate.
    points = np.random.default_rng(0).random((20_000, 4))
    chance = ((points[:, 0] > 0.5) & (points[:, 3] < 0.5)) * 1.0
    surface: Any = SimpleNamespace(pool=(points, chance))
    found = map_data(TRAFFIC, 0, [], surface)
    assert found["pairs"] == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]
    grid = found["grids"][0]["chance"]
    assert grid["most"] == pytest.approx(0.5, abs=0.1)
    values = np.frombuffer(base64.b64decode(grid["data"]), dtype=np.uint8)
    shown = values.reshape(grid["ny"], grid["nx"]) / 255.0 * grid["most"]
    middle = PAIR_NODES // 2
    assert shown[:, : middle - 8].max() < 0.01
    assert shown[5:-5, middle + 8 : -5].mean() == pytest.approx(0.5, abs=0.02)
    assert np.median(shown[5:-5, middle]) == pytest.approx(0.25, abs=0.05)


@pytest.mark.parametrize(
    ("scenario", "level", "radius", "through"),
    [
        (US23, 1, 0.05, None),
        (US23, 2, 0.05, 2),
        (RANGED, 1, 0.05, 2),
        (RANGED, 2, None, None),
        (TRAFFIC, 0, None, None),
    ],
)
def test_of_three_coordinates_moves_through_one_and_of_more_has_no_balls(
    scenario, level, radius, through
):
    found = map_data(scenario, level, [], None)
    assert (found["radius"], found["through"]) == (radius, through)


def test_a_case_is_described_by_its_coordinates():
    plain = MergeCase(level=2, x_pov0_m=-240.0, v_pov0_mps=30.0, svo_rad=0.5, scenario=US23)
    assert described(plain) == "x_POV0 -240.0 m, v_POV0 30.00 m/s, psi 0.50 rad"
    queued = replace(
        plain,
        level=0,
        svo_rad=None,
        headway_ahead_s=1.25,
        headway_behind_s=2.0,
        scenario=TRAFFIC,
    )
    assert described(queued).endswith("headway ahead 1.25 s, headway behind 2.00 s")
    assert [c.field for c in coordinates(RANGED, (0,))] == ["x_pov0_m", "v_pov0_mps", "v_vut0_mps"]
