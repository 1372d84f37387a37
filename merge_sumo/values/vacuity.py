"""Whether a condition can be met at all, and whether it can be missed.

A condition is taken apart into alternatives, each a conjunction of comparisons. An alternative is
impossible where the comparisons leave no value of some measure inside its range; measures count as
independent of each other. So "never" and "always" are certain, and silence says nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass
from itertools import product
from typing import Final

from merge_sumo.values.expression import AllOf, AnyOf, Comparison, Condition, Equality, Negation
from merge_sumo.values.ranges import Range

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
                found = [alternative for of_part in each for alternative in of_part]
                if len(found) > MOST_ALTERNATIVES:
                    raise TooManyError
                return found

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
