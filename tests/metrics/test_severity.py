"""Contact, conflict, harsh and safe against a second calculation: polygons, and rows of the motion.

It shares nothing with the package but the points of the lanes: rectangles are shapely's, gaps and
braking after M follow from the recorded places and speeds.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from shapely import Polygon
from support.plans import plan_for

from merge_sumo.road.road import Road
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import Pool
from merge_sumo.scenario.scenario import LEVELS, VUT
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.evaluate import simulate

LENGTH_M, WIDTH_M, NEAR_M = 5.0, 1.8, 6.0
HARSH_MPS2, CLOSE_CALL = 3.0, 1e-6


def body(road: Road, front_m: float, *, on_ramp: bool) -> Polygon:
    """Return the rectangle of a car whose front bumper is at a lane coordinate."""
    front, rear = (road.lane_point(x, on_ramp=on_ramp) for x in (front_m, front_m - LENGTH_M))
    along = np.array([front.x_m - rear.x_m, front.y_m - rear.y_m])
    along = along / np.hypot(*along)
    across = np.array([-along[1], along[0]]) * WIDTH_M / 2.0
    nose = np.array([front.x_m, front.y_m])
    tail = nose - LENGTH_M * along
    return Polygon([nose + across, nose - across, tail - across, tail + across])


def overlap_before_m(road: Road, trajectory: Trajectory) -> float:
    """Return the largest area, in m2, that a car of the mainline and the VUT share before M."""
    largest, x_m = 0.0, trajectory.motion[:, :, 0]
    for row in range(x_m.shape[1]):
        for car, vut in zip(x_m[:, row].tolist(), x_m[:, 1].tolist(), strict=True):
            if row != 1 and vut < 0.0 and abs(car - vut) < 40.0:
                bodies = body(road, car, on_ramp=False), body(road, vut, on_ramp=True)
                largest = max(largest, bodies[0].intersection(bodies[1]).area)
    return largest


def expected(trajectory: Trajectory) -> str | None:
    """Return the severity of a merge by its rows after M; None where it is too close to call."""
    assert trajectory.after is not None
    x_m, v_mps = trajectory.after[:, :, 0], trajectory.after[:, :, 1]
    cars = [row for row in range(x_m.shape[1]) if row != VUT]
    at_m = {car: float(x_m[0, car] - x_m[0, VUT]) for car in cars}
    nearest = min(cars, key=lambda car: abs(at_m[car]))
    behind = [car for car in cars if at_m[car] < 0.0] + [VUT] * (at_m[nearest] > 0.0)
    distance_m = np.abs(np.delete(x_m, VUT, axis=1) - x_m[:, [VUT]])
    least_m = float(distance_m.min()) - LENGTH_M
    falls_mps = -np.diff(v_mps[:, behind], axis=0)
    hardest_mps2 = float(falls_mps.max(initial=0.0)) / 0.1
    near_m = abs(at_m[nearest]) - NEAR_M
    if min(abs(least_m), abs(near_m), abs(hardest_mps2 - HARSH_MPS2)) < CLOSE_CALL:
        return None
    if least_m < 0.0:
        return "contact"
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
        shared_m2 = overlap_before_m(plan.road, ran.trajectory)
        if shared_m2 == 0.0 or shared_m2 > 1e-3:
            assert (measures.before_clearance_m or 1.0) * (1.0 - 2.0 * (shared_m2 > 0.0)) > 0.0
        if measures.end is not End.MERGED:
            continue
        wanted = expected(ran.trajectory)
        if wanted is not None:
            assert measures.severity == wanted, (ran.trajectory.case, measures)
            agreed[wanted] += 1
    assert agreed.total() > 0.95 * count
