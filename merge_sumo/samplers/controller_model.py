"""A model of the controller: an ensemble of trees that has learned what the VUT does.

A controller is smooth here and jumps there, and what it decides by is not known: extremely
randomised trees (Geurts et al., 2006) take both. Half of the members look at the present state
alone, the others also at what was before. Each member has not seen every GROUPS-th case, so that
members disagree where few cases tell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.metrics.criterion import PAPER_CRITERION, Criterion
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.samplers.observation import HISTORY, Inputs, Observation
from merge_sumo.samplers.rollout import ModelRollout
from merge_sumo.scenario.case import FloatArray, Pool
from merge_sumo.scenario.scenario import VUT
from merge_sumo.simulation.povs import Povs

GROUPS: Final = 4
"""Members that look at the same inputs."""
MAX_FEATURES: Final = 0.5
"""Share of the inputs among which each node of a tree chooses."""
FEWEST: Final = 4
"""Fewest cases to learn from."""
AT_ONCE: Final = 100
"""Cases up to which all members learn from every batch; later they take turns."""
LEARNED: Final = 500
"""Most cases that a member learns from: half of them the last ones, half spread before."""
KEPT: Final = 4 * LEARNED
"""Cases whose inputs are kept, which take four times the memory of the motion."""

Steps = tuple[Inputs, FloatArray]
"""Inputs of the VUT in the steps of a case, (T, inputs), and its accelerations, (T,), in m/s2."""


class ControllerModel:
    """Learns from the motions of a campaign; see `Predictor`.

    Its predictions are a pure function of the outcomes, whatever their order. All levels of a
    campaign teach the same model.
    """

    members = 2 * GROUPS

    def __init__(
        self,
        pool: Pool,
        povs: Povs,
        seed: int,
        criterion: Criterion = PAPER_CRITERION,
        lines: CentreLines | None = None,
    ) -> None:
        """Prepare a model that has learned nothing.

        Args:
            pool: the cases.
            povs: the drivers of the POV.
            seed: of the trees.
            criterion: what counts as a failure.
            lines: centre lines of the road.
        """
        self._scenario, self._seed = pool.scenario, seed
        self._rollout = ModelRollout(pool, povs, criterion, lines)
        self._batch: dict[int, int] = {}
        self._motions: dict[int, FloatArray] = {}
        self._steps: dict[int, Steps] = {}
        self._cases: dict[int, list[int]] = {}
        """By group, the cases that its members learned from."""
        self._trees: dict[int, Any] = {}
        """By member."""
        self._has_learned = False

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Take outcomes and their motions by index; an episode that went wrong teaches nothing."""
        self._has_learned = False
        for outcome in outcomes:
            if not outcome.measures.end.is_error:
                self._batch[outcome.index] = outcome.batch
                self._motions[outcome.index] = motions[outcome.index]

    def can_predict(self, level: int) -> bool:
        """Return whether it has seen enough, and the POV of the level is known."""
        return len(self._motions) >= FEWEST and self._rollout.can_predict(level)

    def predict(
        self, points: Mapping[int, FloatArray], member: int | None = None
    ) -> dict[int, FloatArray]:
        """Return the gaps at M of cases by level, (M, n) each; see `Predictor`.

        All members and levels are one rollout: each row is a case and the member that drives in it.
        """
        if not self._has_learned:
            self._learn()
        trees = [self._trees[number] for number in range(self.members)]
        if member is not None:
            trees = [trees[member]]
        counts = [len(of_level) for of_level in points.values()]
        ends = sum(counts) * np.arange(1, len(trees) + 1)

        def drive(inputs: Inputs, rows: NDArray[np.int64]) -> FloatArray:
            accelerations = np.empty(len(rows))
            first = 0
            for tree, last in zip(trees, np.searchsorted(rows, ends).tolist(), strict=True):
                if last > first:
                    accelerations[first:last] = tree.predict(inputs[first:last])[:, 0]
                first = last
            return accelerations

        gaps = self._rollout.play(points, len(trees), drive)
        by_level = np.split(gaps, np.cumsum(counts)[:-1], axis=1)
        return dict(zip(points, by_level, strict=True))

    def _learn(self) -> None:
        """Learn the trees of each group whose cases have changed."""
        from sklearn.tree import ExtraTreeRegressor

        self._has_learned = True
        for group in range(GROUPS):
            cases = self._learned_by(group)
            if cases == self._cases.get(group):
                continue
            self._cases[group] = cases
            steps = self._steps_of(cases)
            inputs = np.concatenate([inputs for inputs, _ in steps])
            accelerations = np.concatenate([a_mps2 for _, a_mps2 in steps])
            for member, looked_at in ((group, inputs[:, :-HISTORY]), (GROUPS + group, inputs)):
                seed = (self._seed * self.members + member) % 2**32
                tree = ExtraTreeRegressor(max_features=MAX_FEATURES, random_state=seed)
                # What `predict` of the estimator checks costs more than the tree does.
                self._trees[member] = tree.fit(looked_at, accelerations).tree_

    def _learned_by(self, group: int) -> list[int]:
        """Return the cases that members of a group learn from, by index."""
        until = max(self._batch.values())
        if len(self._batch) > AT_ONCE and until >= GROUPS:
            until -= (until - group) % GROUPS
        cases = sorted(index for index, batch in self._batch.items() if batch <= until)
        if len(cases) > LEARNED:
            half = LEARNED // 2
            spread = np.linspace(0, len(cases) - half, half, endpoint=False).astype(np.int64)
            cases = [cases[place] for place in spread.tolist()] + cases[-half:]
        if len(cases) < GROUPS:
            return cases
        return [index for index in cases if index % GROUPS != group]

    def _steps_of(self, cases: Sequence[int]) -> list[Steps]:
        """Return the inputs and accelerations of the VUT in cases, by index."""
        if len(self._steps) > KEPT:
            self._steps.clear()
        new = [index for index in cases if index not in self._steps]
        if new:
            observed = self._observed_steps([self._motions[index] for index in new])
            self._steps.update(zip(new, observed, strict=True))
        return [self._steps[index] for index in cases]

    def _observed_steps(self, motions: Sequence[FloatArray]) -> list[Steps]:
        """Return inputs and accelerations of the VUT in motions, (T + 1, A, 3) each."""
        longest = max(map(len, motions))
        together = np.empty((longest, *motions[0].shape[1:], len(motions)))
        for place, motion in enumerate(motions):
            together[: len(motion), ..., place] = motion
            together[len(motion) :, ..., place] = motion[-1, ..., :]
        observation = Observation(self._scenario, len(motions))
        last = np.zeros(len(motions))
        inputs = []
        for state in together[:-1]:
            inputs.append(observation.see(state[:, 0], state[:, 1], last).copy())
            last = state[VUT, 2]
        by_step, steps = np.array(inputs), []
        for place, motion in enumerate(motions):
            of_case = np.ascontiguousarray(by_step[: len(motion) - 1, place])
            steps.append((of_case, motion[:-1, VUT, 2]))
        return steps
