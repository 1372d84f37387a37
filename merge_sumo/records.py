"""Records by declaration: JSON and TOML into typed values, or one sentence on the error.

The annotations of a class declare its values, with bounds as `Meta`. Reading is
strict: texts and true are not numbers, and 18 is 18.0 where a number may have a fraction.
Unknown names, numbers beyond float64, half characters and endless nesting are refused, since the
file may be received from others.
"""

from __future__ import annotations

import io
import json
import re
import tomllib
import zipfile
from collections.abc import Container, Sequence
from dataclasses import is_dataclass
from enum import Enum
from functools import cache
from operator import methodcaller
from pathlib import Path
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    ClassVar,
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
from numpy.typing import NDArray

from merge_sumo.errors import UserError, explained
from merge_sumo.files import read_limited, regular

T = TypeVar("T")

WORDS: dict[Any, str] = {
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
MAX_RECORD_BYTES = 1 << 28
"""A larger JSON file is not read."""
MAX_TOML_BYTES = 1 << 20
"""A larger file is not read: it has some 6,000 cases."""
_NAMED = re.compile(r"Object (missing required|contains unknown) field `(.*?)`", re.DOTALL)


class RecordError(UserError):
    """A value that is not a record of its type."""


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of values that are a line or a table of a file."""


def record_type(name: str, fields: Sequence[tuple[Any, ...]]) -> Any:
    """Return a type of records with fields that are known at run time.

    Args:
        name: name of the type.
        fields: of each field: name, type, and its default, if it has one.
    """
    return msgspec.defstruct(name, fields, bases=(Record,), frozen=True, forbid_unknown_fields=True)


def decode(content: bytes | str, kind: Any = Any) -> Any:
    """Return JSON as a value of a type.

    Args:
        content: the JSON.
        kind: the type.

    Raises:
        RecordError: it is not JSON, or not of the type.
    """
    try:
        return msgspec.json.decode(content, type=kind)
    except msgspec.ValidationError as error:
        record = None if kind is Any else decode(content)
        raise RecordError(_sentence(error, record, kind)) from error
    except RecursionError as error:
        raise RecordError("it has too many nested levels") from error
    except (msgspec.DecodeError, ValueError) as error:
        raise RecordError(f"it is not JSON ({error})") from error


def read_record(path: Path, kind: type[T]) -> T | None:
    """Return a JSON file as a value of a type; None without the file.

    Args:
        path: the file.
        kind: the type.

    Raises:
        UserError: the file is not as it was written.
    """
    try:
        content = read_limited(path, MAX_RECORD_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    with explained(f"{path} is damaged"):
        known: T = decode(content, kind)
    return known


def convert(record: object, kind: type[T], *, strict: bool = True) -> T:
    """Return plain values, as JSON and TOML have them, as a value of a type.

    Args:
        record: the values.
        kind: the type.
        strict: False where texts stand for numbers, as in XML.

    Raises:
        RecordError: the values are others, or have names that a dataclass does not have.
    """
    _check_names(record, kind)
    try:
        return msgspec.convert(record, kind, strict=strict)
    except msgspec.ValidationError as error:
        raise RecordError(_sentence(error, record, kind)) from error
    except RecursionError as error:
        raise RecordError("it has too many nested levels") from error


def _check_names(record: object, kind: Any) -> None:
    """Raise `RecordError` for a name that a dataclass, or one in its fields, does not have."""
    if not (is_dataclass(kind) and isinstance(record, dict)):
        return
    hints = _hints(kind)  # type: ignore[arg-type]
    for name, value in record.items():
        if name not in hints:
            raise RecordError(_unknown(name, kind))
        _check_names(value, hints[name])


def check_fields(value: Any) -> None:
    """Check and convert the fields of a dataclass in place: 18 to 18.0, a list to a tuple.

    Numbers of numpy are as good as those of Python.

    Args:
        value: the dataclass.

    Raises:
        RecordError: a field is of another type.
    """
    kind: Any = type(value)
    for name, hint in _hints(kind).items():
        known = getattr(value, name)
        if isinstance(hint, type) and is_dataclass(hint) and isinstance(known, hint):
            continue  # also of a subclass, which msgspec takes for another type
        plain = known.item() if isinstance(known, np.generic) else known
        try:
            object.__setattr__(value, name, msgspec.convert(plain, hint))
        except msgspec.ValidationError as error:
            raise RecordError(_not_a_value(name, known, hint, str(error))) from error


def read_indexed(path: Path, kind: type[T], indices: Container[int]) -> list[T]:
    """Return the lines of a JSON-lines file of cases; nothing without the file.

    Args:
        path: the file.
        kind: what each line is.
        indices: those that a line may have.

    Raises:
        RecordError: a line is not of that kind, or has another index, or is of the
            case and the VUT of an earlier line.
    """
    try:
        lines = regular(path).read_bytes().splitlines()
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RecordError(f"{path} cannot be read: {error.strerror}") from error
    values: dict[Any, T] = {}
    for number, line in enumerate(lines, start=1):
        with explained(f"line {number} of {path} is damaged"):
            value: Any = convert(decode(line, dict[str, Any]), kind)
            # A case may have a line for each VUT.
            key = value.index, getattr(value, "vut", None)
            if value.index not in indices or key in values:
                raise RecordError(f"case {value.index} does not exist or has a line already")
        values[key] = value
    return list(values.values())


def read_toml(path: Path, what: str) -> tuple[str, dict[str, Any]]:
    """Return the text of a TOML file, and its record.

    Args:
        path: the file.
        what: what it holds, for messages.

    Raises:
        UserError: it cannot be read, or is not TOML.
    """
    try:
        text = read_limited(path, MAX_TOML_BYTES).decode()
        return text, tomllib.loads(text)
    except OSError as error:
        raise UserError(f"cannot read the {what} {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"the {what} {path} is not UTF-8 text") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"the {what} {path} is not TOML: {error}") from error


def toml_value(value: object) -> str:
    """Return a plain value as TOML in one line, numbers in full.

    Args:
        value: numbers, texts, lists and tables.
    """
    if isinstance(value, dict):
        named = []
        for name, of in value.items():
            is_bare = name.isascii() and name.isidentifier()
            named.append(f"{name if is_bare else toml_value(name)} = {toml_value(of)}")
        return f"{{{', '.join(named)}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def to_plain(value: object) -> Any:
    """Return a value as the lists and tables of JSON, numbers of numpy as those of Python.

    Args:
        value: a value with records and dataclasses.
    """
    return msgspec.to_builtins(value, enc_hook=methodcaller("item"))


def to_json(value: object, *, indent: int | None = None) -> bytes:
    """Return a value as JSON, with its line end.

    Args:
        value: the value, as of `to_plain`.
        indent: spaces of each level; None for one line.

    Raises:
        ValueError: a number is not finite.
    """
    return (json.dumps(to_plain(value), indent=indent, allow_nan=False) + "\n").encode()


def in_words(hint: Any) -> str:
    """Return the values of a type in words, for "it must be ...".

    Args:
        hint: the type, with its limits.
    """
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        meta: Meta = parts[1]
        limits = "" if meta.gt is None else f" above {meta.gt:g}"
        limits += "" if meta.ge is None else f" of {meta.ge:g} or more"
        limits += "" if meta.le is None else f", up to {meta.le:g}"
        return meta.description or in_words(parts[0]) + limits
    if origin in (Union, UnionType):
        words = dict.fromkeys(in_words(part) for part in parts if part is not NoneType)
        return " or ".join(words)
    if origin is Literal:
        return f"one of {', '.join(parts)}"
    if isinstance(hint, type) and issubclass(hint, Enum):
        return f"one of {', '.join(str(member.value) for member in hint)}"
    return WORDS.get(hint, "a list" if origin is tuple else "a table of names and values")


@cache
def _hints(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True).items()
    return {name: hint for name, hint in hints if get_origin(hint) is not ClassVar}


def _unknown(name: object, kind: Any) -> str:
    return f"{kind.__name__.lower()} has no {name!r:.60}: it has {', '.join(_hints(kind))}"


def _sentence(error: msgspec.ValidationError, record: Any, kind: Any) -> str:
    """Return a sentence on a record: the field, its value, and the required type."""
    message, _, place = str(error).partition(" - at `$")
    name = "it"
    for name in re.findall(r"\.(\w+)", place):
        kind = _hints(_class_of(kind)).get(name)
        record = record.get(name) if isinstance(record, dict) else None
    wrong = _NAMED.match(message)
    if wrong and wrong[1] == "missing required":
        return f"{name} has no field {wrong[2]}"
    if wrong:
        return _unknown(wrong[2], _class_of(kind))
    return _not_a_value(name, record, kind, message)


def _class_of(hint: Any) -> Any:
    """Return the record or dataclass that a type means, the first of a union."""
    for part in (hint, *get_args(hint)):
        if is_dataclass(part) or (isinstance(part, type) and issubclass(part, Record)):
            return part
    return Record


def _not_a_value(name: str, value: object, hint: Any, message: str) -> str:
    try:
        shown = f"{value!r:.60}"
    except (ValueError, RecursionError):  # thousands of digits, or of brackets
        shown = "something endless"
    if hint is None:  # a field of another record of a union
        return f"{name} is {shown}: {message}"
    finite = "out of range" in message
    return f"{name} is {shown}: it must be {'finite' if finite else in_words(hint)}"


def read_arrays(file: Path | io.BytesIO, *names: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of an .npz file of merge-sumo, by name.

    These files are not compressed, so that none is more than it looks.

    Args:
        file: the file.
        names: the arrays to read; by default all.

    Raises:
        RecordError: the file is missing, or is not such a file.
    """
    try:
        with np.load(regular(file) if isinstance(file, Path) else file, allow_pickle=False) as data:
            if any(member.compress_type != zipfile.ZIP_STORED for member in data.zip.infolist()):
                raise ValueError("it is compressed")
            return {name: data[name] for name in names or data.files}
    except Exception as error:  # numpy and the zip library raise whatever comes up
        raise RecordError(str(error)) from error
