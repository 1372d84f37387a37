"""Traffic: three cars on the mainline."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from support.vut_contract import factory, run_cases

from merge_sumo.controllers.controller import seen_in
from merge_sumo.drivers.car_following import conflicting_car, keep_safe, safe_speed_mps
from merge_sumo.metrics.measures import Measures
from merge_sumo.scenario.case import Case, Pool, from_unit, to_unit
from merge_sumo.scenario.scenario import AHEAD, BEHIND, DT_S, POV, US23, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.sumo.binding import load_libsumo
from merge_sumo.sumo.sumo_simulation import SumoSimulation

TRAFFIC = replace(
    US23, name="us23-traffic", headway_ahead_s=(1.0, 4.0), headway_behind_s=(1.0, 4.0)
)


def cases_of(level: int, n: int, scenario: Scenario = TRAFFIC, seed: int = 0) -> list[Case]:
    rng = np.random.default_rng([seed, level])
    points = rng.random((n, len(scenario.dimensions(level))))
    return Pool(levels=(level,), scenario=scenario).cases(points, level)


def test_the_cars_start_at_their_headways_and_the_speed_of_the_pov():
    point = np.array([[0.5, 0.5, 0.0, 1.0]])
    (case,) = from_unit(point, 0, scenario=TRAFFIC)
    assert case.starts() == [(-260.0, 30.0), (-182.0, 18.0), (-230.0, 30.0), (-380.0, 30.0)]
    assert to_unit([case], 0, scenario=US23) == pytest.approx(point, abs=1e-12)


def test_the_safe_speed_is_that_of_sumos_original_krauss_model():
    libsumo = load_libsumo()
    attributes = {"carFollowModel": "KraussOrig1", "decel": "4", "tau": "1.3", "accel": "1000"}
    rng = np.random.default_rng(0)
    gaps, leaders = rng.uniform(0.5, 200.0, 200), rng.uniform(0.0, 45.0, 200)
    with SumoSimulation(
        1, vut_type={**attributes, "minGap": "0", "maxSpeed": "200"}, scenario=US23
    ) as simulation:
        simulation.place(0, [(-340.0, 0.0), (-182.0, 18.0)])
        theirs = []
        for gap, leader in zip(gaps.tolist(), leaders.tolist(), strict=True):
            theirs.append(libsumo.vehicle.getFollowSpeed("vut.0", 45.0, gap, leader, 4.0))
    assert safe_speed_mps(gaps, leaders, 4.0, 1.3) == pytest.approx(theirs, abs=1e-9)


class TestCarsOfTheMainline:
    @pytest.mark.parametrize("level", [0, 1, 2])
    def test_that_are_far_away_change_nothing(self, level):
        vut, alone, far = factory("design2"), cases_of(level, 60, US23), []
        for case in alone:
            far.append(replace(case, scenario=TRAFFIC, headway_ahead_s=18.0, headway_behind_s=16.0))
        for one, other in zip(run_cases(vut, alone), run_cases(vut, far), strict=True):
            assert np.array_equal(one.motion, other.motion[:, :2])
            assert one.end == other.end
            assert Measures.of(other).score == Measures.of(one).score

    def test_brake_behind_one_that_brakes_and_never_touch_it(self):
        rng = np.random.default_rng(0)
        v = np.tile(rng.uniform(5.0, 35.0, 50), (4, 1))
        x = np.zeros((4, 50))
        x[AHEAD], x[BEHIND] = rng.uniform(1.1, 2.0, (2, 50)) * [[1.0], [-1.0]] * v[0]
        for step in range(200):
            a = np.full((4, 50), 2.0)
            a[AHEAD] = -4.0 if step > 10 else 0.0
            keep_safe(a, x, v, TRAFFIC)
            a = np.clip(a, -4.0, 2.0)
            x, v = x + v * DT_S, np.maximum(v + a * DT_S, 0.0)
            assert (x[[AHEAD, POV]] - x[[POV, BEHIND]]).min() > TRAFFIC.pov_length_m
        assert v.max(axis=1)[[POV, AHEAD, BEHIND]].max() < 0.2


def test_the_conflicting_car_will_be_nearest_to_m():
    # At 28 m/s already, the VUT is at M in 5 s; then the cars are at -50, 10 and -40 m.
    x = np.array([[-200.0], [-140.0], [-140.0], [-190.0]])
    v = np.array([[30.0], [28.0], [30.0], [30.0]])
    assert conflicting_car(x, v, TRAFFIC).tolist() == [AHEAD]
    assert conflicting_car(x, v, replace(TRAFFIC, level0_v_mps=28.0 / 1.5)).tolist() == [AHEAD]
    x[AHEAD] = 0.0
    assert conflicting_car(x, v, TRAFFIC).tolist() == [BEHIND]


def test_a_controller_sees_the_conflicting_car_as_pov_and_all_cars_from_the_front_on():
    seen = seen_in(1.5, BEHIND, [-200.0, -140.0, -150.0, -190.0], [30.0, 28.0, 31.0, 29.0])
    assert seen == (1.5, -190.0, 29.0, -140.0, 28.0)
    assert seen.others == ((-150.0, 31.0), (-190.0, 29.0), (-200.0, 30.0))


@pytest.mark.parametrize(("row", "name"), [(POV, "pov"), (AHEAD, "ahead"), (BEHIND, "behind")])
def test_a_case_fails_where_any_car_is_too_near(row, name):
    motion = np.zeros((1, 4, 3))
    motion[:, :, 1] = 25.0
    motion[0, [POV, AHEAD, BEHIND], 0] = 40.0, 90.0, -50.0
    motion[0, row, :2] = 4.0, 27.0
    measures = Measures.of(Trajectory(cases_of(0, 1)[0], motion, End.MERGED))
    assert measures.is_close
    assert (measures.dx_m, measures.dv_mps, measures.nearest) == (4.0, 2.0, name)
