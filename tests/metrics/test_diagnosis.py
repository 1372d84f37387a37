"""Which vehicle braked, which kind of failure it was, and where failures lie: by hand."""

# mypy: no-strict-optional

from __future__ import annotations

import numpy as np
import pytest

from merge_sumo.metrics.cause import Diagnosis, Kind, diagnose
from merge_sumo.metrics.failure_boxes import failure_boxes
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


class TestBoxes:
    def test_of_a_band_of_equal_arrival_speak_of_the_time(self):
        outcomes = over_the_pool(lambda x, v: 8.3 < -x / v < 8.8)
        (box,) = failure_boxes(outcomes, 1)
        assert box.failures == sum(o.failed for o in outcomes)
        assert box.where == "POV due at M (at constant speed) between 8.29 and 8.80 s"
        inside = [o for o in outcomes if 8.29 <= -o.case.x_pov0_m / o.case.v_pov0_mps <= 8.8]
        assert box.indices == tuple(o.index for o in inside)

    def test_of_another_level_are_not_mixed_in(self):
        outcomes = over_the_pool(lambda x, v: x > -200, level=2)
        assert failure_boxes(outcomes, 1) == []
        assert failure_boxes(outcomes, 2)[0].level == 2

    def test_of_a_level_where_everything_fails_are_the_whole_pool(self):
        (box,) = failure_boxes(over_the_pool(lambda x, v: True), 1)
        assert (box.where, box.failures) == ("anywhere", box.cases)
