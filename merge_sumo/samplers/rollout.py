"""Rollouts by eq. (4), against the very POVs of the levels, without SUMO."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.following import keep_safe
from merge_sumo.drivers.levelk import DECISION_STEPS, QNetwork, actions_mps2, feature_columns
from merge_sumo.drivers.policies import load_network
from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.metrics.criterion import PAPER_CRITERION, Criterion
from merge_sumo.metrics.merge import REACTION_S
from merge_sumo.samplers.observation import Inputs, Observation
from merge_sumo.scenario.case import FloatArray, Pool
from merge_sumo.scenario.scenario import AHEAD, BEHIND, DT_S, POV, VUT
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.povs import POLICIES, Povs

Answer = Callable[[Inputs, NDArray[np.int64]], FloatArray]
"""Gives accelerations of the VUT, (R,), by inputs, (R, inputs), and the numbers of the cases."""
FAR: Final = 5.0
"""Distance behind M of all other cars, in units of the limit, from which a case cannot fail."""
SLOWEST_MPS: Final = 0.5
"""Speed at which a VUT that stands goes on, to estimate the gap of a case that cannot fail."""
STILL: Final = 0.92
"""Share of rows that still move below which the others are dropped."""


class ModelRollout:
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
        """Return whether the POV of a level is known, and not a program of the user.

        A rollout ends at M: none is possible where the VUT chooses the place of the merge.
        """
        known = level == 0 or level in self._networks
        return known and self._scenario.lane_m is None

    def _starts(self, level: int, points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
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

    def play(self, points: Mapping[int, FloatArray], copies: int, answer: Answer) -> FloatArray:
        """Roll cases out; all step together, as arrays.

        Args:
            points: cases of the unit cube by level, (n, d) each; N of all levels.
            copies: how often each is rolled out.
            answer: the VUT; rows 0 to N - 1 are the first copy of each case.

        Returns:
            Signed gaps (`Outcome.signed_gap`), (copies, N); NaN where the VUT never arrives.
        """
        if self._by_gap:
            gap_m = self._play(points, copies, answer)
            return gap_m.reshape(copies, -1) / self._scenario.dx_crash_m
        played: list[FloatArray] = []
        gap_m = self._play(points, copies, answer, played)
        motion, gaps = np.array(played), np.empty(len(gap_m))
        cases = [case for level, of in points.items() for case in self._pool.cases(of, level)]
        for row, case in enumerate(cases * copies):
            arrived = motion[:, VUT, 0, row] >= 0.0
            last = int(arrived.argmax()) if arrived.any() else len(motion) - 1
            of_row = motion[: last + 1, :, :, row].copy()
            of_row[-1, :, 2] = 0.0
            end, after = End.TIMEOUT, None
            if not np.isnan(gap_m[row]):
                end, after = End.MERGED, self._drives_on(of_row[-1])
            trajectory = Trajectory(case, of_row, end, after=after)
            gaps[row] = self._criterion.judged(trajectory, self._lines).signed_gap
        return gaps.reshape(copies, -1)

    def _drives_on(self, at_m: FloatArray) -> FloatArray | None:
        """Predict the follow-up of a state at M, (A, 3): all keep their speeds for a reaction."""
        steps = round(min(REACTION_S, self._scenario.follow_up_s) / DT_S)
        after = np.tile(at_m, (steps + 1, 1, 1))
        after[:, :, 0] += DT_S * np.arange(steps + 1)[:, None] * at_m[:, 1]
        return after if steps else None

    def _play(
        self,
        points: Mapping[int, FloatArray],
        copies: int,
        answer: Answer,
        played: list[FloatArray] | None = None,
    ) -> FloatArray:
        """Return the gaps at M, (R,); add every step, (A, 3, R), to what is `played`."""
        scenario = self._scenario
        starts = [self._starts(level, of_level) for level, of_level in points.items()]
        x_m, v_mps, svo_rad = (
            np.tile(np.concatenate(of_all, axis=-1), copies) for of_all in zip(*starts, strict=True)
        )
        levels = np.tile(np.repeat(list(points), list(map(len, points.values()))), copies)
        rows = np.arange(len(levels))
        gap_m = np.full(len(rows), np.nan)
        cars = [row for row in range(len(x_m)) if row != VUT]
        a_mps2 = np.zeros_like(x_m)
        held = np.zeros((len(cars), len(rows)))
        observation = Observation(scenario, len(rows))
        taken_m, decel = scenario.pov_length_m + scenario.min_gap_m, -scenario.a_min_mps2
        for step in range(scenario.max_steps):
            inputs = observation.see(x_m, v_mps, a_mps2[VUT])
            if step % DECISION_STEPS == 0:
                for level, network in self._networks.items():
                    of_level = np.flatnonzero(levels == level)
                    if len(of_level):
                        states = x_m[:, of_level], v_mps[:, of_level], svo_rad[of_level]
                        held[:, of_level] = self._decisions(network, cars, *states)
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
            ended = x_m[VUT] >= 0.0
            if played is None:
                ended |= x_m[cars].min(axis=0) > FAR * scenario.dx_crash_m
            going = np.isnan(gap_m[rows])
            ended &= going
            if ended.any():
                gap_m[rows[ended]] = _gap_at_merge_m(x_m[:, ended], v_mps[:, ended])
                going &= ~ended
                if not going.any():
                    break
                if played is None and going.mean() < STILL:
                    rows, levels, svo_rad = rows[going], levels[going], svo_rad[going]
                    x_m, v_mps, a_mps2 = x_m[:, going], v_mps[:, going], a_mps2[:, going]
                    held = held[:, going]
                    observation.keep(going)
        if played is not None:
            played.append(np.stack((x_m, v_mps, np.zeros_like(x_m)), axis=1))
        return gap_m

    def _decisions(
        self,
        network: QNetwork,
        cars: list[int],
        x_m: FloatArray,
        v_mps: FloatArray,
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


def _gap_at_merge_m(x_m: FloatArray, v_mps: FloatArray) -> FloatArray:
    """Return the gap, (R,), to the car nearest to the VUT at M, in states (A, R).

    A VUT that has not arrived goes on at its speed.
    """
    left_s = np.maximum(-x_m[VUT], 0.0) / np.maximum(v_mps[VUT], SLOWEST_MPS)
    gaps = np.delete(x_m + v_mps * left_s, VUT, axis=0) - np.maximum(x_m[VUT], 0.0)
    nearest = np.abs(gaps).argmin(axis=0)
    return np.asarray(gaps[nearest, np.arange(gaps.shape[1])], dtype=np.float64)
