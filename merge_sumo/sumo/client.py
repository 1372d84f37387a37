"""SUMO's own TraCI client, which comes with its programs and knows all of its commands."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

from merge_sumo.errors import UserError
from merge_sumo.sumo.binding import SUMO_VERSION, sumo_program


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
