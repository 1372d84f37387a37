"""Rollouts by eq. (4), against the very POVs of the levels, without SUMO."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.following import keep_safe
from merge_sumo.drivers.levelk import (
    DECISION_STEPS,
    QNetwork,
    actions_mps2,
    feature_columns,
)
from merge_sumo.drivers.policies import load_network
from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.metrics.criterion import PAPER_CRITERION, Criterion
from merge_sumo.metrics.merge import REACTION_S
from merge_sumo.samplers.observation import Inputs, Observation
from merge_sumo.scenario.case import FloatArray, Pool
from merge_sumo.scenario.scenario import AHEAD, BEHIND, DT_S, POV, VUT, MergeScenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.povs import POLICIES, Povs

Answer = Callable[[Inputs, NDArray[np.int64]], FloatArray]
"""Gives accelerations of the VUT, (R,), by inputs, (R, inputs), and the numbers of the cases."""
STILL: Final = 0.92
"""Share of rows that still move below which the others are dropped."""


class TwinRollout:
    """Rolls cases of a pool out against a VUT that is given as a function."""

    def __init__(
        self,
        pool: Pool,
        povs: Povs,
        criterion: Criterion = PAPER_CRITERION,
        lines: CentreLines | None = None,
    ) -> None:
        """Take the pool, the POVs, what counts as a failure, and the road's centre lines."""
        self._pool, self._scenario = pool, pool.scenario
        self._criterion, self._lines = criterion, lines
        self._by_gap = criterion.is_papers
        self._networks = {
            level: load_network(POLICIES[level], povs.policies)
            for level in set(povs.levels) & set(POLICIES)
        }

    def can_predict(self, level: int) -> bool:
        """Return whether the POV of a level is known, and not a program of a person's own.

        A rollout is of a merge and ends at M: none is possible of other kinds of scenarios, or
        where the VUT chooses the place.
        """
        known = level == 0 or level in self._networks
        return known and isinstance(self._scenario, MergeScenario) and not self._scenario.lane_m

    def _starts(self, points: FloatArray, level: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return x and v, (A, n), and psi, (n,), of cases, (n, d), of the unit cube."""
        scenario = self._scenario
        values = {
            d.field: d.low + u * (d.high - d.low)
            for d, u in zip(scenario.dimensions(level), points.T, strict=True)
        }
        n, v_vut0_mps = len(points), scenario.bounds("v_vut0_mps")[0]
        x_m, v_mps = np.zeros((2, scenario.vehicles, n))
        x_m[POV], v_mps[POV] = values["x_pov0_m"], values["v_pov0_mps"]
        x_m[VUT] = scenario.x_vut0_m
        v_mps[VUT] = values.get("v_vut0_mps", v_vut0_mps)
        if scenario.vehicles > 2:
            v_mps[[AHEAD, BEHIND]] = v_mps[POV]
            x_m[AHEAD] = x_m[POV] + values["headway_ahead_s"] * v_mps[POV]
            x_m[BEHIND] = x_m[POV] - values["headway_behind_s"] * v_mps[POV]
        return x_m, v_mps, values.get("svo_rad", np.zeros(n))

    def play(self, level: int, points: FloatArray, answer: Answer) -> FloatArray:
        """Return the signed gaps of cases, (n, d), of a level: see `Outcome.signed_gap`, (n,).

        All step together, as arrays. NaN where the VUT never arrives.
        """
        if self._by_gap:
            return self._play(level, points, answer) / self._scenario.dx_crash_m
        played: list[FloatArray] = []
        gap_m = self._play(level, points, answer, played)
        motion = np.array(played)
        found = np.empty(len(gap_m))
        for row, case in enumerate(self._pool.cases(points, level)):
            arrived = motion[:, VUT, 0, row] >= 0.0
            last = int(arrived.argmax()) if arrived.any() else len(motion) - 1
            of_row = motion[: last + 1, :, :, row].copy()
            of_row[-1, :, 2] = 0.0
            end, after = End.TIMEOUT, None
            if not np.isnan(gap_m[row]):
                end, after = End.MERGED, self._drives_on(of_row[-1])
            found_of = Trajectory(case, of_row, end, after=after)
            judged = self._criterion.judged(found_of, self._lines)
            found[row] = judged.signed_gap
        return found

    def _drives_on(self, at_m: FloatArray) -> FloatArray | None:
        """Predict the follow-up of a state at M, (A, 3): all keep their speeds for a reaction."""
        steps = round(min(REACTION_S, self._scenario.follow_up_s) / DT_S)
        after = np.tile(at_m, (steps + 1, 1, 1))
        after[:, :, 0] += DT_S * np.arange(steps + 1)[:, None] * at_m[:, 1]
        return after if steps else None

    def _play(
        self,
        level: int,
        points: FloatArray,
        answer: Answer,
        played: list[FloatArray] | None = None,
    ) -> FloatArray:
        """Return the gaps at M, (R,); add every step, (A, 3, R), to what is `played`."""
        scenario, network = self._scenario, self._networks.get(level)
        x_m, v_mps, svo_rad = self._starts(points, level)
        rows = np.arange(len(points))
        gap_m = np.full(len(rows), np.nan)
        cars = [row for row in range(len(x_m)) if row != VUT]
        a_mps2 = np.zeros_like(x_m)
        held = np.zeros((len(cars), len(rows)))
        observation = Observation(scenario, len(rows))
        taken_m, decel = scenario.pov_length_m + scenario.min_gap_m, -scenario.a_min_mps2
        for step in range(scenario.max_steps):
            inputs = observation.see(x_m, v_mps, a_mps2[VUT])
            if network is not None and step % DECISION_STEPS == 0:
                held = self._decisions(network, x_m, v_mps, cars, svo_rad)
            a_mps2[cars] = held
            if len(cars) > 1:
                keep_safe(a_mps2, x_m, v_mps, taken_m, decel, scenario.tau_s)
            a_mps2[VUT] = answer(inputs, rows)
            a_mps2 = np.clip(a_mps2, scenario.a_min_mps2, scenario.a_max_mps2)
            v_next = np.maximum(v_mps + a_mps2 * DT_S, 0.0)
            x_before_m, x_m = x_m, x_m + v_mps * DT_S
            # What is recorded of a vehicle that comes to a stand.
            a_mps2 = np.maximum(a_mps2, v_mps / -DT_S)
            if played is not None:
                played.append(np.stack((x_before_m, v_mps, a_mps2), axis=1))
            v_mps = v_next
            arrived = x_m[VUT] >= 0.0
            if arrived.any():
                gaps = x_m[cars][:, arrived] - x_m[VUT, arrived]
                nearest = np.abs(gaps).argmin(axis=0)
                known = rows[arrived]
                fresh = np.isnan(gap_m[known])
                gap_m[known[fresh]] = gaps[nearest, np.arange(gaps.shape[1])][fresh]
                going = np.isnan(gap_m[rows])
                if not going.any():
                    break
                if played is None and going.mean() < STILL:
                    rows, svo_rad = rows[going], svo_rad[going]
                    x_m, v_mps, a_mps2 = x_m[:, going], v_mps[:, going], a_mps2[:, going]
                    held = held[:, going]
                    observation.keep(going)
        if played is not None:
            played.append(np.stack((x_m, v_mps, np.zeros_like(x_m)), axis=1))
        return gap_m

    def _decisions(
        self,
        network: QNetwork,
        x_m: FloatArray,
        v_mps: FloatArray,
        cars: list[int],
        svo_rad: FloatArray,
    ) -> FloatArray:
        """Return what the cars of the mainline choose, (C, R), in states, (A, R)."""
        limited, count = network.limited(self._scenario), len(cars)
        features = feature_columns(
            x_m[cars].ravel(),
            v_mps[cars].ravel(),
            np.tile(x_m[VUT], count),
            np.tile(v_mps[VUT], count),
            np.tile(svo_rad, count) if network.sees_svo else None,
            scenario=limited,
        )
        chosen = network.values_at_once(np.array(features).T).argmax(axis=1)
        held_mps2: FloatArray = actions_mps2(limited)[chosen].reshape(count, -1)
        return held_mps2
