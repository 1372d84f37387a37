"""Conditions over named values: parsed without running anything, and how far from being met.

A condition is made of comparisons with `and`, `or`, `not` and brackets, as Python writes them:
`ttc_s < 1.5 or drac_mps2 > 4 or end == "TIMEOUT"`. Its margin is the robustness of Fainekos and
Pappas (2009), seen from the other side: below 0 where the condition is met and above where it is
not. That of a comparison is the distance to its threshold in units of the threshold (of 1 where
that is 0, or where two values are compared), that of two texts 1; `and` is the largest of its
parts, `or` the smallest, and `not` turns the sign.
"""

from __future__ import annotations

import ast
import re
import sys
import warnings
from collections.abc import Callable, Iterable, Mapping, Set
from typing import Any, NamedTuple

from merge_sumo.errors import UserError
from merge_sumo.printable import either, meant, nearest, printable

Value = float | str
"""A number, which may be infinite, or a text."""

MOST_MARGIN = 100.0
LEAST_MARGIN = 1e-9
"""Margins are finite and never 0, so that their sign says whether a condition is met."""
MOST_CHARACTERS = 1000
"""Of an expression: what a parser that is not ours may be given."""
MOST_WRITTEN = 20 * MOST_CHARACTERS
"""Of one as Python writes it, with its spaces, brackets and digits: records have it so."""

Vocabulary = Mapping[str, Set[str] | None]
"""The values that there are by name: the texts that one may have, None for a number."""
OTHER_SIGNS = re.compile(r"&&?|\|\|?|!(?!=)|(?<![=<>!])=(?!=)")
"""Signs of other languages."""


class Condition(NamedTuple):
    """A condition: how far values are from meeting it, and the values that it speaks of."""

    margin: Callable[[Mapping[str, Value]], float]
    names: frozenset[str]


def parse_condition(
    text: str, vocabulary: Vocabulary, what: str, named: Mapping[str, str] | None = None
) -> tuple[Condition, str]:
    """Return the condition that a text states, and the text as Python would write it.

    Args:
        text: the condition as the user wrote it.
        vocabulary: the values that it may speak of.
        what: where it stands, which begins every complaint.
        named: conditions that it may name, by their names.

    Raises `UserError` where it is none.
    """
    shown = printable(text[:80]) + ("..." if len(text) > 80 else "")
    too_long = UserError(f"{what} has {len(text)} characters: {MOST_CHARACTERS} are the most")
    if len(text) > MOST_WRITTEN:
        raise too_long
    try:
        with warnings.catch_warnings(action="ignore"):  # "1.5or" is odd, and means what it says
            tree = ast.parse(text.lstrip(), mode="eval").body
        written = ast.unparse(tree)
        if len(text) > MOST_CHARACTERS and text != written:
            raise too_long
        return _Parser(vocabulary, f"{what} {shown!r}", named or {}).condition(tree), written
    except (SyntaxError, ValueError, MemoryError, RecursionError) as error:
        sign = OTHER_SIGNS.search(text)
        hint = f": write and, or, not, == or < instead of {sign[0]}" if sign else ""
        raise UserError(
            f"{what} {shown!r} is no expression over measures such as "
            f"'ttc_s < 1.5 or end == \"TIMEOUT\"'{hint}"
        ) from error


class _Parser:
    def __init__(self, vocabulary: Vocabulary, what: str, named: Mapping[str, str]) -> None:
        self._vocabulary, self._what, self._named = vocabulary, what, named

    def condition(self, node: ast.expr) -> Condition:
        """Return the condition of a part of the tree."""
        match node:
            case ast.BoolOp(op=sign, values=parts):
                return _joined(map(self.condition, parts), every=isinstance(sign, ast.And))
            case ast.UnaryOp(op=ast.Not(), operand=of):
                return _negated(self.condition(of))
            case ast.Compare(left=first, ops=signs, comparators=others):
                pairs = zip((first, *others), signs, others, strict=False)
                return _joined((self._comparison(*pair) for pair in pairs), every=True)
            case ast.Name(id=name) if name in self._named:
                return self.condition(ast.parse(self._named[name], mode="eval").body)
            case ast.Name(id=name) if name in self._vocabulary:
                raise self._error(f"{name} stands alone: compare it with something")
            case ast.Name(id=name):
                raise self._unknown(name)
        raise self._error(
            f"{_shown(node)} is no condition: write comparisons, and, or, not and brackets"
        )

    def _comparison(self, first: ast.expr, sign: ast.cmpop, second: ast.expr) -> Condition:
        left, right = self._side(first, second), self._side(second, first)
        texts = [side.value for side in (left, right) if isinstance(side, ast.Constant)]
        names = [side for side in (left, right) if isinstance(side, str)]
        if texts or any(self._vocabulary[name] for name in names):
            return self._equality(sign, names, texts)
        if not names:
            raise self._error("a comparison of two numbers says nothing of a case")
        if isinstance(sign, ast.Gt | ast.GtE):
            left, right = right, left
        elif not isinstance(sign, ast.Lt | ast.LtE):
            raise self._error("compare numbers with <, <=, > or >=")
        return _inequality(left, right, or_equal=isinstance(sign, ast.LtE | ast.GtE))

    def _equality(self, sign: ast.cmpop, names: list[str], texts: list[Any]) -> Condition:
        choices = self._vocabulary[names[0]] if len(texts) == len(names) == 1 else None
        if choices is None:
            raise self._error("compare a measure that is a text with a text in quotes")
        name, text = names[0], texts[0]
        if not isinstance(sign, ast.Eq | ast.NotEq):
            raise self._error(f"{name} is a text: compare it with == or !=")
        if text not in choices:
            raise self._error(
                f"{name} is never {text!r}: {meant(text, sorted(choices))}it is "
                f"{either(sorted(choices))}"
            )
        met = Condition(lambda values: -1.0 if values[name] == text else 1.0, frozenset({name}))
        return met if isinstance(sign, ast.Eq) else _negated(met)

    def _side(self, node: ast.expr, other: ast.expr) -> Any:
        """Return the name of a measure, a number, or the constant of a text."""
        match node:
            case ast.Name(id=name) if name in self._vocabulary:
                return name
            case ast.Name(id=name) if name in self._named:
                raise self._error(
                    f"{name} is a criterion, which is met or not: write it alone, or compare a "
                    "measure"
                )
            case ast.Name(id=name):
                texts = self._vocabulary.get(other.id) if isinstance(other, ast.Name) else None
                if near := nearest(name, sorted(texts or ())):
                    raise self._error(f'a text is to be in quotes: {_shown(other)} == "{near[0]}"')
                raise self._unknown(name)
            case ast.Constant(value=str()):
                return node
            case ast.Constant(value=int() | float() as number) if not isinstance(number, bool):
                return self._finite(number)
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant(value=int() | float() as number)):
                return self._finite(-number)
        raise self._error(f"{_shown(node)} is neither a measure nor a number nor a text")

    def _finite(self, number: float) -> float:
        # An integer may be too large for a float.
        if abs(number) > sys.float_info.max:
            raise self._error("a number is to be finite")
        return float(number)

    def _unknown(self, name: str) -> UserError:
        hint = meant(name, (*self._vocabulary, *self._named))
        hint = hint or f"choose {', '.join(self._vocabulary)}"
        return self._error(f"there is no measure {printable(name)!r}: {hint.strip()}")

    def _error(self, why: str) -> UserError:
        return UserError(f"{self._what}: {why}")


def _inequality(left: str | float, right: str | float, *, or_equal: bool) -> Condition:
    """Return whether one side is below the other, or as large where `or_equal`."""
    fixed = [abs(side) for side in (left, right) if not isinstance(side, str)]
    unit = (fixed and fixed[0]) or 1.0

    def margin(values: Mapping[str, Value]) -> float:
        low, high = (
            float(values[side]) if isinstance(side, str) else side for side in (left, right)
        )
        met = low <= high if or_equal else low < high
        away = 0.0 if low == high else (low - high) / unit
        size = min(max(abs(away), LEAST_MARGIN), MOST_MARGIN)
        return -size if met else size

    return Condition(margin, frozenset(side for side in (left, right) if isinstance(side, str)))


def _negated(condition: Condition) -> Condition:
    return Condition(lambda values: -condition.margin(values), condition.names)


def _joined(conditions: Iterable[Condition], *, every: bool) -> Condition:
    """Return whether every one of some conditions is met, or any."""
    parts = list(conditions)
    worst = max if every else min
    return Condition(
        lambda values: worst(part.margin(values) for part in parts),
        frozenset().union(*(part.names for part in parts)),
    )


def _shown(node: ast.expr) -> str:
    return printable(ast.unparse(node)[:60])
