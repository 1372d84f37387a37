"""Explanations: the smallest change of one coordinate or parameter with which a failure passes."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter
from typing import Annotated, Any

from msgspec import Meta, structs

from merge_sumo.analysis.run_study import RunStudy, StudyFile
from merge_sumo.campaigns.recorded import RecordedCampaign, failures
from merge_sumo.controllers.parameters import Range, values_of
from merge_sumo.controllers.spec import ControllerSpec
from merge_sumo.errors import UserError
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.records import Record, to_plain
from merge_sumo.result import Result
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import Coordinate, level_name
from merge_sumo.simulation.evaluate import evaluate
from merge_sumo.simulation.plan import Engine, SimulationPlan
from merge_sumo.workers import open_workers

START_STEPS = 160
"""Steps of the grid over a coordinate: 1 m and .06 m/s in the pool of the paper."""
PARAMETER_STEPS = 40
"""Steps of the grid over the range of a parameter; each value is another VUT."""
BLOCK = 16
"""Values of the grid that run at a time, on one side of the failure's value."""
PSI = 0.0
"""Orientation of a POV that becomes one of level 2."""

Trial = tuple[ControllerSpec, Case]
"""A VUT by its spec, and a case that it drives."""


class Axis(Record, frozen=True):
    """Values of a coordinate or a parameter, and the nearest ones with which a failure passes.

    Attributes:
        name: field of the coordinate in the case, or name of the parameter of the VUT.
        value: its value in the failure, in the unit of the coordinate or the parameter.
        low: lower end of the range that was searched.
        high: upper end.
        step: step of the grid.
        digits: digits after the point of the values that were tried.
        below: the nearest passing value below that of the failure; None where none was found.
        above: the nearest passing value above it, likewise.
    """

    name: Annotated[str, Meta(min_length=1, max_length=100)]
    value: float
    low: float
    high: float
    step: float
    digits: Annotated[int, Meta(ge=0, le=100)]
    below: float | None = None
    above: float | None = None

    @property
    def passing(self) -> list[float]:
        """The nearest values that pass, the smallest change first."""
        found = [value for value in (self.below, self.above) if value is not None]
        return sorted(found, key=lambda value: abs(value - self.value))

    @property
    def scale(self) -> float:
        """Units of the last digit in 1."""
        return float(10.0**self.digits)

    def grid(self, sign: int) -> list[int]:
        """Return the grid on one side of the failure's value, in units of the last digit.

        It begins with the failure's value, rounded away from that side. It is empty where the
        range ends there.

        Args:
            sign: 1 for the values above that of the failure, -1 for those below.
        """
        # A whole number of units may be off by a rounding error.
        own = math.floor(sign * self.value * self.scale + 1e-6)
        end = self.high if sign > 0 else self.low
        last = math.floor(sign * end * self.scale + 1e-6)
        if last <= own:
            return []
        stride = max(1, round(self.step * self.scale))
        return [sign * units for units in (own, *range(own + stride, last, stride), last)]


class Explanation(Record, frozen=True):
    """The smallest changes of one coordinate or parameter with which a failure passes.

    Attributes:
        index: of the case in its campaign.
        start: its coordinates in the order of the pool, with psi at level 2.
        levels: whether the case passes at the other levels of the POV, by their name.
        parameters: parameters of the VUT.
        vut: spec of the VUT that drove; None for that of the campaign.
    """

    index: Annotated[int, Meta(ge=0)]
    start: tuple[Axis, ...]
    levels: dict[str, bool]
    parameters: tuple[Axis, ...] = ()
    vut: str | None = None

    @property
    def key(self) -> tuple[int, str]:
        """The case and the VUT: a file has one explanation for each such pair."""
        return self.index, self.vut or ""


EXPLANATIONS = StudyFile("explanations.jsonl", Explanation)
"""A line for each failure and VUT that was explained."""


@dataclass(frozen=True, slots=True, repr=False)
class ExplanationResult(Result):
    """The smallest changes with which a failure of a campaign passes.

    `ms.explain` returns it.

    Example:
        ```python
        explained = ms.explain("runs/latest", 19)
        for axis in explained.found.start:
            print(axis.name, axis.value, "passes at", axis.passing)
        ```

    Attributes:
        run: the campaign.
        found: the changes.
    """

    run: RecordedCampaign
    found: Explanation

    def to_record(self) -> dict[str, Any]:
        """Return the object that `--json` prints."""
        return {**to_plain(self.found), "file": str(self.run.folder / EXPLANATIONS.name)}


def failure_of(run: RecordedCampaign, index: int | None) -> Outcome:
    """Return a failure of a campaign.

    Args:
        run: the campaign.
        index: index of the failure; None for the worst.

    Raises:
        UserError: for an index without a case, and a case that did not fail.
    """
    worst = failures(run.cases)
    if index is None and not worst:
        raise UserError(f"{run.folder} has no failure to explain")
    outcome = worst[0] if index is None else run.outcome(index)
    if not outcome.failed:
        raise UserError(f"case {index} did not fail: choose a case that failed")
    return outcome


def write_worst_explanation(study: RunStudy) -> None:
    """Explain the worst failure of a campaign that has just ended.

    Nothing is written for drivers that need SUMO, nor where the engines differ.

    Args:
        study: the campaign, and how its cases run.
    """
    worst = failures(study.run.cases)
    if study.plan.needs_sumo is None and worst:
        plan = study.plan.with_engine(None)
        # Worker processes would take longer to start than these cases.
        with suppress(UserError), open_workers(1) as here:
            here_alone = replace(study, plan=plan, workers=here)
            _write(study.run, _Search(here_alone, worst[0]).explanation(()))


def explain(
    study: RunStudy, index: int | None = None, ranges: Sequence[Range] = ()
) -> ExplanationResult:
    """Explain a failure of a campaign, and write the explanation into its folder.

    Args:
        study: the campaign, and how its cases run.
        index: index of the failure; None for the worst.
        ranges: parameters of the VUT, with the range to search.

    Returns:
        The explanation, with its campaign.

    Raises:
        UserError: for an index without a failure, for a campaign with another net or other POVs,
            for a parameter that the VUT does not have, and where a case that runs a second time
            ends otherwise.
    """
    outcome = failure_of(study.run, index)
    study.check_same_system()
    found = _Search(study, outcome).explanation(ranges)
    if study.settings.vut != study.run.settings.vut:
        found = structs.replace(found, vut=study.settings.vut)
    _write(study.run, found)
    study.on_cases(1)
    return ExplanationResult(study.run, found)


def _write(run: RecordedCampaign, found: Explanation) -> None:
    """Write an explanation next to those of other cases and other VUTs."""
    kept = [one for one in EXPLANATIONS.read_lines(run) if one.key != found.key]
    EXPLANATIONS.write_lines(run.folder, sorted([*kept, found], key=lambda one: one.key))


class _Search:
    """Runs a failure again with other values."""

    def __init__(self, study: RunStudy, outcome: Outcome) -> None:
        """Take the failure, and how its cases run."""
        self._study, self._index, self._case = study, outcome.index, outcome.case
        self._vut = study.plan.vut.spec
        self._reported: dict[Trial, bool] = {(self._vut, self._case): False}
        """Whether the trials pass that the explanation reports; confirmed in SUMO at the end."""

    def explanation(self, ranges: Sequence[Range]) -> Explanation:
        """Search along all axes, and confirm the result in SUMO.

        Raises:
            UserError: where a case that runs a second time ends otherwise.
        """
        case, plan = self._case, self._study.plan
        present = values_of(plan.vut, ranges)
        self._confirm(plan)
        levels = {}
        for level in plan.povs.levels:
            if level != case.level:
                psi = PSI if level == 2 else None
                trial = self._vut, replace(case, level=level, svo_rad=psi)
                (passes,) = self._passes(plan, [trial])
                levels[level_name(level)] = self._reported[trial] = passes
        start = []
        for c in case.scenario.dimensions(case.level):
            axis = _axis(c.field, getattr(case, c.field), c, START_STEPS)
            start.append(self._searched(axis, self._with_start))
        parameters = []
        for one in ranges:
            axis = _axis(one.name, present[one.name], one, PARAMETER_STEPS)
            parameters.append(self._searched(axis, self._with_parameter))
        self._confirm(replace(plan, engine=Engine.SUMO))
        return Explanation(self._index, tuple(start), levels, tuple(parameters))

    def _confirm(self, plan: SimulationPlan) -> None:
        if self._passes(plan, self._reported) != list(self._reported.values()):
            raise UserError(
                f"case {self._index} ended differently when it ran again: the VUT has changed "
                "since the campaign, or is not repeatable"
            )

    def _searched(self, axis: Axis, trial: Callable[[str, float], Trial]) -> Axis:
        """Return an axis with the nearest values that pass."""

        def passes(values: list[float]) -> list[bool]:
            trials = [trial(axis.name, value) for value in values]
            return self._passes(self._study.plan, trials)

        below, above = nearest(axis, -1, passes), nearest(axis, 1, passes)
        for value in (below, above):
            if value is not None:
                self._reported[trial(axis.name, value)] = True
        return structs.replace(axis, below=below, above=above)

    def _with_start(self, name: str, value: float) -> Trial:
        changed: dict[str, Any] = {name: value}
        return self._vut, replace(self._case, **changed)

    def _with_parameter(self, name: str, value: float) -> Trial:
        return self._vut.with_value(name, value), self._case

    def _passes(self, plan: SimulationPlan, trials: Iterable[Trial]) -> list[bool]:
        """Run trials, those of a VUT at a time; a value that the controller refuses fails."""
        passes: list[bool] = []
        for spec, of_vut in groupby(trials, key=itemgetter(0)):
            cases = [case for _, case in of_vut]
            try:
                vut = plan.vut if spec == self._vut else plan.vut.with_spec(spec)
                changed = replace(plan, vut=vut)
                passes += list(
                    evaluate(changed, cases, self._study.workers, passes_without_contact)
                )
            except UserError:
                if spec == self._vut:
                    raise
                passes += [False] * len(cases)
        return passes


def _axis(name: str, value: float, range_: Coordinate | Range, steps: int) -> Axis:
    """Return an axis over a range whose grid has a number of steps, or fewer."""
    low, high, digits = range_.low, range_.high, range_.digits
    unit = 10.0**-digits
    step = max(1, round((high - low) / steps / unit)) * unit
    return Axis(name, float(value), low, high, round(step, digits), digits)


def nearest(axis: Axis, sign: int, passes: Callable[[list[float]], list[bool]]) -> float | None:
    """Return the first value of one side of an axis that passes; None where none does.

    The values of the grid run until one passes; then the interval before it is halved. Verdicts are
    not monotone: a pass between two values of the grid is missed.

    Args:
        axis: the axis.
        sign: 1 for the values above that of the failure, -1 for those below.
        passes: returns whether the case passes with each of some values.
    """
    grid = axis.grid(sign)
    for begin in range(0, len(grid) - 1, BLOCK):
        block = grid[begin : begin + BLOCK + 1]
        passed = passes([units / axis.scale for units in block[1:]])
        if True in passed:
            fails, succeeds = block[passed.index(True) :][:2]
            break
    else:
        return None
    while abs(succeeds - fails) > 1:
        middle = (fails + succeeds) // 2
        if passes([middle / axis.scale]) == [True]:
            succeeds = middle
        else:
            fails = middle
    return succeeds / axis.scale


def passes_without_contact(episode: Episode) -> bool:
    """Return whether a case passes and no bodies touch.

    Args:
        episode: the episode of the case.
    """
    outcome = episode.outcome
    return outcome.passes and outcome.measures.severity != Severity.CONTACT
