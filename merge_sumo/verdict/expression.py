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
from collections.abc import Mapping, Set
from dataclasses import dataclass
from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.system.printable import printable
from merge_sumo.system.suggestions import either, meant, nearest

Value = float | str
"""A number, which may be infinite, or a text."""

MOST_MARGIN: Final = 100.0
LEAST_MARGIN: Final = 1e-9
"""Margins are finite and never 0, so that their sign says whether a condition is met."""
MOST_CHARACTERS: Final = 1000
"""Of an expression: what a parser that is not ours may be given."""
MOST_WRITTEN: Final = 20 * MOST_CHARACTERS
"""Of one as Python writes it, with its spaces, brackets and digits: records have it so."""

Vocabulary = Mapping[str, Set[str] | None]
"""The values that there are by name: the texts that one may have, None for a number."""
NONE: Final[Mapping[str, str]] = {}
"""No conditions that are named."""
ALIKE_MEASURES: Final = 0.5
"""Ratio of matching characters from which on a measure may have been meant."""
OTHER_SIGNS: Final = re.compile(r"&&?|\|\|?|!(?!=)|(?<![=<>!])=(?!=)")
"""Signs of other languages."""


@dataclass(frozen=True, slots=True)
class Inequality:
    """Whether one value is below another: left < right, or <= where `or_equal`."""

    left: str | float
    right: str | float
    or_equal: bool

    def margin(self, values: Mapping[str, Value]) -> float:
        """Return how far it is from being met."""
        left, right = (_number(side, values) for side in (self.left, self.right))
        met = left <= right if self.or_equal else left < right
        fixed = [abs(side) for side in (self.left, self.right) if isinstance(side, float)]
        away = 0.0 if left == right else (left - right) / ((fixed and fixed[0]) or 1.0)
        size = min(max(abs(away), LEAST_MARGIN), MOST_MARGIN)
        return -size if met else size


@dataclass(frozen=True, slots=True)
class Equality:
    """Whether a value is a text."""

    name: str
    text: str

    def margin(self, values: Mapping[str, Value]) -> float:
        """Return -1 where it is, else 1."""
        return -1.0 if values[self.name] == self.text else 1.0


@dataclass(frozen=True, slots=True)
class Negation:
    """That a condition is not met."""

    of: Condition

    def margin(self, values: Mapping[str, Value]) -> float:
        """Return how far it is from being met."""
        return -self.of.margin(values)


@dataclass(frozen=True, slots=True)
class AllOf:
    """That every one of some conditions is met."""

    parts: tuple[Condition, ...]

    def margin(self, values: Mapping[str, Value]) -> float:
        """Return how far it is from being met."""
        return max(part.margin(values) for part in self.parts)


@dataclass(frozen=True, slots=True)
class AnyOf:
    """That at least one of some conditions is met."""

    parts: tuple[Condition, ...]

    def margin(self, values: Mapping[str, Value]) -> float:
        """Return how far it is from being met."""
        return min(part.margin(values) for part in self.parts)


Condition = Inequality | Equality | Negation | AllOf | AnyOf


def names_of(condition: Condition) -> frozenset[str]:
    """Return the values that a condition speaks of."""
    match condition:
        case Inequality(left, right):
            return frozenset(side for side in (left, right) if isinstance(side, str))
        case Equality(name):
            return frozenset({name})
        case Negation(of):
            return names_of(of)
        case AllOf(parts) | AnyOf(parts):
            return frozenset[str]().union(*map(names_of, parts))


def _number(side: str | float, values: Mapping[str, Value]) -> float:
    value = values[side] if isinstance(side, str) else side
    assert isinstance(value, float), "the vocabulary says that it is a number"  # noqa: S101
    return value


def parse_condition(
    text: str, vocabulary: Vocabulary, what: str, named: Mapping[str, str] = NONE
) -> tuple[Condition, str]:
    """Return the condition that a text states, and the text as Python would write it.

    Args:
        text: what a person wrote.
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
        return _Parser(vocabulary, f"{what} {shown!r}", named).condition(tree), written
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
            case ast.BoolOp(op=ast.And(), values=parts):
                return AllOf(tuple(map(self.condition, parts)))
            case ast.BoolOp(op=ast.Or(), values=parts):
                return AnyOf(tuple(map(self.condition, parts)))
            case ast.UnaryOp(op=ast.Not(), operand=of):
                return Negation(self.condition(of))
            case ast.Compare(left=first, ops=signs, comparators=others):
                sides = (first, *others)
                pairs = zip(sides, signs, sides[1:], strict=False)
                chain = tuple(self._comparison(*pair) for pair in pairs)
                return chain[0] if len(chain) == 1 else AllOf(chain)
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
        texts = [side for side in (left, right) if isinstance(side, _Text)]
        names = [s for s in (left, right) if isinstance(s, str) and not isinstance(s, _Text)]
        choices = [self._vocabulary[name] for name in names]
        if texts or any(choices):
            return self._equality(sign, names, texts)
        if not names:
            raise self._error("a comparison of two numbers says nothing of a case")
        match sign:
            case ast.Lt() | ast.LtE():
                return Inequality(left, right, isinstance(sign, ast.LtE))
            case ast.Gt() | ast.GtE():
                return Inequality(right, left, isinstance(sign, ast.GtE))
        raise self._error("compare numbers with <, <=, > or >=")

    def _equality(self, sign: ast.cmpop, names: list[str], texts: list[_Text]) -> Condition:
        choices = self._vocabulary[names[0]] if len(texts) == len(names) == 1 else None
        if choices is None:
            raise self._error("compare a measure that is a text with a text in quotes")
        name, text = names[0], str(texts[0])
        if not isinstance(sign, ast.Eq | ast.NotEq):
            raise self._error(f"{name} is a text: compare it with == or !=")
        if text not in choices:
            raise self._error(
                f"{name} is never {text!r}: {meant(text, sorted(choices))}it is "
                f"{either(sorted(choices))}"
            )
        equality = Equality(name, text)
        return equality if isinstance(sign, ast.Eq) else Negation(equality)

    def _side(self, node: ast.expr, other: ast.expr) -> Value:
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
            case ast.Constant(value=str(text)):
                return _Text(text)
            case ast.UnaryOp(op=ast.USub(), operand=ast.Constant() as number):
                return -self._finite(number)
            case ast.Constant() as number:
                return self._finite(number)
        raise self._error(f"{_shown(node)} is neither a measure nor a number nor a text")

    def _finite(self, node: ast.Constant) -> float:
        if not isinstance(node.value, int | float) or isinstance(node.value, bool):
            raise self._error(f"{_shown(node)} is neither a measure nor a number nor a text")
        # An integer may be too large for a float.
        if abs(node.value) > sys.float_info.max:
            raise self._error("a number is to be finite")
        return float(node.value)

    def _unknown(self, name: str) -> UserError:
        hint = meant(name, (*self._vocabulary, *self._named), ALIKE_MEASURES)
        hint = hint or f"choose {', '.join(self._vocabulary)}"
        return self._error(f"there is no measure {printable(name)!r}: {hint.strip()}")

    def _error(self, why: str) -> UserError:
        return UserError(f"{self._what}: {why}")


class _Text(str):
    """A text in quotes: a plain `str` is the name of a value."""

    __slots__ = ()


def _shown(node: ast.expr) -> str:
    return printable(ast.unparse(node)[:60])
