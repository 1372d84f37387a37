"""The SUMO installation: its library and its programs."""

from __future__ import annotations

import importlib
import os
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from merge_sumo.errors import UserError
from merge_sumo.files import ScratchFolder
from merge_sumo.scenario.scenario import DT_S

DEBIAN_PACKAGES = "libgl1 libx11-6 libxext6 libxrender1 libatomic1 libexpat1"
"""Shared libraries that SUMO's wheels load, even without a window."""
LOADER_FAILED = 127
"""Exit code of a program whose shared libraries are missing."""
SUMO_VERSION = "1.28.0"
"""The version whose motions are tested; pyproject.toml pins the same."""
PROGRAM_LIMIT_S = 15.0
"""Maximum time of SUMO for an episode, which takes a tenth of a second."""

SPEED_MODE_COMMANDED = 32
"""Speed mode without SUMO's own checks: the vehicle drives at the commanded speed."""
SUMO_OPTIONS = (
    *("--step-length", str(DT_S)),
    *("--insertion-checks", "none"),
    *("--time-to-teleport", "-1"),
    *("--default.speeddev", "0"),
    *("--xml-validation", "never"),
    *("--no-step-log", "true"),
    *("--no-warnings", "true"),
    *("--duration-log.disable", "true"),
)
"""Options of every simulation, except on collisions."""
NO_COLLISIONS = ("--collision.action", "none")
"""SUMO does not search for collisions, as measures show which vehicles touch."""


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Yield a temporary folder.

    Raises:
        UserError: the folder for temporary files cannot be written.
    """
    try:
        made = ScratchFolder()
    except OSError as error:
        raise UserError(
            f"cannot write a temporary folder: {error.strerror}; set TMPDIR to a writable folder"
        ) from error
    with made as name:
        yield Path(name)


def load_libsumo() -> Any:
    """Import libsumo.

    Returns:
        The module.

    Raises:
        UserError: the module or a system library is missing, or it has another version: a package
            such as libtraci may have replaced it.
    """
    try:
        libsumo = importlib.import_module("libsumo")
    except ImportError as error:
        raise _library_missing("libsumo", str(error)) from error
    version = str(libsumo.getVersion()[1]).removeprefix("SUMO ")
    if version != SUMO_VERSION:
        raise UserError(
            f"libsumo has SUMO {version}, but merge-sumo needs {SUMO_VERSION}: run `pip install "
            f"--force-reinstall --no-deps libsumo=={SUMO_VERSION} eclipse-sumo=={SUMO_VERSION}`, "
            "and remove packages that install another SUMO (older libtraci)"
        )
    return libsumo


def _library_missing(name: str, reason: str) -> UserError:
    return UserError(
        f"{name} cannot be loaded ({reason}): run `pip install libsumo=={SUMO_VERSION} "
        f"eclipse-sumo=={SUMO_VERSION}`, and on Debian or Ubuntu "
        f"`apt-get update && apt-get install -y {DEBIAN_PACKAGES}` as root"
    )


def sumo_program(name: str) -> str:
    """Return the path of a SUMO program.

    The program on the PATH is a wrapper in Python. Killing that one leaves the program running.

    Args:
        name: name of the program, such as "sumo-gui".

    Raises:
        UserError: the program is missing.
    """
    with suppress(ImportError, AttributeError):
        program = Path(importlib.import_module("sumo").SUMO_HOME, "bin", name)
        if program.is_file():
            return str(program)
    raise UserError(
        f"{name} is missing: run `pip install --force-reinstall eclipse-sumo=={SUMO_VERSION}`"
    )


def sumo_environment() -> dict[str, str]:
    """Return the environment variables of a SUMO program."""
    others = {key: value for key, value in os.environ.items() if not key.startswith("SUMO_")}
    return {**others, "SUMO_HOME": str(Path(sumo_program("sumo")).parents[1])}


def run_program(
    name: str, arguments: Sequence[str], folder: Path, limit_s: float | None = PROGRAM_LIMIT_S
) -> str:
    """Run a SUMO program to its end.

    Args:
        name: name of the program, such as "sumo".
        arguments: arguments of its command line.
        folder: working folder.
        limit_s: time after which it is killed, in s; None for no limit.

    Returns:
        The reason of its failure in a line; empty for exit code 0.

    Raises:
        UserError: the program or a shared library is missing.

    Example:
        >>> run_program("sumo", ["-c", "replay.sumocfg"], Path("scenarios/pov-yields"))
        ''
    """
    try:
        done = subprocess.run(
            [sumo_program(name), *arguments],
            cwd=folder,
            env=sumo_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            timeout=limit_s,
            start_new_session=True,  # Ctrl-C is for this process
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"it did not end within {limit_s:g} s"
    message = (done.stderr or "").strip() or f"exit code {done.returncode}"
    reason = message.splitlines()[0]
    if done.returncode == LOADER_FAILED:
        raise _library_missing(name, reason.rpartition("libraries: ")[2])
    return reason.removeprefix("Error: ") if done.returncode else ""
