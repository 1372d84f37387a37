"""Conditions over named values, parsed without running code; each has a margin.

A condition has comparisons with `and`, `or`, `not` and brackets, as in Python:
`ttc_s < 1.5 or drac_mps2 > 4 or end == "TIMEOUT"`. Its margin is the negative robustness of
Fainekos and Pappas (2009): below 0 where the condition is met. That of a comparison is the distance
to its threshold in units of the threshold (a threshold of 0, and a comparison of two measures, have
the unit 1), that of two texts 1; `and` is the largest of its parts, `or` the smallest, and `not`
changes the sign.
"""

from __future__ import annotations

import ast
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence, Set
from typing import Any, NamedTuple

from merge_sumo.errors import UserError
from merge_sumo.printable import either, meant, printable

Value = float | str
"""A number, which may be infinite, or a text."""

MOST_MARGIN = 100.0
LEAST_MARGIN = 1e-9
"""Margins are finite and never 0, so that their sign says whether a condition is met."""
MOST_CHARACTERS = 1000
"""Of an expression, as typed and as Python writes it."""

Vocabulary = Mapping[str, Set[str] | None]
"""The known values by name: the possible texts, or None for a number."""


class Condition(NamedTuple):
    """A parsed condition.

    Attributes:
        margin: returns the margin for values by name, below 0 where the condition is met.
        names: names in the condition.
    """

    margin: Callable[[Mapping[str, Value]], float]
    names: frozenset[str]


def parse_condition(
    text: str, vocabulary: Vocabulary, named: Mapping[str, str]
) -> tuple[Condition, str]:
    """Return the condition of a text, and the text as Python would write it.

    Args:
        text: the condition as the user wrote it.
        vocabulary: the values that may be in it.
        named: other conditions that may be in it, by name.

    Raises:
        UserError: the text is not a condition.

    Example:
        >>> condition, text = parse_condition("ttc_s<1.5", {"ttc_s": None}, {})
        >>> text, condition.margin({"ttc_s": 3.0})
        ('ttc_s < 1.5', 1.0)
    """
    shown = printable(text[:80]) + ("..." if len(text) > 80 else "")
    what = f"`fail_when` {shown!r}"
    try:
        _check_length(text)
        with warnings.catch_warnings(action="ignore"):  # "1.5or" is odd, and means what it says
            tree = ast.parse(text.lstrip(), mode="eval").body
        written = ast.unparse(tree)
        _check_length(written)
        return _Parser(vocabulary, what, named).condition(tree), written
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        raise UserError(
            f"{what} is not a condition over measures: write comparisons joined by and, or, not "
            "as in Python, such as 'ttc_s < 1.5 or end == \"TIMEOUT\"'"
        ) from error


def _check_length(text: str) -> None:
    if len(text) > MOST_CHARACTERS:
        raise UserError(f"`fail_when` has {len(text)} characters: write at most {MOST_CHARACTERS}")


class _Parser:
    def __init__(self, vocabulary: Vocabulary, what: str, named: Mapping[str, str]) -> None:
        self._vocabulary, self._what, self._named = vocabulary, what, named

    def condition(self, node: ast.expr) -> Condition:
        """Return the condition of a part of the tree.

        Args:
            node: the part.
        """
        match node:
            case ast.BoolOp(op=sign, values=parts):
                return _joined(list(map(self.condition, parts)), every=isinstance(sign, ast.And))
            case ast.UnaryOp(op=ast.Not(), operand=of):
                return _negated(self.condition(of))
            case ast.Compare(left=left, ops=signs, comparators=sides):
                comparisons = []
                for comparison, right in zip(signs, sides, strict=True):
                    comparisons.append(self._comparison(left, comparison, right))
                    left = right
                return _joined(comparisons, every=True)
            case ast.Name(id=name) if name in self._named:
                return self.condition(ast.parse(self._named[name], mode="eval").body)
            case ast.Name(id=name) if name not in self._vocabulary:
                raise self._unknown(name)
        raise self._error(
            "is not a condition: write comparisons joined by and, or, not, with brackets", node
        )

    def _comparison(self, first: ast.expr, sign: ast.cmpop, second: ast.expr) -> Condition:
        left, right = self._side(first), self._side(second)
        names = [side for side in (left, right) if isinstance(side, str)]
        texts = [side.value for side in (left, right) if isinstance(side, ast.Constant)]
        if texts or any(self._vocabulary[name] for name in names):
            return self._equality(sign, names, texts)
        if not names:
            raise self._error(
                "a comparison of two numbers does not depend on the case: compare a measure"
            )
        match sign:
            case ast.Lt() | ast.LtE():
                return _inequality(left, right, or_equal=isinstance(sign, ast.LtE))
            case ast.Gt() | ast.GtE():
                return _inequality(right, left, or_equal=isinstance(sign, ast.GtE))
        raise self._error("compare numbers with <, <=, > or >=")

    def _equality(self, sign: ast.cmpop, names: list[str], texts: list[Any]) -> Condition:
        choices = self._vocabulary[names[0]] if len(texts) == len(names) == 1 else None
        if choices is None:
            raise self._error("compare a text measure with a text in quotes")
        name, text = names[0], texts[0]
        if not isinstance(sign, ast.Eq | ast.NotEq):
            raise self._error(f"{name} is a text: compare it with == or !=")
        if text not in choices:
            raise self._error(f"{name} cannot be {text!r}: choose {either(sorted(choices))}")
        met = Condition(lambda values: -1.0 if values[name] == text else 1.0, frozenset({name}))
        return met if isinstance(sign, ast.Eq) else _negated(met)

    def _side(self, node: ast.expr) -> Any:
        """Return the name of a measure, a number, or the constant of a text."""
        match node:
            case ast.Name(id=name) if name in self._vocabulary:
                return name
            case ast.Name(id=name):
                raise self._unknown(name)
            case ast.Constant(value=str()):
                return node
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                # An integer may be too large for a float.
                if number > sys.float_info.max:
                    raise self._error("a number must be finite")
                return float(number)
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant() as constant):
                number = self._side(constant)
                if isinstance(number, float):
                    return -number
        raise self._error("is not a measure, a number or a text", node)

    def _unknown(self, name: str) -> UserError:
        known = *self._vocabulary, *self._named
        choice = f"{meant(name, known)}choose one of {', '.join(known)}"
        return self._error(
            f"unknown measure {printable(name)!r} (write a text in quotes): {choice}"
        )

    def _error(self, why: str, node: ast.expr | None = None) -> UserError:
        shown = printable(ast.unparse(node)[:60]) + " " if node else ""
        return UserError(f"{self._what}: {shown}{why}")


def _inequality(left: str | float, right: str | float, *, or_equal: bool) -> Condition:
    """Return the condition that one side is below the other, or equal where `or_equal`."""
    unit, names = 1.0, set[str]()
    for side in (left, right):
        if isinstance(side, str):
            names.add(side)
        else:
            unit = abs(side) or 1.0

    def margin(values: Mapping[str, Value]) -> float:
        low = float(values[left]) if isinstance(left, str) else left
        high = float(values[right]) if isinstance(right, str) else right
        is_met = low <= high if or_equal else low < high
        away = 0.0 if low == high else (low - high) / unit
        size = min(max(abs(away), LEAST_MARGIN), MOST_MARGIN)
        return -size if is_met else size

    return Condition(margin, frozenset(names))


def _negated(condition: Condition) -> Condition:
    return Condition(lambda values: -condition.margin(values), condition.names)


def _joined(parts: Sequence[Condition], *, every: bool) -> Condition:
    """Return the condition that every one of some conditions is met, or any."""
    worst = max if every else min
    names = frozenset[str]().union(*(part.names for part in parts))
    return Condition(lambda values: worst(part.margin(values) for part in parts), names)
