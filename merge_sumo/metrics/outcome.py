"""The outcome of a case: what was predicted of it, its measures, its margin and its record."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Annotated, Any, Self, get_type_hints

import numpy as np
from msgspec import Meta

from merge_sumo.files import Files
from merge_sumo.metrics.measures import FOLLOW_UP, OURS, Measures, recorded_measures
from merge_sumo.metrics.paper import margin_of
from merge_sumo.records import Record, convert, decode, record_type, to_plain
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, Scenario
from merge_sumo.scenario.signals import Signals
from merge_sumo.scenario.trajectory import End, Trajectory, cut_at

NO_GAP = 100.0 / 3.0
"""Gap of a VUT that never arrives, in units of the limit: another car goes first, far away."""
_DIGITS = 4
"""Decimals of a prediction, in memory as on disk: a resumed campaign decides by the same values."""


Probability = Annotated[float, Meta(ge=0.0, le=1.0)]


class Prediction(Record, frozen=True):
    """The prediction of a case before it ran: gaps at M and the failure probability.

    A record has it as `foretold`.

    Attributes:
        dx_m: signed gaps at M, in m, in one row: one for each member of the model of the
            controller (`twin` in files); None where the VUT never arrived.
        p_twin: failure probability by these gaps.
        p_surrogate: failure probability by the surrogate of the outcomes.
        p_fail: failure probability by both.
    """

    dx_m: tuple[tuple[float | None, ...]]
    p_twin: Probability
    p_surrogate: Probability
    p_fail: Probability

    @classmethod
    def of(cls, dx_m: FloatArray, p_twin: float, p_surrogate: float, p_fail: float) -> Self:
        """Return a rounded prediction.

        Args:
            dx_m: signed gaps at M, (M,), in m; NaN where the VUT never arrived.
            p_twin: failure probability by the gaps.
            p_surrogate: failure probability by the surrogate.
            p_fail: failure probability by both.
        """
        rounded_m = np.round(dx_m, _DIGITS).tolist()
        gaps = tuple(None if math.isnan(gap) else gap for gap in rounded_m)
        probabilities = (round(float(p), _DIGITS) for p in (p_twin, p_surrogate, p_fail))
        return cls((gaps,), *probabilities)


@dataclass(frozen=True, slots=True)
class Outcome:
    """The outcome of a case: its measures and its margin.

    Attributes:
        index: number of the case in its campaign, from 0.
        batch: number of the batch in which the case ran, from 0.
        case: the case.
        measures: the measures of its episode.
        prediction: prediction of the case before it ran; None without one.
        margin: distance from failing by the failure criterion, without a unit; below 0 the case
            fails. The default is the margin of the score P. None after an error.

    Example:
        ```python
        outcome = ms.run("design2", level=1, x_pov0_m=-290, v_pov0_mps=30).outcome
        print(outcome.failed, outcome.margin, outcome.measures.ttc_s)
        ```
    """

    index: int
    batch: int
    case: Case
    measures: Measures
    prediction: Prediction | None = None
    margin: float | None = None

    def __post_init__(self) -> None:
        """Use the margin of the score as the default."""
        if self.margin is None:
            object.__setattr__(self, "margin", margin_of(self.measures.score))

    @property
    def failed(self) -> bool:
        """Whether the case fails: its margin is below 0."""
        return self.margin is not None and self.margin < 0.0

    @property
    def is_by_score(self) -> bool:
        """Whether the margin is the margin of the score."""
        return self.margin == margin_of(self.measures.score)

    @property
    def is_tested(self) -> bool:
        """Whether the case is judged: the VUT reached the merge point, or the case failed."""
        return self.measures.end is End.MERGED or self.failed

    @property
    def passes(self) -> bool:
        """Whether the case passes: it is judged, and does not fail."""
        return self.is_tested and not self.failed

    @property
    def signed_gap(self) -> float | None:
        """The gap at M, divided by the limit of the scenario; from -1 to 1 the case fails.

        It is negative if the VUT is first. With another criterion than the paper's, the margin m
        becomes a gap: 1 + m if m >= 0, and 1 / (1 - m) if m < 0. None after an error, and if the
        paper's criterion has no gap.
        """
        dx_m, margin = self.measures.dx_m, self.margin
        if margin is None or self.is_by_score:
            return None if dx_m is None else dx_m / self.case.scenario.dx_crash_m
        gap = 1.0 + margin if margin >= 0.0 else 1.0 / (1.0 - margin)
        return -gap if dx_m is not None and dx_m < 0.0 else gap

    def to_record(self) -> dict[str, Any]:
        """Return the record of the case in `outcomes.jsonl`, with units in the names."""
        scenario = self.case.scenario
        record: dict[str, Any] = {"index": self.index, "batch": self.batch}
        for name in ("level", *scenario.case_fields):
            record[name] = getattr(self.case, name)
        if self.case.draw:
            record["draw"] = self.case.draw
        for name in recorded_measures(scenario):
            record[name] = self.measures.value(name)
        if not self.is_by_score:
            record["margin"] = self.margin
        if self.prediction is not None:
            record["foretold"] = to_plain(self.prediction)
        return record

    def trajectory(self, whole: FloatArray, signals: Signals | None = None) -> Trajectory:
        """Return the trajectory of the case from its recorded motion.

        Args:
            whole: motion up to M and after it, (T + 1, A, 3), as in `Trajectory`.
            signals: signals of the VUT.
        """
        found = self.measures
        until_m, after = cut_at(whole, round(found.t_end_s / DT_S))
        fault = found.error, found.clipped_steps
        return Trajectory(self.case, until_m, found.end, *fault, after, signals)

    @classmethod
    def from_json(cls, line: bytes | str, scenario: Scenario) -> Outcome:
        """Return the outcome of a line of `outcomes.jsonl`.

        Args:
            line: the line.
            scenario: scenario of the campaign.

        Raises:
            UserError: the line is not a record of a case.
        """
        known = convert(decode(line), record_of(scenario))
        coordinates = {name: getattr(known, name) for name in ("level", *scenario.case_fields)}
        case = Case(**coordinates, draw=known.draw, scenario=scenario)
        measures = Measures(**{name: getattr(known, name) for name in recorded_measures(scenario)})
        return cls(known.index, known.batch, case, measures, known.foretold, known.margin)


@lru_cache
def record_of(scenario: Scenario) -> Any:
    """Return the type of the lines of `outcomes.jsonl` in a scenario.

    Args:
        scenario: the scenario.
    """
    types = {"index": int, "batch": int, **get_type_hints(Case)}
    required = [(name, types[name]) for name in ("index", "batch", "level", *scenario.case_fields)]
    optional: list[tuple[str, Any, Any]] = []
    for name, one in recorded_measures(scenario).items():
        if name in OURS and one.only_with != FOLLOW_UP:
            required.append((name, get_type_hints(one.function)["return"]))
        else:
            optional.append((name, float | None, None))
    optional += [
        ("draw", int, 0),
        ("margin", float | None, None),
        ("foretold", Prediction | None, None),
    ]
    return record_type("outcome", [*required, *optional])


@dataclass(frozen=True, slots=True)
class Episode:
    """A simulated case: its outcome and its trajectory.

    Attributes:
        outcome: the outcome.
        trajectory: the motion of all vehicles.
        files: hashes of the user's files that the VUT has loaded, by path.
        pov_files: hashes of those that the user's POV has loaded.
        ran_again: whether the case ran again after a worker had died, or after the loss of episodes
            that no case explains (`Rollout.ran_again`).
        in_sumo: whether SUMO ran the case, whichever engine the plan has.
        earlier: the same case with the earlier version, in a campaign against one.
    """

    outcome: Outcome
    trajectory: Trajectory
    files: Files = field(default_factory=dict)
    pov_files: Files = field(default_factory=dict)
    ran_again: bool = False
    in_sumo: bool = True
    earlier: Episode | None = None

    def at(self, index: int, batch: int, prediction: Prediction | None = None) -> Episode:
        """Return the episode at a place in a campaign.

        Args:
            index: place of the case.
            batch: its batch.
            prediction: its prediction. In a campaign against an earlier version it is that of the
                regression, and goes into the record of the earlier version.
        """
        earlier = self.earlier
        if earlier is not None:
            earlier, prediction = earlier.at(index, batch, prediction), None
        outcome = replace(self.outcome, index=index, batch=batch, prediction=prediction)
        return replace(self, outcome=outcome, earlier=earlier)
