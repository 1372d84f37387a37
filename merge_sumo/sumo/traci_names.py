"""SUMO's own TraCI client: it packs values, and knows the functions of command numbers."""

from __future__ import annotations

import importlib
import inspect
import sys
import warnings
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from merge_sumo.sumo.binding import sumo_program


@cache
def load_traci() -> Any:
    """Return SUMO's own client, which comes with its programs.

    Raises:
        UserError: SUMO's programs are missing.
    """
    tools = str(Path(sumo_program("sumo")).parents[1] / "tools")
    if tools not in sys.path:
        sys.path.append(tools)
    return importlib.import_module("traci")


def pack(form: str, *values: Any) -> bytes:
    """Return values with their types, as SUMO's own client packs them.

    Args:
        form: a letter for each value: integer (i), double (d), string (s), signed (b) and unsigned
            byte (B), list of strings (l) or of floats (f), position in the plane (o), in space (O),
            on earth (g, G) or on a road (r), colour (c), polygon (p).
        *values: the values.
    """
    connection = load_traci().connection.Connection
    packed: bytes = connection.__new__(connection)._pack(form, *values)
    return packed


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


def name_of(command: int, variable: int) -> str:
    """Return the functions that send a command; its numbers where none does.

    Args:
        command: its number.
        variable: number of its variable.
    """
    unnamed = f"the command 0x{command:02x} of variable 0x{variable:02x}"
    return " or ".join(functions().get((command, variable), (unnamed,)))
