"""The smallest change of each parameter of a controller with which a failure passes.

One parameter at a time takes other values, the others and the start of the case stay. From today's
value values of a grid run, to both sides, until one passes or the range ends; between that and the
value before it the middle runs, and so on. Verdicts are not monotone: a pass between two values of
the grid is missed. A value that the controller refuses does not pass.

Cases run in SUMO, as a parameter makes another VUT, and most of the time goes into its start.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Final

from msgspec import Meta

from merge_sumo.engine.evaluate import CaseResults, evaluate
from merge_sumo.engine.plan import Engine, SimulationPlan
from merge_sumo.errors import UserError
from merge_sumo.studies.parameter_ranges import Range, spec_with, todays_values
from merge_sumo.system.records import Record
from merge_sumo.system.suggestions import either
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import Case
from merge_sumo.vuts.registry import VutFactory

STEPS: Final = 40
"""Values of the grid over the range of a parameter."""
PARTS: Final = 8
"""Units of a step of the grid: a change that is said is known to a unit."""

ROUNDED: Final = 0.35
"""Units that a rounded value is off at most: a 1,000th of the range."""


class ParameterChange(Record, frozen=True):
    """What one parameter of the controller by itself does to a failure.

    Attributes:
        name: the parameter.
        today: its value.
        low: the least value of the range that was searched.
        high: the largest.
        below: the value under today's and nearest to it that was found to pass; None without one.
        above: the same over today's.
    """

    name: Annotated[str, Meta(min_length=1, max_length=100)]
    today: float
    low: float
    high: float
    below: float | None = None
    above: float | None = None

    @property
    def passing(self) -> tuple[float, ...]:
        """The values that pass."""
        return tuple(value for value in (self.below, self.above) if value is not None)

    def claims(self) -> Iterator[tuple[float, bool]]:
        """Yield the values of which sentences say something, and whether the case passes.

        Each value that passes, and the one that is a unit nearer to today's.
        """
        scale = _Scale(Range(self.name, self.low, self.high), self.today)
        for value in self.passing:
            yield value, True
            units = scale.units(value)
            yield scale.value(units - (1 if units > 0 else -1)), False


@dataclass(frozen=True, slots=True)
class _Scale:
    """The values of a parameter in units from today's."""

    range: Range
    today: float

    @property
    def unit(self) -> float:
        return (self.range.high - self.range.low) / (STEPS * PARTS)

    def value(self, units: int) -> float:
        """Return the value so many units from today's; the last one is the end of the range."""
        end = self.range.high if units > 0 else self.range.low
        if abs(units) >= self._last(end):
            return end if units else self.today
        return self.range.rounded(self.today + units * self.unit)

    def units(self, value: float) -> int:
        """Return the number of units from today's value; the inverse of `value`."""
        is_end = value in (self.range.low, self.range.high)
        size = self._last(value) if is_end else round(abs(value - self.today) / self.unit)
        return size if value > self.today else -size

    def grid(self, sign: int) -> list[int]:
        """Return the values of the grid on one side, in units, from today's on."""
        last = self._last(self.range.high if sign > 0 else self.range.low)
        steps = [*range(PARTS, last + 1, PARTS)]
        if last and (not steps or steps[-1] != last):
            steps.append(last)
        return [sign * step for step in steps]

    def _last(self, end: float) -> int:
        """Return the units to an end of the range; the last one is more than a rounding error."""
        return max(0, math.ceil(abs(end - self.today) / self.unit - ROUNDED))


class _Runs:
    """Runs failures with values of a parameter."""

    def __init__(
        self, plan: SimulationPlan, cases: Mapping[int, Case], workers: Workers | None
    ) -> None:
        """Take the plan, and the failures by index."""
        self._plan, self._cases = replace(plan, engine=Engine.SUMO), cases
        self._workers = workers
        self.count = dict.fromkeys(cases, 0)
        """Cases that ran, by failure."""

    def passing(self, name: str, value: float, indices: Sequence[int]) -> set[int]:
        """Return which of some failures pass with a value; none where it is refused."""
        spec = spec_with(self._plan.vut.spec, {name: value})
        for index in indices:
            self.count[index] += 1
        cases = [self._cases[index] for index in indices]
        try:
            vut = VutFactory(spec, self._plan.vut.options)
            plan = replace(self._plan, vut=vut).for_cases(len(cases))
            ran = evaluate(plan, cases, self._workers, pass_of)
            return {indices[place] for place, passes in ran if passes}
        except UserError:
            return set()


def pass_of(results: CaseResults) -> list[bool]:
    """Return of each result whether the case has a verdict and does not fail."""
    return [verdict.is_tested and not verdict.failed for verdict in results.verdicts()]


def parameter_changes(
    plan: SimulationPlan,
    cases: Mapping[int, Case],
    ranges: Sequence[Range],
    workers: Workers | None = None,
) -> tuple[dict[int, tuple[ParameterChange, ...]], dict[int, int]]:
    """Return by failure the smallest change of each parameter, and how many cases ran for it.

    Args:
        plan: that of the campaign.
        cases: the failures, by index.
        ranges: the parameters, with the values that are tried.
        workers: where cases run, by default in this process.

    Raises `UserError` for a parameter that the controller does not have, a range without today's
    value, and a VUT that does not repeat itself.
    """
    today = todays_values(plan.vut, ranges)
    runs = _Runs(plan, cases, workers)
    found: dict[int, list[ParameterChange]] = {index: [] for index in cases}
    for one in ranges:
        scale = _Scale(one, today[one.name])
        below, above = (_first_passes(runs, scale, sign, list(cases)) for sign in (-1, 1))
        for index, changes in found.items():
            values = (below.get(index), above.get(index))
            changes.append(ParameterChange(one.name, scale.today, one.low, one.high, *values))
    _confirm(runs, found)
    return {index: tuple(changes) for index, changes in found.items()}, runs.count


def _first_passes(
    runs: _Runs, scale: _Scale, sign: int, indices: Sequence[int]
) -> dict[int, float]:
    """Return by failure the value on one side of today's that is nearest to it and passes."""
    name = scale.range.name
    # By failure the last value that does not pass, and the first that does, in units.
    open_, brackets, before = list(indices), dict[int, tuple[int, int]](), 0
    for units in scale.grid(sign):
        passing = runs.passing(name, scale.value(units), open_) if open_ else set()
        brackets.update(dict.fromkeys(passing, (before, units)))
        open_ = [index for index in open_ if index not in passing]
        before = units
    while wide := {pair for pair in brackets.values() if abs(pair[1] - pair[0]) > 1}:
        for fails, passes in wide:
            middle = (fails + passes) // 2
            within = [index for index, pair in brackets.items() if pair == (fails, passes)]
            passing = runs.passing(name, scale.value(middle), within)
            for index in within:
                brackets[index] = (fails, middle) if index in passing else (middle, passes)
    return {index: scale.value(passes) for index, (_, passes) in brackets.items()}


def _confirm(runs: _Runs, found: Mapping[int, Sequence[ParameterChange]]) -> None:
    """Raise `UserError` where a case of which something is said ends otherwise a second time."""
    said: dict[tuple[str, float], dict[int, bool]] = {}
    for index, changes in found.items():
        for change in changes:
            for value, passes in change.claims():
                said.setdefault((change.name, value), {})[index] = passes
    for (name, value), claimed in said.items():
        passing = runs.passing(name, value, list(claimed))
        for index, passes in claimed.items():
            if (index in passing) != passes:
                raise UserError(
                    f"case {index} ends otherwise with {name}={value:.12g} when it runs a second "
                    "time: the VUT does not repeat itself, and nothing can be said of its changes"
                )


def in_words(changes: Sequence[ParameterChange]) -> Iterator[str]:
    """Yield with which values of one parameter a failure passes, and which have none."""
    helps = [
        f"{one.name} is {either([f'{value:.12g}' for value in one.passing])} "
        f"({one.today:.12g} today, searched from {one.low:.12g} to {one.high:.12g})"
        for one in changes
        if one.passing
    ]
    if helps:
        yield f"The same start passes if the VUT's {', or '.join(helps)}."
    stuck = [
        f"{c.name} (searched from {c.low:.12g} to {c.high:.12g})" for c in changes if not c.passing
    ]
    if stuck:
        yield f"No value of the VUT's {either(stuck)} was found with which this start passes."
