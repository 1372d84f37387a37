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
RowValue = float | str | None
"""Value of a signal in a row of a motion; None where the controller set none."""
Signals = dict[str, tuple[RowValue, ...]]
"""Values of a case by name, one for each row of its motion."""

MOST_NAMES = 8
"""Maximum number of signals of a case."""
CHARACTERS = 40
"""Maximum length of a name, and of a word."""

Run = tuple[Annotated[int, Meta(ge=1)], RowValue]
"""Rows that follow each other with the same value: their number, and the value."""
SignalRuns = Annotated[dict[str, tuple[Run, ...]], Meta(min_length=1, max_length=MOST_NAMES)]
"""Run-length encoded signals for JSON, by name."""


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
            signals[_cut_text(name)] = valid
    return signals


def _valid_value(value: object) -> RowValue:
    """Return a value as a signal has it: six digits, a cut text, "true" or "false"; else None."""
    if isinstance(value, str):
        return _cut_text(value)
    if isinstance(value, bool | np.bool_):
        return "true" if value else "false"
    if not isinstance(value, int | float | np.integer | np.floating):
        return None
    try:
        number = float(f"{float(value):.6g}")
    except (OverflowError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _cut_text(text: str) -> str:
    # A subclass of `str` may override its methods: take its characters only. They are cut twice:
    # before, as the text may be huge; after, as an escape is longer than its character.
    return printable(str.__str__(text)[:CHARACTERS])[:CHARACTERS]


def columns_of(steps: Iterable[tuple[int, StepSignals]], rows: int) -> Signals | None:
    """Collect the signals of the steps of a case by name.

    Args:
        steps: row of the motion and signals of each step, in ascending order of the rows.
        rows: number of rows of the motion. Later steps are ignored.

    Returns:
        The first `MOST_NAMES` signals; None where the controller set none.

    Example:
        >>> columns_of([(0, {"mode": "go"}), (1, {"mode": "yield"})], 3)
        {'mode': ('go', 'yield', None)}
    """
    columns: dict[str, list[RowValue]] = {}
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

    Example:
        >>> from_runs({"mode": ((2, "go"), (1, None))}, 3)
        {'mode': ('go', 'go', None)}
    """
    signals: Signals = {}
    for name, runs in record.items():
        # Before the values are repeated: a count in a hostile file may exceed the memory.
        if sum(count for count, _ in runs) != rows:
            raise UserError("a signal and the motion differ in their number of rows")
        values: list[RowValue] = []
        for count, value in runs:
            is_own = value is None or _valid_value(value) == value
            if _cut_text(name) != name or not is_own:
                raise UserError("a signal has a value that merge-sumo does not write")
            values += [value] * count
        signals[name] = tuple(values)
    return signals
