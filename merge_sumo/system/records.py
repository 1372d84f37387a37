"""Records by declaration: JSON and TOML into typed values, or one sentence on what is wrong.

What a record may hold is what the annotations of its class say, with bounds as `Meta`. Reading is
strict: a text is no number, true is no number, and 18 is 18.0 where a number may have a fraction.
Unknown names, numbers beyond float64, half characters and endless nesting are refused, since the
file may be somebody else's.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Final,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec
import numpy as np
from msgspec import Meta

from merge_sumo.errors import UserError
from merge_sumo.system.arrays import regular
from merge_sumo.system.suggestions import meant

__all__ = ["Meta", "Record", "check_fields", "convert", "decode", "read_lines", "to_plain"]

T = TypeVar("T")

WORDS: Final[dict[Any, str]] = {
    bool: "True or False",
    int: "a whole number",
    float: "a number",
    str: "a text",
    tuple[float, float]: "two numbers, [low, high]",
    tuple[int, ...]: "a list of whole numbers",
    tuple[float, ...]: "a list of numbers",
    tuple[str, ...]: "a list of texts",
}
"""Types of fields in words; another type is a table of names and values."""
_NAMED: Final = re.compile(r"Object (missing required|contains unknown) field `(.*?)`", re.DOTALL)


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of values that are a line or a table of a file."""


def record_type(name: str, fields: Sequence[tuple[Any, ...]]) -> Any:
    """Return a type of records with fields that are known at run time: (name, type[, default])."""
    return msgspec.defstruct(name, fields, bases=(Record,), frozen=True, forbid_unknown_fields=True)


def decode(content: bytes | str, kind: Any = Any) -> Any:
    """Return what JSON says as a value of a type; `UserError` where it is none."""
    try:
        return msgspec.json.decode(content, type=kind)
    except msgspec.ValidationError as error:
        record = None if kind is Any else decode(content)
        raise UserError(_sentence(error, record, kind)) from error
    except RecursionError as error:
        raise UserError("it is nested too deeply") from error
    except ValueError as error:
        raise UserError(f"it is no JSON ({error})") from error


def convert(record: object, kind: type[T]) -> T:
    """Return plain values, as JSON and TOML have them, as a value of a type.

    Raises `UserError` for other values, and for names that a dataclass does not have.
    """
    if is_dataclass(kind) and isinstance(record, dict):
        known = list(_hints(kind))
        for name in record:
            if name not in known:
                raise UserError(_unknown(name, kind))
    try:
        return msgspec.convert(record, kind)
    except msgspec.ValidationError as error:
        raise UserError(_sentence(error, record, kind)) from error
    except RecursionError as error:
        raise UserError("it is nested too deeply") from error


def check_fields(value: Any) -> None:
    """Check and convert the fields of a dataclass in place: 18 to 18.0, a list to a tuple.

    Numbers of numpy are as good as those of Python. Raises `UserError` for another type.
    """
    kind: Any = type(value)
    for name, hint in _hints(kind).items():
        known = getattr(value, name)
        plain = known.item() if isinstance(known, np.generic) else known
        try:
            object.__setattr__(value, name, msgspec.convert(plain, hint))
        except msgspec.ValidationError as error:
            raise UserError(_not_a_value(name, known, hint, str(error))) from error


def read_lines(path: Path, kind: type[T]) -> Iterator[tuple[int, T]]:
    """Yield the number and the value of each line of a JSON-lines file, if it exists.

    Raises `UserError` with the number of a line that is no such value.
    """
    try:
        lines = regular(path).read_bytes().splitlines()
    except FileNotFoundError:
        return
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    for number, line in enumerate(lines, start=1):
        try:
            yield number, decode(line, kind)
        except UserError as error:
            raise UserError(f"line {number} of {path}: {error}") from error


def to_plain(value: object) -> Any:
    """Return a value as the lists and tables that JSON has."""
    return msgspec.to_builtins(value)


def in_words(hint: Any) -> str:
    """Return what a field of a type may hold, for "it must be ..."."""
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        bounds: Meta = parts[1]
        limits = "" if bounds.ge is None else f" from {bounds.ge:g} up"
        if bounds.le is not None:
            limits = f" from {bounds.ge:g} to {bounds.le:g}"
        return bounds.description or in_words(parts[0]) + limits
    if origin in (Union, UnionType):
        return " or ".join(in_words(part) for part in parts if part is not NoneType)
    if origin is Literal:
        return f"one of {', '.join(parts)}"
    if isinstance(hint, type) and issubclass(hint, Enum):
        return f"one of {', '.join(str(member.value) for member in hint)}"
    return WORDS.get(hint, "a list" if origin is tuple else "a table of names and values")


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _unknown(name: object, kind: Any) -> str:
    known = list(_hints(kind))
    hint = meant(str(name), known) or f"it has {', '.join(known)}"
    noun = kind.__name__.lower()
    return f"a{'n' if noun[0] in 'aeiou' else ''} {noun} has no {name!r:.60}: {hint.strip()}"


def _sentence(error: msgspec.ValidationError, record: Any, kind: Any) -> str:
    """Return what is wrong in a record: the field, what it holds, and what it must be."""
    message = str(error)
    place = re.search(r" - at `\$([^`]*)`$", message)
    names = re.findall(r"\.(\w+)", place[1]) if place else []
    for name in names:
        kind = _hints(_class_in(kind))[name]
        record = record.get(name) if isinstance(record, dict) else None
    wrong = _NAMED.match(message)
    if wrong and wrong[1] == "missing required":
        return f"{names[-1] if names else 'it'} has no {wrong[2]}"
    if wrong:
        return _unknown(wrong[2], _class_in(kind))
    return _not_a_value(names[-1] if names else "it", record, kind, message)


def _not_a_value(name: str, value: object, hint: Any, message: str) -> str:
    try:
        shown = f"{value!r:.60}"
    except (ValueError, RecursionError):  # thousands of digits, or of brackets
        shown = "something endless"
    finite = "out of range" in message
    return f"{name} is {shown}: it must be {'finite' if finite else in_words(hint)}"


def _class_in(hint: Any) -> Any:
    """Return the class of records that a type is or may be."""
    return next((part for part in get_args(hint) if hasattr(part, "__annotations__")), hint)
