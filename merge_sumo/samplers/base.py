"""The two verbs of a sampler, and the frame that all level-wise samplers share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, Final

import numpy as np

from merge_sumo.metrics.outcome import Outcome, Prediction
from merge_sumo.metrics.summary import by_case
from merge_sumo.samplers.allocation import even_shares
from merge_sumo.samplers.history import LevelHistory, bounded
from merge_sumo.scenario.case import Case, FloatArray, Pool, to_unit

if TYPE_CHECKING:
    from merge_sumo.samplers.predictor import Predictor

DEFAULT_BATCH: Final = 40
"""Cases of a batch of a sampler without a preferred size."""


class Sampler(ABC):
    """Proposes cases; knows nothing of SUMO and runs nothing.

    `ask` is a pure function of the settings, of the outcomes told so far, and of the pending cases:
    two calls return the same cases, and neither the order of `tell` nor a repeated `tell` matters.
    A campaign resumes by telling its journal to a new sampler.
    """

    about: ClassVar[str] = ""
    """What it does, in a line without a full stop: for help and documentation."""
    colour: ClassVar[str] = "#7B3294"
    """Of its curves in figures, #RRGGBB."""
    learns: ClassVar[bool] = True
    """Whether proposals depend on the outcomes, and not only on their number."""
    uses_predictions: ClassVar[bool] = False
    """Whether proposals depend on predictions of a model of the controller."""
    overlaps: ClassVar[bool] = False
    """Whether it is asked while cases run, and counts these (`pend`)."""
    tolerated: float = 0.0
    """Share of its runs that may fail in a case that does not: the campaign's."""

    def __init__(self, pool: Pool, seed: int, predictor: Predictor | None = None) -> None:
        """Propose cases from `pool`; `seed` makes the proposals reproducible.

        `predictor` simulates cases before they run, for samplers with `uses_predictions`.
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
        return DEFAULT_BATCH

    def tell(
        self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None = None
    ) -> None:
        """Take outcomes; those without a verdict (VUT_ERROR, SIM_ERROR) only count as proposed.

        `motions`, (T + 1, A, 3) by the index of an outcome, are for the predictor.
        """
        for outcome in outcomes:
            self._proposed[outcome.case.level] += outcome.index not in self._outcomes
            self._outcomes[outcome.index] = outcome
        if self.predictor is not None and motions is not None:
            self.predictor.tell(outcomes, motions)

    def pend(self, cases: Iterable[Case]) -> None:
        """Take the cases that run at present, in place of those of the last call.

        They count as proposed; a sampler that `overlaps` also keeps away from them.
        """
        self._pending = list(cases)

    def pending(self, level: int) -> FloatArray:
        """Return the pending cases of a level as points of its unit cube, (m, d)."""
        cases = (case for case in self._pending if case.level == level)
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
        """Return the number of cases told, with or without a verdict, or pending.

        Of one level or of all.
        """
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
        for place, case in enumerate(cases):
            if case.runs > 1:
                margins = np.array([run.margin for run in case.outcomes], dtype=np.float64)
                variance[place] = np.var(bounded(margins), ddof=1)
        return LevelHistory(
            points=to_unit((run.case for run in worst), level, self.pool.scenario),
            margin=bounded(np.array([run.margin for run in worst], dtype=np.float64)),
            failed=np.array([case.share > self.tolerated for case in cases], dtype=bool),
            # None becomes NaN.
            gap=np.array([run.signed_gap for run in worst], dtype=np.float64),
            batch=np.array([case.outcomes[0].batch for case in cases], dtype=np.int64),
            runs=np.array([case.runs for case in cases], dtype=np.int64),
            failures=np.array([case.failures for case in cases], dtype=np.int64),
            variance=variance,
            varies=any(case.varies for case in every),
        )

    def rng(self, *key: int) -> np.random.Generator:
        """Return the generator of this proposal: seed, cases proposed so far, and a key.

        Cases without a verdict count, so that a batch that gave none is not proposed again.
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
        return even_shares({level: self.proposed(level) for level in self.pool.levels}, n)

    @abstractmethod
    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return `n` points, (n, d), of the level's unit cube; the history's points have its d."""


def reflect(points: FloatArray) -> FloatArray:
    """Return points, (n, d), folded back into the unit cube at its faces."""
    folded = np.mod(points, 2.0)
    return np.asarray(np.minimum(folded, 2.0 - folded), dtype=np.float64)
