"""The command line: the commands, and what becomes of a `UserError`."""

from __future__ import annotations

import sys
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated

import typer

from merge_sumo.commands import (
    campaign,
    cases,
    certify,
    experiments,
    histories,
    probability,
    runs,
    scenarios,
    training,
    vuts,
)
from merge_sumo.commands.shared import app, say
from merge_sumo.errors import UserError
from merge_sumo.system.interrupt import Stopped

__all__ = ["app", "campaign", "cases", "certify", "experiments", "main", "probability"]
__all__ += ["histories", "runs", "scenarios", "training", "vuts"]


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as version_of

        typer.echo(f"merge-sumo {version_of('merge-sumo')}")
        raise typer.Exit


def _check_here() -> None:
    """Raise `UserError` where the working folder is gone: names of files mean nothing there."""
    try:
        Path.cwd()
    except OSError as error:
        raise UserError(
            f"the working folder cannot be read ({error.strerror}): change to another one"
        ) from error


def main() -> None:
    """Run the command line; a `UserError` becomes one sentence and exit code 2.

    What a signal stopped ends with 128 + its number.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # No name of a file ends a command because a terminal has no such letter.
            stream.reconfigure(errors="backslashreplace")
    try:
        _check_here()
        app()
    except UserError as error:
        say(f"merge-sumo: {error}")
        sys.exit(2)
    except Stopped as stopped:
        sys.exit(stopped.exit_code)


if __name__ == "__main__":
    main()
