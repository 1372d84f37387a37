"""Why a case fails: the smallest change of one thing with which it passes.

One thing changes, all others stay: a coordinate of the start, psi, a parameter of the VUT that is
named, or the level of the POV. Values are whole numbers of their last digit. From the value of the
case on values of a grid run, to both sides, until one passes or the range ends; between that and
the value before it the middle runs, and so on. Verdicts are not monotone: a pass between two values
of the grid is missed, so the step of the grid is recorded.

A case passes where it has a verdict and does not fail; a value that the controller refuses does not
pass. What is said of a case runs a second time, in SUMO.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Final

from msgspec import Meta

from merge_sumo.campaigns.run import Run, failures
from merge_sumo.campaigns.settings import named_again
from merge_sumo.engine.evaluate import Episodes, evaluate, workers_or_here
from merge_sumo.engine.plan import Engine, SimulationPlan
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.coordinates import coordinates, described
from merge_sumo.scenario.scenario import level_name
from merge_sumo.studies.counterfactuals import AVOIDANCE, Avoidance
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.studies.study_file import StudyFile
from merge_sumo.system.printable import quoted
from merge_sumo.system.records import Record, replaced, to_plain
from merge_sumo.system.result import Result
from merge_sumo.system.suggestions import either
from merge_sumo.system.workers import Workers
from merge_sumo.verdict.score import Outcome
from merge_sumo.vuts.base import VutSpec
from merge_sumo.vuts.factory import VutFactory
from merge_sumo.vuts.parameters import Range

START_STEPS: Final = 160
"""Values of the grid over a coordinate: 1 m and .06 m/s in the pool of the paper."""
PARAMETER_STEPS: Final = 40
"""Values of the grid over the range of a parameter, each of which is another VUT."""
BLOCK: Final = 8
"""Values of a side of the grid that run at a time, so that workers have something to do."""
ROUNDED: Final = 1e-6
"""Units that a value is off at most where it is a whole number of them."""
PSI: Final = 0.0
"""Orientation of a POV that becomes one of level 2."""

Trial = tuple[VutSpec, Case]
"""The spec of a VUT, and a case that it drives."""


class Axis(Record, frozen=True):
    """Values of one thing, and the nearest to that of a failure with which it passes.

    Attributes:
        name: a coordinate, as a field of the case, or a parameter of the VUT.
        value: its value in the failure.
        low: the least value of the range.
        high: the largest value.
        step: step of the grid.
        digits: digits behind the point of the values that were tried.
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

    def share(self, value: float) -> float:
        """Return the change to a value as a share of the range."""
        return abs(value - self.value) / (self.high - self.low)

    @property
    def _scale(self) -> float:
        """Units of the last digit in 1."""
        return float(10.0**self.digits)

    def nearer(self, value: float) -> float | None:
        """Return the value before one, seen from the failure's; None where there is none."""
        sign = 1 if value > self.value else -1
        before = (round(value * self._scale) - sign) / self._scale
        return before if (before - self.value) * sign > 0.0 else None

    def side(self, sign: int) -> Side:
        """Search one side of the failure's value for the first that passes."""
        at, end = (v * self._scale for v in (self.value, self.high if sign > 0 else self.low))
        if sign > 0:
            first, last = math.floor(at + ROUNDED) + 1, math.floor(end + ROUNDED)
        else:
            first, last = math.ceil(at - ROUNDED) - 1, math.ceil(end - ROUNDED)
        if (last - first) * sign < 0:
            return None
        stride = max(1, round(self.step * self._scale))
        fails = first - sign
        grid = [*range(fails + sign * stride, last, sign * stride), last]
        for begin in range(0, len(grid), BLOCK):
            block = grid[begin : begin + BLOCK]
            for units, passes in zip(block, (yield [u / self._scale for u in block]), strict=True):
                if passes:
                    return (yield from self._between(fails, units))
                fails = units
        return None

    def _between(self, fails: int, passes: int) -> Side:
        while abs(passes - fails) > 1:
            middle = (fails + passes) // 2
            (passed,) = yield [middle / self._scale]
            fails, passes = (fails, middle) if passed else (middle, passes)
        return passes / self._scale


Side = Generator[list[float], list[bool], float | None]
"""Asks for values and is told whether each passes; returns the first that does."""


class Explanation(Record, frozen=True):
    """The smallest changes of one thing that were found to make a failure pass.

    Attributes:
        index: of the case in its campaign.
        start: its coordinates, with psi at level 2, in the pool's order.
        levels: by name of another level of the POV, whether the case passes there.
        parameters: the parameters of the VUT that were named.
    """

    index: Annotated[int, Meta(ge=0)]
    start: tuple[Axis, ...]
    levels: dict[str, bool]
    parameters: tuple[Axis, ...] = ()

    @property
    def nearest_start(self) -> tuple[str, float] | None:
        """The coordinate and the value of the smallest change of the start that passes."""
        found = [(axis.share(axis.passing[0]), axis) for axis in self.start if axis.passing]
        axis = min(found, key=lambda pair: pair[0])[1] if found else None
        return None if axis is None else (axis.name, axis.passing[0])


EXPLANATIONS: Final = StudyFile("explanations.jsonl", Explanation)


@dataclass(frozen=True, slots=True, repr=False)
class ExplanationResult(Result):
    """The smallest changes with which a failure of a campaign passes.

    Attributes:
        run: the campaign.
        found: what was found.
    """

    run: Run
    found: Explanation

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {**to_plain(self.found), "file": str(self.run.folder / EXPLANATIONS.name)}

    def lines(self) -> list[str]:
        """Return the failure, its changes, and a command that runs the smallest."""
        outcome, folder = self.run.outcome(self.found.index), quoted(self.run.folder)
        avoidance = AVOIDANCE.read_lines(self.run).get(self.found.index)
        words = in_words(self.found, outcome, avoidance)
        lines = [f"case {outcome.index}, POV level {level_name(outcome.case.level)}: "]
        lines[0] += described(outcome.case)
        lines += [f"  {sentence}" for sentence in words]
        if self.found.nearest_start is not None:
            name, value = self.found.nearest_start
            at = f"--at {name}={value!r}"
            at += named_again(self.run.settings)
            lines.append(f"look at it: merge-sumo run --case {folder} {outcome.index} {at}")
        return [*lines, f"in the report: merge-sumo report {folder}"]


def failure_of(run: Run, index: int | None) -> Outcome:
    """Find a failure of a run by its index, by default the worst.

    Raises `UserError` for a case that is there no more, or did not fail.
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
    run: Run,
    plan: SimulationPlan,
    *,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
) -> None:
    """Explain the worst failure of a campaign that has just ended, where that takes no SUMO.

    Nothing is written for drivers that need SUMO, nor where the engines differ.
    """
    worst = failures(run.cases)[:1]
    if plan.needs_sumo is not None or not worst:
        return
    try:
        found = _Neighbours(plan.with_engine(None), worst[0], workers=workers).found(check)
    except UserError:
        return
    _write(run, found)


def explain(
    study: RunStudy, index: int | None = None, ranges: Sequence[Range] = ()
) -> ExplanationResult:
    """Explain a failure of a campaign, and write that into its folder.

    Args:
        study: the campaign, and how its cases run.
        index: of the failure; the worst by default.
        ranges: parameters of the VUT that are searched, too.

    Raises:
        UserError: for a case that is there no more or did not fail, for a campaign with a net or
            POVs of another day, for a parameter that the VUT does not have, and where a case that
            runs a second time ends otherwise.
    """
    outcome = failure_of(study.run, index)
    study.check_same_system()
    with workers_or_here(study.workers) as opened:
        found = _Neighbours(study.plan, outcome, ranges, opened).found()
    _write(study.run, found)
    study.on_cases(1)
    return ExplanationResult(study.run, found)


def _write(run: Run, found: Explanation) -> None:
    """Write an explanation beside those of other cases."""
    known = {**EXPLANATIONS.read_lines(run), found.index: found}
    EXPLANATIONS.write_lines(run.folder, [known[index] for index in sorted(known)])


class _Neighbours:
    """Runs a failure with other values."""

    def __init__(
        self,
        plan: SimulationPlan,
        outcome: Outcome,
        ranges: Sequence[Range] = (),
        workers: Workers | None = None,
    ) -> None:
        """Take the plan, the failure, the parameters that are searched, and where cases run."""
        self._plan, self._outcome, self._workers = plan, outcome, workers
        case, present = outcome.case, plan.vut.values_of(ranges)
        self._axes = [
            _axis(c.field, getattr(case, c.field), c.dimension.low, c.dimension.high, c.digits)
            for c in coordinates(case.scenario, (case.level,))
        ]
        self._coordinates = len(self._axes)
        self._axes += [
            _axis(r.name, present[r.name], r.low, r.high, r.digits, PARAMETER_STEPS) for r in ranges
        ]
        self._levels = [level for level in plan.povs.levels if level != case.level]

    def found(self, check: Callable[[], None] = lambda: None) -> Explanation:
        """Search, and confirm what was found; raises `UserError` where a case ends otherwise.

        `check` is called after each step, and may raise to stop there.
        """
        itself = self._plan.vut.spec, self._outcome.case
        fails, *at_levels = self._passes([itself, *map(self._at_level, self._levels)])
        if fails:
            raise self._other_now()
        levels = dict(zip(map(level_name, self._levels), at_levels, strict=True))
        nearest = self._nearest(check)
        axes = tuple(
            replaced(axis, below=nearest[place, -1], above=nearest[place, 1])
            for place, axis in enumerate(self._axes)
        )
        self._confirm(axes, at_levels)
        start, parameters = axes[: self._coordinates], axes[self._coordinates :]
        return Explanation(self._outcome.index, start, levels, parameters)

    def _nearest(self, check: Callable[[], None]) -> dict[tuple[int, int], float | None]:
        """Search both sides of each axis, all at a time; return the nearest values that pass."""
        every = [(place, sign) for place in range(len(self._axes)) for sign in (-1, 1)]
        sides = {(place, sign): self._axes[place].side(sign) for place, sign in every}
        nearest: dict[tuple[int, int], float | None] = dict.fromkeys(every)
        answers: dict[tuple[int, int], Any] = dict.fromkeys(every)
        while answers:
            asked: dict[tuple[int, int], list[float]] = {}
            for key, passes in answers.items():
                try:
                    asked[key] = sides[key].send(passes)
                except StopIteration as end:
                    nearest[key] = end.value
            trials = [self._trial(key[0], v) for key, values in asked.items() for v in values]
            passing = iter(self._passes(trials))
            answers = {key: [next(passing) for _ in values] for key, values in asked.items()}
            check()
        return nearest

    def _trial(self, place: int, value: float) -> Trial:
        vut, case = self._plan.vut.spec, self._outcome.case
        changed: dict[str, Any] = {self._axes[place].name: value}
        if place < self._coordinates:
            return vut, replace(case, **changed)
        return vut.with_values(changed), case

    def _at_level(self, level: int) -> Trial:
        case = replace(self._outcome.case, level=level, svo_rad=PSI if level == 2 else None)
        return self._plan.vut.spec, case

    def _passes(self, trials: Sequence[Trial], engine: Engine | None = None) -> list[bool]:
        """Run trials, those of a VUT at a time; a spec that is refused does not pass."""
        plan = self._plan if engine is None else replace(self._plan, engine=engine)
        passes = [False] * len(trials)
        for spec in dict.fromkeys(spec for spec, _ in trials):
            places = [place for place, (of, _) in enumerate(trials) if of == spec]
            cases, own = [trials[place][1] for place in places], spec == plan.vut.spec
            try:
                vut = plan.vut if own else VutFactory(spec, plan.vut.options)
                ran = list(evaluate(replace(plan, vut=vut), cases, self._workers, pass_of))
            except UserError:
                if own:
                    raise
                continue
            for place, passed in ran:
                passes[places[place]] = passed
        return passes

    def _confirm(self, axes: Sequence[Axis], at_levels: Sequence[bool]) -> None:
        """Run what is said a second time, in SUMO, and values that are a unit nearer."""
        claims = [((self._plan.vut.spec, self._outcome.case), False)]
        claims += zip(map(self._at_level, self._levels), at_levels, strict=True)
        for place, axis in enumerate(axes):
            for value in axis.passing:
                claims.append((self._trial(place, value), True))
                nearer = axis.nearer(value)
                if nearer is not None:
                    claims.append((self._trial(place, nearer), False))
        trials, expected = zip(*claims, strict=True)
        if self._passes(trials, Engine.SUMO) != list(expected):
            raise self._other_now()

    def _other_now(self) -> UserError:
        return UserError(
            f"case {self._outcome.index} ends otherwise when it runs again: the VUT is another "
            "than that of the campaign, or does not repeat itself, and nothing can be said of its "
            "changes"
        )


def _axis(
    name: str, value: float, low: float, high: float, digits: int, steps: int = START_STEPS
) -> Axis:
    unit = 10.0**-digits
    step = max(1, round((high - low) / steps / unit)) * unit
    return Axis(name, float(value), low, high, round(step, digits), digits)


def pass_of(results: Episodes) -> list[bool]:
    """Return of each result whether the case has a verdict and does not fail."""
    return [verdict.is_tested and not verdict.failed for verdict in results.verdicts()]


def in_words(
    found: Explanation, outcome: Outcome, avoidance: Avoidance | None = None
) -> Iterator[str]:
    """Yield what is known of a failure: axes, levels, and until when something helped.

    `avoidance` says which drivers would have avoided it, where that is known.
    """
    for axis in found.start:
        yield _axis_in_words(axis, *name_and_unit(outcome.case, axis.name))
    for axis in found.parameters:
        yield _axis_in_words(axis, f"the VUT's {axis.name}", "")
    for level, passes in found.levels.items():
        psi = f", psi {PSI:g}" if level == level_name(2) else ""
        verb = "passes" if passes else "does not pass"
        yield f"the same start {verb} at level {level}{psi}"
    yield from _last_moment(outcome, avoidance)


def name_and_unit(case: Case, field: str) -> tuple[str, str]:
    """Return name and unit of a coordinate; of an unknown one its field."""
    named = {c.field: (c.name, c.unit) for c in coordinates(case.scenario, (case.level,))}
    return named.get(field, (field, ""))


def _axis_in_words(axis: Axis, name: str, unit: str) -> str:
    def text(value: float) -> str:
        return f"{value:.{axis.digits}f} {unit}".rstrip()

    passing = either(map(text, axis.passing)) if axis.passing else "no other value"
    return (
        f"{name} is {text(axis.value)}; passes at {passing} (tried from {text(axis.low)} to "
        f"{text(axis.high)}, every {text(axis.step)})"
    )


def _last_moment(outcome: Outcome, avoidance: Avoidance | None) -> Iterator[str]:
    """Yield until when the VUT could still do something."""
    measures, scenario = outcome.measures, outcome.case.scenario
    kept = f"{scenario.dx_crash_m:g} m at {'M' if scenario.place == 'M' else 'this place'}"
    if measures.last_avoidable_s is not None:
        yield (
            f"the last way out closes at {measures.last_avoidable_s:.1f} s: after that neither "
            f"full braking nor full acceleration of the VUT keeps {kept}, with the POV moving as "
            "it did, and then at its last speed"
        )
    elif measures.avoidable is False:
        yield f"at no time would full braking or full acceleration of the VUT have kept {kept}"
    if avoidance is not None and avoidance.latest_takeover_s is not None:
        until_s = avoidance.latest_takeover_s
        yield f"the fuzzy safety model can take over until {until_s:.1f} s and avoid it"
