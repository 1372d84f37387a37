"""What is said of a criterion before the first case: it decides nothing, or nearly nothing."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, Final

from merge_sumo.system.suggestions import either
from merge_sumo.values.expression import Comparison, Condition, Equality
from merge_sumo.values.ranges import ANY, Range, Speeds, measure_ranges, signal_ranges
from merge_sumo.values.scenario import POV, VEHICLES, VUT, Scenario
from merge_sumo.values.vacuity import Domain, comparisons_in, text_of

KMH_PER_MPS: Final = 3.6


def domain_of(scenario: Scenario, speeds: Speeds, texts: dict[str, frozenset[str]]) -> Domain:
    """Return what measures can be in a scenario; `texts` are those that its texts can be."""
    cars = {VEHICLES[POV]} if scenario.vehicles == 2 else set(VEHICLES) - {VEHICLES[VUT]}
    return Domain(measure_ranges(scenario, speeds), texts | {"nearest": frozenset(cars)})


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
        return _predicate(node.operator.name, *parts)
    # Some kinds of node name their one part, or their two parts, twice.
    if kind in _OF_ONE:
        return _OF_ONE[kind](parts[0])
    return _OF_TWO[kind](parts[0], parts[1]) if kind in _OF_TWO else ANY


def _predicate(operator: str, left: Range, right: Range) -> Range:
    if operator in ("GREATER", "GEQ"):
        return _minus(left, right)
    return _minus(right, left) if operator in ("LESS", "LEQ") else ANY


def _minus(a: Range, b: Range) -> Range:
    return _plus(a, Range(-b.high, -b.low))


def _plus(a: Range, b: Range) -> Range:
    low, high = a.low + b.low, a.high + b.high
    return ANY if math.isnan(low) or math.isnan(high) else Range(low, high)


def _absolute(a: Range) -> Range:
    inside = a.low <= 0.0 <= a.high
    return Range(0.0 if inside else min(map(abs, a)), max(map(abs, a)))


def _times(a: Range, b: Range) -> Range:
    found = [x * y for x in a for y in b]
    return ANY if any(map(math.isnan, found)) else Range(min(found), max(found))


def _larger(a: Range, b: Range) -> Range:
    return Range(max(a.low, b.low), max(a.high, b.high))


def _smaller(a: Range, b: Range) -> Range:
    return Range(min(a.low, b.low), min(a.high, b.high))


def _not(a: Range) -> Range:
    return Range(-a.high, -a.low)


def _same(a: Range) -> Range:
    """Return the range of the least, or the largest, of some values that are in a range."""
    return a


_OF_ONE: Final[dict[str, Callable[[Range], Range]]] = {
    "Abs": _absolute,
    "Neg": _not,
    **dict.fromkeys(("Always", "Eventually", "Historically", "Once"), _same),
}
"""How the range of a node follows from that of its part. Of others nothing is known: windows with
bounds may be empty near the ends of an episode."""
_OF_TWO: Final[dict[str, Callable[[Range, Range], Range]]] = {
    "Addition": _plus,
    "Subtraction": _minus,
    "Multiplication": _times,
    "Conjunction": _smaller,
    "Disjunction": _larger,
    "Implies": lambda a, b: _larger(_not(a), b),
}
