"""Signals: named numbers and words that a controller sets at each step, such as its mode.

They are recorded with the motion of a case, plotted and exported. They come from a user's code, so
their number and length are limited, and texts are made printable.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import groupby, islice
from typing import Annotated

import numpy as np
from msgspec import Meta

from merge_sumo.errors import UserError
from merge_sumo.printable import printable

StepSignals = dict[str, float | str]
"""Values of one step, by name."""
Signals = dict[str, tuple[float | str | None, ...]]
"""Values of a case by name, one for each row of its motion; None where the controller set none."""

MOST_NAMES = 8
"""Maximum number of signals of a case."""
CHARACTERS = 40
"""Maximum length of a name, and of a word."""

SignalRuns = Annotated[
    dict[str, tuple[tuple[Annotated[int, Meta(ge=1)], float | str | None], ...]],
    Meta(min_length=1, max_length=MOST_NAMES),
]
"""Run-length encoded signals for JSON: by name, (number of rows, value) for each run of a value."""


def valid_signals(values: object) -> StepSignals:
    """Return the signals among the values that a controller has set at a step.

    Numbers are rounded to six digits, names and words are cut to `CHARACTERS`. All other values,
    numbers that are not finite, and values after the first `MOST_NAMES` are dropped.

    Args:
        values: any object of a user's code.

    Returns:
        The signals; empty where the object is not a dictionary.

    Example:
        >>> valid_signals({"mode": "yield", "gap_m": 12.3456789, "plan": [1, 2]})
        {'mode': 'yield', 'gap_m': 12.3457}
    """
    if not isinstance(values, dict):
        return {}
    signals: StepSignals = {}
    for name, value in islice(values.items(), MOST_NAMES):
        valid = _valid_value(value)
        if valid is not None and isinstance(name, str):
            signals[_word(name)] = valid
    return signals


def _valid_value(value: object) -> float | str | None:
    if isinstance(value, str):
        return _word(value)
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if not isinstance(value, int | float | np.integer | np.floating):
        return None
    try:
        number = float(f"{float(value):.6g}")
    except (OverflowError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _word(text: str) -> str:
    # A subclass of `str` may override its methods: take its characters only.
    return printable(str.__str__(text)[:CHARACTERS])[:CHARACTERS]


def by_name(steps: Iterable[tuple[int, StepSignals]], rows: int) -> Signals | None:
    """Collect the signals of the steps of a case by name.

    Args:
        steps: row of the motion and signals of each step, in ascending order of the rows.
        rows: number of rows of the motion. Later steps are ignored.

    Returns:
        The first `MOST_NAMES` signals; None where the controller set none.

    Example:
        >>> by_name([(0, {"mode": "go"}), (1, {"mode": "yield"})], 3)
        {'mode': ('go', 'yield', None)}
    """
    columns: dict[str, list[float | str | None]] = {}
    for row, signals in steps:
        if row >= rows:
            break
        for name, value in signals.items():
            if name not in columns:
                if len(columns) == MOST_NAMES:
                    continue
                columns[name] = [None] * rows
            columns[name][row] = value
    return {name: tuple(values) for name, values in columns.items()} or None


def to_runs(signals: Signals) -> SignalRuns:
    """Return signals in the form in which JSON holds them.

    Args:
        signals: the signals of a case.

    Example:
        >>> to_runs({"mode": ("go", "go", None)})
        {'mode': ((2, 'go'), (1, None))}
    """
    record: SignalRuns = {}
    for name, values in signals.items():
        runs = []
        for value, same in groupby(values):
            runs.append((len(list(same)), value))
        record[name] = tuple(runs)
    return record


def from_runs(record: SignalRuns, rows: int) -> Signals:
    """Return the signals of a file: the inverse of `to_runs`.

    Args:
        record: the content of the file.
        rows: number of rows of the motion of the case.

    Raises:
        UserError: a signal has another number of rows, or a value that merge-sumo does not write.
    """
    signals: Signals = {}
    for name, runs in record.items():
        if sum(count for count, _ in runs) != rows:
            raise UserError("a signal has other rows than the motion")
        values: list[float | str | None] = []
        for count, value in runs:
            if _word(name) != name or (value is not None and _valid_value(value) != value):
                raise UserError("a signal has a value that merge-sumo does not write")
            values += [value] * count
        signals[name] = tuple(values)
    return signals
