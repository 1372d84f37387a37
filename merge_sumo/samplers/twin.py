"""The twin of the VUT: it has watched how the VUT drives, and plays its part against any POV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.metrics.criterion import PAPER_CRITERION, Criterion
from merge_sumo.metrics.score import Outcome
from merge_sumo.samplers.experts import GROUPS, Steps, learn
from merge_sumo.samplers.observation import HISTORY, Inputs, Observation
from merge_sumo.samplers.rollout import TwinRollout
from merge_sumo.scenario.case import FloatArray, Pool
from merge_sumo.scenario.scenario import VUT
from merge_sumo.simulation.povs import Povs

EXPERTS: Final = 2
"""One that looks at the present, and one that looks at what was before, too."""
FEWEST: Final = 4
"""Cases that it takes to play at all."""
AT_ONCE: Final = 100
"""Cases up to which all members learn from every batch; later they take turns."""
LEARNED: Final = 500
"""Cases that a member learns from at most: half of them the last ones, half spread before."""


KEPT: Final = 4 * LEARNED
"""Cases of which it is kept what the VUT saw, which takes four times the memory of the motion."""


class Twin:
    """Learns from the motions of a campaign; see `Predictor`.

    What it says is a pure function of what it was told, however it was told. All levels of a
    campaign teach the same twin.
    """

    def __init__(
        self,
        pool: Pool,
        povs: Povs,
        seed: int,
        criterion: Criterion = PAPER_CRITERION,
        lines: CentreLines | None = None,
    ) -> None:
        """Know the pool and its POVs, what counts as a failure, and the road's centre lines."""
        self._pool, self._seed = pool, seed
        now = Observation(pool.scenario, 0).now
        self._looked_at = now, now + HISTORY
        """How many of the inputs each expert looks at."""
        self._rollout = TwinRollout(pool, povs, criterion, lines)
        self._batch: dict[int, int] = {}
        self._motions: dict[int, FloatArray] = {}
        self._steps: dict[int, Steps] = {}
        """What the VUT saw and did, of cases that were learned from lately."""
        self._learned: dict[int, tuple[int, ...]] = {}
        """By group, the cases that its members learn from; empty after each new outcome."""
        self._members: dict[tuple[int, int], tuple[tuple[int, ...], Any]] = {}
        """By expert and group: from which cases it has learned, and what."""

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Take outcomes and their motions by index; an episode that went wrong teaches nothing."""
        new = [o for o in outcomes if not o.measures.end.is_error and o.index not in self._batch]
        self._learned.clear()
        for outcome in new:
            self._batch[outcome.index] = outcome.batch
            self._motions[outcome.index] = motions[outcome.index]

    def can_predict(self, level: int) -> bool:
        """Return whether it has seen enough, and the POV is no program of a person's own."""
        return len(self._motions) >= FEWEST and self._rollout.can_predict(level)

    def predict(
        self,
        level: int,
        points: FloatArray,
        *,
        screening: int | None = None,
        held_out: Sequence[int] = (),
    ) -> FloatArray:
        """Return the gaps at M of cases; see `Predictor`.

        All members together are one rollout: each row is a case and the member that drives in it.
        """
        n, numbers = len(points), list(range(EXPERTS * GROUPS))
        if screening is not None:
            numbers = [screening * GROUPS + self._last_batch() % GROUPS]
        if held_out:
            group = np.array(held_out) % GROUPS
            cases = [np.flatnonzero(group == number % GROUPS) for number in numbers]
        else:
            cases = [np.arange(n)] * len(numbers)
        trees = [self._member(*divmod(number, GROUPS)) for number in numbers]
        rows_until = np.cumsum(list(map(len, cases)))

        def drive(inputs: Inputs, rows: NDArray[np.int64]) -> FloatArray:
            answers = np.empty(len(rows))
            first = 0
            for tree, until in zip(trees, np.searchsorted(rows, rows_until).tolist(), strict=True):
                if until > first:
                    answers[first:until] = tree.predict(inputs[first:until])[:, 0]
                first = until
            return answers

        gaps = self._rollout.play(level, points[np.concatenate(cases)], drive)
        if not held_out:
            return gaps.reshape(-1, GROUPS if screening is None else 1, n)
        by_expert = np.empty((EXPERTS, n))
        expert = np.repeat(np.arange(len(cases)) // GROUPS, list(map(len, cases)))
        by_expert[expert, np.concatenate(cases)] = gaps
        return by_expert

    def _last_batch(self) -> int:
        return max(self._batch.values(), default=0)

    def _member(self, expert: int, group: int) -> Any:
        """Return what a member of an expert has learned by now."""
        if group not in self._learned:
            self._learned[group] = self._learned_by(group)
        indices = self._learned[group]
        known = self._members.get((expert, group))
        if known is None or known[0] != indices:
            cases = self._steps_of(indices)
            seed = (self._seed * EXPERTS + expert) * GROUPS + group
            known = indices, learn(cases, self._looked_at[expert], seed % 2**32)
            self._members[expert, group] = known
        return known[1]

    def _learned_by(self, group: int) -> tuple[int, ...]:
        """Return the cases that members of a group learn from, by index."""
        until = self._last_batch()
        if len(self._batch) > AT_ONCE and until >= GROUPS:
            until -= (until - group) % GROUPS
        some = sorted(index for index, batch in self._batch.items() if batch <= until)
        if len(some) > LEARNED:
            half = LEARNED // 2
            spread = np.linspace(0, len(some) - half, half, endpoint=False).astype(np.int64)
            some = [some[place] for place in spread.tolist()] + some[-half:]
        return tuple(index for index in some if index % GROUPS != group or len(some) < GROUPS)

    def _steps_of(self, indices: Sequence[int]) -> list[Steps]:
        """Return what the VUT saw and did in cases, by index."""
        if len(self._steps) > KEPT:
            self._steps.clear()
        new = [index for index in indices if index not in self._steps]
        watched = self._observed_steps([self._motions[index] for index in new])
        self._steps.update(zip(new, watched, strict=True))
        return [self._steps[index] for index in indices]

    def _observed_steps(self, motions: Sequence[FloatArray]) -> list[Steps]:
        """Return what the VUT saw and did in motions, (T + 1, A, 3) each."""
        if not motions:
            return []
        longest = max(map(len, motions))
        together = np.empty((longest, *motions[0].shape[1:], len(motions)))
        for place, motion in enumerate(motions):
            together[: len(motion), ..., place] = motion
            together[len(motion) :, ..., place] = motion[-1, ..., :]
        observation = Observation(self._pool.scenario, len(motions))
        last = np.zeros(len(motions))
        seen = []
        for x_v_a in together[:-1]:
            seen.append(observation.see(x_v_a[:, 0], x_v_a[:, 1], last).copy())
            last = x_v_a[VUT, 2]
        inputs = np.array(seen)
        return [
            (np.ascontiguousarray(inputs[: len(motion) - 1, place]), motion[:-1, VUT, 2])
            for place, motion in enumerate(motions)
        ]
