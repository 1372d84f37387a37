"""Which code a campaign runs, and whether the folder that names it is this user's own."""

from __future__ import annotations

import os
import shlex
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from merge_sumo.errors import UserError
from merge_sumo.system.hashing import sha256_of
from merge_sumo.system.trust import Code, doubt, note_own
from merge_sumo.vuts.registry import file_named, runs_code

RECORD: Final = "campaign.json"
"""File of a campaign's folder that names its code, with all other settings."""
FILES: Final = ("vut_files", "pov_files")
"""Keys of `campaign.json`: what the VUT and a POV of a person's own have loaded."""


def note_run(folder: Path, at: Path, record: Mapping[str, Any], *, begun: bool) -> None:
    """Remember that this user runs the code that a campaign's `record` names, if it does.

    `folder` is the folder as far as it is written, `at` the path that it has or will take, `begun`
    whether this user began the campaign there.
    """
    vut, command, pov = _named(record)
    if runs_code(vut, command) or (pov is not None and runs_code(pov, None)):
        note_own(folder, at, RECORD, _code(record), begun=begun)


def check_own_code(folder: Path, recorded: Mapping[str, Any], given: Mapping[str, object]) -> None:
    """Raise `UserError` where a folder has code run that neither is this user's nor was `given`."""
    vut, command, pov = _named({**recorded, **given})
    vut_given = ("vut" if command is None else "vut_command") in given
    for spec, started, named in ((vut, command, vut_given), (pov, None, "pov" in given)):
        if spec is None or named or not runs_code(spec, started):
            continue
        why = doubt(folder, RECORD, _code(recorded))
        if why is not None:
            raise UserError(
                f"{folder} {why}, and to go on is to run the controller that it names, "
                f"{started or spec}: say --trust-vut if you trust it"
            )


def _named(record: Mapping[str, Any]) -> tuple[str, str | None, str | None]:
    vut, command, pov = (record.get(name) for name in ("vut", "vut_command", "pov"))
    return str(vut), None if command is None else str(command), None if pov is None else str(pov)


def _code(record: Mapping[str, Any]) -> Code:
    """Return the code that a record names, with its files as far as they are as recorded."""
    vut, command, pov = _named(record)
    here = Path(os.path.realpath(Path.cwd()))
    named = _files_named(vut, command, pov)
    files = {str(here / path): sha256_of(path) for path in named if path.is_file()}
    for name in FILES:
        known = record.get(name)
        for file, sha256 in (known if isinstance(known, dict) else {}).items():
            # A name is relative to where the campaign was begun, which may be elsewhere.
            if sha256 is not None and sha256_of(Path(file)) == sha256:
                files[str(here / file)] = sha256
    relative = command is not None or not all(
        any(path.is_absolute() for path in _files_named(spec, None, None))
        for spec in (vut, pov)
        if spec is not None and runs_code(spec, None)
    )
    return Code((vut, command, pov), files, str(here) if relative else "")


def _files_named(vut: str, command: str | None, pov: str | None) -> list[Path]:
    """Return the files that specs and the words of a command name."""
    names = [path for spec in (vut, pov or "") if (path := file_named(spec))]
    with suppress(ValueError):
        names += shlex.split(command or "")
    return [Path(name) for name in names if "\0" not in name]
