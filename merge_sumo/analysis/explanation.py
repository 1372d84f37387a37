"""Why a case fails: the smallest change of one thing with which it passes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Annotated, Any

from msgspec import Meta

from merge_sumo.analysis.run_study import RunStudy, StudyFile
from merge_sumo.campaigns.run import Run, failures
from merge_sumo.controllers.parameters import Range, values_of
from merge_sumo.controllers.spec import ControllerSpec
from merge_sumo.errors import UserError
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.records import Record, replaced, to_plain
from merge_sumo.result import Result
from merge_sumo.scenario.case import Case, coordinates
from merge_sumo.scenario.scenario import level_name
from merge_sumo.simulation.evaluate import evaluate
from merge_sumo.simulation.plan import Engine, SimulationPlan
from merge_sumo.workers import Workers, open_workers

START_STEPS = 160
"""Values of the grid over a coordinate: 1 m and .06 m/s in the pool of the paper."""
PARAMETER_STEPS = 40
"""Values of the grid over the range of a parameter, each of which is another VUT."""
BLOCK = 16
"""Values of a side of the grid that run at a time, so that workers have something to do."""
PSI = 0.0
"""Orientation of a POV that becomes one of level 2."""

Trial = tuple[ControllerSpec, Case]
"""The spec of a VUT, and a case that it drives."""


class Axis(Record, frozen=True):
    """Values of one thing, and the nearest to that of a failure with which it passes.

    Values are whole numbers of units of their last digit.

    Attributes:
        name: a coordinate, as a field of the case, or a parameter of the VUT.
        value: its value in the failure.
        low: the least value of the range.
        high: the largest value.
        step: step of the grid.
        digits: digits after the point of the values that were tried.
        below: the nearest value under the failure's that passes; None where none was found.
        above: the nearest value over it.
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
    def passing(self) -> tuple[float, ...]:
        """The nearest values that pass, the smallest change first."""
        found = (value for value in (self.below, self.above) if value is not None)
        return tuple(sorted(found, key=lambda value: abs(value - self.value)))

    @property
    def scale(self) -> float:
        """Units of the last digit in 1."""
        return float(10.0**self.digits)

    def grid(self, sign: int) -> list[int]:
        """Return the values of one side in units, from the failure's on, which is rounded to it.

        Empty where the range ends there.
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
    """The smallest changes of one thing that were found to make a failure pass.

    Attributes:
        index: of the case in its campaign.
        start: its coordinates, with psi at level 2, in the pool's order.
        levels: by name of another level of the POV, whether the case passes there.
        parameters: the parameters of the VUT that were named.
        vut: the VUT that drove; None for that of the campaign.
    """

    index: Annotated[int, Meta(ge=0)]
    start: tuple[Axis, ...]
    levels: dict[str, bool]
    parameters: tuple[Axis, ...] = ()
    vut: str | None = None

    @property
    def key(self) -> tuple[int, str]:
        """The case and the VUT, of which a file has one explanation."""
        return self.index, self.vut or ""

    @property
    def nearest_start(self) -> tuple[str, float] | None:
        """The coordinate and the value of the smallest change of the start that passes."""
        nearest = None
        least = math.inf
        for axis in self.start:
            for value in axis.passing[:1]:
                share = abs(value - axis.value) / (axis.high - axis.low)
                if share < least:
                    least, nearest = share, (axis.name, value)
        return nearest


EXPLANATIONS = StudyFile("explanations.jsonl", Explanation)
"""A line for each failure and VUT that was explained."""


@dataclass(frozen=True, slots=True, repr=False)
class ExplanationResult(Result):
    """The smallest changes with which a failure of a campaign passes.

    Attributes:
        run: the campaign.
        found: the changes.
    """

    run: Run
    found: Explanation

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {**to_plain(self.found), "file": str(self.run.folder / EXPLANATIONS.name)}


def failure_of(run: Run, index: int | None) -> Outcome:
    """Return a failure of a campaign by its index, by default the worst.

    Raises:
        UserError: for an index without a case, and a case that did not fail.
    """
    worst = failures(run.cases)[:1]
    if index is None and not worst:
        raise UserError(f"{run.folder} has no failure: nothing can be explained")
    outcome = worst[0] if index is None else run.outcome(index)
    if not outcome.failed:
        such = "".join(f", such as {o.index}" for o in worst)
        raise UserError(f"case {index} did not fail: name a failure{such}")
    return outcome


def note_explanation(
    run: Run, plan: SimulationPlan, check: Callable[[], None] = lambda: None
) -> None:
    """Explain the worst failure of a campaign that has just ended, where that takes no SUMO.

    Nothing is written for drivers that need SUMO, nor where the engines differ.

    Args:
        run: the campaign.
        plan: how its cases ran.
        check: called before each step of the search; may raise to stop there.
    """
    worst = failures(run.cases)[:1]
    if plan.needs_sumo is None and worst:
        # Worker processes would take longer to start than these cases.
        with suppress(UserError), open_workers(1) as here:
            _write(run, _Search(plan.with_engine(None), worst[0], here, check).explanation())


def explain(
    study: RunStudy, index: int | None = None, ranges: Sequence[Range] = ()
) -> ExplanationResult:
    """Explain a failure of a campaign, and write that into its folder.

    Args:
        study: the campaign, and how its cases run.
        index: of the failure; the worst by default.
        ranges: parameters of the VUT that are searched, too.

    Raises:
        UserError: for an index without a failure, for a campaign with a net or POVs of another
            day, for a parameter that the VUT does not have, and where a case that runs a second
            time ends otherwise.
    """
    outcome = failure_of(study.run, index)
    study.check_same_system()
    found = _Search(study.plan, outcome, study.workers).explanation(ranges)
    if study.settings.vut != study.run.settings.vut:
        found = replaced(found, vut=study.settings.vut)
    _write(study.run, found)
    study.on_cases(1)
    return ExplanationResult(study.run, found)


def _write(run: Run, found: Explanation) -> None:
    """Write an explanation next to those of other cases and other VUTs."""
    kept = [one for one in EXPLANATIONS.read_lines(run) if one.key != found.key]
    EXPLANATIONS.write_lines(run.folder, sorted([*kept, found], key=lambda one: one.key))


class _Search:
    """Runs a failure again with other values."""

    def __init__(
        self,
        plan: SimulationPlan,
        outcome: Outcome,
        workers: Workers | None = None,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        """Take the failure, and how it runs.

        Args:
            plan: how its cases run.
            outcome: the failure.
            workers: where they run, by default in this process.
            check: called before cases run; may raise to stop there.
        """
        self._plan, self._outcome, self._case = plan, outcome, outcome.case
        self._workers, self._check = workers, check
        self._claims: dict[Trial, bool] = {}
        """Whether cases pass that the explanation states."""

    def explanation(self, ranges: Sequence[Range] = ()) -> Explanation:
        """Search along all axes, and confirm the result in SUMO.

        Raises:
            UserError: where a case that runs a second time ends otherwise.
        """
        case, vut = self._case, self._plan.vut.spec
        present = values_of(self._plan.vut, ranges)
        trials = [(vut, case)]
        levels = [level for level in self._plan.povs.levels if level != case.level]
        for level in levels:
            trials.append((vut, replace(case, level=level, svo_rad=PSI if level == 2 else None)))
        itself, *at_levels = self._passes(self._plan, trials)
        if itself:
            raise self._ends_otherwise()
        self._claims = dict(zip(trials, (itself, *at_levels), strict=True))
        start = []
        for c in coordinates(case.scenario, (case.level,)):
            bounds = c.dimension.low, c.dimension.high
            axis = _axis(c.field, getattr(case, c.field), *bounds, c.digits, START_STEPS)
            start.append(self._searched(axis, self._with_start))
        parameters = []
        for r in ranges:
            axis = _axis(r.name, present[r.name], r.low, r.high, r.digits, PARAMETER_STEPS)
            parameters.append(self._searched(axis, self._with_parameter))
        in_sumo = replace(self._plan, engine=Engine.SUMO)
        if self._passes(in_sumo, list(self._claims)) != list(self._claims.values()):
            raise self._ends_otherwise()
        names = map(level_name, levels)
        of_levels = dict(zip(names, at_levels, strict=True))
        return Explanation(self._outcome.index, tuple(start), of_levels, tuple(parameters))

    def _searched(self, axis: Axis, trial: Callable[[str, float], Trial]) -> Axis:
        """Return an axis with the nearest values that pass."""

        def ask(values: list[float]) -> list[bool]:
            return self._passes(self._plan, [trial(axis.name, value) for value in values])

        for side, sign in (("below", -1), ("above", 1)):
            found = nearest(axis, sign, ask)
            if found is not None:
                fails, passes = found
                axis = replaced(axis, **{side: passes})
                self._claims[trial(axis.name, passes)] = True
                if (fails - axis.value) * sign > 0.0:
                    self._claims[trial(axis.name, fails)] = False
        return axis

    def _with_start(self, name: str, value: float) -> Trial:
        changed: dict[str, Any] = {name: value}
        return self._plan.vut.spec, replace(self._case, **changed)

    def _with_parameter(self, name: str, value: float) -> Trial:
        return self._plan.vut.spec.with_values({name: value}), self._case

    def _passes(self, plan: SimulationPlan, trials: Sequence[Trial]) -> list[bool]:
        """Run trials, those of a VUT at a time; a value that the controller refuses fails."""
        self._check()
        passes = dict.fromkeys(trials, False)
        for spec in dict.fromkeys(spec for spec, _ in trials):
            cases = [case for of, case in trials if of == spec]
            own = spec == plan.vut.spec
            try:
                vut = plan.vut if own else plan.vut.with_spec(spec)
                ran = evaluate(replace(plan, vut=vut), cases, self._workers, pass_of)
                for case, passed in zip(cases, ran, strict=True):
                    passes[spec, case] = passed
            except UserError:
                if own:
                    raise
        return [passes[trial] for trial in trials]

    def _ends_otherwise(self) -> UserError:
        return UserError(
            f"case {self._outcome.index} ends otherwise when it runs again: the VUT is another "
            "than that of the campaign, or does not repeat itself, and nothing can be said of its "
            "changes"
        )


def _axis(name: str, value: float, low: float, high: float, digits: int, steps: int) -> Axis:
    """Return an axis whose grid has a number of steps over its range, or fewer."""
    unit = 10.0**-digits
    step = max(1, round((high - low) / steps / unit)) * unit
    return Axis(name, float(value), low, high, round(step, digits), digits)


def nearest(
    axis: Axis, sign: int, ask: Callable[[list[float]], list[bool]]
) -> tuple[float, float] | None:
    """Search one side of an axis for the first value that passes.

    The values of the grid run until one passes; then the interval before it is halved. Verdicts are
    not monotone: a pass between two values of the grid is missed.

    Args:
        axis: the axis.
        sign: 1 for the values above that of the failure, -1 for those below.
        ask: returns whether values pass.

    Returns:
        The value before, which does not pass, and the first that does; None where none passes.
    """
    grid = axis.grid(sign)
    for begin in range(0, len(grid) - 1, BLOCK):
        block = grid[begin : begin + BLOCK + 1]
        passed = ask([units / axis.scale for units in block[1:]])
        if True in passed:
            first = passed.index(True)
            fails, passes = block[first : first + 2]
            break
    else:
        return None
    while abs(passes - fails) > 1:
        middle = (fails + passes) // 2
        if ask([middle / axis.scale]) == [True]:
            passes = middle
        else:
            fails = middle
    return fails / axis.scale, passes / axis.scale


def pass_of(episode: Episode) -> bool:
    """Return whether a case has a verdict, does not fail, and ends without a contact."""
    outcome = episode.outcome
    touches = outcome.measures.severity == Severity.CONTACT
    return outcome.is_tested and not outcome.failed and not touches
