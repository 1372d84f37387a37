"""The reference drivers: formulas and reactions by hand, and cases that a blind driver fails."""

from __future__ import annotations

import numpy as np
import pytest
from plans import plan_for

from merge_sumo.drivers.base import Scene
from merge_sumo.drivers.level0 import level0_time_to
from merge_sumo.drivers.reference import (
    REFERENCES,
    CarefulPov,
    CarefulVut,
    FsmVut,
    Reg157Vut,
    RssVut,
    cfs,
    pfs,
    rss_distance_m,
    ttc_s,
)
from merge_sumo.values.case import Case
from merge_sumo.values.scenario import Scenario
from merge_sumo.values.trajectory import End

CASE = Case(level=0, x_pov0_m=-200.0, v_pov0_mps=30.0)


def one(value):
    return np.array([float(value)])


def started(driver, scenario=None):
    made = driver(1)
    made.begin(
        0,
        CASE
        if scenario is None
        else Case(level=0, x_pov0_m=-200.0, v_pov0_mps=30.0, scenario=scenario),
    )
    return made


def scene(x_pov_m, v_pov_mps, x_vut_m, v_vut_mps):
    state = map(one, (x_pov_m, v_pov_mps, x_vut_m, v_vut_mps))
    return Scene.of_pair(np.array([True]), np.array([0]), *state)


def at_m(dx_m, v_pov_mps=30.0, x_vut_m=-140.0):
    """Return a scene with a VUT at 28 m/s, at M in 5 s, and the POV dx ahead of it then."""
    return scene(dx_m + v_pov_mps * x_vut_m / 28.0, v_pov_mps, x_vut_m, 28.0)


class TestFormulas:
    def test_time_to_collision(self):
        assert ttc_s(one(10), one(25), one(20)) == 2.0
        assert ttc_s(one(10), one(20), one(25)) == np.inf
        assert ttc_s(one(-1), one(20), one(25)) == 0.0

    def test_rss_distance(self):
        # 15 + 2 * 0.75^2 / 2 + 21.5^2 / 8 - 20^2 / 8
        assert rss_distance_m(one(20), one(20), 0.75, 2.0, 4.0, 4.0) == pytest.approx(23.34375)
        assert rss_distance_m(one(5), one(40), 0.75, 2.0, 4.0, 4.0) == 0.0

    @pytest.mark.parametrize(
        ("gap_m", "wanted"),
        # Unsafe below 7.5 + 100 / 12, safe above 7.5 + 100 / 8.
        [(20.0, 0.0), (18.0, 0.48), (15.8, 1.0), (0.0, 1.0)],
    )
    def test_cfs(self, gap_m, wanted):
        assert cfs(one(gap_m), one(20), one(10), 0.75, 4.0, 6.0) == pytest.approx(wanted)

    def test_cfs_is_0_where_the_gap_opens(self):
        assert cfs(one(1), one(20), one(21), 0.75, 4.0, 6.0) == 0.0
        assert cfs(one(-1), one(20), one(21), 0.75, 4.0, 6.0) == 1.0

    @pytest.mark.parametrize(
        ("gap_m", "wanted"),
        # Unsafe below 2 + 15 + 200 / 6 - 200 / 7, safe above 2 + 15 + 200 / 4 - 200 / 7 + 2.
        [(40.5, 0.0), (30.0, (17.0 + 150.0 / 7.0 - 28.0) / (2.0 + 50.0 / 3.0)), (21.7, 1.0)],
    )
    def test_pfs(self, gap_m, wanted):
        assert pfs(one(gap_m), one(20), one(20), 0.75, 4.0, 6.0, 7.0, 2.0) == pytest.approx(wanted)


class TestModels:
    @pytest.mark.parametrize(("gap_m", "brakes"), [(9.9, True), (10.1, False)])
    def test_the_careful_driver_fears_a_time_to_collision_of_two_seconds(self, gap_m, brakes):
        found = started(CarefulVut).braking_mps2(one(gap_m), one(30), one(25))
        assert found == pytest.approx(0.774 * 9.81 if brakes else 0.0)

    @pytest.mark.parametrize(("gap_m", "brakes"), [(5.69, True), (5.71, False)])
    def test_reg157_waits_until_it_has_to(self, gap_m, brakes):
        # v_rel / 12 + 0.35 = 0.85 s at 6 m/s, and a step of 0.1 s.
        assert started(Reg157Vut).braking_mps2(one(gap_m), one(30), one(24)) == (
            6.0 if brakes else 0.0
        )

    def test_rss_keeps_its_distance_with_the_limits_of_the_scenario(self):
        rss = started(RssVut)
        assert rss.braking_mps2(one(23.3), one(20), one(20)) > 0.0
        assert rss.braking_mps2(one(23.4), one(20), one(20)) == 0.0

    def test_fsm_brakes_as_far_as_the_situation_is_unsafe(self):
        fsm = started(FsmVut, Scenario(a_min_mps2=-7.0))
        # CFS 0.48 between 4 and 6 m/s2.
        assert fsm.braking_mps2(one(18), one(20), one(10)) == pytest.approx(0.48 * 2.0 + 4.0)
        # PFS alone, up to 4 m/s2, with a leader that brakes by 7.
        proactive = (17.0 + 150.0 / 7.0 - 28.0) / (2.0 + 50.0 / 3.0)
        assert fsm.braking_mps2(one(30), one(20), one(20)) == pytest.approx(4.0 * proactive)


class TestReactions:
    def answers(self, driver, seen, steps):
        return [round(float(driver.act(seen)[0]), 4) for _ in range(steps)]

    def test_the_careful_driver_perceives_reacts_and_brakes_by_its_jerk(self):
        # Perceived after 0.4 s. What brakes after 1.1 s moves the car from 1.2 s on, the first step
        # after 1.15 s; within the 4 m/s2 of the scenario.
        slow = scene(-30.0 * level0_time_to(one(100), one(20))[0], 30.0, -100.0, 20.0)
        found = self.answers(started(CarefulVut), slow, 17)
        assert found == [1.0] * 4 + [0.0] * 7 + [-1.265, -2.53, -3.795, -4.0, -4.0, -4.0]

    def test_reg157_brakes_at_once_after_its_reaction_time(self):
        assert self.answers(started(Reg157Vut), at_m(0.0), 5) == [0.0] * 3 + [-4.0] * 2

    def test_who_has_reacted_stays_alert(self):
        careful = started(CarefulVut)
        assert self.answers(careful, at_m(0.0), 13)[-1] == -2.53
        assert careful.act(at_m(100.0)) == 0.0  # at its speed already
        assert self.answers(careful, at_m(0.0), 2) == [-1.265, -2.53]

    def test_who_takes_over_has_seen_nothing_yet(self):
        careful = started(CarefulVut)
        self.answers(careful, at_m(0.0), 13)
        careful.forget_risk(np.array([True]))
        assert self.answers(careful, at_m(0.0), 12) == [0.0] * 11 + [-1.265]

    def test_a_new_episode_begins_afresh(self):
        careful = started(CarefulVut)
        self.answers(careful, at_m(0.0), 13)
        careful.begin(0, CASE)
        assert self.answers(careful, at_m(0.0), 11) == [0.0] * 11

    def test_a_scenario_that_lets_them_brake_harder_does(self):
        hard = started(Reg157Vut, Scenario(a_min_mps2=-9.0))
        assert self.answers(hard, at_m(0.0), 5)[-1] == -6.0

    def test_who_cannot_fall_behind_any_more_goes_on(self):
        # 0.5 s before M full braking gains half a metre.
        assert self.answers(started(Reg157Vut), at_m(0.0, x_vut_m=-14.0), 6) == [0.0] * 6

    @pytest.mark.parametrize(
        ("driver", "dx_m", "brakes"),
        [
            # Fronts 10 m apart at M are a gap of 4 m, behind a POV that draws away by 2 m/s,
            (CarefulVut, 10.0, False),
            (RssVut, 10.0, True),
            # or ahead of one that comes nearer: in 2 s by 4 m.
            (CarefulVut, -9.9, True),
            (CarefulVut, -10.1, False),
            (RssVut, -20.0, True),
            (RssVut, -60.0, False),
        ],
    )
    def test_who_leads_at_m_must_not_make_another_run_into_it(self, driver, dx_m, brakes):
        found = self.answers(started(driver), at_m(dx_m), 14)[-1]
        assert (found < 0.0) == brakes

    def test_corridors_do_not_know_of_each_other(self):
        pair = Reg157Vut(2)
        for corridor in (0, 1):
            pair.begin(corridor, CASE)
        both = [
            np.array([a[0], b[0]])
            for a, b in ((at_m(0.0).x_m[row], at_m(100.0).x_m[row]) for row in (0, 1))
        ]
        state = both[0], np.full(2, 30.0), both[1], np.full(2, 28.0)
        seen = Scene.of_pair(np.ones(2, dtype=bool), np.zeros(2, dtype=int), *state)
        found = [pair.act(seen).tolist() for _ in range(5)]
        assert found[-1] == [-4.0, 0.0]


class TestTheCarefulPov:
    def test_falls_behind_a_vut_that_cuts_in(self):
        pov = started(CarefulPov)
        found = [float(pov.act(at_m(-5.0))[0]) for _ in range(14)]
        assert found[:11] == [0.0] * 11
        assert found[12] < found[11] < 0.0

    def test_goes_on_where_it_is_too_late(self):
        pov = started(CarefulPov)
        assert all(pov.act(at_m(3.0, x_vut_m=-14.0)) == 0.0 for _ in range(14))


@pytest.mark.parametrize("name", ["level0", *REFERENCES])
def test_only_the_blind_driver_collides_where_both_are_due_at_the_same_time(name):
    due_s = level0_time_to(one(182), one(18))[0]
    speeds = np.arange(25.0, 35.5, 2.0)
    cases = [Case(level=0, x_pov0_m=-v * due_s, v_pov0_mps=v) for v in speeds.tolist()]
    with plan_for(name, corridors=6).open() as ground:
        ends = [
            abs(ran.x_pov_m[-1] - ran.x_vut_m[-1]) < 6.0
            for _, ran in ground.run(cases)
            if ran.end is End.MERGED
        ]
    assert ends == [name == "level0"] * len(cases)
