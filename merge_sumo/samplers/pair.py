"""The models of two versions of a VUT: together they predict where the versions differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.regression import regression_gaps
from merge_sumo.samplers.controller_model import ControllerModel
from merge_sumo.scenario.case import FloatArray


class ControllerModelPair:
    """Predicts what stands for the gap of a regression; see `Predictor` and `regression`.

    Each member of the new version's model is paired with the member of the old version's model that
    learned from the same cases.
    """

    members = ControllerModel.members

    def __init__(self, new: ControllerModel, old: ControllerModel) -> None:
        """Take a model of each version."""
        self._new, self._old = new, old

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Take outcomes of the new version and their motions, (T + 1, A, 3), by index."""
        self._new.tell(outcomes, motions)

    def tell_old(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray]) -> None:
        """Take outcomes of the old version and their motions, in the same way."""
        self._old.tell(outcomes, motions)

    def can_predict(self, level: int) -> bool:
        """Return whether both models can predict cases of a level."""
        return self._new.can_predict(level) and self._old.can_predict(level)

    def predict(
        self, points: Mapping[int, FloatArray], member: int | None = None
    ) -> dict[int, FloatArray]:
        """Return what stands for the gap of a regression in each case; see `Predictor`."""
        new, old = self._new.predict(points, member), self._old.predict(points, member)
        return {level: regression_gaps(new[level], old[level]) for level in points}
