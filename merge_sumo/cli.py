"""The command line: the commands, and what becomes of a `UserError`."""

from __future__ import annotations

import os
import sys
import traceback
from pathlib import Path
from typing import Annotated, Final

import typer

from merge_sumo.commands import campaigns, inputs, studies
from merge_sumo.commands.application import app
from merge_sumo.commands.printing import say
from merge_sumo.errors import UserError
from merge_sumo.system.interrupt import Stopped, stopping_in_order
from merge_sumo.system.limits import check_limits, exhausted
from merge_sumo.system.printable import printable
from merge_sumo.system.streams import prepare_streams

__all__ = ["app", "campaigns", "inputs", "main", "studies"]

FAULT: Final = 70
"""Exit code of a fault of this package, as EX_SOFTWARE of sysexits.h."""


@app.callback(invoke_without_command=True)
def _version(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as version_of

        typer.echo(f"merge-sumo {version_of('merge-sumo')}")
        raise typer.Exit


def _check_here() -> None:
    """Raise `UserError` where the working folder is gone: relative paths mean nothing then."""
    try:
        Path.cwd()
    except OSError as error:
        raise UserError(
            f"the working folder cannot be read ({error.strerror}): change to another one"
        ) from error


def main() -> None:
    """Run the command line; a `UserError` becomes one sentence and exit code 2.

    So does an error of the system that has run out of something. What a signal stopped ends with
    128 + its number. Any other error is a fault of this package, and ends with a code that is no
    result: 1, which Python would give, is that of a gate that is met.
    """
    prepare_streams()
    for library in ("OMP", "OPENBLAS", "MKL"):  # products are small, and the cores are for workers
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    try:
        # From here on, so that no signal finds a temporary folder that nobody removes.
        with stopping_in_order():
            _check_here()
            check_limits()
            app()
    except UserError as error:
        say(f"merge-sumo: {error}")
        sys.exit(2)
    except Stopped as stopped:
        sys.exit(stopped.exit_code)
    except Exception as error:
        if (sentence := exhausted(error)) is not None:
            say(f"merge-sumo: {sentence}")
            sys.exit(2)
        for line in traceback.format_exc().splitlines():
            typer.echo(printable(line), err=True)
        say("merge-sumo: this is a fault of merge-sumo and no result: report it with these lines")
        sys.exit(FAULT)


if __name__ == "__main__":
    main()
