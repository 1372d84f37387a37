"""Contact, conflict, harsh and safe against a second calculation: polygons, and rows of the motion.

It shares nothing with the package but the points of the lanes: rectangles are shapely's, their
first overlap is of any row of the motion, and braking after M follows from the recorded speeds.
"""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from shapely import Polygon
from support.plans import plan_for

from merge_sumo.metrics.bodies import encounters
from merge_sumo.road.loader import centre_lines
from merge_sumo.road.road import Road
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import FloatArray, Pool
from merge_sumo.scenario.scenario import LEVELS, VUT
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.evaluate import simulate

LENGTH_M, WIDTH_M, NEAR_M = 5.0, 1.8, 6.0
HARSH_MPS2, CLOSE_CALL = 3.0, 1e-6


def body(road: Road, front_m: float, *, on_ramp: bool) -> tuple[Polygon, FloatArray]:
    """Return the rectangle and the heading of a car with its front bumper at a lane coordinate."""
    front, rear = (road.lane_point(x, on_ramp=on_ramp) for x in (front_m, front_m - LENGTH_M))
    along = np.array([front.x_m - rear.x_m, front.y_m - rear.y_m])
    along = along / np.hypot(*along)
    across = np.array([-along[1], along[0]]) * WIDTH_M / 2.0
    nose = np.array([front.x_m, front.y_m])
    tail = nose - LENGTH_M * along
    return Polygon([nose + across, nose - across, tail - across, tail + across]), along


def first_overlap(road: Road, trajectory: Trajectory) -> tuple[int, float] | None:
    """Return the first row in which bodies overlap, and the speed of one relative to the other."""
    merge, whole = len(trajectory.motion) - 1, trajectory.whole
    for row, cars in enumerate(whole[:, :, :2]):
        x_vut, v_vut = cars[VUT].tolist()
        has_left = trajectory.case.scenario.lane_m is not None and row >= merge
        speeds = []
        for x, v in np.delete(cars, VUT, axis=0).tolist():
            if x_vut > -40.0 and abs(x - x_vut) < 40.0:
                other, along = body(road, x, on_ramp=False)
                own, heading = body(road, x_vut, on_ramp=not has_left)
                if other.intersection(own).area > 0.0:
                    speeds.append(float(np.hypot(*(v * along - v_vut * heading))))
        if speeds:
            return row, max(speeds)
    return None


def expected(trajectory: Trajectory) -> str | None:
    """Return the severity of a merge without a contact; None where it is too close to call."""
    assert trajectory.after is not None
    x_m, v_mps = trajectory.after[:, :, 0], trajectory.after[:, :, 1]
    cars = [row for row in range(x_m.shape[1]) if row != VUT]
    at_m = {car: float(x_m[0, car] - x_m[0, VUT]) for car in cars}
    nearest = min(cars, key=lambda car: abs(at_m[car]))
    behind = [car for car in cars if at_m[car] < 0.0] + [VUT] * (at_m[nearest] > 0.0)
    falls_mps = -np.diff(v_mps[:, behind], axis=0)
    hardest_mps2 = float(falls_mps.max(initial=0.0)) / 0.1
    near_m = abs(at_m[nearest]) - NEAR_M
    if min(abs(near_m), abs(hardest_mps2 - HARSH_MPS2)) < CLOSE_CALL:
        return None
    if near_m < 0.0:
        return "conflict"
    return "harsh" if hardest_mps2 > HARSH_MPS2 else "safe"


@pytest.mark.parametrize(
    ("scenario", "vut"),
    [
        ("us23", "design1"),
        ("roundabout", "level0"),
        ("us23-traffic", "design2"),
        ("us23-lane", "sumo:IDM"),
    ],
)
def test_agrees_with_polygons_and_steps(scenario, vut):
    found = named_scenario(scenario)
    plan = plan_for(vut, scenario=found)
    count = 200
    cases = make_sampler("uniform", Pool(levels=LEVELS, scenario=found), 5).ask(count)
    agreed: Counter[str] = Counter()
    for ran in simulate(plan, cases):
        measures = ran.outcome.measures
        assert (measures.impact_speed_mps is None) == (measures.severity != "contact")
        overlap = first_overlap(plan.road, ran.trajectory)
        if overlap is not None:
            (met,) = encounters([ran.trajectory], centre_lines(plan.road))
            assert met.row == overlap[0]
            assert met.impact_mps == pytest.approx(overlap[1])
            assert measures.impact_speed_mps == met.impact_mps
        elif measures.end is not End.MERGED:
            continue
        wanted = expected(ran.trajectory) if overlap is None else "contact"
        if wanted is not None:
            assert measures.severity == wanted, (ran.trajectory.case, measures)
            assert ((measures.clearance_m or math.inf) <= 0.0) == (wanted == "contact")
            agreed[wanted] += 1
    assert agreed.total() > 0.95 * count
