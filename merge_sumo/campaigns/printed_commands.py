"""Commands that are printed for a user to run: of a shell, or calls of Python.

A call of Python stands where a controller is an object of this process.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from keyword import iskeyword
from pathlib import Path
from typing import Any

from merge_sumo.config import flag_of
from merge_sumo.controllers.kinds import parse, runs_code
from merge_sumo.controllers.python import object_of
from merge_sumo.controllers.signatures import is_code
from merge_sumo.controllers.spec import HERE
from merge_sumo.printable import quoted

CONTROLLERS = ("vut", "pov", "against")
OPTIONS = {"run": ("run", "case"), "resume": ("campaign", "resume")}
"""Verbs of a recorded campaign that are a command with an option."""

Argument = str | Path | int | float | Sequence[int | str] | Mapping[str, float]


def campaign_command(
    verb: str,
    folder: Path,
    record: Mapping[str, Any],
    *arguments: Argument,
    **options: Argument | None,
) -> str:
    """Return the command of a verb for a recorded campaign, with the controllers of the campaign.

    Args:
        verb: name of a function of the API; `run` takes a case, `resume` continues the campaign.
        folder: folder of the campaign.
        record: content of its `campaign.json`.
        arguments: further arguments after the folder.
        options: options by keyword; a controller replaces the recorded one, None is left out.
    """
    named = dict(options)
    # `settings_from_folder` asks for code again. Only a campaign has two versions.
    for name in CONTROLLERS if verb == "resume" else CONTROLLERS[:2]:
        spec = record.get(name)
        if isinstance(spec, str) and runs_code(spec):
            named.setdefault(name, spec)
    return command(verb, folder, *arguments, **named)


def command(verb: str, *arguments: Argument, **options: Argument | None) -> str:
    """Return the command of a verb, or its call in Python where a controller is an object.

    Args:
        verb: name of a function of the API.
        arguments: arguments in their order.
        options: options by keyword; those that are None are left out.
    """
    given = {name: value for name, value in options.items() if value is not None}
    specs = [parse(str(given[name])) for name in CONTROLLERS if name in given]
    if any(spec.kind == HERE for spec in specs):
        return call(verb, *arguments, **given)
    name, *option = OPTIONS.get(verb if arguments else "", (verb,))
    words = ["merge-sumo", name, *map(flag_of, option)]
    for argument in arguments:
        words += _words(argument)
    for name, value in given.items():
        if value is True:
            words.append(flag_of(name))
            continue
        for word in _words(value):
            words += [flag_of(name), word]
    return " ".join(words)


def call(verb: str, *arguments: Argument, **options: Argument) -> str:
    """Return a call of Python, in which `ms` is this package.

    Args:
        verb: name of a function of the API.
        arguments: arguments in their order.
        options: options by keyword.
    """
    parts = list(map(_expression, arguments))
    if verb == "run" and parts:
        parts = [f"recorded=({', '.join(parts)})"]
    for name, value in options.items():
        expression = _controller(str(value)) if name in CONTROLLERS else _expression(value)
        parts.append(f"{name}={expression}")
    return f"ms.{verb}({', '.join(parts)})"


def _words(argument: Argument) -> Iterator[str]:
    """Yield the words of a shell for an argument."""
    if isinstance(argument, Mapping):
        for name, value in argument.items():
            yield quoted(f"{name}={value!r}")
    elif isinstance(argument, str | Path):
        yield quoted(argument)
    elif isinstance(argument, Sequence):
        for item in argument:
            yield quoted(str(item))
    else:
        yield str(argument)


def _controller(text: str) -> str:
    """Return an expression for a controller: an object has the name that the caller gave it."""
    spec = parse(text)
    if spec.kind != HERE or spec.parameters:
        return _expression(text)
    name, known = re.sub(r"-\d+$", "", spec.argument), object_of(spec)
    if not name.isidentifier() or iskeyword(name):
        return "vut"
    return name if known is None or is_code(known) else f"{name}(...)"


def _expression(argument: Argument) -> str:
    """Return a value as Python writes it."""
    if isinstance(argument, int | float):
        return str(argument)
    plain = str(argument) if isinstance(argument, Path) else argument
    if isinstance(plain, str) and not plain.isprintable():
        return repr(plain)
    return json.dumps(plain, ensure_ascii=False)
