"""The maps of the report: the coordinates that they show, and what they show of the others."""

# mypy: no-strict-optional

from __future__ import annotations

from dataclasses import replace

import pytest

from merge_sumo.reports.report_data import map_data
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import MergeCase
from merge_sumo.scenario.coordinates import coordinates, described
from merge_sumo.scenario.scenario import US23

TRAFFIC = named_scenario("us23-traffic")
RANGED = replace(US23, v_vut0_mps=(14.0, 22.0))


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
