"""The twin of the VUT: it has watched how the VUT drives, and plays its part against any POV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.engine.povs import Povs
from merge_sumo.twin.experts import GROUPS, Expert, Steps
from merge_sumo.twin.observation import Inputs, Observation
from merge_sumo.twin.rollout import TwinRollout
from merge_sumo.values.bodies import CentreLines
from merge_sumo.values.case import FloatArray, Pool
from merge_sumo.values.criterion import PAPER_CRITERION, Criterion
from merge_sumo.values.scenario import VUT
from merge_sumo.values.score import Outcome

EXPERTS: Final = (Expert(history=False), Expert(history=True))
TAUGHT: Final = (Expert(history=False, others=True), Expert(history=True, others=True))
"""Experts, and those that there are besides where other campaigns are learned from."""
FEWEST: Final = 4
"""Cases that it takes to play at all."""
AT_ONCE: Final = 100
"""Cases up to which all members learn from every batch; later they take turns."""
LEARNED: Final = 500
"""Cases that a member learns from at most: half of them the last ones, half spread before."""


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
        others: Sequence[FloatArray] = (),
        criterion: Criterion = PAPER_CRITERION,
        lines: CentreLines | None = None,
    ) -> None:
        """Know the pool and its POVs, what counts as a failure, and the road's centre lines.

        `others` are motions, (T + 1, A, 3), of campaigns that are learned from.
        """
        self._pool, self._seed = pool, seed
        self._rollout = TwinRollout(pool, povs, criterion, lines)
        self._batch: dict[int, int] = {}
        self._steps: dict[int, Steps] = {}
        self._learned: dict[int, tuple[int, ...]] = {}
        """By group, the cases that its members learn from; empty after each new outcome."""
        self._others = self._observed_steps(others, own=False)
        self._experts = (*EXPERTS, *TAUGHT) if self._others else EXPERTS
        self._members: dict[tuple[int, int], tuple[tuple[int, ...], Any]] = {}
        """By expert and group: from which cases it has learned, and what."""

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Take outcomes and their motions by index; an episode that went wrong teaches nothing."""
        new = [o for o in outcomes if not o.measures.end.is_error and o.index not in self._batch]
        watched = self._observed_steps([motions[o.index] for o in new])
        self._learned.clear()
        for outcome, steps in zip(new, watched, strict=True):
            self._batch[outcome.index] = outcome.batch
            self._steps[outcome.index] = steps

    def can_predict(self, level: int) -> bool:
        """Return whether it has seen enough, and the POV is no program of a person's own."""
        known = len(self._steps) >= FEWEST or bool(self._others)
        return known and self._rollout.can_predict(level)

    def predict(self, level: int, points: FloatArray, screening: int | None = None) -> FloatArray:
        """Return gaps at M, (E, G, n), of cases, (n, d), of the unit cube; see `Predictor`."""
        experts = self._speakers()
        if screening is None:
            members = [(e, g) for e in experts for g in range(GROUPS)]
        else:
            members = [(experts[screening], self._last_batch() % GROUPS)]
        everywhere = [np.arange(len(points))] * len(members)
        gaps_m = np.array(self._played(level, points, members, everywhere))
        return gaps_m.reshape(-1, 1 if screening is not None else GROUPS, len(points))

    def _speakers(self) -> list[int]:
        """Return who speaks for each expert: who knows nothing of this VUT lets others speak."""
        first = 0 if self._steps else len(EXPERTS)
        return [max(e, e % len(EXPERTS) + first) for e in range(len(self._experts))]

    def _played(
        self,
        level: int,
        points: FloatArray,
        members: Sequence[tuple[int, int]],
        places: Sequence[NDArray[np.int64]],
    ) -> list[FloatArray]:
        """Return for each member the gaps at M, (n,), of the places among points that it plays."""
        trees = [self._member(e, g) for e, g in members]
        cuts = np.cumsum([0, *map(len, places)])

        def answer(inputs: Inputs, now: int, rows: NDArray[np.int64]) -> FloatArray:
            answers = np.empty(len(rows))
            first, *ends = np.searchsorted(rows, cuts).tolist()
            for (e, _), tree, last in zip(members, trees, ends, strict=True):
                if first < last:
                    seen = self._experts[e].sees(inputs[first:last], now)
                    answers[first:last] = tree.predict(seen)[:, 0]
                first = last
            return answers

        gaps_m = self._rollout.play(points[np.concatenate(places)], level, answer)
        return np.split(gaps_m, cuts[1:-1])

    def predict_held_out(
        self, level: int, indices: Sequence[int], points: FloatArray
    ) -> FloatArray:
        """Return gaps at M, (E, n), by members that have not learned from these cases."""
        group = np.array(indices) % GROUPS
        members = [(e, g) for e in self._speakers() for g in range(GROUPS)]
        places = [np.flatnonzero(group == g) for _, g in members]
        gaps_m = self._played(level, points, members, places)
        found = np.empty((len(self._experts), len(points)))
        for number, (place, gaps) in enumerate(zip(places, gaps_m, strict=True)):
            found[number // GROUPS, place] = gaps
        return found

    def _last_batch(self) -> int:
        return max(self._batch.values(), default=0)

    def _member(self, expert: int, group: int) -> Any:
        """Return what a member of an expert has learned by now."""
        if group not in self._learned:
            self._learned[group] = self._learned_by(group)
        indices = self._learned[group]
        known = self._members.get((expert, group))
        if known is None or known[0] != indices:
            cases = [steps for place, steps in enumerate(self._others) if place % GROUPS != group]
            cases += [self._steps[index] for index in indices]
            seed = (self._seed * len(self._experts) + expert) * GROUPS + group
            known = indices, self._experts[expert].learn(cases, seed % 2**32)
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

    def _observed_steps(self, motions: Sequence[FloatArray], *, own: bool = True) -> list[Steps]:
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
            Steps(
                np.ascontiguousarray(inputs[: len(motion) - 1, place]),
                observation.now,
                motion[:-1, VUT, 2],
                own,
            )
            for place, motion in enumerate(motions)
        ]
