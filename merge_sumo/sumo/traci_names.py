"""SUMO's own TraCI client: it packs values, and knows the functions of command numbers."""

from __future__ import annotations

import importlib
import inspect
import sys
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from merge_sumo.sumo.binding import sumo_program


def load_traci() -> Any:
    """Return SUMO's own client, which comes with its programs.

    Raises:
        UserError: SUMO's programs are missing.
    """
    tools = str(Path(sumo_program("sumo")).parents[1] / "tools")
    if tools not in sys.path:
        sys.path.append(tools)
    return importlib.import_module("traci")


@cache
def packer() -> Callable[..., bytes]:
    """Return the function that packs typed values, called with letters of a form and the values."""
    connection = load_traci().connection.Connection
    pack: Callable[..., bytes] = connection.__new__(connection)._pack
    return pack


EXAMPLES: tuple[Any, ...] = ("x", 1.0, 1, [("1", 1.0, 1, 1)], (1, 2, 3, 4), [1.0], ["a"])
"""Values of arguments: with one of them each function of the client sends its command."""


@cache
def functions() -> dict[tuple[int, int], tuple[str, ...]]:
    """Return functions, as `vehicle.getSpeed`, by the numbers of their command and variable.

    Every function of the client is called with a connection that only notes the command.
    """
    traci = load_traci()
    found: dict[tuple[int, int], tuple[str, ...]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # some functions are deprecated
        for name, domain in sorted(vars(traci).items()):
            if not isinstance(domain, traci.domain.Domain):
                continue
            own_connection = domain._connection
            for function, call in inspect.getmembers(domain, inspect.ismethod):
                sent = None if function.startswith("_") else _sent(domain, call)
                if sent is not None:
                    found[sent] = *found.get(sent, ()), f"{name}.{function}"
            domain._connection = own_connection
    return found


class _Recorder:
    """A connection that notes the first command and ends the call."""

    sent: tuple[int, int] | None = None

    def _sendCmd(self, command: int, variable: Any, *_: Any) -> None:  # noqa: N802 (TraCI's name)
        if self.sent is None and isinstance(variable, int):
            self.sent = command, variable
        raise InterruptedError


def _sent(domain: Any, call: Any) -> tuple[int, int] | None:
    """Return the numbers of the command that a function sends; None if it sends none."""
    needed, options = 0, {}
    for parameter in inspect.signature(call).parameters.values():
        if parameter.default is True:
            options[parameter.name] = False  # with these, a function may ask something first
        elif parameter.default is parameter.empty and parameter.kind != parameter.VAR_POSITIONAL:
            needed += 1
    recorder = domain._connection = _Recorder()
    for example in EXAMPLES:
        with suppress(Exception):  # it takes other values, or sends nothing
            call(*[example] * needed, **options)
        if recorder.sent is not None:
            break
    return recorder.sent


def name_of(command: int, variable: int | None = None) -> str:
    """Return the name of a command.

    Args:
        command: its number.
        variable: number of its variable; None for a command without one.
    """
    if variable is None:
        for name, value in vars(load_traci().constants).items():
            if name.startswith("CMD_") and value == command:
                return str(name)
        return f"the command 0x{command:02x}"
    unnamed = f"{name_of(command)} of variable 0x{variable:02x}"
    return " or ".join(functions().get((command, variable), (unnamed,)))
