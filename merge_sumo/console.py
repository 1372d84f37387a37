"""Printing: results on standard output, messages for the user on standard error."""

from __future__ import annotations

import errno
import json
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import cache
from io import TextIOWrapper
from typing import TYPE_CHECKING, Any

from merge_sumo import config
from merge_sumo.errors import Notice, UserError, WorkersLostError
from merge_sumo.interrupt import Interrupt, Stopped
from merge_sumo.printable import printable

if TYPE_CHECKING:
    from merge_sumo.result import Result


def prepare_streams() -> None:
    """Open closed standard streams, and write characters that a terminal lacks as escapes.

    A closed stream opens the null device. Otherwise a file that is opened later would get the
    number of the stream, and with it the output.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode)  # noqa: PTH123, SIM115 (it stays open)
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)
    for output in (sys.stdout, sys.stderr):
        if isinstance(output, TextIOWrapper):
            output.reconfigure(errors="backslashreplace")


def show(line: object) -> None:
    """Print a line of a result on standard output.

    Args:
        line: the line.

    Raises:
        UserError: the line cannot be written, and the result is lost.
        Stopped: the reader has closed the pipe. The command ends as other programs do.
    """
    try:
        print(printable(str(line)), flush=True)
    except OSError as error:
        # Drop the rest of the buffer, also when the interpreter ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if error.errno == errno.EPIPE:
            raise Stopped(signal.SIGPIPE) from None
        raise UserError(f"cannot write the result to standard output: {error.strerror}") from error


def say(line: str) -> None:
    """Print a line for the user on standard error. A line that cannot be written is lost.

    Args:
        line: the line, in which a field in backticks becomes its option.
    """
    with suppress(OSError):
        print(printable(_with_flags(line)), file=sys.stderr, flush=True)


@cache
def _field_names() -> set[str]:
    """Return the names of the fields that are options."""
    kinds = [kind for kind in vars(config).values() if is_dataclass(kind)]
    names = {field.name for kind in kinds for field in fields(kind) if field.kw_only}
    return names | {"vut"}


def _with_flags(sentence: str) -> str:
    """Return a sentence of the package with options instead of keywords in backticks."""

    def in_place(keyword: re.Match[str]) -> str:
        return config.flag_of(keyword[1]) if keyword[1] in _field_names() else keyword[0]

    return re.sub(r"`(\w+)`", in_place, sentence)


def print_json(record: dict[str, Any]) -> None:
    """Print a JSON object in one line.

    Args:
        record: the object.
    """
    show(json.dumps(record, allow_nan=False))


def print_result(result: Result, as_json: bool, **paths: object) -> int:
    """Print a result in lines or as one JSON object, and return the exit code.

    Args:
        result: the result.
        as_json: whether to print JSON.
        paths: paths that belong to the result, or None. In lines each follows its name.
    """
    written = {name: str(path) for name, path in paths.items() if path is not None}
    if as_json:
        print_json({**result.to_record(), **written})
    else:
        for line in result.lines():
            show(_with_flags(line))
        for name, path in written.items():
            show(f"{name}: {path}")
    return 0 if result.is_good else 1


@contextmanager
def stoppable() -> Iterator[Callable[[], None]]:
    """Yield a `check` for a campaign, which stops it after the running batch if Ctrl-C was pressed.

    The note of the exception, which says how to continue, is printed.

    Raises:
        UserError: the connection to the workers is lost.
    """
    try:
        with Interrupt(
            "finishing the running batch; press Ctrl-C again to stop at once"
        ) as interrupt:
            yield interrupt.check
    except Stopped as stopped:
        notes = getattr(stopped, "__notes__", ["before the first case: nothing was written"])
        say("; ".join(["stopped", *notes]))
        raise
    except WorkersLostError as lost:
        raise UserError("; ".join([str(lost), *getattr(lost, "__notes__", ())])) from lost


@contextmanager
def notices_printed() -> Iterator[None]:
    """Print each `Notice` on standard error, and show other warnings as usual."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", Notice)
        show_warning = warnings.showwarning

        def print_notice(
            message: Warning | str, category: type[Warning], *place: Any, **options: Any
        ) -> None:
            if issubclass(category, Notice):
                say(f"note: {message}")
            else:
                show_warning(message, category, *place, **options)

        warnings.showwarning = print_notice
        yield
