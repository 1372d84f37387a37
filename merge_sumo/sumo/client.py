"""SUMO's own TraCI client, which comes with its programs, and SUMO as a program behind it."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout
from os import devnull
from pathlib import Path
from typing import Any, Final

from merge_sumo.errors import UserError
from merge_sumo.sumo.binding import (
    SUMO_VERSION,
    ending_with_us,
    sumo_environment,
    sumo_program,
)

TRIES: Final = 240
BETWEEN_S: Final = 0.1


def load_traci() -> Any:
    """Return the client; `UserError` where it cannot be loaded."""
    tools = str(Path(sumo_program("sumo")).parents[1] / "tools")
    if tools not in sys.path:
        sys.path.append(tools)
    try:
        return importlib.import_module("traci")
    except ImportError as error:
        raise UserError(
            f"SUMO's traci cannot be loaded ({error}): run `pip install traci=={SUMO_VERSION}`"
        ) from error


def open_program(name: str, options: Sequence[str]) -> tuple[subprocess.Popen[bytes], Any]:
    """Start a SUMO program that waits for a client; return it and the client's connection.

    Raises `UserError` when it does not start.
    """
    traci = load_traci()
    port = importlib.import_module("sumolib.miscutils").getFreeSocketPort()
    process = subprocess.Popen(
        ending_with_us([sumo_program(name), *options, "--remote-port", str(port)]),
        env=sumo_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        # It prints each of its tries.
        with Path(devnull).open("w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
            return process, traci.connect(port, TRIES, proc=process, waitBetweenRetries=BETWEEN_S)
    except BaseException as error:
        end_program(process)
        if isinstance(error, (traci.FatalTraCIError, traci.TraCIException, OSError)):
            raise UserError(f"{name} did not open: {error}") from error
        raise


def end_program(process: subprocess.Popen[bytes]) -> None:
    """End a program, whatever it does."""
    if process.poll() is None:
        process.kill()
    process.wait()
