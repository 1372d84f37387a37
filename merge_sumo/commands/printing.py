"""How commands print: results on standard output, sentences for a person on standard error."""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TextIO

import typer

from merge_sumo import options, verbs
from merge_sumo.errors import Notice, UserError, WorkersLostError
from merge_sumo.system.folders import dated
from merge_sumo.system.interrupt import Interrupt, Stopped
from merge_sumo.system.printable import printable, quoted

if TYPE_CHECKING:
    from merge_sumo.system.result import Result

__all__ = ["folder_of", "notices_printed", "print_json", "print_result", "quoted"]
__all__ += ["say", "show", "stoppable"]


def show(line: object) -> None:
    """Print a line of a result on standard output."""
    typer.echo(printable(str(line)))


def say(line: str) -> None:
    """Print a line for a person on standard error."""
    typer.echo(printable(_in_flags(line)), err=True)


@cache
def _flags() -> dict[str, str]:
    """Return the option of the command line by the keyword of Python."""
    records = [one for one in vars(verbs).values() if is_dataclass(one) and isinstance(one, type)]
    known = {
        name: max(options.flags_of(name, one), key=len)
        for record in records
        if issubclass(record, options.Asked)
        for name, (one, _) in options.options_of(record).items()
    }
    return {**known, "vut": "--vut", "recorded": "--case", "at": "--at"}


def _in_flags(sentence: str) -> str:
    """Return a sentence of the API with options of the command line in the place of keywords."""
    return re.sub(r"`(\w+)`", lambda found: _flags().get(found[1], found[0]), sentence)


def print_json(record: dict[str, Any]) -> None:
    """Print a JSON object in one line."""
    typer.echo(json.dumps(record, allow_nan=False))


def print_result(result: Result, *, as_json: bool, **more: object) -> None:
    """Print a result in lines or as one JSON object; `more` are paths that belong to it, or None.

    In lines, such a path stands behind its name.
    """
    paths = {name: str(path) for name, path in more.items() if path is not None}
    if as_json:
        print_json({**result.to_record(), **paths})
        return
    lines = map(_in_flags, result.lines())
    for line in (*lines, *(f"{name}: {path}" for name, path in paths.items())):
        show(line)


def folder_of(out: Path | None, resume: Path | None, what: str) -> Path:
    """Return the folder that a command writes, or goes on in; without both a dated one."""
    if resume is not None and out is not None:
        raise UserError("--resume names the folder: leave --out away")
    return resume or out or dated(what)


@contextmanager
def stoppable(unit: str, how_to_go_on: Callable[[], str | None]) -> Iterator[Callable[[], None]]:
    """Give the `check` of a verb: at Ctrl-C the running `unit` ends, and a sentence is printed.

    It says how to go on, unless that is None because nothing was written. So does the `UserError`
    where a cluster is gone.
    """
    try:
        with Interrupt(f"finishing the running {unit}; once more stops at once") as interrupt:
            yield interrupt.check
    except Stopped:
        sentence = how_to_go_on()
        say(
            f"stopped; {sentence}"
            if sentence
            else "stopped before the first case; nothing was written"
        )
        raise
    except WorkersLostError as lost:
        sentence = how_to_go_on()
        raise UserError(f"{lost}; {sentence}" if sentence else str(lost)) from lost


@contextmanager
def notices_printed() -> Iterator[None]:
    """Print each `Notice` on standard error; other warnings are shown as always."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", Notice)
        show_warning = warnings.showwarning

        def print_notice(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, Notice):
                say(str(message))
            else:
                show_warning(message, category, filename, lineno, file, line)

        warnings.showwarning = print_notice
        yield
