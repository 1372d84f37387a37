"""What samplers share that put cases of their own among the picks of another sampler."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from merge_sumo.samplers.base import Sampler
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.prediction import Prediction
from merge_sumo.values.score import Outcome


class SamplerWrapper(Sampler):
    """A sampler among whose picks others are; it is told and asked what this one is."""

    def __init__(self, sampler: Sampler) -> None:
        """Take a sampler that was told nothing."""
        super().__init__(sampler.pool, sampler.seed)
        self._sampler = sampler
        self.learns, self.overlaps = sampler.learns, sampler.overlaps  # type: ignore[misc]
        self.uses_predictions = sampler.uses_predictions  # type: ignore[misc]
        self._places: list[int | None] = []
        """By the place in the last batch, the place among the sampler's own picks."""

    def prediction(self, place: int) -> Prediction | None:
        """Return the prediction of a case of the last batch; None for none of the sampler's."""
        number = self._places[place]
        return None if number is None else self._sampler.prediction(number)

    def batch_size(self) -> int:
        """Return the preferred number of cases of the next batch."""
        return self._sampler.batch_size()

    def tell(
        self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None = None
    ) -> None:
        """Take outcomes, also those of cases that the sampler did not pick."""
        super().tell(outcomes, motions)
        self._sampler.tell(outcomes, motions)

    def pend(self, cases: Iterable[Case]) -> None:
        """Take the cases that run at present."""
        pending = list(cases)
        super().pend(pending)
        self._sampler.pend(pending)

    def skip(self, cases: Iterable[Case]) -> None:
        """Count cases as proposed whose outcomes will not be told."""
        skipped = list(cases)
        super().skip(skipped)
        self._sampler.skip(skipped)
