"""Contact, conflict, harsh and safe against a second calculation: polygons, and braking in steps.

It shares nothing with the package but the points of the lanes: rectangles are shapely's, contact
after M and braking are found by moving both cars in steps of a millisecond.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from plans import plan_for
from shapely import Polygon

from merge_sumo.engine.evaluate import run_cases
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import Pool
from merge_sumo.scenario.scenario import LEVELS
from merge_sumo.scenario.trajectory import Trajectory

LENGTH_M, WIDTH_M, NEAR_M = 5.0, 1.8, 6.0
REACTION_S, HARSH_MPS2, STEP_S = 0.75, 3.0, 0.001
CLOSE_CALL_M = 0.03
"""Nearer to a limit than this the steps of a millisecond cannot tell."""


def body(road: Corridor, front_m: float, *, on_ramp: bool) -> Polygon:
    """Return the rectangle of a car whose front bumper is at a lane coordinate."""
    front, rear = (road.lane_point(x, on_ramp=on_ramp) for x in (front_m, front_m - LENGTH_M))
    along = np.array([front.x_m - rear.x_m, front.y_m - rear.y_m])
    along = along / np.hypot(*along)
    across = np.array([-along[1], along[0]]) * WIDTH_M / 2.0
    nose = np.array([front.x_m, front.y_m])
    tail = nose - LENGTH_M * along
    return Polygon([nose + across, nose - across, tail - across, tail + across])


def overlap_before_m(road: Corridor, trajectory: Trajectory) -> float:
    """Return the largest area, in m2, that a car of the mainline and the VUT share before M."""
    largest, x_m = 0.0, trajectory.motion[:, :, 0]
    for row in range(x_m.shape[1]):
        for car, vut in zip(x_m[:, row].tolist(), x_m[:, 1].tolist(), strict=True):
            if row != 1 and vut < 0.0 and abs(car - vut) < 40.0:
                bodies = body(road, car, on_ramp=False), body(road, vut, on_ramp=True)
                largest = max(largest, bodies[0].intersection(bodies[1]).area)
    return largest


def after_m(dx_m: float, dv_mps: float, braking_mps2: float, until_s: float) -> float:
    """Return the smallest bumper gap behind M: the car behind reacts, then brakes.

    `dx_m` and `dv_mps` are those of the car ahead less those of the car behind.
    """
    time_s = np.arange(0.0, until_s, STEP_S)
    closing = np.where(time_s < REACTION_S, 0.0, -braking_mps2)
    speed = np.maximum(-dv_mps + np.cumsum(closing) * STEP_S, 0.0) if dv_mps < 0.0 else 0.0 * time_s
    return float((dx_m - LENGTH_M - np.cumsum(speed) * STEP_S).min())


def expected(trajectory: Trajectory) -> str | None:
    """Return the severity of a merge; None where it is too close to call."""
    motion = trajectory.motion
    (x_vut, v_vut), rest = motion[-1, 1, :2], np.delete(motion[-1, :, :2], 1, axis=0)
    pairs = [(x - x_vut, v - v_vut) if x >= x_vut else (x_vut - x, v_vut - v) for x, v in rest]
    drive_on_m = min(after_m(dx, dv, 0.0, REACTION_S) for dx, dv in pairs)
    braking_m = min(
        after_m(dx, dv, HARSH_MPS2, REACTION_S + max(-dv, 0.0) / HARSH_MPS2 + 0.1)
        for dx, dv in pairs
    )
    nearest_m = min(abs(x - x_vut) for x, _ in rest)
    near_calls = (drive_on_m, braking_m, nearest_m - NEAR_M)
    if min(map(abs, near_calls)) < CLOSE_CALL_M:
        return None
    if drive_on_m < 0.0:
        return "contact"
    if nearest_m < NEAR_M:
        return "conflict"
    return "harsh" if braking_m < 0.0 else "safe"


@pytest.mark.parametrize(
    ("scenario", "vut"),
    [("us23", "design1"), ("roundabout", "level0"), ("us23-traffic", "design2")],
)
def test_agrees_with_polygons_and_steps(scenario, vut):
    found = named_scenario(scenario)
    plan = plan_for(vut, scenario=found)
    count = 200
    cases = make_sampler("uniform", Pool(levels=LEVELS, scenario=found), 5).ask(count)
    told: Counter[str] = Counter()
    for ran in run_cases(plan, cases):
        measures = ran.outcome.measures
        assert (measures.impact_speed_mps is None) == (measures.severity != "contact")
        shared_m2 = overlap_before_m(plan.road, ran.trajectory)
        if shared_m2 == 0.0 or shared_m2 > 1e-3:
            assert (measures.before_clearance_m or 1.0) * (1.0 - 2.0 * (shared_m2 > 0.0)) > 0.0
        if not measures.end.is_tested:
            continue
        wanted = expected(ran.trajectory)
        if wanted is not None:
            assert measures.severity == wanted, (ran.trajectory.case, measures)
            told[wanted] += 1
    assert told.total() > 0.95 * count
