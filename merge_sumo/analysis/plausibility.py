"""What a person should know before believing the verdict of a campaign, in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final

from merge_sumo.system.printable import counted
from merge_sumo.values.criteria import CRITERIA
from merge_sumo.values.criterion import Criterion, condition_of, values_of
from merge_sumo.values.expression import (
    AllOf,
    AnyOf,
    Comparison,
    Condition,
    Negation,
    names_of,
)
from merge_sumo.values.scenario import DT_S
from merge_sumo.values.score import Outcome

KMH_PER_MPS: Final = 3.6
CLIPPED_SHARE: Final = 0.01
"""Share of the steps from which on it is said that accelerations were clipped."""


def doubts(outcomes: Sequence[Outcome], criterion: Criterion) -> list[str]:
    """Return what is odd about the outcomes of a campaign; nothing for most.

    Of a criterion that says the same of all cases, a neighbour that would not.
    """
    if not outcomes:
        return []
    sentences = (_clipped(outcomes), _one_verdict(outcomes, criterion))
    return [sentence for sentence in sentences if sentence is not None]


def _clipped(outcomes: Sequence[Outcome]) -> str | None:
    """Return in how many steps a VUT asked for more than its limits; None where hardly ever."""
    clipped = sum(outcome.measures.clipped_steps for outcome in outcomes)
    steps = sum(round(outcome.measures.t_end_s / DT_S) for outcome in outcomes)
    if not clipped or clipped < CLIPPED_SHARE * steps:
        return None
    scenario = outcomes[0].case.scenario
    return (
        f"in {clipped} of {steps} steps the VUT asks for an acceleration outside "
        f"{scenario.a_min_mps2:g} to {scenario.a_max_mps2:g} m/s2, which is clipped"
    )


def _one_verdict(outcomes: Sequence[Outcome], criterion: Criterion) -> str | None:
    """Return a criterion beside one that says the same of all cases, where it tells them apart."""
    judged = [outcome for outcome in outcomes if outcome.margin is not None]
    failures = sum(outcome.failed for outcome in judged)
    if (
        criterion.require is not None
        or criterion.fail_when in CRITERIA
        or 0 < failures < len(judged)
    ):
        return None
    condition = condition_of(criterion.words)
    values = [values_of(outcome.measures, names_of(condition)) for outcome in judged]
    for before, after, why in _with_other_thresholds(condition):
        other = _with(condition, before, after)
        met = sum(other.margin(of_case) < 0.0 for of_case in values)
        if 0 < met < len(judged):
            every = "every case fails" if failures else "no case fails"
            return (
                f"{every} under {criterion.words}; with {_text_of(after)} ({why}) "
                f"{met} of {counted(len(judged), 'case')} would"
            )
    return None


def _with_other_thresholds(condition: Condition) -> Iterator[tuple[Comparison, Comparison, str]]:
    """Yield comparisons with a threshold in another unit or of the other sign, and what it is."""
    for comparison in _comparisons_in(condition):
        sides = (comparison.left, comparison.right)
        numbers = [side for side in sides if isinstance(side, float)]
        names = [side for side in sides if isinstance(side, str)]
        if len(numbers) != 1 or numbers[0] == 0.0:
            continue
        (number,), (name,) = numbers, names
        speed = name.endswith("_mps")
        for other, why, fits in (
            (number / KMH_PER_MPS, f"{number:g} km/h", speed),
            (-number, "the other sign", True),
            (number * KMH_PER_MPS, f"{number:g} m/s as km/h", speed),
        ):
            if fits:
                short = float(f"{other:.3g}")
                left, right = (short if isinstance(side, float) else side for side in sides)
                yield comparison, Comparison(left, right, comparison.or_equal), why


def _with(condition: Condition, before: Comparison, after: Comparison) -> Condition:
    """Return a condition with one comparison in the place of another."""
    match condition:
        case Negation(of):
            return Negation(_with(of, before, after))
        case AllOf(parts):
            return AllOf(tuple(_with(part, before, after) for part in parts))
        case AnyOf(parts):
            return AnyOf(tuple(_with(part, before, after) for part in parts))
    return after if condition == before else condition


def _comparisons_in(condition: Condition) -> Iterator[Comparison]:
    """Yield the comparisons of numbers in a condition, from left to right."""
    match condition:
        case Comparison():
            yield condition
        case Negation(of):
            yield from _comparisons_in(of)
        case AllOf(parts) | AnyOf(parts):
            for part in parts:
                yield from _comparisons_in(part)


def _text_of(condition: Comparison) -> str:
    """Return a comparison as a person writes it, with the measure first."""
    left, right, sign = condition.left, condition.right, "<=" if condition.or_equal else "<"
    if isinstance(left, float):
        left, right, sign = right, left, sign.replace("<", ">")
    shown = [side if isinstance(side, str) else f"{side:.12g}" for side in (left, right)]
    return f"{shown[0]} {sign} {shown[1]}"
