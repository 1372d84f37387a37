"""Signals: named numbers and words that a controller leaves for each step, such as its mode.

They are kept with the motion of a case, drawn next to it, and exported. Names and words come from
the user's code: they are bounded, and made printable.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import groupby, islice
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from merge_sumo.errors import UserError
from merge_sumo.printable import printable

StepSignals = dict[str, float | str]
"""Values of one step, by name."""
Signals = dict[str, tuple[float | str | None, ...]]
"""By name, a value for each row of the motion of a case; None where none was left."""

MOST_NAMES = 8
"""Number of signals of a case; others are dropped."""
CHARACTERS = 40
"""Of a name, and of a word."""


def as_signals(left: object) -> StepSignals:
    """Return the numbers and words that a controller has left; other values are dropped.

    Numbers have six digits, names and words are cut. A number that is not finite is none.
    """
    if not isinstance(left, dict):
        return {}
    kept: StepSignals = {}
    for name, value in islice(left.items(), MOST_NAMES):
        known = _value(value)
        if known is not None and isinstance(name, str):
            kept[_word(name)] = known
    return kept


def _value(value: object) -> float | str | None:
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if isinstance(value, int | float | np.integer | np.floating):
        try:
            number = float(f"{float(value):.6g}")
        except (OverflowError, ValueError):
            return None
        return number if math.isfinite(number) else None
    return _word(value) if isinstance(value, str) else None


def _word(text: str) -> str:
    # A subclass of `str` may override its methods: take its characters only.
    return printable(str.__str__(text)[:CHARACTERS])[:CHARACTERS]


def series(left: Iterable[tuple[int, StepSignals]], rows: int) -> Signals | None:
    """Return the signals of a case by its number of rows and the values left: (row, by name).

    None where nothing was left. Of more than `MOST_NAMES`, the first ones.
    """
    columns: dict[str, list[float | str | None]] = {}
    for row, values in left:
        if row >= rows:
            break
        for name, value in values.items():
            if name not in columns:
                if len(columns) == MOST_NAMES:
                    continue
                columns[name] = [None] * rows
            columns[name][row] = value
    return {name: tuple(values) for name, values in columns.items()} or None


def to_record(signals: Signals) -> dict[str, list[list[Any]]]:
    """Return signals as JSON keeps them: by name, [number of rows, value] for equal values."""
    record: dict[str, list[list[Any]]] = {}
    for name, values in signals.items():
        record[name] = []
        for value, same in groupby(values):
            record[name].append([len(list(same)), value])
    return record


SignalRuns = Annotated[
    dict[str, tuple[tuple[Annotated[int, Meta(ge=1)], float | str | None], ...]],
    Meta(min_length=1, max_length=MOST_NAMES),
]
"""The result of `to_record`, as JSON has it."""


def from_runs(runs: SignalRuns, rows: int) -> Signals:
    """Return the signals of a case by its number of rows; `UserError` where they are invalid."""
    signals: Signals = {}
    for name, pairs in runs.items():
        if sum(count for count, _ in pairs) != rows:
            raise UserError("a signal has other rows than the motion")
        values: list[float | str | None] = []
        for count, value in pairs:
            if _word(name) != name or (value is not None and _value(value) != value):
                raise UserError("a signal is not as it was written")
            values += [value] * count
        signals[name] = tuple(values)
    return signals
