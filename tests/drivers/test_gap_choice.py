"""The VUT that chooses a gap on an acceleration lane, and where it waits."""

# mypy: no-strict-optional

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.vut_contract import ON_LANE, begin, factory, run_on

from merge_sumo.drivers.base import MERGE, NO_REQUEST, STAY, Scene
from merge_sumo.drivers.gap_choice import DESIGN, GapChoiceDesign, GapChoiceVut
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.scenario import DT_S, US23
from merge_sumo.scenario.trajectory import End


def scene(x_m: list[float], v_mps: list[float], *, merged: bool = False) -> Scene:
    """Return a scene of one corridor with vehicles in the order of their rows."""
    x, v = (np.array(values, dtype=np.float64)[:, None] for values in (x_m, v_mps))
    return Scene(np.array([True]), np.array([9]), x, v, merged=np.array([merged]))


def answers(x_m, v_mps, *, merged=False, design=DESIGN) -> tuple[float, int]:
    """Return its answer and its merge request."""
    vut = GapChoiceVut(1, design)
    begin(vut)
    answer = vut.act(scene(x_m, v_mps, merged=merged))
    return float(answer[0]), int(vut.merge_requests()[0])


@pytest.mark.parametrize(
    ("x_pov", "v_pov", "merge_request"),
    [
        (-70.0, 30.0, MERGE),  # behind, in the next step: -38 - 5 - (-67) = 24 m, 0.8 s at 30 m/s
        (-69.99, 30.0, STAY),
        (-18.5, 15.0, MERGE),  # ahead: -17 - 5 - (-38) = 16 m, 0.8 s at its own 20 m/s
        (-18.51, 15.0, STAY),
        (-41.0, 20.0, STAY),  # next to it
        (500.0, 30.0, MERGE),
    ],
)
def test_a_gap_is_accepted_by_its_time_gaps_in_the_next_step(x_pov, v_pov, merge_request):
    assert answers([x_pov, -40.0], [v_pov, 20.0])[1] == merge_request


def test_both_gaps_count_and_so_does_the_headway():
    between = [-75.0, -40.0, -10.0, -140.0], [30.0, 20.0, 20.0, 30.0]  # 29 m behind, 25 m ahead
    assert answers(*between)[1] == MERGE
    assert answers(*between, design=GapChoiceDesign(headway_s=0.96))[1] == MERGE
    assert answers(*between, design=GapChoiceDesign(headway_s=0.97))[1] == STAY
    assert answers([-75.0, -40.0, -21.0, -140.0], between[1])[1] == STAY


def test_it_requests_no_merge_before_the_gore_and_on_the_mainline():
    assert answers([500.0, -72.1], [30.0, 20.0]) == (1.0, STAY)
    assert answers([500.0, -72.0], [30.0, 20.0]) == (1.0, MERGE)
    assert answers([500.0, -40.0], [30.0, 20.0], merged=True) == (1.0, NO_REQUEST)


def test_without_a_lane_it_is_the_level_0_vut():
    case = replace(ON_LANE, scenario=US23)
    vut, level0 = GapChoiceVut(1), factory("level0").open(1)
    begin(vut, case)
    begin(level0, case)
    at_m = scene([-45.0, -40.0], [30.0, 27.95])._replace(merged=None)
    assert vut.act(at_m).tolist() == level0.act(at_m).tolist() == [pytest.approx(0.5)]
    assert vut.merge_requests().tolist() == [NO_REQUEST]


def test_without_a_gap_it_stands_before_the_end_of_the_lane_and_waits():
    vut = GapChoiceVut(1)
    begin(vut)
    x, v, hardest = -40.0, 24.0, 0.0
    for _ in range(200):
        a = float(vut.act(scene([x, x], [v, v]))[0])
        assert vut.merge_requests().tolist() == [STAY]
        hardest = min(hardest, a)
        x, v = x + v * DT_S, max(v + a * DT_S, 0.0)
    assert v == pytest.approx(0.0, abs=1e-9)
    assert x == pytest.approx(129.0, abs=0.2)
    assert -3.0 - 1e-9 <= hardest <= -2.9


def test_on_the_mainline_it_keeps_a_distance():
    near, _ = answers([-30.0, -40.0], [15.0, 20.0], merged=True)
    far, _ = answers([400.0, -40.0], [20.0, 20.0], merged=True)
    assert near < -2.0
    assert 0.5 < far <= 1.0


def test_it_merges_in_sumo_and_a_longer_headway_merges_later():
    scenario = named_scenario("us23-lane-traffic")
    mean_m = []
    for headway_s in (0.5, 1.2):
        ran = run_on(factory(f"gap?headway_s={headway_s}"), scenario, 0, 40)
        assert {t.end for t in ran} <= {End.MERGED, End.TIMEOUT}
        assert all(t.x_vut_m[-1] < 130.0 for t in ran), "no merge is forced"
        mean_m.append(np.mean([t.x_vut_m[-1] for t in ran]))
    assert mean_m[0] < mean_m[1]
