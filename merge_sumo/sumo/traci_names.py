"""Names of TraCI's commands, from SUMO's own client: (command, variable) to functions.

Every function of the client's domains is called once with a connection that only notes what it
would send.
"""

from __future__ import annotations

import importlib
import inspect
import sys
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final

from merge_sumo.errors import UserError
from merge_sumo.sumo.binding import SUMO_VERSION, sumo_program

DUMMIES: Final[tuple[Any, ...]] = ("x", 1.0, 1, [("1", 1.0, 1, 1)], (1, 2, 3, 4), [1.0], ["a"])
"""Arguments that one function or another takes before it sends something."""


def load_traci() -> Any:
    """Return SUMO's own client, which comes with its programs; `UserError` where there is none."""
    tools = str(Path(sumo_program("sumo")).parents[1] / "tools")
    if tools not in sys.path:
        sys.path.append(tools)
    try:
        return importlib.import_module("traci")
    except ImportError as error:
        raise UserError(
            f"SUMO's traci cannot be loaded ({error}): run `pip install traci=={SUMO_VERSION}`"
        ) from error


@cache
def packer() -> Callable[..., bytes]:
    """Return what packs typed values in SUMO's own client: letters of a form, and the values."""
    connection = load_traci().connection.Connection
    pack: Callable[..., bytes] = connection.__new__(connection)._pack
    return pack


class _SentError(Exception):
    """Ends a call when it is known what it sends."""


class _Notes:
    """A connection that notes the first command and ends the call."""

    def __init__(self) -> None:
        self.sent: tuple[int, int] | None = None

    def _sendCmd(self, command: int, variable: Any, *_: Any) -> None:  # noqa: N802 (TraCI's name)
        if isinstance(variable, int):
            self.sent = command, variable
        raise _SentError


@cache
def named() -> dict[tuple[int, int], tuple[str, ...]]:
    """Return functions, as `vehicle.getSpeed`, by the numbers of their command and variable."""
    traci = load_traci()
    domain_of = traci.domain.Domain
    functions: dict[tuple[int, int], list[str]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # some functions are deprecated
        for name, domain in sorted(vars(traci).items()):
            if not isinstance(domain, domain_of):
                continue
            mine: Any = domain
            before, mine._connection = mine._connection, None
            try:
                for function, call in inspect.getmembers(mine, inspect.ismethod):
                    sent = None if function.startswith("_") else _sent(mine, call)
                    if sent is not None:
                        functions.setdefault(sent, []).append(f"{name}.{function}")
            finally:
                mine._connection = before
    return {key: tuple(names) for key, names in functions.items()}


def _sent(domain: Any, call: Any) -> tuple[int, int] | None:
    parameters = inspect.signature(call).parameters.values()
    needed = sum(p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters)
    # With these on, a function may ask something first.
    off = {p.name: False for p in parameters if p.default is True}
    notes = domain._connection = _Notes()
    for dummy in DUMMIES:
        try:
            call(*[dummy] * needed, **off)
        except _SentError:
            break
        except Exception:  # noqa: S112 (it wants other arguments, or asks nothing of SUMO)
            continue
    return notes.sent


def name_of(command: int, variable: int | None = None) -> str:
    """Return the name of a command, on a variable if it is on one."""
    if variable is not None and (command, variable) in named():
        return " or ".join(named()[command, variable])
    constants = vars(load_traci().constants)
    names = [n for n, v in constants.items() if n.startswith("CMD_") and v == command]
    of = f" of variable 0x{variable:02x}" if variable is not None else ""
    return (names[0] if names else f"the command 0x{command:02x}") + of
