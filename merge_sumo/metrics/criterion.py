"""The failure criterion: a named criterion, a condition on measures, or a requirement over time.

It gives each case a margin, below 0 for a failure, in units of the thresholds (`expression.py`), or
of lambda under the criterion of the paper.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

from merge_sumo.errors import UserError
from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.metrics.expression import Condition, Value, Vocabulary, parse_condition
from merge_sumo.metrics.measures import (
    FOLLOW_UP,
    MEASURES,
    Measures,
    known_measures,
    measures_of,
    recorded_measures,
)
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.paper import margin_of
from merge_sumo.metrics.temporal import check_formula, robustness, try_formula
from merge_sumo.scenario.scenario import VEHICLES, VUT, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory

PAPER = "paper"


@dataclass(frozen=True, slots=True)
class NamedCriterion:
    """A criterion with a name.

    Attributes:
        condition: text of the condition over measures under which a case fails.
        about: meaning of the condition, in a phrase.
    """

    condition: str
    about: str


CRITERIA = {
    PAPER: NamedCriterion(
        "score < -500",
        "front bumpers within 6 m when the VUT reaches M (a contact or a conflict)",
    ),
    "contact": NamedCriterion("clearance_m <= 0", "bodies overlap (a contact)"),
    "unsafe": NamedCriterion(
        "clearance_m <= 0 or brake_after_mps2 > 3",
        "a contact, or the car behind must brake harder than 3 m/s2, the limit of UN "
        "Regulation No. 79 for the car behind in a lane change",
    ),
}
"""Named criteria, for `fail_when`."""


TEXTS = {
    "end": frozenset(end.value for end in End if not end.is_error),
    "severity": frozenset(severity.value for severity in Severity),
    "merged_first": frozenset({"VUT", "POV"}),
    "nearest": frozenset(VEHICLES) - {VEHICLES[VUT]},
}
"""Values of measures that are texts. Errors are not judged under any criterion."""


@dataclass(frozen=True, slots=True)
class Criterion:
    """The failure criterion of a campaign.

    `as_written` is the text of the user, `condition` the same with the condition of a named
    criterion in place of its name, and `description` a clause for a report.

    Attributes:
        fail_when: the name of a criterion, or a condition over measures, as Python writes it.
        require: a formula of signal temporal logic that has to hold, in place of a condition; its
            robustness is the margin (`temporal.py`).

    Raises:
        UserError: the text is not a criterion.

    Example:
        >>> criterion = Criterion("ttc_s < 1.5")
        >>> criterion.outcome(trajectory).failed
    """

    fail_when: str = PAPER
    require: str | None = None

    def __post_init__(self) -> None:
        """Check the condition, and write it as Python would."""
        fail_when = self.fail_when.strip()
        if fail_when not in CRITERIA:
            _, fail_when = _parsed(self.fail_when)
        # The class is frozen: a dataclass sets its own fields this way.
        object.__setattr__(self, "fail_when", fail_when)
        if self.require is not None:
            if fail_when != PAPER:
                raise UserError("`fail_when` and `require` cannot be combined: choose one of them")
            object.__setattr__(self, "require", check_formula(self.require))

    def check(self, scenario: Scenario) -> None:
        """Check that the criterion can be evaluated in a scenario.

        Args:
            scenario: the scenario.

        Raises:
            UserError: the scenario lacks a measure of the condition, or rtamt cannot evaluate the
                formula.
        """
        if self.require is not None:
            try_formula(self.require)
            return
        missing = condition_of(self.condition).names - recorded_measures(scenario).keys()
        if missing:
            name = min(missing)
            needs = MEASURES[name].only_with
            how = ", or a `follow_up_s` above 0" if needs == FOLLOW_UP else ""
            raise UserError(
                f"`fail_when` uses {name}, which needs {needs}: choose another scenario than "
                f"{scenario.name}{how}"
            )

    @property
    def is_of_paper(self) -> bool:
        """Whether it is the criterion of the paper, with the margin of the score."""
        return self.fail_when == PAPER and self.require is None

    @property
    def uses_score(self) -> bool:
        """Whether it is a condition on the score, so that its margin may be the score's."""
        return self.require is None and "score" in condition_of(self.condition).names

    def description(self, scenario: Scenario) -> str:
        """Return the condition under which a case of a scenario fails.

        Args:
            scenario: the scenario.
        """
        if self.is_of_paper:
            limit = f"{scenario.dx_crash_m:g} m"
            return f"front bumpers within {limit} when the VUT reaches {scenario.goal}"
        return self.condition

    @property
    def as_written(self) -> str:
        """The criterion as a user writes it."""
        return self.fail_when if self.require is None else f"not ({self.require})"

    @property
    def condition(self) -> str:
        """The text of the condition under which a case fails; `condition_of` parses it."""
        named = CRITERIA.get(self.as_written)
        return self.as_written if named is None else named.condition

    def margin(self, measures: Measures) -> float | None:
        """Return the margin of an episode.

        Args:
            measures: its measures; with its motion where `require` is the criterion.

        Returns:
            The distance from failing, below 0 for a failure, without a unit; None after an error.
        """
        if measures.end.is_error:
            return None
        if self.is_of_paper:
            return margin_of(measures.score)
        if self.require is not None:
            return robustness(self.require, measures.trajectory)
        condition = condition_of(self.condition)
        return condition.margin(values_of(measures, condition.names))

    def outcomes(
        self, trajectories: Sequence[Trajectory], lines: CentreLines | None
    ) -> list[Outcome]:
        """Return the outcomes of episodes of one scenario, in one batch.

        A measure is calculated when it is first read.

        Args:
            trajectories: the motions.
            lines: centre lines of the road; None for none before M.
        """
        outcomes = []
        for index, measures in enumerate(measures_of(trajectories, lines)):
            margin, case = self.margin(measures), measures.trajectory.case
            outcomes.append(Outcome(index, 0, case, measures, margin=margin))
        return outcomes

    def outcome(self, trajectory: Trajectory, lines: CentreLines | None = None) -> Outcome:
        """Return the outcome of an episode outside of campaigns.

        Args:
            trajectory: the motion.
            lines: centre lines of the road; None for none before M.
        """
        return self.outcomes([trajectory], lines)[0]

    def close_calls(
        self, trajectories: Sequence[Trajectory], rounding: float, lines: CentreLines
    ) -> set[int]:
        """Return the indices where a rounding error in the motion could change the verdict.

        Args:
            trajectories: the motions.
            rounding: largest rounding error of a position, m.
            lines: centre lines of the road.
        """
        found = set()
        if self.is_of_paper:
            for index, trajectory in enumerate(trajectories):
                x_m = trajectory.motion[-1, :, 0]
                distance_m = abs(x_m[trajectory.nearest] - x_m[VUT])
                if abs(distance_m - trajectory.case.scenario.dx_crash_m) <= rounding:
                    found.add(index)
            return found
        for outcome in self.outcomes(trajectories, lines):
            # A margin has no unit. The same number serves: it is 100,000 times the measured error.
            if outcome.margin is not None and abs(outcome.margin) <= rounding:
                found.add(outcome.index)
        return found


PAPER_CRITERION = Criterion()


@lru_cache
def _parsed(text: str) -> tuple[Condition, str]:
    """Return a condition, which may name criteria, and its text as Python would write it."""
    named = {name: criterion.condition for name, criterion in CRITERIA.items()}
    return parse_condition(text, vocabulary(), named)


def condition_of(text: str) -> Condition:
    """Return the parsed condition of a criterion.

    Args:
        text: the condition as Python writes it.
    """
    return _parsed(text)[0]


def vocabulary() -> Vocabulary:
    """Return the measures of conditions by name: None for a number, or the possible texts."""
    numbers = [name for name, one in known_measures().items() if one.missing is not None]
    return {**dict.fromkeys(numbers), **TEXTS}


def values_of(measures: Measures, names: Iterable[str] | None = None) -> dict[str, Value]:
    """Return the values of measures in a condition.

    Args:
        measures: measures of an episode.
        names: names of the measures; None for the whole vocabulary.

    Returns:
        By name; a measure without a value has `Measure.missing`, or "" if it is a text. Where it is
        too late to brake or to avoid, the value is the worst: infinity at the bad end.
    """
    after_gap_m = measures.after_gap_m
    is_too_late = {
        "drac_mps2": measures.is_close,
        "last_avoidable_s": measures.is_close,
        "brake_after_mps2": measures.end is End.MERGED,
        "after_drac_mps2": after_gap_m is not None and after_gap_m <= 0.0,
    }
    values: dict[str, Value] = {}
    for name in vocabulary() if names is None else names:
        value, measure = measures.value(name), known_measures()[name]
        if value is None and measure.missing is None:  # a text
            value = ""
        elif value is None and is_too_late.get(name):
            value = math.inf if measure.worse == "high" else -math.inf
        elif value is None:
            value = measure.missing
        values[name] = value if isinstance(value, str) else float(value)
    return values
