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


class Sampler(ABC):
    """Proposes the cases of a campaign, and learns from their outcomes.

    A sampler does not simulate. For each batch, a campaign calls these methods:

    1. `batch_size`, `ask`, `prediction` for each case, and `set_pending`.
    2. After the batch has run: `tell` and `set_pending`.

    `ask` is a pure function of the settings, of the outcomes so far, and of the pending cases. Two
    calls return the same cases. The order of the outcomes and a repeated `tell` have no influence.
    A campaign resumes by telling the recorded outcomes to a new sampler.

    To write a sampler, implement `ask`, or subclass `LevelwiseSampler` and implement `propose`. The
    methods `history`, `pending`, `observed`, `proposed`, `shares` and `rng` are there for you.

    Attributes:
        about: the method in one line without a full stop, for help and documentation.
        colour: colour of its curves in figures, #RRGGBB.
        learns: whether proposals depend on the outcomes, and not only on their number.
        uses_predictions: whether proposals depend on the predictions of a `Predictor`.
        overlaps: whether it proposes while cases run, and avoids their neighbourhood.
        tolerated: share of the runs of a case that may fail before the case counts as a failure.
        pool: the cases to choose from.
        seed: seed of all random numbers.
        predictor: predicts cases before they run; None without `uses_predictions`.

    Example:
        ```python
        sampler = make_sampler("coverage", pool, seed=1)
        for batch in range(3):
            outcomes = []
            for index, episode in enumerate(simulate(plan, sampler.ask(15)), 15 * batch):
                outcomes.append(episode.at(index, batch).outcome)
            sampler.tell(outcomes)
        ```
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
            predictor: predicts cases before they run; ignored without `uses_predictions`.
        """
        self.pool = pool
        self.seed = seed
        self.predictor = predictor if self.uses_predictions else None
        self._outcomes: dict[int, Outcome] = {}
        self._proposed: Counter[int] = Counter()
        self._pending: list[Case] = []

    @abstractmethod
    def ask(self, n: int) -> list[Case]:
        """Propose cases.

        Args:
            n: number of cases.

        Returns:
            The next `n` cases, none of which was proposed before.
        """

    def prediction(self, position: int) -> Prediction | None:
        """Return the prediction of a case of the last `ask`.

        Args:
            position: position of the case in the returned list, from 0.

        Returns:
            The prediction; None if the case was not predicted.
        """
        return None

    def batch_size(self) -> int:
        """Return the preferred number of cases of the next batch."""
        return 40

    def tell(
        self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None = None
    ) -> None:
        """Learn from outcomes.

        Args:
            outcomes: outcomes in any order. Errors (VUT_ERROR and SIM_ERROR) only count as
                proposed. An outcome replaces an earlier outcome with the same index.
            motions: motions of the cases, (T + 1, A, 3), by index, for the predictor.
        """
        for outcome in outcomes:
            if outcome.index not in self._outcomes:
                self._proposed[outcome.case.level] += 1
            self._outcomes[outcome.index] = outcome
        if self.predictor is not None and motions is not None:
            self.predictor.tell(outcomes, motions)

    def set_pending(self, cases: Iterable[Case]) -> None:
        """Replace the pending cases.

        Pending cases count as proposed. A sampler that `overlaps` avoids their neighbourhood.

        Args:
            cases: all proposed cases without an outcome.
        """
        self._pending = list(cases)

    def pending(self, level: int) -> FloatArray:
        """Return the pending cases of a level.

        Args:
            level: POV level.

        Returns:
            Points of the unit cube of the level, (m, d).
        """
        cases = [case for case in self._pending if case.level == level]
        return to_unit(cases, level, self.pool.scenario)

    def observed(self, level: int | None = None) -> list[Outcome]:
        """Return the outcomes without errors, in the order of their index.

        Args:
            level: POV level; None for all levels.
        """
        observed = []
        for index in sorted(self._outcomes):
            outcome = self._outcomes[index]
            if outcome.margin is not None and level in (None, outcome.case.level):
                observed.append(outcome)
        return observed

    def proposed(self, level: int | None = None) -> int:
        """Return the number of cases so far, with the pending cases.

        Args:
            level: POV level; None for all levels.
        """
        if level is None:
            return self._proposed.total() + len(self._pending)
        pending = [case for case in self._pending if case.level == level]
        return self._proposed[level] + len(pending)

    def history(self, level: int) -> LevelHistory:
        """Return the cases of a level without errors as arrays, with a row for each case.

        Args:
            level: POV level.
        """
        of_all_levels = by_case(self.observed())
        cases = [case for case in of_all_levels if case.case.level == level]
        worst = [case.deciding() for case in cases]
        variance = []
        for case in cases:
            margins = bounded(np.array([run.margin for run in case.outcomes], dtype=float))
            variance.append(np.var(margins, ddof=1) if case.runs > 1 else np.nan)
        return LevelHistory(
            points=to_unit([run.case for run in worst], level, self.pool.scenario),
            margin=bounded(np.array([run.margin for run in worst], dtype=float)),
            failed=np.array([case.share > self.tolerated for case in cases], dtype=bool),
            # A gap of None, of a VUT that never arrived, becomes NaN.
            gap=np.array([run.signed_gap for run in worst], dtype=float),
            batch=np.array([case.outcomes[0].batch for case in cases], dtype=int),
            runs=np.array([case.runs for case in cases], dtype=int),
            failures=np.array([case.failures for case in cases], dtype=int),
            variance=np.array(variance, dtype=float),
            varies=any(case.varies for case in of_all_levels),
        )

    def shares(self, n: int, weights: Mapping[int, float] | None = None) -> dict[int, int]:
        """Divide a batch among the levels (Wang et al., section V-D).

        Each level first gets one case. With fewer cases than levels, the levels with the fewest
        proposed cases get one. The method of largest remainders divides the rest.

        Args:
            n: number of cases.
            weights: positive weights by level; equal weights by default.

        Returns:
            Numbers of cases by level; their sum is `n`.

        Example:
            ```pycon
            >>> make_sampler("coverage", Pool(levels=(0, 1, 2), scenario=US23), seed=1).shares(5)
            {0: 2, 1: 2, 2: 1}
            ```
        """
        weights = weights or dict.fromkeys(self.pool.levels, 1.0)
        by_need = sorted(weights, key=lambda level: (self.proposed(level), level))
        shares = dict.fromkeys(sorted(weights), 0)
        for level in by_need[:n]:
            shares[level] = 1
        total = sum(weights.values())
        for _ in range(n - sum(shares.values())):
            missing = {level: n * weights[level] / total - shares[level] for level in by_need}
            shares[max(missing, key=missing.__getitem__)] += 1
        return shares

    def rng(self, *key: int) -> np.random.Generator:
        """Return the random generator of the next proposal.

        It depends on the seed and on the number of proposed cases. Errors count, so that a batch of
        errors is not proposed again.

        Args:
            key: numbers that distinguish generators of one proposal, for example the level.
        """
        return np.random.default_rng([self.seed, self.proposed(), *key])


class LevelwiseSampler(Sampler):
    """A sampler that divides a batch among the levels, and proposes points for each level.

    Example:
        ```python
        class RandomSampler(LevelwiseSampler):
            about = "draws cases at random"

            def propose(self, history, n, rng, level):
                return rng.random((n, history.dims))
        ```
    """

    def ask(self, n: int) -> list[Case]:
        """Return the next `n` cases, level by level.

        Args:
            n: number of cases.
        """
        cases: list[Case] = []
        for level, share in self.allocate(n).items():
            if share:
                points = self.propose(self.history(level), share, self.rng(level), level)
                cases += self.pool.cases(points, level)
        return cases

    def allocate(self, n: int) -> dict[int, int]:
        """Return the number of cases for each level.

        Args:
            n: number of cases of the batch: the sum over the levels.
        """
        return self.shares(n)

    @abstractmethod
    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Propose points of the unit cube of a level.

        Args:
            history: outcomes of the level. A point has d = `history.dims` coordinates.
            n: number of points.
            rng: random generator of this proposal.
            level: POV level.

        Returns:
            Points, (n, d).
        """


class Predictor(Protocol):
    """Predicts the gaps of cases before they run; a pure function of the outcomes told so far.

    Attributes:
        members: number of members of its ensemble, M. They learn from different data, so that they
            disagree where they extrapolate.
    """

    members: int

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Learn from outcomes.

        Args:
            outcomes: outcomes of any level.
            motions: their motions, (T + 1, A, 3), by index: x in m, v in m/s and a in m/s2 of each
                of the A vehicles.
        """

    def can_predict(self, level: int) -> bool:
        """Return whether the outcomes so far suffice to predict cases of a level.

        Args:
            level: level of the POV.
        """

    def predict(
        self, points: Mapping[int, FloatArray], member: int | None = None
    ) -> Mapping[int, FloatArray]:
        """Predict the signed gaps of cases (`Outcome.signed_gap`).

        Args:
            points: cases of the unit cube by level of the POV, (n, d) each.
            member: the only member that predicts, from 0 to M - 1; None for all.

        Returns:
            Gaps by level, (M, n) each, or (1, n) by one member; NaN where the VUT never arrives.
        """


def reflect(points: FloatArray) -> FloatArray:
    """Reflect points at the faces of the unit cube until they are inside.

    Args:
        points: points of any size, (n, d).

    Returns:
        Points of the unit cube, (n, d).
    """
    folded = np.mod(points, 2.0)
    return np.minimum(folded, 2.0 - folded)
