"""Why a case fails: the smallest change of one thing with which it passes.

One thing changes, all others stay: a coordinate of the start, psi, a parameter of the VUT that is
named, or the level of the POV. Values are whole numbers of their last digit. From the value of the
case on the values of a grid run, to both sides; between the first that passes and the value before
it the middle runs, and so on. Verdicts are not monotone: a pass between two values
of the grid is missed, so the step of the grid is recorded.

A case passes where it has a verdict and does not fail; a value that the controller refuses does not
pass. What is said of a case runs a second time, in SUMO.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Any, Final

from msgspec import Meta

from merge_sumo.analysis.run_study import RunStudy, StudyFile
from merge_sumo.campaigns.run import Run, failures
from merge_sumo.controllers.parameters import Range, values_of
from merge_sumo.controllers.spec import ControllerSpec
from merge_sumo.errors import UserError
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.records import Record, replaced, to_plain
from merge_sumo.result import Result
from merge_sumo.scenario.case import Case, coordinates
from merge_sumo.scenario.scenario import level_name
from merge_sumo.simulation.evaluate import evaluate
from merge_sumo.simulation.plan import Engine, SimulationPlan
from merge_sumo.workers import Workers, workers_or_here

START_STEPS: Final = 160
"""Values of the grid over a coordinate: 1 m and .06 m/s in the pool of the paper."""
PARAMETER_STEPS: Final = 40
"""Values of the grid over the range of a parameter, each of which is another VUT."""
BLOCK: Final = 16
"""Values of a side of the grid that run at a time, so that workers have something to do."""
ROUNDED: Final = 1e-6
"""Units that a value is off at most where it is a whole number of them."""
PSI: Final = 0.0
"""Orientation of a POV that becomes one of level 2."""

Trial = tuple[ControllerSpec, Case]
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
    def scale(self) -> float:
        """Units of the last digit in 1."""
        return float(10.0**self.digits)

    def grid(self, sign: int) -> list[int]:
        """Return the values of one side in units, from the failure's on, which is rounded to it.

        Empty where the range ends there.
        """
        end = self.high if sign > 0 else self.low
        own, last = (math.floor(sign * v * self.scale + ROUNDED) for v in (self.value, end))
        stride = max(1, round(self.step * self.scale))
        grid = [own, *range(own + stride, last, stride), last]
        return [sign * units for units in grid] if last > own else []


def nearest(
    axes: Sequence[Axis], ask: Callable[[list[tuple[int, float]]], list[bool]]
) -> dict[tuple[int, int], tuple[float, float]]:
    """Search both sides of each axis for the first value that passes, all at a time.

    `ask` says of values, each with the place of its axis, whether they pass. Returns by place and
    sign the value before, which does not pass, and that one; nothing for sides without.
    """

    def tried(units: Iterable[tuple[int, int]]) -> dict[tuple[int, int], bool]:
        known = list(dict.fromkeys(units))
        passed = ask([(place, number / axes[place].scale) for place, number in known])
        return dict(zip(known, passed, strict=True))

    sides = {(p, sign): axis.grid(sign) for p, axis in enumerate(axes) for sign in (-1, 1)}
    found: dict[tuple[int, int], tuple[int, int]] = {}
    for begin in range(0, max(map(len, sides.values()), default=0), BLOCK):
        rest = {k: grid[begin : begin + BLOCK + 1] for k, grid in sides.items() if k not in found}
        passed = tried((place, units) for (place, _), grid in rest.items() for units in grid[1:])
        for key, grid in rest.items():
            pairs = (pair for pair in pairwise(grid) if passed[key[0], pair[1]])
            if (pair := next(pairs, None)) is not None:
                found[key] = pair
    while wide := {
        key: sum(pair) // 2 for key, pair in found.items() if abs(pair[1] - pair[0]) > 1
    }:
        passed = tried((place, middle) for (place, _), middle in wide.items())
        for key, middle in wide.items():
            fails, passes = found[key]
            found[key] = (fails, middle) if passed[key[0], middle] else (middle, passes)
    return {
        (place, sign): (fails / axes[place].scale, passes / axes[place].scale)
        for (place, sign), (fails, passes) in found.items()
    }


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
        vut: the VUT that drove in the changed cases.
    """

    run: Run
    found: Explanation
    vut: str

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {**to_plain(self.found), "file": str(self.run.folder / EXPLANATIONS.name)}


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
    run: Run, plan: SimulationPlan, check: Callable[[], None] = lambda: None
) -> None:
    """Explain the worst failure of a campaign that has just ended, where that takes no SUMO.

    Nothing is written for drivers that need SUMO, nor where the engines differ. `check` is called
    after each step, and may raise to stop there.
    """
    worst = failures(run.cases)[:1]
    if plan.needs_sumo is None and worst:
        # Worker processes would take longer to start than these cases.
        with suppress(UserError), workers_or_here(None) as here:
            _explained(run, _Neighbours(plan.with_engine(None), worst[0], (), here, check))


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
        found = _explained(study.run, _Neighbours(study.plan, outcome, ranges, opened))
    study.on_cases(1)
    return ExplanationResult(study.run, found, study.settings.vut)


def _explained(run: Run, neighbours: _Neighbours) -> Explanation:
    """Search, and write what is found beside the explanations of other cases."""
    found = neighbours.found()
    known = {**EXPLANATIONS.read_lines(run), found.index: found}
    EXPLANATIONS.write_lines(run.folder, [known[index] for index in sorted(known)])
    return found


class _Neighbours:
    """Runs a failure with other values."""

    def __init__(
        self,
        plan: SimulationPlan,
        outcome: Outcome,
        ranges: Sequence[Range],
        workers: Workers | None,
        check: Callable[[], None] = lambda: None,
    ) -> None:
        """Take the plan, the failure, the parameters that are searched, and where cases run."""
        self._check = check
        self._plan, self._outcome, self._workers = plan, outcome, workers
        case, present = outcome.case, values_of(plan.vut, ranges)
        self._axes = [
            _axis(c.field, getattr(case, c.field), c.dimension.low, c.dimension.high, c.digits)
            for c in coordinates(case.scenario, (case.level,))
        ]
        self._coordinates = len(self._axes)
        self._axes += [
            _axis(r.name, present[r.name], r.low, r.high, r.digits, PARAMETER_STEPS) for r in ranges
        ]
        self._levels = [level for level in plan.povs.levels if level != case.level]

    def found(self) -> Explanation:
        """Search, and confirm what was found; raises `UserError` where a case ends otherwise."""
        itself = self._plan.vut.spec, self._outcome.case
        others = list(map(self._at_level, self._levels))
        fails, *at_levels = self._passes([itself, *others])
        if fails:
            raise self._other_now()
        pairs = nearest(self._axes, self._ask)
        claims = [(itself, False), *zip(others, at_levels, strict=True)]
        for (place, sign), (before, value) in pairs.items():
            claims.append((self._trial(place, value), True))
            if (before - self._axes[place].value) * sign > 0.0:
                claims.append((self._trial(place, before), False))
        trials, expected = zip(*claims, strict=True)
        if self._passes(trials, Engine.SUMO) != list(expected):
            raise self._other_now()
        values = {key: value for key, (_, value) in pairs.items()}
        axes = tuple(
            replaced(axis, below=values.get((place, -1)), above=values.get((place, 1)))
            for place, axis in enumerate(self._axes)
        )
        start, parameters = axes[: self._coordinates], axes[self._coordinates :]
        levels = dict(zip(map(level_name, self._levels), at_levels, strict=True))
        return Explanation(self._outcome.index, start, levels, parameters)

    def _ask(self, values: list[tuple[int, float]]) -> list[bool]:
        self._check()
        return self._passes([self._trial(place, value) for place, value in values])

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
                vut = plan.vut if own else plan.vut.with_spec(spec)
                ran = list(evaluate(replace(plan, vut=vut), cases, self._workers, pass_of))
            except UserError:
                if own:
                    raise
                continue
            for place, passed in ran:
                passes[places[place]] = passed
        return passes

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


def pass_of(episode: Episode) -> bool:
    """Return whether a case has a verdict and does not fail."""
    return episode.outcome.is_tested and not episode.outcome.failed
