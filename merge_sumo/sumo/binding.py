"""The SUMO installation: its library and its programs, or a sentence that says what is missing."""

from __future__ import annotations

import importlib
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
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
"""The one whose motions are known; pyproject.toml pins the same."""
PROGRAM_LIMIT_S = 15.0
"""Time that SUMO has for an episode; it needs a tenth of a second."""

SPEED_MODE_COMMANDED = 32
"""All of SUMO's own checks off: the vehicle drives at the speed that it is given."""
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
"""Of every simulation, besides what it does about collisions."""
NO_COLLISIONS = ("--collision.action", "none")
"""SUMO looks for none: measures say which vehicles touch."""
NOT_A_NAME = re.compile(r"[,:%\ud800-\udfff]|\$\{")
"""To SUMO a comma parts names, a colon parts host and port, and the others stand for something."""


@contextmanager
def scratch_folder() -> Iterator[Path]:
    """Give a temporary folder whose name SUMO takes as it is; `UserError` where there is none."""
    try:
        above = Path(tempfile.gettempdir())
        if NOT_A_NAME.search(str(above)[len(above.drive) :]):
            raise UserError(
                f"SUMO cannot use the folder for temporary files {str(above)!r}: set TMPDIR to one "
                "without commas, colons, percent signs, ${ and what is not UTF-8 in its name"
            )
        made = ScratchFolder()
    except OSError as error:
        raise UserError(
            f"cannot write a temporary folder: {error.strerror}; set TMPDIR to a folder"
        ) from error
    with made as name:
        yield Path(name)


def load_libsumo() -> Any:
    """Import and return libsumo.

    Raises `UserError` when the module or a system library is missing, or it is of another SUMO: a
    package such as libtraci may have put another one in its place.
    """
    try:
        libsumo = importlib.import_module("libsumo")
    except ModuleNotFoundError as error:
        if error.name != "libsumo":
            raise
        raise UserError("libsumo is not installed: run `pip install libsumo==1.28.0`") from error
    except ImportError as error:
        raise _library_missing("libsumo", str(error)) from error
    version = str(libsumo.getVersion()[1]).removeprefix("SUMO ")
    if version != SUMO_VERSION:
        raise UserError(
            f"libsumo is of SUMO {version}, and merge-sumo needs {SUMO_VERSION}: run `pip install "
            f"--force-reinstall --no-deps libsumo=={SUMO_VERSION} eclipse-sumo=={SUMO_VERSION}`, "
            "and keep packages that bring another SUMO (older libtraci) out of this environment"
        )
    return libsumo


def _library_missing(name: str, reason: str) -> UserError:
    return UserError(
        f"{name} cannot be loaded ({reason}): on Debian or Ubuntu run "
        f"`apt-get update && apt-get install -y {DEBIAN_PACKAGES}` as root"
    )


def sumo_program(name: str) -> str:
    """Return the path of a SUMO program ("sumo", "sumo-gui"); `UserError` when it is missing.

    The wheel puts a Python wrapper on the PATH; killing that leaves the program running, so the
    program itself is started.
    """
    try:
        home = Path(importlib.import_module("sumo").SUMO_HOME)
    except (ImportError, AttributeError) as error:
        raise UserError(
            f"{name} is not installed: run `pip install eclipse-sumo==1.28.0`"
        ) from error
    program = home / "bin" / name
    if not program.is_file():
        raise UserError(
            f"{name} is missing in {program.parent}: run `pip install --force-reinstall "
            "eclipse-sumo==1.28.0`"
        )
    return str(program)


def sumo_environment() -> dict[str, str]:
    """Return the environment for a SUMO program: what is SUMO's in it is the installation's."""
    others = {key: value for key, value in os.environ.items() if not key.startswith("SUMO_")}
    return {**others, "SUMO_HOME": str(Path(sumo_program("sumo")).parents[1])}


ENDS_WITH_US = """
import ctypes, os, sys
ctypes.CDLL(None).prctl(1, 9)  # PR_SET_PDEATHSIG, SIGKILL
if os.getppid() == int(sys.argv[1]):
    os.execv(sys.argv[2], sys.argv[2:])
"""


def ending_with_us(command: Sequence[str]) -> list[str]:
    """Return a command that does the same, and on Linux ends when the thread that gives it ends.

    So a program that waits for us, or for the user, is not left when this process is killed.
    """
    if sys.platform != "linux" or not sys.executable:
        return list(command)
    return [sys.executable, "-I", "-S", "-c", ENDS_WITH_US, str(os.getpid()), *command]


@dataclass(frozen=True, slots=True)
class ProgramEnd:
    """The end of a program: its exit code, and a reason where that is not 0."""

    code: int
    reason: str


def run_program(
    name: str, arguments: Sequence[str], folder: Path, limit_s: float | None = PROGRAM_LIMIT_S
) -> ProgramEnd:
    """Run a SUMO program, with the environment of the installation.

    Args:
        name: the program, as "sumo".
        arguments: its arguments.
        folder: the folder in which it runs.
        limit_s: time after which it is killed, with the processes that it started. Without a limit
            its errors go to the terminal.

    Raises:
        UserError: the program or a shared library is missing.
    """
    command = [sumo_program(name), *arguments]
    with subprocess.Popen(
        command if limit_s is not None else ending_with_us(command),
        cwd=folder,
        env=sumo_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=None if limit_s is None else subprocess.PIPE,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as process:
        try:
            _, said = process.communicate(timeout=limit_s)
        except BaseException as error:
            _kill(process)
            if isinstance(error, subprocess.TimeoutExpired):
                return ProgramEnd(-1, f"it did not end within {limit_s:g} s")
            raise
    reason = ((said or "").strip() or "no message").splitlines()[0]
    if process.returncode == LOADER_FAILED:
        raise _library_missing(name, reason.rpartition("libraries: ")[2])
    said = reason.removeprefix("Error: ") if process.returncode else ""
    return ProgramEnd(process.returncode, said)


def _kill(process: subprocess.Popen[str]) -> None:
    with suppress(ProcessLookupError, PermissionError):  # none may be left
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
