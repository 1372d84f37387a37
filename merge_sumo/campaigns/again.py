"""Commands that the package prints for a user to run, with the controllers that they need.

They are shell commands, or calls of Python where a controller is an object of this process.
"""

from __future__ import annotations

import json
import re
import sys
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from keyword import iskeyword
from pathlib import Path
from typing import Any

from merge_sumo.controllers.in_memory import names_code
from merge_sumo.controllers.kinds import parse
from merge_sumo.controllers.python import object_of
from merge_sumo.controllers.signatures import is_code
from merge_sumo.controllers.spec import HERE, PYTHON
from merge_sumo.printable import quoted
from merge_sumo.road.scenario_file import spoken_name
from merge_sumo.scenario.scenario import US23, Scenario

CONTROLLERS = ("vut", "pov", "against")
OPTIONS = {"run": ("run", "case"), "resume": ("campaign", "resume")}
"""Verbs of a recorded campaign that are a command with an option."""

Argument = str | Path | int | float | Sequence[int] | Mapping[str, float]


def again(
    verb: str, folder: Path, record: Mapping[str, Any], *arguments: Argument, **options: Argument
) -> str:
    """Return the command of a verb for a recorded campaign, with the controllers of the campaign.

    Args:
        verb: name of a function of the API; `run` takes a case, `resume` continues the campaign.
        folder: folder of the campaign.
        record: content of its `campaign.json`.
        arguments: further arguments after the folder.
        options: options by keyword; a controller replaces the recorded one.
    """
    return command(verb, folder, *arguments, **(options | _named(verb, record) | options))


def call_again(verb: str, folder: Path, record: Mapping[str, Any], **options: Argument) -> str:
    """Return the call in Python of a verb for a recorded campaign.

    Args:
        verb: name of a function of the API.
        folder: folder of the campaign.
        record: content of its `campaign.json`.
        options: options by keyword; a recorded controller replaces a controller.
    """
    return call(verb, [folder], {**options, **_named(verb, record)})


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
        return call(verb, arguments, given)
    name, *option = OPTIONS.get(verb if arguments else "", (verb,))
    words = [name, *map(_flag, option)]
    words += [word for argument in arguments for word in _words(argument)]
    for name, value in given.items():
        if value is True:
            words.append(_flag(name))
            continue
        for word in _words(value):
            words += [_flag(name), word]
    found = dict.fromkeys(root for spec in specs if (root := _root(spec.kind, spec.argument)))
    path = f"PYTHONPATH={quoted(':'.join(found))} " if found else ""
    return f"{path}merge-sumo {' '.join(words)}"


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def campaign_in(scenario: Scenario, **options: str | None) -> str:
    """Return the command of a campaign in a scenario; empty for a scenario without a name."""
    name = spoken_name(scenario)
    if name is None:
        return ""
    return command("campaign", **options, scenario=None if name == US23.name else name)


def _named(verb: str, record: Mapping[str, Any]) -> dict[str, str]:
    """Return the controllers of a record that no run folder names; see `settings_of`."""
    names = CONTROLLERS if verb == "resume" else CONTROLLERS[:-1]
    specs = {name: record.get(name) for name in names}
    return {
        name: spec
        for name, spec in specs.items()
        if isinstance(spec, str) and (names_code(spec) or parse(spec).kind == HERE)
    }


def _words(argument: Argument) -> Iterator[str]:
    """Yield the words of a shell for an argument."""
    if isinstance(argument, Mapping):
        yield from (quoted(f"{name}={value!r}") for name, value in argument.items())
    elif isinstance(argument, str | Path):
        yield quoted(argument)
    elif isinstance(argument, int | float):
        yield str(argument)
    else:
        yield from map(str, argument)


def _root(kind: str, argument: str) -> str:
    """Return the folder of a module that a new process does not look into by itself; "" for none.

    Who called us may have put it into the path, as pytest does.
    """
    module = sys.modules.get(argument.rpartition(":")[0].partition(".")[0])
    file = getattr(module, "__file__", None)
    if kind != PYTHON or argument.rpartition(":")[0].endswith(".py") or file is None:
        return ""
    root = Path(file).resolve().parent
    if Path(file).name == "__init__.py":
        root = root.parent
    installed = (Path(path).resolve() for path in sysconfig.get_paths().values())
    return "" if root == Path.cwd() or root in installed else str(root)


def call(
    verb: str, arguments: Sequence[Argument], given: Mapping[str, Argument] | None = None
) -> str:
    """Return a call of Python, in which `ms` is this package.

    Args:
        verb: name of a function of the API.
        arguments: arguments in their order.
        given: options by keyword.
    """
    parts = [_value(argument) for argument in arguments]
    if verb == "run" and parts:
        parts = [f"recorded=({', '.join(parts)})"]
    for name, value in (given or {}).items():
        expression = _controller(str(value)) if name in CONTROLLERS else _value(value)
        parts.append(f"{name}={expression}")
    return f"ms.{verb}({', '.join(parts)})"


def _controller(text: str) -> str:
    """Return what a controller is called where it is an object: it is of the caller's names."""
    spec = parse(text)
    if spec.kind != HERE or spec.parameters:
        return _value(text)
    name, known = re.sub(r"-\d+$", "", spec.argument), object_of(spec)
    if not name.isidentifier() or iskeyword(name):
        return "vut"
    return name if known is None or is_code(known) else f"{name}(...)"


def _value(argument: Argument) -> str:
    """Return a value as Python writes it."""
    if isinstance(argument, str | Path):
        text = str(argument)
        return json.dumps(text, ensure_ascii=False) if text.isprintable() else repr(text)
    if isinstance(argument, Mapping):
        items = (f"{_value(name)}: {value!r}" for name, value in argument.items())
        return f"{{{', '.join(items)}}}"
    if isinstance(argument, int | float):
        return str(argument)
    return f"[{', '.join(map(str, argument))}]"
