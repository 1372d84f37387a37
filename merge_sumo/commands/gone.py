"""Commands of the version before, each with a sentence that names its successor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from merge_sumo.errors import UserError

COMMANDS: Final[Mapping[str, str]] = {
    "board": "`merge-sumo report` prints on A4, and `report --json` has each fact with its source",
    "crosscheck": "`python tools/crosscheck.py RUN`, in a checkout, repeats cases in HighwayEnv",
    "policies": "`python tools/export_policy.py NAME FILE`, in a checkout, writes an ONNX network",
    "compare-runs": "`merge-sumo compare RUN RUN...` compares what is recorded",
    "history": "`merge-sumo compare RUN RUN...` compares any number of recorded versions",
    "stress": "`merge-sumo rerun RUN --stress` does it",
    "certify": "after a campaign without failures, `merge-sumo probability RUN --cases 100000` "
    "bounds how much of the pool can fail",
}
"""What replaces a command, by its name."""


def check_command(arguments: Sequence[str]) -> None:
    """Raise `UserError` where the first argument is a command that is gone."""
    if arguments and arguments[0] in COMMANDS:
        raise UserError(f"the command {arguments[0]} is gone: {COMMANDS[arguments[0]]}")
