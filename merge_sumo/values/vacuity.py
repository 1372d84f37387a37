"""Whether a criterion decides anything: conditions that no case, or every case, can meet.

The values that a measure can have are intervals. They follow from eq. (4), the limits of
acceleration and the starts: a vehicle that starts with v0 and drives d metres is at most as fast as
the root of v0^2 + 2 a d. A condition is taken apart into alternatives, each a conjunction of
comparisons; an alternative is impossible where its comparisons leave no value of some measure.
Measures count as independent of each other, so "never" and "always" are certain, and silence says
nothing. Formulas are bounded by interval arithmetic.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Set
from dataclasses import dataclass
from itertools import product
from typing import Any, Final, NamedTuple

from merge_sumo.system.suggestions import either
from merge_sumo.values.bodies import WIDTH_M
from merge_sumo.values.expression import AllOf, AnyOf, Comparison, Condition, Equality, Negation
from merge_sumo.values.measures import further_measures
from merge_sumo.values.merge import REACTION_S
from merge_sumo.values.scenario import DT_S, POV, VEHICLES, VUT, Scenario, lane_of
from merge_sumo.values.score import MU_CRASH, MU_SAFETY, MU_TASK
from merge_sumo.values.trajectory import End

ROUNDING: Final = 1.0
"""Added to a length in m and a speed in m/s that follow from sums of rounded steps."""


class Range(NamedTuple):
    """All values from `low` to `high`, both included; they may be infinite."""

    low: float
    high: float

    @property
    def text(self) -> str:
        """The range in words."""
        if self.low == self.high:
            return f"always {self.low:g}"
        if self.high == math.inf:
            return "above 0" if 0.0 < self.low < MINUTE else f"{self.low:g} or more"
        return (
            f"at most {self.high:g}" if self.low == -math.inf else f"{self.low:g} to {self.high:g}"
        )


MINUTE: Final = 1e-300
ABOVE_0: Final = math.nextafter(0.0, 1.0)
ANY: Final = Range(-math.inf, math.inf)
NOT_NEGATIVE: Final = Range(0.0, math.inf)


@dataclass(frozen=True, slots=True)
class Speeds:
    """The highest speeds in m/s."""

    vut_mps: float  # of the VUT, up to M
    car_mps: float  # of a car of the mainline, until the VUT is at M
    impact_mps: float  # of one body towards another where they touch; lanes may meet at an angle
    added_behind_mps: float  # what the follow-up may add to the speed of any

    @classmethod
    def possible(cls, scenario: Scenario) -> Speeds:
        """Return those that no vehicle of a scenario can pass, whatever drives it."""
        a_mps2, time_s = scenario.a_max_mps2, scenario.timeout_s
        v_vut0, v_car0 = scenario.v_start_max_mps, scenario.fastest_start_mps
        vut_mps = _after_mps(scenario, v_vut0, _last_merge_m(scenario) - scenario.x_vut0_m)
        # Bodies touch where the car is at most a length, and a second's way, from M.
        near_m = scenario.farthest_start_m + _last_merge_m(scenario)
        near_m += 2.0 * _length_m(scenario) + vut_mps * REACTION_S
        impact_mps = vut_mps + _after_mps(scenario, v_car0, near_m)
        car_mps, added_mps = v_car0 + a_mps2 * time_s + ROUNDING, a_mps2 * scenario.follow_up_s
        if added_mps:  # a body may be hit far behind M
            impact_mps = max(impact_mps, car_mps) + added_mps
        return cls(vut_mps, car_mps, impact_mps, added_mps)

    @classmethod
    def usual(cls, scenario: Scenario) -> Speeds:
        """Return those that a scenario names: where vehicles start, and what the road allows."""
        v_mps = max(
            *(scenario.bounds("v_vut0_mps")[1], scenario.fastest_start_mps),
            *(scenario.v_hw_max_mps, scenario.level0_v_mps),
        )
        return cls(v_mps, v_mps, v_mps, 0.0)


def _last_merge_m(scenario: Scenario) -> float:
    """Return the last place at which the VUT can merge."""
    return (lane_of(scenario) or (0.0, 0.0))[1]


def _length_m(scenario: Scenario) -> float:
    return max(scenario.pov_length_m, scenario.vut_length_m)


def _after_mps(scenario: Scenario, v_mps: float, way_m: float) -> float:
    """Return a bound of the speed after some metres at full acceleration.

    A step of eq. (4) adds (a dt)^2 to what the way alone gives, and may pass the end by its length.
    """
    a_mps2, most_mps = scenario.a_max_mps2, v_mps + scenario.a_max_mps2 * scenario.timeout_s
    way_m += most_mps * DT_S
    of_steps = scenario.max_steps * (a_mps2 * DT_S) ** 2
    return min(most_mps, math.sqrt(v_mps**2 + 2.0 * a_mps2 * way_m + of_steps)) + ROUNDING


def measure_ranges(scenario: Scenario, speeds: Speeds) -> dict[str, Range]:
    """Return the range of every measure that is a number, as criteria count it.

    A measure without a value counts as one that is never met (`criterion.py`): that is in its
    range.
    """
    length_m, inf = _length_m(scenario), math.inf
    deepest_m = length_m + WIDTH_M + speeds.impact_mps * REACTION_S
    farthest_m = scenario.farthest_start_m + _last_merge_m(scenario)
    begin_m, _ = lane_of(scenario) or (0.0, 0.0)
    return {
        "ttc_s": Range(ABOVE_0, inf),
        "clearance_m": Range(-deepest_m, inf),
        "before_clearance_m": Range(-(length_m + WIDTH_M), inf),
        "bumper_gap_m": Range(-length_m, inf),
        "dx_m": Range(-(farthest_m + speeds.vut_mps * DT_S + ROUNDING), inf),
        "dv_mps": Range(-speeds.vut_mps, speeds.car_mps),
        "drac_mps2": NOT_NEGATIVE,
        "brake_after_mps2": NOT_NEGATIVE,
        "pet_s": NOT_NEGATIVE,
        "t_end_s": Range(DT_S, round(scenario.max_steps * DT_S, 1)),
        "impact_speed_mps": Range(0.0, speeds.impact_mps),
        "vut_max_brake_mps2": Range(0.0, -scenario.a_min_mps2),
        "pov_max_brake_mps2": Range(0.0, -scenario.a_min_mps2),
        "pov_sustained_brake_mps2": Range(0.0, -scenario.a_min_mps2),
        "pov_slowdown_mps": Range(0.0, speeds.car_mps),
        "last_avoidable_s": ANY,
        "clipped_steps": Range(0.0, float(scenario.max_steps)),
        "score": Range(MU_CRASH - 2.0 * MU_SAFETY - MU_TASK, 0.0),
        "after_gap_m": Range(-length_m, inf),
        "after_ttc_s": NOT_NEGATIVE,
        "after_drac_mps2": NOT_NEGATIVE,
        "x_merge_m": Range(begin_m, inf),
        "lane_share": NOT_NEGATIVE,
        "gap_ahead_m": Range(-length_m, inf),
        "gap_behind_m": Range(-length_m, inf),
        "time_gap_ahead_s": ANY,
        "time_gap_behind_s": ANY,
        "stood_s": Range(0.0, scenario.timeout_s + DT_S),
        **dict.fromkeys(further_measures(), ANY),
    }


def signal_ranges(scenario: Scenario, speeds: Speeds, never_s: float) -> dict[str, Range]:
    """Return the range of every signal of a formula; `never_s` is the longest time to collision."""
    v_vut = Range(0.0, speeds.vut_mps + speeds.added_behind_mps)
    v_pov = Range(0.0, speeds.car_mps + speeds.added_behind_mps)
    accelerations = Range(scenario.a_min_mps2, scenario.a_max_mps2)
    return {
        "x_pov_m": Range(-scenario.farthest_start_m, math.inf),
        "v_pov_mps": v_pov,
        "a_pov_mps2": accelerations,
        "x_vut_m": Range(scenario.x_vut0_m, math.inf),
        "v_vut_mps": v_vut,
        "a_vut_mps2": accelerations,
        "dx_m": ANY,
        "dv_mps": Range(-v_vut.high, v_pov.high),
        "bumper_gap_m": Range(-_length_m(scenario), math.inf),
        "ttc_s": Range(0.0, never_s),
    }


MOST_ALTERNATIVES: Final = 2048
"""With more of them nothing is said of a condition."""


@dataclass(frozen=True, slots=True)
class _OneOf:
    """Whether a text is, or is not, one of some."""

    name: str
    texts: frozenset[str]


_Atom = Comparison | _OneOf
_Alternative = tuple[_Atom, ...]


class TooManyError(Exception):
    """A condition has more alternatives than are looked at."""


@dataclass(frozen=True, slots=True)
class Domain:
    """The values that measures can have: ranges of numbers and sets of texts, by name."""

    ranges: Mapping[str, Range]
    texts: Mapping[str, Set[str]]

    def is_never(self, condition: Condition) -> bool:
        """Return whether a condition is certain never to be met."""
        return not self._possible(condition, wanted=True)

    def is_always(self, condition: Condition) -> bool:
        """Return whether a condition is certain to be met in every case."""
        return not self._possible(condition, wanted=False)

    def _possible(self, condition: Condition, *, wanted: bool) -> bool:
        try:
            alternatives = self._alternatives(condition, wanted=wanted)
        except TooManyError:
            return True
        return any(map(self._consistent, alternatives))

    def _alternatives(self, condition: Condition, *, wanted: bool) -> list[_Alternative]:
        match condition:
            case Comparison(left, right, or_equal):
                # Not a < b is b <= a, and not a <= b is b < a: no value is a NaN.
                turned = Comparison(right, left, not or_equal)
                return [(condition if wanted else turned,)]
            case Equality(name, text):
                is_it = frozenset({text})
                texts = is_it if wanted else frozenset(self.texts[name]) - is_it
                return [(_OneOf(name, texts),)]
            case Negation(of):
                return self._alternatives(of, wanted=not wanted)
            case AllOf(parts) | AnyOf(parts):
                each = [self._alternatives(part, wanted=wanted) for part in parts]
                if isinstance(condition, AllOf) is wanted:
                    if math.prod(map(len, each)) > MOST_ALTERNATIVES:
                        raise TooManyError
                    return [sum(chosen, ()) for chosen in product(*each)]
                alternatives = [alternative for of_part in each for alternative in of_part]
                if len(alternatives) > MOST_ALTERNATIVES:
                    raise TooManyError
                return alternatives

    def _consistent(self, alternative: _Alternative) -> bool:
        """Return whether ranges leave a value for everything that a conjunction speaks of."""
        texts = {name: set(of) for name, of in self.texts.items()}
        bounds = dict(self.ranges)
        comparisons = []
        for atom in alternative:
            if isinstance(atom, _OneOf):
                texts[atom.name] &= atom.texts
                if not texts[atom.name]:
                    return False
            else:
                comparisons.append(atom)
        if _contradict(comparisons):
            return False
        # A bound travels through all comparisons of two measures in as many rounds as they are.
        return all(
            _narrow(bounds, comparison)
            for _ in range(len(comparisons))
            for comparison in comparisons
        )


def _contradict(comparisons: list[Comparison]) -> bool:
    """Return whether two comparisons say the opposite of each other."""
    strict = {(c.left, c.right) for c in comparisons if not c.or_equal}
    known = {(c.left, c.right) for c in comparisons}
    return any((right, left) in known for left, right in strict)


def _narrow(bounds: dict[str, Range], comparison: Comparison) -> bool:
    """Take from ranges what a comparison rules out; return whether anything is left."""
    left, right = (_range(bounds, side) for side in (comparison.left, comparison.right))
    highest, lowest = right.high, left.low
    if not comparison.or_equal:
        if highest == -math.inf or lowest == math.inf:
            return False
        highest, lowest = math.nextafter(highest, -math.inf), math.nextafter(lowest, math.inf)
    left = Range(left.low, min(left.high, highest))
    right = Range(max(right.low, lowest), right.high)
    for side, now in ((comparison.left, left), (comparison.right, right)):
        if now.low > now.high:
            return False
        if isinstance(side, str):
            bounds[side] = now
    return True


def _range(bounds: Mapping[str, Range], side: str | float) -> Range:
    return bounds[side] if isinstance(side, str) else Range(side, side)


def comparisons_in(condition: Condition) -> Iterator[Comparison | Equality]:
    """Yield the comparisons of a condition, from left to right."""
    match condition:
        case Comparison() | Equality():
            yield condition
        case Negation(of):
            yield from comparisons_in(of)
        case AllOf(parts) | AnyOf(parts):
            for part in parts:
                yield from comparisons_in(part)


def text_of(condition: Comparison | Equality) -> str:
    """Return a comparison as a person writes it, with the measure first."""
    if isinstance(condition, Equality):
        return f'{condition.name} == "{condition.text}"'
    left, right, sign = condition.left, condition.right, "<=" if condition.or_equal else "<"
    if isinstance(left, float):
        left, right, sign = right, left, sign.replace("<", ">")
    shown = [side if isinstance(side, str) else f"{side:.12g}" for side in (left, right)]
    return f"{shown[0]} {sign} {shown[1]}"


KMH_PER_MPS: Final = 3.6


def domain_of(scenario: Scenario, speeds: Speeds, texts: dict[str, frozenset[str]]) -> Domain:
    """Return what measures can be in a scenario; `texts` are those that its texts can be."""
    cars = {VEHICLES[POV]} if scenario.vehicles == 2 else set(VEHICLES) - {VEHICLES[VUT]}
    possible = {"nearest": frozenset(cars), "end": frozenset({scenario.ends_as, End.TIMEOUT.value})}
    return Domain(measure_ranges(scenario, speeds), texts | possible)


def emptiness(condition: Condition, domain: Domain) -> str | None:
    """Return in words that a condition is met in no case or in every one; None where it is not."""
    if domain.is_never(condition):
        verdict, how = "no case can meet it", "its parts rule each other out"
    elif domain.is_always(condition):
        verdict, how = "every case meets it", "its parts leave nothing out"
    else:
        return None
    decided = (domain.is_never, domain.is_always)
    deciding = [c for c in comparisons_in(condition) if any(holds(c) for holds in decided)]
    why = "; ".join(dict.fromkeys(text for c in deciding for text in _limits(c, domain))) or how
    return f"{verdict}: {why}"


def idle_parts(condition: Condition, domain: Domain) -> Iterator[str]:
    """Yield in words the comparisons of a condition that are decided without any case."""
    for comparison in dict.fromkeys(comparisons_in(condition)):
        for verdict, holds in (("never", domain.is_never), ("always", domain.is_always)):
            if holds(comparison):
                why = "; ".join(_limits(comparison, domain))
                yield f"{text_of(comparison)} {verdict} holds" + (f": {why}" if why else "")


def _limits(comparison: Comparison | Equality, domain: Domain) -> Iterator[str]:
    """Yield the ranges that decide a comparison, and the threshold in m/s where it may be km/h."""
    if isinstance(comparison, Equality):
        yield f"{comparison.name} is {either(sorted(domain.texts[comparison.name] - {''}))}"
        return
    sides = (comparison.left, comparison.right)
    for name in (side for side in sides if isinstance(side, str)):
        limits = domain.ranges[name]
        yield f"{name} is {limits.text}"
        for number in (side for side in sides if isinstance(side, float)):
            as_mps = number / KMH_PER_MPS
            if name.endswith("_mps") and limits.low < as_mps < limits.high < number:
                yield f"{number:g} km/h are {as_mps:.1f} m/s"


def robustness_range(formula: Any, scenario: Scenario, speeds: Speeds, never_s: float) -> Range:
    """Return between what the robustness of a parsed formula of rtamt lies.

    Every sample of a signal may be any value of its range. What is not known is any number.
    """
    return _value(formula, signal_ranges(scenario, speeds, never_s))


def _value(node: Any, signals: dict[str, Range]) -> Range:
    kind = type(node).__name__
    if kind == "Variable":
        return signals.get(node.var, ANY)
    if kind == "Constant":
        return Range(float(node.val), float(node.val))
    parts = [_value(child, signals) for child in node.children]
    if any(math.isnan(end) for part in parts for end in part):
        return ANY
    if kind == "Predicate":
        above, below = parts if node.operator.name in ("GREATER", "GEQ") else reversed(parts)
        is_order = node.operator.name in ("GREATER", "GEQ", "LESS", "LEQ")
        return _OF_TWO["Subtraction"](above, below) if is_order else ANY
    # Some kinds of node name their one part, or their two parts, twice.
    if kind in _OF_ONE:
        return _OF_ONE[kind](parts[0])
    return _OF_TWO[kind](parts[0], parts[1]) if kind in _OF_TWO else ANY


def _between(*values: float) -> Range:
    """Return the range of some values; any number where one of them is none (inf - inf)."""
    return ANY if any(map(math.isnan, values)) else Range(min(values), max(values))


_OF_ONE: Final[dict[str, Callable[[Range], Range]]] = {
    "Abs": lambda a: Range(max(a.low, -a.high, 0.0), max(map(abs, a))),
    "Neg": lambda a: Range(-a.high, -a.low),
    **dict.fromkeys(("Always", "Eventually", "Historically", "Once"), lambda a: a),
}
"""How the range of a node follows from that of its part. Of others nothing is known: windows with
bounds may be empty near the ends of an episode."""
_OF_TWO: Final[dict[str, Callable[[Range, Range], Range]]] = {
    "Addition": lambda a, b: _between(a.low + b.low, a.high + b.high),
    "Subtraction": lambda a, b: _between(a.low - b.high, a.high - b.low),
    "Multiplication": lambda a, b: _between(*(x * y for x in a for y in b)),
    "Conjunction": lambda a, b: Range(min(a.low, b.low), min(a.high, b.high)),
    "Disjunction": lambda a, b: Range(max(a.low, b.low), max(a.high, b.high)),
    "Implies": lambda a, b: Range(max(-a.high, b.low), max(-a.low, b.high)),
}
