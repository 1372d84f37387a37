"""A model of the controller: trees learn its accelerations, and roll cases out against the POVs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.car_following import conflicting_car, keep_safe
from merge_sumo.drivers.levelk import (
    DECISION_STEPS,
    QNetwork,
    actions_mps2,
    prospects,
)
from merge_sumo.drivers.policies import load_network
from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.metrics.criterion import PAPER_CRITERION, Criterion
from merge_sumo.metrics.fmc import BoolArray, IntArray
from merge_sumo.metrics.merge import REACTION_S
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.regression import regression_gaps
from merge_sumo.scenario.case import Case, FloatArray, Pool
from merge_sumo.scenario.scenario import AHEAD, BEHIND, DT_S, POV, VUT, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.povs import POLICIES, Povs

# Members of the ensemble with the same inputs.
GROUPS = 4
# Steps, 0.3, 0.6 and 1 s, after which a slow controller may react to a state.
LAGS = (3, 6, 10)
# Accelerations before the last one that are inputs.
EARLIER = 4
# Inputs of the past, at the end of each row.
PAST_INPUTS = 4 + EARLIER + 4 * len(LAGS)
# Distance of all other cars after the merge point, in units of the limit, from which a case cannot
# fail.
FAR = 5.0

Inputs = NDArray[np.float32]
Drive = Callable[[Inputs], FloatArray]
"""Gives accelerations of the VUT, (R,), for inputs, (R, inputs)."""


class TreeInputs:
    """The inputs of the trees in R episodes that advance together.

    The first inputs are the last acceleration, the state, and the predictions that follow from
    them. The last ones, `PAST_INPUTS`, describe the past: a controller with a delay or a memory
    decides by it, too.

    Example:
        tree_inputs = TreeInputs(US23, rows=1)
        inputs = tree_inputs.step(x_m, v_mps, a_last_mps2)
    """

    def __init__(self, scenario: Scenario, rows: int) -> None:
        """Begin episodes.

        Args:
            scenario: their scenario.
            rows: number of episodes, R.
        """
        self._scenario = scenario
        self._step = 0
        # A ring buffer of the last steps, (steps, 5, R).
        self._past = np.empty((1 + max(LAGS), 5, rows), dtype=np.float32)
        self._since_jump = np.zeros(rows)
        self._lowest = np.zeros(rows)
        self._highest = np.zeros(rows)

    def keep(self, rows: BoolArray) -> None:
        """Drop episodes.

        Args:
            rows: which episodes are kept, (R,).
        """
        self._past = self._past[:, :, rows]
        self._since_jump = self._since_jump[rows]
        self._lowest = self._lowest[rows]
        self._highest = self._highest[rows]

    def step(self, x_m: FloatArray, v_mps: FloatArray, a_last_mps2: FloatArray) -> Inputs:
        """Take the next states and return the inputs.

        Args:
            x_m: positions in m, (A, R).
            v_mps: speeds in m/s, (A, R).
            a_last_mps2: last accelerations of the VUT in m/s2, (R,).

        Returns:
            The inputs, (R, inputs).
        """
        scenario = self._scenario
        x_pov, v_pov, x_vut, v_vut = x_m[POV], v_mps[POV], x_m[VUT], v_mps[VUT]
        traffic = []
        if len(x_m) > 2:
            conflicting = conflicting_car(x_m, v_mps, scenario)
            rows = np.arange(len(conflicting))
            x_pov, v_pov = x_m[conflicting, rows], v_mps[conflicting, rows]
            traffic.append(conflicting)
            for car in (POV, AHEAD, BEHIND):
                traffic += [x_m[car] - x_vut, v_mps[car]]
        times_s, gaps_m, v_level0, v_full = prospects((x_pov, v_pov, x_vut, v_vut), scenario)
        inputs = [a_last_mps2, x_pov - x_vut, v_pov - v_vut, x_pov, v_pov, x_vut, v_vut, *times_s]
        for gap_m in gaps_m:
            # Small gaps decide; larger ones are compressed beyond 80 m.
            inputs.append(gap_m / (1.0 + np.abs(gap_m) / 80.0))
        inputs += [v_level0, v_full, *traffic]

        # Distance, closing speed, gap on the level-0 profile, speed and acceleration.
        remembered = np.array([inputs[row] for row in (1, 2, 10, 6, 0)], dtype=np.float32)
        past, now = self._past, self._step
        if now == 0:
            past[:] = remembered
        # A change of the acceleration within a step that is a new decision.
        jumped = np.abs(remembered[4] - past[(now - 1) % len(past), 4]) > 0.25
        past[now % len(past)] = remembered
        self._since_jump = np.where(jumped, 0.0, self._since_jump + 1.0)
        self._lowest = np.minimum(self._lowest, a_last_mps2)
        self._highest = np.maximum(self._highest, a_last_mps2)
        step = np.full_like(a_last_mps2, now)
        inputs += [step, self._since_jump, self._lowest, self._highest]
        for lag in range(1, 1 + EARLIER):
            inputs.append(past[(now - lag) % len(past), 4])
        for lag in LAGS:
            inputs += [*past[(now - lag) % len(past), :4]]
        self._step += 1
        return np.array(inputs, dtype=np.float32).T


class ModelRollout:
    """Rolls cases of a pool out by eq. (4), without SUMO, against the POVs of the levels.

    Example:
        ModelRollout(pool, povs).play({0: points}, [lambda inputs: np.zeros(len(inputs))])
    """

    def __init__(
        self,
        pool: Pool,
        povs: Povs,
        criterion: Criterion = PAPER_CRITERION,
        lines: CentreLines | None = None,
    ) -> None:
        """Load the networks of the POVs.

        Args:
            pool: the cases.
            povs: the drivers of the POV.
            criterion: condition of a failure.
            lines: centre lines of the road.
        """
        self._pool, self.scenario = pool, pool.scenario
        self._criterion, self._lines = criterion, lines
        self._networks: dict[int, QNetwork] = {}
        for level in set(povs.levels) & set(POLICIES):
            self._networks[level] = load_network(POLICIES[level], povs.policies)

    def can_predict(self, level: int) -> bool:
        """Return whether the POV of a level is known, and not a program of the user.

        A rollout ends at M: none is possible where the VUT chooses the place of the merge.

        Args:
            level: level of the POV.
        """
        known = level == 0 or level in self._networks
        return known and self.scenario.lane_m is None

    def play(self, points: Mapping[int, FloatArray], drives: Sequence[Drive]) -> FloatArray:
        """Roll each case out with each controller; all advance together, as arrays.

        Args:
            points: cases of the unit cube by level, (n, d) each; N cases of all levels.
            drives: the controllers.

        Returns:
            Signed gaps (`Outcome.signed_gap`), (controllers, N); NaN where the VUT never arrives.
        """
        if self._criterion.is_of_paper:
            gaps_m, _ = self._play(points, drives)
            return gaps_m.reshape(len(drives), -1) / self.scenario.dx_crash_m
        cases: list[Case] = []
        for level, of_level in points.items():
            cases += self._pool.cases(of_level, level)
        cases *= len(drives)
        steps = self.scenario.max_steps
        motion = np.zeros((steps + 1, self.scenario.vehicles, 3, len(cases)))
        gaps_m, last = self._play(points, drives, motion)
        trajectories = []
        for row, case in enumerate(cases):
            of_row = motion[: last[row] + 1, :, :, row].copy()
            end, after = End.TIMEOUT, None
            if not np.isnan(gaps_m[row]):
                end, after = End.MERGED, self._follow_up(of_row[-1])
            trajectories.append(Trajectory(case, of_row, end, after=after))
        outcomes = self._criterion.outcomes(trajectories, self._lines)
        gaps = [outcome.signed_gap for outcome in outcomes]
        return np.array(gaps, dtype=np.float64).reshape(len(drives), -1)

    def _follow_up(self, at_m: FloatArray) -> FloatArray | None:
        """Predict the motion after a state at M, (A, 3): all keep their speeds for a reaction."""
        steps = round(min(REACTION_S, self.scenario.follow_up_s) / DT_S)
        after = np.tile(at_m, (steps + 1, 1, 1))
        after[:, :, 0] += DT_S * np.arange(steps + 1)[:, None] * at_m[:, 1]
        return after if steps else None

    def _starts(self, level: int, points: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return states (x, v, a), (3, A, n), psi and level, (n,), of cases, (n, d)."""
        scenario = self.scenario
        values = {}
        for dimension, units in zip(scenario.dimensions(level), points.T, strict=True):
            values[dimension.field] = dimension.low + units * (dimension.high - dimension.low)
        n, (v_vut0_mps, _) = len(points), scenario.bounds("v_vut0_mps")
        states = np.zeros((3, scenario.vehicles, n))
        x_m, v_mps, _ = states
        x_m[POV], v_mps[POV] = values["x_pov0_m"], values["v_pov0_mps"]
        x_m[VUT] = scenario.x_vut0_m
        v_mps[VUT] = values.get("v_vut0_mps", v_vut0_mps)
        if scenario.vehicles > 2:
            v_mps[[AHEAD, BEHIND]] = v_mps[POV]
            x_m[AHEAD] = x_m[POV] + values["headway_ahead_s"] * v_mps[POV]
            x_m[BEHIND] = x_m[POV] - values["headway_behind_s"] * v_mps[POV]
        return states, values.get("svo_rad", np.zeros(n)), np.full(n, level)

    def _play(
        self,
        points: Mapping[int, FloatArray],
        drives: Sequence[Drive],
        motion: FloatArray | None = None,
    ) -> tuple[FloatArray, IntArray]:
        """Roll each case out with each controller in turn: R rows.

        Args:
            points: cases of the unit cube by level, (n, d) each.
            drives: the controllers.
            motion: filled with the states, (steps + 1, A, 3, R). Without it a case also ends where
                it cannot fail any more.

        Returns:
            Gaps at M in m, (R,), NaN where the VUT never arrives, and last steps, (R,).
        """
        scenario = self.scenario
        starts = []
        for level, of_level in points.items():
            starts.append(self._starts(level, of_level))
        parts = [np.concatenate(part, axis=-1) for part in zip(*starts, strict=True)]
        states, svo_rad, levels = (np.tile(part, len(drives)) for part in parts)
        x_m, v_mps, a_mps2 = states
        rows = np.arange(len(levels))
        bounds = np.arange(len(drives) + 1) * (len(rows) // len(drives))
        gap_m = np.full(len(rows), np.nan)
        last = np.full(len(rows), scenario.max_steps)
        cars = np.flatnonzero(np.arange(len(x_m)) != VUT)
        held_mps2 = np.zeros((len(cars), len(rows)))
        tree_inputs = TreeInputs(scenario, len(rows))
        for step in range(scenario.max_steps):
            inputs = tree_inputs.step(x_m, v_mps, a_mps2[VUT])
            if step % DECISION_STEPS == 0:
                for level, network in self._networks.items():
                    at = np.flatnonzero(levels[rows] == level)
                    if len(at):
                        held_mps2[:, at] = self._decisions(
                            network, cars, x_m[:, at], v_mps[:, at], svo_rad[rows[at]]
                        )
            a_mps2[cars] = held_mps2
            if len(cars) > 1:
                keep_safe(a_mps2, x_m, v_mps, scenario)
            # The rows of a drive that still advance follow each other.
            firsts = np.searchsorted(rows, bounds).tolist()
            for drive, first, end in zip(drives, firsts[:-1], firsts[1:], strict=True):
                a_mps2[VUT, first:end] = np.ravel(drive(inputs[first:end]))
            np.clip(a_mps2, scenario.a_min_mps2, scenario.a_max_mps2, out=a_mps2)
            v_next_mps = np.maximum(v_mps + a_mps2 * DT_S, 0.0)
            # The recorded acceleration of a vehicle that comes to a stand.
            np.maximum(a_mps2, v_mps / -DT_S, out=a_mps2)
            if motion is not None:
                motion[step][:, :, rows] = states.transpose(1, 0, 2)
            x_m += v_mps * DT_S
            v_mps[:] = v_next_mps
            ended = x_m[VUT] >= 0.0
            if motion is None:
                ended |= x_m[cars].min(axis=0) > FAR * scenario.dx_crash_m
            else:
                motion[step + 1][:, :2, rows] = states[:2].transpose(1, 0, 2)
            if ended.any():
                gap_m[rows[ended]] = _gap_at_merge_m(x_m[:, ended], v_mps[:, ended])
                last[rows[ended]] = step + 1
                going = ~ended
                if not going.any():
                    break
                rows, held_mps2, states = rows[going], held_mps2[:, going], states[:, :, going]
                x_m, v_mps, a_mps2 = states
                tree_inputs.keep(going)
        return gap_m, last

    def _decisions(
        self,
        network: QNetwork,
        cars: IntArray,
        x_m: FloatArray,
        v_mps: FloatArray,
        svo_rad: FloatArray,
    ) -> FloatArray:
        """Return the accelerations that the cars of the mainline choose, (C, R)."""
        count = len(cars)
        vut = np.tile(x_m[VUT], count), np.tile(v_mps[VUT], count)
        state = (x_m[cars].ravel(), v_mps[cars].ravel(), *vut)
        inputs = network.observe(state, np.tile(svo_rad, count), self.scenario)
        chosen = network.values_at_once(inputs).argmax(axis=1)
        actions = actions_mps2(network.limited(self.scenario))
        chosen_mps2: FloatArray = actions[chosen].reshape(count, -1)
        return chosen_mps2


def _gap_at_merge_m(x_m: FloatArray, v_mps: FloatArray) -> FloatArray:
    """Return the gap, (R,), to the car nearest to the VUT at M, in states (A, R).

    A VUT that has not arrived keeps its speed, or 0.5 m/s where it stands.
    """
    left_s = np.maximum(-x_m[VUT], 0.0) / np.maximum(v_mps[VUT], 0.5)
    gaps = np.delete(x_m + v_mps * left_s, VUT, axis=0) - np.maximum(x_m[VUT], 0.0)
    nearest = np.abs(gaps).argmin(axis=0)
    gap_m: FloatArray = gaps[nearest, np.arange(len(nearest))]
    return gap_m


class ControllerModel:
    """An ensemble of trees that learns from the motions of a campaign; see `Predictor`.

    A controller is smooth in some regions and jumps in others, and its inputs are unknown:
    extremely randomised trees (Geurts et al., 2006) fit both. Half of the members see the present
    state alone, the others also the past. Each member leaves out every GROUPS-th case, so that
    members disagree where cases are few.

    It is a `Predictor`: its predictions are a pure function of the outcomes, whatever their order.
    The cases of all levels train the same model.

    Example:
        model = ControllerModel(ModelRollout(pool, povs), seed=1)
        model.tell(outcomes, motions)
        gaps = model.predict({0: points})[0]
    """

    members = 2 * GROUPS

    def __init__(self, rollout: ModelRollout, seed: int) -> None:
        """Prepare an untrained model.

        Args:
            rollout: rolls cases out.
            seed: seed of the trees.
        """
        self._rollout, self._seed = rollout, seed
        self._batch: dict[int, int] = {}
        self._motions: dict[int, FloatArray] = {}
        # Inputs and accelerations of the steps of the cases that are learned.
        self._steps: dict[int, tuple[Inputs, FloatArray]] = {}
        # By group, the cases that its members learned from; by member, its tree.
        self._cases: dict[int, list[int]] = {}
        self._trees: dict[int, Any] = {}
        self._has_learned = False

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Take outcomes; an episode with an error is left out.

        Args:
            outcomes: outcomes of any level.
            motions: their motions, (T + 1, A, 3), by index.
        """
        self._has_learned = False
        for outcome in outcomes:
            if not outcome.measures.end.is_error:
                self._batch[outcome.index] = outcome.batch
                self._motions[outcome.index] = motions[outcome.index]

    def can_predict(self, level: int) -> bool:
        """Return whether there are four cases to learn from, and the POV of the level is known.

        Args:
            level: level of the POV.
        """
        return len(self._motions) >= 4 and self._rollout.can_predict(level)

    def predict(
        self, points: Mapping[int, FloatArray], member: int | None = None
    ) -> dict[int, FloatArray]:
        """Predict the signed gaps of cases.

        Args:
            points: cases of the unit cube by level of the POV, (n, d) each.
            member: the only member that predicts; None for all.

        Returns:
            Gaps by level, (M, n) each, or (1, n) by one member; NaN where the VUT never arrives.
        """
        if not self._has_learned:
            self._learn()
        members = range(self.members) if member is None else [member]
        gaps = self._rollout.play(points, [self._trees[number].predict for number in members])
        ends = np.cumsum([len(of_level) for of_level in points.values()])
        return dict(zip(points, np.split(gaps, ends[:-1], axis=1), strict=True))

    def _learn(self) -> None:
        """Fit the trees of each group whose cases have changed."""
        from sklearn.tree import ExtraTreeRegressor

        self._has_learned = True
        learned = [self._learned_by(group) for group in range(GROUPS)]
        self._keep_steps(set().union(*learned))
        for group, cases in enumerate(learned):
            if cases == self._cases.get(group):
                continue
            self._cases[group] = cases
            inputs = np.concatenate([self._steps[index][0] for index in cases])
            accelerations = np.concatenate([self._steps[index][1] for index in cases])
            for member, seen in ((group, inputs[:, :-PAST_INPUTS]), (GROUPS + group, inputs)):
                seed = (self._seed * self.members + member) % 2**32
                # Each node of a tree chooses among half of the inputs.
                tree = ExtraTreeRegressor(max_features=0.5, random_state=seed)
                # The checks in `predict` of the estimator cost more than the tree does.
                self._trees[member] = tree.fit(seen, accelerations).tree_

    def _learned_by(self, group: int) -> list[int]:
        """Return the cases that members of a group learn from, by index."""
        until = max(self._batch.values())
        # Up to 100 cases all members learn from every batch; later they take turns.
        if len(self._batch) > 100 and until >= GROUPS:
            until -= (until - group) % GROUPS
        cases = sorted(index for index, batch in self._batch.items() if batch <= until)
        # At most 500 cases: the last 250, and 250 spread over the others.
        if len(cases) > 500:
            spread = np.linspace(0, len(cases) - 250, 250, endpoint=False).astype(np.int64)
            cases = [cases[place] for place in spread.tolist()] + cases[-250:]
        if len(cases) < GROUPS:
            return cases
        return [index for index in cases if index % GROUPS != group]

    def _keep_steps(self, cases: set[int]) -> None:
        """Keep the steps of some cases, by index, and forget those of others."""
        self._steps = {index: self._steps[index] for index in cases & set(self._steps)}
        new = sorted(cases - set(self._steps))
        if not new:
            return
        motions = [self._motions[index] for index in new]
        steps = np.arange(max(map(len, motions)))
        # A shorter motion keeps its last state.
        padded = [motion[np.minimum(steps, len(motion) - 1)] for motion in motions]
        tree_inputs = TreeInputs(self._rollout.scenario, len(new))
        last_mps2 = np.zeros(len(new))
        inputs = []
        for state in np.stack(padded, axis=-1)[:-1]:
            inputs.append(tree_inputs.step(state[:, 0], state[:, 1], last_mps2))
            last_mps2 = state[VUT, 2]
        for index, motion, of_case in zip(new, motions, np.stack(inputs, axis=1), strict=True):
            until = len(motion) - 1
            # A copy: a view would keep the inputs of all.
            self._steps[index] = of_case[:until].copy(), motion[:until, VUT, 2]


class ControllerModelPair:
    """Models of two versions of a VUT; together they predict the gap of a `regression`.

    Each member of the new version's model is paired with the member of the old version's model that
    learned from the same cases.

    Example:
        pair = ControllerModelPair(ControllerModel(rollout, 1), ControllerModel(old_rollout, 1))
        pair.tell(outcomes, motions)
        pair.tell_old(old_outcomes, old_motions)
        gaps = pair.predict({0: points})[0]
    """

    members = ControllerModel.members

    def __init__(self, new: ControllerModel, old: ControllerModel) -> None:
        """Take the models of both versions.

        Args:
            new: model of the new version.
            old: model of the old version, with the same seed.
        """
        self._new, self._old = new, old

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Take outcomes of the new version.

        Args:
            outcomes: outcomes of any level.
            motions: their motions, (T + 1, A, 3), by index.
        """
        self._new.tell(outcomes, motions)

    def tell_old(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Take outcomes of the old version.

        Args:
            outcomes: outcomes of the same cases.
            motions: their motions, (T + 1, A, 3), by index.
        """
        self._old.tell(outcomes, motions)

    def can_predict(self, level: int) -> bool:
        """Return whether both models can predict cases of a level.

        Args:
            level: level of the POV.
        """
        return self._new.can_predict(level) and self._old.can_predict(level)

    def predict(
        self, points: Mapping[int, FloatArray], member: int | None = None
    ) -> dict[int, FloatArray]:
        """Predict the signed gaps of regressions.

        Args:
            points: cases of the unit cube by level of the POV, (n, d) each.
            member: the only pair of members that predicts; None for all.

        Returns:
            Gaps by level, (M, n) each, or (1, n) by one pair of members.
        """
        new, old = self._new.predict(points, member), self._old.predict(points, member)
        return {level: regression_gaps(new[level], old[level]) for level in points}
