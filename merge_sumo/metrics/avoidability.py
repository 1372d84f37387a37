"""Until when the VUT could have avoided a conflict at M."""

from __future__ import annotations

import numpy as np

from merge_sumo.metrics.merge import place_of_merge_m
from merge_sumo.scenario.scenario import DT_S, VUT
from merge_sumo.scenario.trajectory import Trajectory


def last_avoidable_s(trajectory: Trajectory) -> float | None:
    """Return the last time, in s, at which the VUT could still avoid a conflict; None without one.

    The POV never moves backwards, so of all ways to arrive at M the first and the last possible
    decide: the VUT passes in front at full acceleration, or waits at full braking. Both are
    rolled out from every step of the record at once. On an acceleration lane it is about the place
    where the VUT merged. In traffic every car has to be avoided, and
    gaps between cars are left out.

    Other cars move as recorded, and keep their last speed after that. The VUT moves by eq. (4), as
    in the record: by the speed before a step, so what it decides in one moves it from the next on.
    By the speed after the step the time would be a step later, and up to 0.5 s.
    """
    place_m = place_of_merge_m(trajectory)
    cars, scenario = np.delete(trajectory.motion, VUT, axis=1), trajectory.case.scenario
    steps = np.arange(1, scenario.max_steps + 1)[:, None]
    beyond = steps * (cars[-1, :, 1] * DT_S) + cars[-1, :, 0]
    x_cars = np.concatenate([cars[:, :, 0], beyond])
    starts = np.arange(len(cars) - 1)
    avoidable = np.zeros(len(starts), dtype=bool)
    for acceleration in (scenario.a_max_mps2, scenario.a_min_mps2):
        x, v = trajectory.x_vut_m[:-1].copy(), trajectory.v_vut_mps[:-1].copy()
        driving = np.ones(len(starts), dtype=bool)
        for ahead in range(1, scenario.max_steps + 1):
            x = x + v * DT_S
            v = np.maximum(v + acceleration * DT_S, 0.0)
            arrived = driving & (x >= place_m)
            dx = x_cars[starts[arrived] + ahead] - x[arrived, None]
            avoidable[arrived] |= (np.abs(dx) >= scenario.dx_crash_m).all(axis=1)
            driving &= ~arrived
            if not driving.any():
                break
            if acceleration < 0.0 and not v[driving].any():
                # These stop short of M and can wait there, if the POV moves on.
                avoidable[driving] |= bool((cars[-1, :, 1] > 0.0).all())
                break
    return round(float(starts[avoidable][-1]) * DT_S, 1) if avoidable.any() else None
