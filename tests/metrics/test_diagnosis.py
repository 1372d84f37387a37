"""Which vehicle braked, which kind of failure it was, and where failures lie: by hand."""

# mypy: no-strict-optional

from __future__ import annotations

import numpy as np
import pytest

from merge_sumo.campaigns.recorded import regions_of
from merge_sumo.metrics.cause import Diagnosis, Kind, diagnose
from merge_sumo.metrics.failure_regions import failure_regions
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, POV, US23, VUT
from merge_sumo.scenario.trajectory import End, Trajectory

STEPS = 81
LEVEL0 = np.ones(STEPS)
"""Accelerations of a level-0 VUT in a hand-made episode of 8 s: from 18 to 26 m/s."""


def phases(*parts: tuple[float, float]) -> np.ndarray:
    """Return accelerations from (seconds, m/s2) pairs; the last one lasts to the end."""
    a = np.concatenate([np.full(round(s / DT_S), value) for s, value in parts])
    return np.concatenate([a, np.full(STEPS, parts[-1][1])])[:STEPS]


def drive(x0: float, v0: float, a: np.ndarray) -> np.ndarray:
    """Return positions, speeds and accelerations by eq. (4), (T, 3)."""
    rows, x, v = [], x0, v0
    for acceleration in a:
        rows.append((x, v, acceleration))
        x, v = x + v * DT_S, max(v + acceleration * DT_S, 0.0)
    return np.array(rows)


def meeting(a_pov: np.ndarray, a_vut: np.ndarray, gap_m: float = 1.0) -> Trajectory:
    """Return an episode in which both arrive at M together, `gap_m` apart."""
    vut = drive(0.0, 18.0, a_vut)
    pov = drive(0.0, 30.0, a_pov)
    vut[:, 0] -= vut[-1, 0]
    pov[:, 0] += gap_m - pov[-1, 0]
    case = Case(level=1, x_pov0_m=float(pov[0, 0]), v_pov0_mps=30.0, scenario=US23)
    return Trajectory(case, np.stack([pov, vut], axis=1), End.MERGED)


def diagnosed(trajectory: Trajectory) -> Diagnosis:
    return diagnose(trajectory, Measures.of(trajectory))


KEEP = np.zeros(STEPS)
BRAKES = phases((3.0, 0.0), (5.0, -1.0))
COASTS = phases((2.0, 1.0), (6.0, 0.0))
EASES = phases((2.0, 1.0), (6.0, -0.5))


class TestWhichVehicleBrakes:
    @pytest.mark.parametrize(
        ("a_pov", "a_vut", "brakes_s", "accelerate"),
        [
            (KEEP, LEVEL0, (None, None), (False, True)),
            (BRAKES, COASTS, (3.0, None), (False, True)),
            (KEEP, phases((2.0, 1.0), (2.0, -2.0), (4.0, 1.0)), (None, 2.0), (False, False)),
        ],
    )
    def test_begins_where_its_speed_falls_and_does_not_accelerate(
        self, a_pov, a_vut, brakes_s, accelerate
    ):
        found = diagnosed(meeting(a_pov, a_vut))
        assert (found.pov.brakes_s, found.vut.brakes_s) == brakes_s
        assert (found.pov.accelerates, found.vut.accelerates) == accelerate

    def test_in_traffic_the_car_that_the_vut_meets(self):
        pair = meeting(BRAKES, LEVEL0)
        ahead = pair.motion[:, POV] + [60.0, 0.0, 0.0]
        # The POV keeps its speed far away; the car behind is the one that arrives with the VUT.
        pov = drive(-400.0, 30.0, KEEP)
        motion = np.stack([pov, pair.motion[:, VUT], ahead, pair.motion[:, POV]], axis=1)
        case = Case(
            level=1,
            x_pov0_m=-400.0,
            v_pov0_mps=30.0,
            headway_ahead_s=2.0,
            headway_behind_s=2.0,
            scenario=named_scenario("us23-traffic"),
        )
        met = Trajectory(case, motion, End.MERGED)
        assert Measures.of(met).nearest == "behind"
        assert diagnosed(met).pov.brakes_s == 3.0
        assert diagnosed(met).kind is Kind.POV_BRAKES

    def test_none_that_loses_less_than_1_mps(self):
        a_little = phases((3.0, 0.0), (0.9, -1.0), (4.1, 0.0))
        assert diagnosed(meeting(a_little, LEVEL0)).pov.brakes_s is None
        more = phases((3.0, 0.0), (1.0, -1.0), (4.0, 0.0))
        assert diagnosed(meeting(more, LEVEL0)).pov.brakes_s == 3.0

    def test_one_that_regains_its_speed_from_when_it_loses_it_again(self):
        twice = phases((1.0, 0.0), (0.5, -1.0), (0.5, 1.0), (2.0, 0.0), (4.0, -1.0))
        assert diagnosed(meeting(twice, LEVEL0)).pov.brakes_s == 4.0


class TestTheKind:
    def test_is_none_where_the_cars_are_6_m_apart(self):
        assert diagnosed(meeting(BRAKES, COASTS, gap_m=30.0)).kind is None


def outcome(index: int, x: float, v: float, failed: bool, level: int = 1) -> Outcome:
    """Return an outcome of a case at (x, v), with both cars at M or far apart."""
    svo = 0.5 if level == 2 else None
    case = Case(level=level, x_pov0_m=x, v_pov0_mps=v, svo_rad=svo, scenario=US23)
    gap = 0.0 if failed else 40.0
    motion = np.array(
        [[[gap - v * DT_S, v, 0.0], [-1.8, 18.0, 0.0]], [[gap, v, 0.0], [0.0, 18.0, 0.0]]]
    )
    return Outcome(index, 0, case, Measures.of(Trajectory(case, motion, End.MERGED)))


def over_the_pool(fails, level: int = 1) -> list[Outcome]:
    places = [(x, v) for x in np.linspace(-340, -180, 33) for v in np.linspace(25, 35, 21)]
    return [outcome(n, x, v, fails(x, v), level) for n, (x, v) in enumerate(places)]


class TestRegions:
    def test_are_told_by_the_quantities_that_lie_close_together(self):
        outcomes = over_the_pool(lambda x, v: 8.3 < -x / v < 8.8)
        (region,) = failure_regions(outcomes, 1, regions_of(outcomes))
        # The first start due is (-220 m, 26.5 m/s), the last (-255 m, 29 m/s).
        assert region.where == "POV due at M 8.30 to 8.79 s"
        assert region.failures == region.cases == region.failing == sum(o.failed for o in outcomes)

    def test_have_numbers_from_the_largest_and_are_not_those_of_another_level(self):
        def fails(x, v):
            return (x > -190 and v > 33) or (x < -330 and v < 26.6) or (x, v) == (-260, 30)

        outcomes = over_the_pool(fails, level=2)
        assert failure_regions(outcomes, 1, regions_of(outcomes)) == []
        first, second = failure_regions(outcomes, 2, regions_of(outcomes))
        assert (first.number, first.failures, second.number, second.failures) == (0, 8, 1, 8)
        bounds = "x_POV0 -185 to -180 m, v_POV0 33.5 to 35.0 m/s"
        assert second.where == f"POV due at M 5.14 to 5.52 s, {bounds}"

    def test_of_a_level_where_everything_fails_are_the_whole_pool(self):
        outcomes = over_the_pool(lambda x, v: True)
        (region,) = failure_regions(outcomes, 1, regions_of(outcomes))
        assert (region.where, region.failures, region.cases) == ("anywhere", 693, 693)
