"""The interface of a sampler, and the base class of those that propose level by level."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import ClassVar, Protocol

import numpy as np

from merge_sumo.metrics.outcome import Outcome, Prediction
from merge_sumo.metrics.summary import by_case
from merge_sumo.samplers.history import LevelHistory, bounded
from merge_sumo.scenario.case import Case, FloatArray, Pool, to_unit


class Predictor(Protocol):
    """Predicts the gaps of cases; a pure function of the outcomes told so far.

    Attributes:
        members: number of members of its ensemble. They learn from different data, so they
            disagree where they extrapolate.
    """

    members: int

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Take outcomes, and their motions, (T + 1, A, 3), by index."""

    def can_predict(self, level: int) -> bool:
        """Return whether the outcomes so far suffice to predict cases of a level."""

    def predict(
        self, points: Mapping[int, FloatArray], member: int | None = None
    ) -> Mapping[int, FloatArray]:
        """Predict the signed gaps of cases (`Outcome.signed_gap`).

        Args:
            points: cases of the unit cube by level of the POV, (n, d) each.
            member: the member that predicts, so that M is 1; None for all.

        Returns:
            Gaps by level, (M, n) each; NaN where the VUT never arrives.
        """


class Sampler(ABC):
    """Proposes cases; runs nothing.

    `ask` is a pure function of the settings, of the outcomes told so far, and of the pending cases:
    two calls return the same cases, and neither the order of `tell` nor a repeated `tell` matters.
    A campaign resumes by telling its journal to a new sampler.

    Attributes:
        about: description in a line without a full stop, for help and documentation.
        colour: of its curves in figures, #RRGGBB.
        learns: whether proposals depend on the outcomes, and not only on their number.
        uses_predictions: whether proposals depend on predictions of a model of the controller.
        overlaps: whether it proposes while cases run, and keeps away from these (`pend`).
        tolerated: share of the runs of a case that may fail before the case counts as failed.

    Example:
        sampler = make_sampler("coverage", pool, seed=1)
        cases = sampler.ask(sampler.batch_size())
        sampler.tell(outcomes)
    """

    about: ClassVar[str] = ""
    colour: ClassVar[str] = "#7B3294"
    learns: ClassVar[bool] = True
    uses_predictions: ClassVar[bool] = False
    overlaps: ClassVar[bool] = False
    tolerated: float = 0.0

    def __init__(self, pool: Pool, seed: int, predictor: Predictor | None = None) -> None:
        """Prepare a sampler without outcomes.

        Args:
            pool: the cases to choose from.
            seed: the same seed gives the same proposals.
            predictor: predicts cases before they run, for samplers with `uses_predictions`.
        """
        self.pool = pool
        self.seed = seed
        self.predictor = predictor if self.uses_predictions else None
        self._outcomes: dict[int, Outcome] = {}
        self._proposed: Counter[int] = Counter()
        self._pending: list[Case] = []

    @abstractmethod
    def ask(self, n: int) -> list[Case]:
        """Return the next `n` cases."""

    def prediction(self, place: int) -> Prediction | None:
        """Return the prediction of a case of the last batch, by its place in the batch."""
        return None

    def batch_size(self) -> int:
        """Return the preferred number of cases of the next batch."""
        return 40

    def tell(
        self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None = None
    ) -> None:
        """Take outcomes; those without a verdict (VUT_ERROR, SIM_ERROR) only count as proposed.

        Args:
            outcomes: the outcomes.
            motions: their motions, (T + 1, A, 3), by index, for the predictor.
        """
        for outcome in outcomes:
            self._proposed[outcome.case.level] += outcome.index not in self._outcomes
            self._outcomes[outcome.index] = outcome
        if self.predictor is not None and motions is not None:
            self.predictor.tell(outcomes, motions)

    def pend(self, cases: Iterable[Case]) -> None:
        """Take the cases that run at present; they replace those of the last call.

        They count as proposed; a sampler that `overlaps` also keeps away from them.
        """
        self._pending = list(cases)

    def pending(self, level: int) -> FloatArray:
        """Return the pending cases of a level as points of its unit cube, (m, d)."""
        cases = [case for case in self._pending if case.level == level]
        return to_unit(cases, level, self.pool.scenario)

    def observed(self, level: int | None = None) -> list[Outcome]:
        """Return the outcomes with a verdict, of one level or of all, in order of their index."""
        observed = []
        for index in sorted(self._outcomes):
            outcome = self._outcomes[index]
            if outcome.margin is not None and level in (None, outcome.case.level):
                observed.append(outcome)
        return observed

    def proposed(self, level: int | None = None) -> int:
        """Return the number of cases of one level or of all that were told or are pending."""
        pending = sum(level in (None, case.level) for case in self._pending)
        return pending + (self._proposed.total() if level is None else self._proposed[level])

    def history(self, level: int) -> LevelHistory:
        """Return the outcomes with a verdict at one level as arrays, a row for each case.

        The worst run of a case gives its margin and its gap.
        """
        every = by_case(self.observed())
        cases = [case for case in every if case.case.level == level]
        worst = [case.deciding() for case in cases]
        variance = np.full(len(cases), np.nan)
        for row, case in enumerate(cases):
            if case.runs > 1:
                margins = np.array([run.margin for run in case.outcomes], dtype=float)
                variance[row] = np.var(bounded(margins), ddof=1)
        return LevelHistory(
            points=to_unit([run.case for run in worst], level, self.pool.scenario),
            margin=bounded(np.array([run.margin for run in worst], dtype=float)),
            failed=np.array([case.share > self.tolerated for case in cases], dtype=bool),
            # None becomes NaN.
            gap=np.array([run.signed_gap for run in worst], dtype=float),
            batch=np.array([case.outcomes[0].batch for case in cases], dtype=int),
            runs=np.array([case.runs for case in cases], dtype=int),
            failures=np.array([case.failures for case in cases], dtype=int),
            variance=variance,
            varies=any(case.varies for case in every),
        )

    def shares(self, n: int, weights: Mapping[int, float] | None = None) -> dict[int, int]:
        """Share `n` cases out over the levels, in whole numbers (Wang et al., section V-D).

        Each level gets one case first, those with the fewest proposed cases before the others. The
        rest follows the largest remainders.

        Args:
            n: number of cases.
            weights: positive weight of each level; equal ones by default.

        Returns:
            Number of cases by level; they add up to `n`.
        """
        weights = weights or dict.fromkeys(self.pool.levels, 1.0)
        by_need = sorted(weights, key=lambda level: (self.proposed(level), level))
        shares = dict.fromkeys(sorted(weights), 0)
        for level in by_need[:n]:
            shares[level] = 1
        total = sum(weights.values())
        for _ in range(n - sum(shares.values())):
            shares[max(by_need, key=lambda level: n * weights[level] / total - shares[level])] += 1
        return shares

    def rng(self, *key: int) -> np.random.Generator:
        """Return the generator of this proposal: seed, cases proposed so far, and a key.

        Cases without a verdict count, so that a batch of errors is not proposed again.
        """
        return np.random.default_rng([self.seed, self.proposed(), *key])


class LevelwiseSampler(Sampler):
    """Shares a batch out over the levels, then proposes points in each level's unit cube."""

    def ask(self, n: int) -> list[Case]:
        """Return the next `n` cases, level by level."""
        cases: list[Case] = []
        for level, share in self.allocate(n).items():
            if share:
                points = self.propose(self.history(level), share, self.rng(level), level)
                cases += self.pool.cases(points, level)
        return cases

    def allocate(self, n: int) -> dict[int, int]:
        """Return the number of cases for each level; they add up to `n`."""
        return self.shares(n)

    @abstractmethod
    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Propose points of the level's unit cube.

        Args:
            history: outcomes of the level; its points have d coordinates.
            n: number of points.
            rng: generator of this proposal.
            level: level of the POV.

        Returns:
            Points, (n, d).
        """


def reflect(points: FloatArray) -> FloatArray:
    """Return points, (n, d), folded back into the unit cube at its faces."""
    folded = np.mod(points, 2.0)
    return np.minimum(folded, 2.0 - folded)
