"""Why a case fails: the smallest changes of its start, and other POVs, with which it passes.

Cases that differ from a failure in one thing run again. A change is a whole number of units of the
last digit with which its coordinate is written, so that what a sentence says has run as it is said.

- *Alone*: one coordinate moves, to both sides, on a grid over the pool; between the last value of
  the grid that does not pass and the first that does, every unit runs. Verdicts are not monotone:
  a pass between two values of the grid is missed, so the step of the grid is recorded.
- *Together*: all coordinates move. The nearest pass in the unit cube is searched for in balls that
  shrink to it, and near what was found: no proof that nothing is nearer.
- *Other POVs*: the same start with each other level, and at level 2 with values of psi.
- *Parameters* of the controller, one at a time: see `parameter_changes`.

A case passes where it has a verdict and does not fail. What is said of a case runs a second time,
in SUMO.

explanations.jsonl      in the folder of a campaign: one line per explained failure, in the order of
                        cases

The file of a folder which somebody sent is data as everything in it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Annotated, Final

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from merge_sumo.analysis.coordinates import Coordinate, coordinates
from merge_sumo.campaigns.store import Run, failures, spread_failures
from merge_sumo.engine.evaluate import evaluate, workers_or_here
from merge_sumo.engine.plan import Engine, SimulationPlan
from merge_sumo.errors import UserError
from merge_sumo.studies.counterfactuals import Avoidance
from merge_sumo.studies.parameter_changes import (
    ParameterChange,
    in_words,
    parameter_changes,
    pass_of,
)
from merge_sumo.studies.parameter_ranges import Range, check_names, todays_values
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.system.folders import replace_own
from merge_sumo.system.records import Record, read_indexed, to_plain
from merge_sumo.system.suggestions import either
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.scenario import OWN, SVO, level_name
from merge_sumo.values.score import Outcome

EXPLANATIONS: Final = "explanations.jsonl"
LISTED: Final = 10
"""Failures that are explained where nobody names any."""
STEPS: Final = 160
"""Values of the grid over the range of a coordinate: 1 m and .06 m/s in the pool of the paper."""
PSI_DIGITS: Final = 1
"""Digits of the values of psi with which a POV of level 2 takes the place of another."""
FIRST_POINTS: Final = 128
POINTS: Final = 48
"""Points of the first ball and of each later one."""
ROUNDS: Final = 6
"""Balls at most. Chosen with `POINTS`, not tuned."""
SHARES: Final = (0.3, 0.5, 0.65, 0.75, 0.85, 0.9, 0.95)
"""Shares of a change that passes, of all coordinates and of each, that are tried in its place."""
NEAR: Final = 0.15
"""Standard deviation of points about a change that passes, as a share of its length."""

Nonnegative = Annotated[float, Meta(ge=0.0)]
Nonpositive = Annotated[float, Meta(le=0.0)]
Units = NDArray[np.int64]
"""Changes of all coordinates, (d,), in units of their last digits."""


class Alone(Record, frozen=True):
    """What one coordinate by itself does to a failure; values are changes of it.

    Attributes:
        field: the coordinate, as a field of the case.
        step: step of the grid.
        lowest: the largest decrease that was tried: the pool ends there.
        highest: the largest increase.
        below: the smallest decrease that was found to pass; None without one.
        above: the smallest increase.
    """

    field: str
    step: Nonnegative
    lowest: Nonpositive
    highest: Nonnegative
    below: Nonpositive | None = None
    above: Nonnegative | None = None

    @property
    def passing(self) -> tuple[float, ...]:
        """The changes that pass."""
        return tuple(change for change in (self.below, self.above) if change is not None)


class OtherPov(Record, frozen=True):
    """What becomes of the same start with another POV.

    Attributes:
        level: its level.
        svo_rad: its social value orientation, at level 2.
        passes: whether the case passes.
    """

    level: Annotated[int, Meta(ge=0, le=OWN)]
    svo_rad: Nonnegative | None
    passes: bool


class Explanation(Record, frozen=True):
    """The smallest changes that were found to make a failure pass.

    Attributes:
        index: of the case in its campaign.
        alone: by coordinate, in the pool's order.
        together: the nearest start that was found to pass, as changes by coordinate; distances are
            those of the unit cube. None where no start passes that was tried.
        povs: the POVs that were tried in the place of the case's.
        cases: cases that ran for it.
        parameters: by parameter of the controller, where these were searched.
    """

    index: Annotated[int, Meta(ge=0)]
    alone: tuple[Alone, ...]
    together: dict[str, float] | None
    povs: tuple[OtherPov, ...]
    cases: Annotated[int, Meta(ge=0)]
    parameters: tuple[ParameterChange, ...] = ()


def changed(case: Case, changes: Mapping[str, float]) -> Case:
    """Return a case with some of its coordinates changed by as much as is said."""
    return replace(case, **{name: getattr(case, name) + by for name, by in changes.items()})


# The file of a campaign.


def read_explanations(run: Run) -> dict[int, Explanation]:
    """Return by index what the folder of a campaign says of its failures.

    Raises `UserError` for a line that is not of one of them.
    """
    cases = {outcome.index: outcome.case for outcome in run.outcomes if outcome.failed}
    path = run.folder / EXPLANATIONS
    known = read_indexed(path, Explanation, cases)
    for index, one in known.items():
        case = cases[index]
        fields = [d.field for d in case.scenario.dimensions(case.level)]
        if [alone.field for alone in one.alone] != fields or not {*(one.together or ())} <= {
            *fields
        }:
            raise UserError(f"{path} is not as it was written: case {index} has other coordinates")
        if not all(change.low < change.high for change in one.parameters):
            raise UserError(f"{path} is not as it was written: case {index} has an empty range")
    return known


def _write(run: Run, found: Iterable[Explanation]) -> None:
    """Write explanations into the folder of a campaign, beside those of other cases."""
    known = {**read_explanations(run), **{one.index: one for one in found}}
    lines = (json.dumps(to_plain(known[index]), allow_nan=False) for index in sorted(known))
    replace_own(run.folder / EXPLANATIONS, "".join(f"{line}\n" for line in lines).encode())


def listed_failures(run: Run, indices: Sequence[int] = ()) -> list[Outcome]:
    """Return failures of a run by their indices, by default ten: the worst of each region first.

    Raises `UserError` for a case that is there no more, or did not fail.
    """
    if not indices:
        return spread_failures(run.cases)[:LISTED]
    chosen = [run.outcome(index) for index in dict.fromkeys(indices)]
    for outcome in chosen:
        if not outcome.failed:
            worst = [o.index for o in failures(run.cases)[:1]]
            such = f", such as {worst[0]}" if worst else ", and this campaign has none"
            raise UserError(f"case {outcome.index} did not fail: name a failure{such}")
    return chosen


def note_explanations(
    run: Run,
    plan: SimulationPlan,
    *,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
) -> None:
    """Explain the listed failures of a campaign that has just ended, where that takes no SUMO.

    Nothing is written for drivers that need SUMO, nor where the engines differ.
    """
    if plan.needs_sumo is not None:
        return
    try:
        found = _found(plan.with_engine(None), listed_failures(run), workers, check)
    except UserError:
        return
    if found:
        _write(run, found)


def explain(
    study: RunStudy, chosen: Sequence[Outcome], *, ranges: Sequence[Range] = ()
) -> list[Explanation]:
    """Explain failures of a campaign, and write that into its folder.

    Args:
        study: the campaign, and how its cases run; it is told how many failures have just been
            explained, which are in the folder by then.
        chosen: the failures.
        ranges: parameters of the controller that are searched, too, with their ranges.

    Raises:
        UserError: for a campaign with a net or policies of another day, without a failure, for a
            parameter that the controller does not have, and where a case that is run a second time
            ends otherwise.
    """
    study.check_same_system()
    run, plan = study.run, study.plan
    if not chosen:
        raise UserError(f"{run.folder} has no failure: nothing can be explained")
    check_names(ranges)
    todays_values(plan.vut, ranges)
    # Without SUMO many cases at a time cost little; with it, each failure is kept as it is done.
    size = len(chosen) if plan.engine is Engine.KINEMATIC else 1
    found: list[Explanation] = []
    with workers_or_here(study.workers) as opened:
        for first in range(0, len(chosen), size):
            part = chosen[first : first + size]
            some = _with_parameters(plan, part, _found(plan, part, opened), ranges, opened)
            _write(run, some)
            found += some
            study.on_cases(len(some))
    return found


def _found(
    plan: SimulationPlan,
    chosen: Sequence[Outcome],
    workers: Workers | None,
    check: Callable[[], None] = lambda: None,
) -> list[Explanation]:
    """Return the explanations of failures, each claim of which SUMO has confirmed."""
    searches = {outcome.index: _search(outcome, plan.povs.levels) for outcome in chosen}
    found: list[Explanation] = []
    answers: dict[int, list[bool]] = {}
    # All searches take a step at a time: so each step is one evaluation.
    while searches:
        asked: dict[int, list[Case]] = {}
        for index, search in list(searches.items()):
            try:
                asked[index] = search.send(answers[index]) if answers else next(search)
            except StopIteration as end:
                found.append(end.value)
                del searches[index]
        answers = _by_index(
            asked, _passes(plan, [c for some in asked.values() for c in some], workers)
        )
        check()
    _confirm(plan, chosen, found, workers)
    return found


def _with_parameters(
    plan: SimulationPlan,
    chosen: Sequence[Outcome],
    found: Sequence[Explanation],
    ranges: Sequence[Range],
    workers: Workers | None,
) -> list[Explanation]:
    """Return explanations with the smallest change of each parameter."""
    if not ranges:
        return list(found)
    cases = {outcome.index: outcome.case for outcome in chosen}
    changes, counts = parameter_changes(plan, cases, ranges, workers)
    return [
        msgspec.structs.replace(
            one, parameters=changes[one.index], cases=one.cases + counts[one.index]
        )
        for one in found
    ]


def _by_index(asked: Mapping[int, Sequence[Case]], passes: Sequence[bool]) -> dict[int, list[bool]]:
    answers, rest = {}, iter(passes)
    for index, some in asked.items():
        answers[index] = [next(rest) for _ in some]
    return answers


def _confirm(
    plan: SimulationPlan,
    chosen: Sequence[Outcome],
    found: Sequence[Explanation],
    workers: Workers | None,
) -> None:
    """Raise `UserError` where a case of which something is said ends otherwise in SUMO."""
    cases = {outcome.index: outcome.case for outcome in chosen}
    said = [(one.index, *claim) for one in found for claim in claims(one, cases[one.index])]
    passes = _passes(replace(plan, engine=Engine.SUMO), [case for _, case, _ in said], workers)
    for (index, case, expected), passed in zip(said, passes, strict=True):
        if passed != expected:
            if case == cases[index]:
                raise _other_vut(index)
            what = "passes" if passed else "does not pass"
            raise UserError(
                f"a case near case {index} {what} when it runs a second time: the VUT does not "
                "repeat itself, and nothing can be said of its changes"
            )


def _other_vut(index: int) -> UserError:
    return UserError(
        f"case {index} passes now: the VUT is another than that of the campaign, or does not "
        "repeat itself, and nothing can be said of its changes"
    )


def _passes(plan: SimulationPlan, cases: Sequence[Case], workers: Workers | None) -> list[bool]:
    """Return of each case whether it passes."""
    if not cases:
        return []
    return [passed for _, passed in sorted(evaluate(plan, cases, workers, keep=pass_of))]


def claims(explanation: Explanation, case: Case) -> Iterator[tuple[Case, bool]]:
    """Yield the cases of which sentences say something, and whether they pass.

    The case itself; each change that passes, and of one coordinate the change one unit smaller; the
    other POVs, of those that differ in psi alone the ends of what passes and of what does not.
    """
    yield case, False
    for alone, axis in zip(explanation.alone, _axes(case), strict=True):
        for change in alone.passing:
            yield changed(case, {alone.field: change}), True
            nearer = axis.change(axis.units(change) - (1 if change > 0 else -1))
            yield changed(case, {alone.field: nearer}), False
    if explanation.together:
        yield changed(case, explanation.together), True
    for _, run in groupby(explanation.povs, key=lambda pov: (pov.level, pov.passes)):
        same = list(run)
        for pov in (same[0], same[-1])[: len(same)]:
            yield replace(case, level=pov.level, svo_rad=pov.svo_rad), pov.passes


# The search.


@dataclass(frozen=True, slots=True)
class _Axis:
    """A coordinate of a failure, in units of the last digit with which it is written.

    Attributes:
        coordinate: the coordinate.
        low: largest decrease within the pool, in units; 0 or less.
        high: largest increase.
    """

    coordinate: Coordinate
    low: int
    high: int

    @property
    def unit(self) -> float:
        return float(10.0**-self.coordinate.digits)

    @property
    def span(self) -> float:
        """Width of the pool."""
        return self.coordinate.dimension.high - self.coordinate.dimension.low

    @property
    def stride(self) -> int:
        """Units from one value of the grid to the next."""
        return max(1, round(self.span / self.unit / STEPS))

    def change(self, units: float) -> float:
        return round(units * self.unit, self.coordinate.digits) + 0.0

    def units(self, change: float) -> int:
        return round(change / self.unit)

    def grid(self, sign: int) -> list[int]:
        """Return the values of the grid on one side, from the case on."""
        end = self.high if sign > 0 else -self.low
        steps = [*range(self.stride, end + 1, self.stride)]
        if end and (not steps or steps[-1] != end):
            steps.append(end)
        return [sign * step for step in steps]


def _axes(case: Case) -> list[_Axis]:
    axes = []
    for one in coordinates(case.scenario, (case.level,)):
        unit, value = 10.0**-one.digits, getattr(case, one.field)
        high = one.dimension.high
        if one.field == SVO.field:
            high = math.nextafter(high, 0.0)
        # A case beside the pool has no value on that side.
        low_units = min(0, math.ceil((one.dimension.low - value) / unit))
        axes.append(_Axis(one, low_units, max(0, math.floor((high - value) / unit))))
    return axes


Search = Generator[list[Case], list[bool], Explanation]
"""Asks for cases, and is told of each whether it passes."""


def _search(outcome: Outcome, levels: Sequence[int]) -> Search:
    """Search for the changes with which a failure passes."""
    case, axes = outcome.case, _axes(outcome.case)
    known = _Known(case, axes)
    povs = list(_other_povs(case.level, levels))
    others = [replace(case, level=level, svo_rad=svo_rad) for level, svo_rad in povs]
    sides = [(axis, sign) for axis in range(len(axes)) for sign in (-1, 1)]
    grids = [known.along(axis, axes[axis].grid(sign)) for axis, sign in sides]
    still, *passes = yield [case, *others, *known.cases(grids)]
    if still:
        raise _other_vut(outcome.index)
    known.tell(grids, passes[len(others) :])
    between = [known.along(axis, known.gap(axis, sign)) for axis, sign in sides]
    wanted = [*between, known.ball(FIRST_POINTS)]
    known.tell(wanted, (yield known.cases(wanted)))
    for _ in range(ROUNDS):
        before = known.nearest
        near = [known.ball(POINTS), known.smaller()]
        told = yield known.cases(near)
        known.tell(near, told)
        if known.nearest is None or (before is not None and (known.nearest == before).all()):
            break
    # A pass that a ball found on an axis may have neighbours that did not run.
    while gaps := [known.along(axis, known.gap(axis, sign)) for axis, sign in sides]:
        if not any(gaps):
            break
        known.tell(gaps, (yield known.cases(gaps)))
    alone = tuple(_alone(known, axis) for axis in range(len(axes)))
    together = known.nearest
    return Explanation(
        index=outcome.index,
        alone=alone,
        together=None if together is None else known.changes(together),
        povs=tuple(
            OtherPov(level, svo_rad, passed)
            for (level, svo_rad), passed in zip(povs, passes, strict=False)
        ),
        cases=1 + len(known.verdicts) + len(others),
    )


def _other_povs(level: int, levels: Sequence[int]) -> Iterator[tuple[int, float | None]]:
    """Yield level and psi of the POVs that take the place of one of a level."""
    for other in levels:
        if other == level:
            continue
        if other != 2:
            yield other, None
            continue
        step = 10.0**-PSI_DIGITS
        for number in range(math.ceil(SVO.high / step)):
            yield other, round(number * step, PSI_DIGITS)


def _alone(known: _Known, axis: int) -> Alone:
    """Return what is known of one coordinate by itself."""
    one = known.axes[axis]
    below, above = (known.first_pass(axis, sign) for sign in (-1, 1))
    return Alone(
        field=one.coordinate.field,
        step=one.change(one.stride),
        lowest=one.change(one.low),
        highest=one.change(one.high),
        below=None if below is None else one.change(below),
        above=None if above is None else one.change(above),
    )


class _Known:
    """The changes of a failure that ran, and the nearest of those that pass."""

    def __init__(self, case: Case, axes: Sequence[_Axis]) -> None:
        """Take the failure and its coordinates."""
        self.axes = axes
        self.verdicts: dict[tuple[int, ...], bool] = {}
        """Whether a change passes."""
        self.nearest: Units | None = None
        self._case = case
        self._low = np.array([axis.low for axis in axes])
        self._high = np.array([axis.high for axis in axes])
        self._share = np.array([axis.unit / axis.span for axis in axes])
        """Length of a unit in the unit cube, (d,)."""
        self._rng = np.random.default_rng(case.seed)

    def along(self, axis: int, values: Iterable[int]) -> list[Units]:
        """Return changes of one coordinate."""
        direction = np.eye(len(self.axes), dtype=np.int64)[axis]
        return [direction * value for value in values]

    def _on_axis(self, axis: int, sign: int) -> dict[int, bool]:
        """Return by size, in units, whether changes of one coordinate to one side pass."""
        return {
            abs(units[axis]): passed
            for units, passed in self.verdicts.items()
            if units[axis] * sign > 0 and sum(map(bool, units)) == 1
        }

    def first_pass(self, axis: int, sign: int) -> int | None:
        """Return the smallest change of one coordinate to one side that passes."""
        on_axis = self._on_axis(axis, sign)
        size = min((size for size, passed in on_axis.items() if passed), default=None)
        return None if size is None else sign * size

    def gap(self, axis: int, sign: int) -> list[int]:
        """Return what did not run between the first pass on one side and the last failure."""
        first = self.first_pass(axis, sign)
        if first is None:
            return []
        before = max((size for size in self._on_axis(axis, sign) if size < abs(first)), default=0)
        return [sign * size for size in range(before + 1, abs(first))]

    def changes(self, units: Units) -> dict[str, float]:
        """Return changes by coordinate, without those of none."""
        pairs = zip(self.axes, units.tolist(), strict=True)
        return {axis.coordinate.field: axis.change(by) for axis, by in pairs if by}

    def cases(self, groups: Iterable[Sequence[Units]]) -> list[Case]:
        """Return the cases of groups of changes, in their order."""
        return [changed(self._case, self.changes(units)) for group in groups for units in group]

    def tell(self, groups: Iterable[Sequence[Units]], passes: Sequence[bool]) -> None:
        """Take what became of groups of changes."""
        every = [units for group in groups for units in group]
        for units, passed in zip(every, passes, strict=True):
            self.verdicts[tuple(units.tolist())] = passed
            if passed and self._length(units) < self.reach:
                self.nearest = units

    def _length(self, units: Units) -> float:
        return float(np.linalg.norm(units * self._share))

    @property
    def reach(self) -> float:
        """Distance in the unit cube up to which something nearer is looked for."""
        if self.nearest is None:
            return float(np.linalg.norm(np.maximum(-self._low, self._high) * self._share)) + 1e-9
        return self._length(self.nearest)

    def ball(self, count: int) -> list[Units]:
        """Return new changes nearer than the nearest that passes: quasi-random in their ball."""
        from scipy.special import ndtri
        from scipy.stats.qmc import Halton

        dims = len(self.axes)
        draws = Halton(dims + 1, scramble=True, seed=self._rng).random(count)
        directions = ndtri(np.clip(draws[:, 1:], 1e-9, 1.0 - 1e-9))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        radii = self.reach * draws[:, :1] ** (1.0 / dims)
        return self._new(radii * directions / self._share)

    def smaller(self) -> list[Units]:
        """Return new changes near the nearest that passes, and parts of it."""
        if self.nearest is None:
            return []
        dims, best = len(self.axes), self.nearest.astype(np.float64)
        shares = np.array((0.0, *SHARES))
        parts = [np.outer(shares, best)]
        for axis in range(dims):
            part = np.tile(best, (len(shares) + 1, 1))
            part[:-1, axis] *= shares
            part[-1, axis] -= np.sign(best[axis])
            parts.append(part)
        spread = NEAR * self.reach / self._share
        parts.append(best + spread * self._rng.standard_normal((POINTS // 2, dims)))
        return self._new(np.concatenate(parts))

    def _new(self, wanted: FloatArray) -> list[Units]:
        """Return whole units near those that are wanted: in the pool, new, and nearer than best."""
        whole = np.unique(np.rint(wanted).astype(np.int64), axis=0)
        inside = ((whole >= self._low) & (whole <= self._high)).all(axis=1) & whole.any(axis=1)
        return [
            units
            for units in whole[inside]
            if self._length(units) < self.reach and tuple(units.tolist()) not in self.verdicts
        ]


# Sentences.

BY: Final[dict[str, tuple[str, str, str]]] = {
    "x_pov0_m": ("the POV starts", "further back", "further ahead"),
    "v_pov0_mps": ("the POV starts", "slower", "faster"),
    "v_vut0_mps": ("the VUT starts", "slower", "faster"),
}
"""Subject, decrease and increase of a coordinate in words; of others their names are said."""


def in_sentences(
    explanation: Explanation, outcome: Outcome, avoidance: Avoidance | None = None
) -> list[str]:
    """Return what is known of a failure: changes, other POVs, and until when something helped.

    Args:
        explanation: of the failure.
        outcome: the failure.
        avoidance: which drivers would have avoided it, where that is known.
    """
    named = {c.field: c for c in coordinates(outcome.case.scenario, (outcome.case.level,))}
    sentences = [*_alone_in_words(explanation, named), *_together_in_words(explanation, named)]
    if explanation.povs:
        sentences.append(_povs_in_words(explanation.povs))
    return [*sentences, *in_words(explanation.parameters), *_last_moment(outcome, avoidance)]


def amount(coordinate: Coordinate, change: float) -> str:
    """Return the size of a change as it is written, as "3.1 m"."""
    return f"{abs(change):.{coordinate.digits}f} {coordinate.unit}".rstrip()


def _by_subject(changes: Iterable[tuple[Coordinate, float]]) -> list[tuple[str, list[str]]]:
    """Return subjects with what is said of them: ("the POV starts", ["3.1 m further back"])."""
    subjects: dict[str, list[str]] = {}
    for one, change in changes:
        subject, lower, higher = BY.get(one.field, (f"{one.name} is", "lower", "higher"))
        way = lower if change < 0.0 else higher
        subjects.setdefault(subject, []).append(f"{amount(one, change)} {way}")
    return list(subjects.items())


def _alone_in_words(one: Explanation, named: Mapping[str, Coordinate]) -> Iterator[str]:
    """Yield which changes of one coordinate pass, the smallest first, and which have none."""
    found = [(named[alone.field], change) for alone in one.alone for change in alone.passing]
    if found:
        found.sort(key=lambda pair: abs(pair[1]) / _span(pair[0]))
        parts = [f"if {subject} {either(ways)}" for subject, ways in _by_subject(found)]
        yield f"It passes {', or '.join(parts)}."
    stuck = [(named[alone.field], alone) for alone in one.alone if not alone.passing]
    if stuck:
        tried = [f"{c.name} (tried every {amount(c, alone.step)})" for c, alone in stuck]
        yield f"Within the pool no change of {either(tried)} alone makes it pass."


def _span(coordinate: Coordinate) -> float:
    return coordinate.dimension.high - coordinate.dimension.low


def _together_in_words(one: Explanation, named: Mapping[str, Coordinate]) -> Iterator[str]:
    if one.together is None:
        yield "No start that was tried passes with this POV."
    elif len(one.together) > 1:
        said = _by_subject((named[name], by) for name, by in one.together.items())
        parts = [f"{subject} {' and '.join(ways)}" for subject, ways in said]
        yield f"Of all starts that were tried, the nearest that passes: {', and '.join(parts)}."


def _povs_in_words(povs: Sequence[OtherPov]) -> str:
    """Return with which other POVs the same start passes, and with which not."""
    said: dict[bool, list[str]] = {True: [], False: []}
    for level, same in groupby(povs, key=lambda pov: pov.level):
        for passes, which in _psi_in_words(list(same)).items():
            said[passes].append(f"level {level_name(level)}{which}")
    places = {passes: " and ".join(names) for passes, names in said.items()}
    if not said[True]:
        return f"The very same start does not pass at {places[False].replace(' and ', ' or ')}."
    text = f"The very same start passes at {places[True]}"
    return f"{text}, and does not at {places[False]}." if said[False] else f"{text}."


def _psi_in_words(same: Sequence[OtherPov]) -> dict[bool, str]:
    """Return of the POVs of one level which pass and which do not, by what differs: psi."""
    if same[0].svo_rad is None:
        return {same[0].passes: ""}
    runs: dict[bool, list[str]] = {}
    for passes, run in groupby(same, key=lambda pov: pov.passes):
        tried = [f"{pov.svo_rad:.{PSI_DIGITS}f}" for pov in run]
        ends = tried[0] if len(tried) == 1 else f"{tried[0]} to {tried[-1]}"
        runs.setdefault(passes, []).append(ends)
    if len(runs) == 1:
        return dict.fromkeys(runs, f" with any psi (tried every {10.0 ** (-PSI_DIGITS):g})")
    return {passes: f" with psi {', '.join(ends)}" for passes, ends in runs.items()}


def _last_moment(outcome: Outcome, avoidance: Avoidance | None) -> Iterator[str]:
    """Yield until when the VUT could still do something."""
    measures, scenario = outcome.measures, outcome.case.scenario
    kept = f"{scenario.dx_crash_m:g} m at {'M' if scenario.place == 'M' else 'this place'}"
    if measures.last_avoidable_s is not None:
        yield (
            f"The last way out closes at {measures.last_avoidable_s:.1f} s: after that neither "
            f"full braking nor full acceleration of the VUT keeps {kept}, with the POV moving as "
            "it did, and then at its last speed."
        )
    elif measures.avoidable is False:
        yield f"At no time would full braking or full acceleration of the VUT have kept {kept}."
    if avoidance is not None and avoidance.latest_takeover_s is not None:
        until_s = avoidance.latest_takeover_s
        yield f"The fuzzy safety model can take over until {until_s:.1f} s and avoid it."
