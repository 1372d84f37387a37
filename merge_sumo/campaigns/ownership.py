"""Which code a campaign runs, and whether the folder that names it is this user's own."""

from __future__ import annotations

import os
import shlex
from collections.abc import Iterable, Mapping
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
OTHERS: Final = ("pov", "against")
"""Keys of `campaign.json` that name a controller beside the VUT."""


def note_run(folder: Path, at: Path, record: Mapping[str, Any], *, begun: bool) -> None:
    """Remember that this user runs the code that a campaign's `record` names, if it does.

    `folder` is the folder as far as it is written, `at` the path that it has or will take, `begun`
    whether this user began the campaign there.
    """
    vut, command, others = _named(record)
    if runs_code(vut, command) or any(runs_code(spec, None) for spec in others.values()):
        note_own(folder, at, RECORD, _code(record), begun=begun)


def check_own_code(folder: Path, recorded: Mapping[str, Any], given: Mapping[str, object]) -> None:
    """Raise `UserError` where a folder has code run that neither is this user's nor was `given`."""
    vut, command, others = _named({**recorded, **given})
    vut_given = ("vut" if command is None else "vut_command") in given
    own = ((spec, None, name in given) for name, spec in others.items())
    for spec, started, named in ((vut, command, vut_given), *own):
        if named or not runs_code(spec, started):
            continue
        why = doubt(folder, RECORD, _code(recorded))
        if why is not None:
            raise UserError(
                f"{folder} {why}, and to go on is to run the controller that it names, "
                f"{started or spec}: say --trust-vut if you trust it"
            )


def _named(record: Mapping[str, Any]) -> tuple[str, str | None, dict[str, str]]:
    """Return the VUT, its command, and the other controllers by the name of their setting."""
    command = record.get("vut_command")
    others = {name: str(record[name]) for name in OTHERS if record.get(name) is not None}
    return str(record.get("vut")), None if command is None else str(command), others


def _code(record: Mapping[str, Any]) -> Code:
    """Return the code that a record names, with its files as far as they are as recorded."""
    vut, command, others = _named(record)
    here = Path(os.path.realpath(Path.cwd()))
    specs = (vut, *others.values())
    named = _files_named(specs, command)
    files = {str(here / path): sha256_of(path) for path in named if path.is_file()}
    for name in FILES:
        known = record.get(name)
        for file, sha256 in (known if isinstance(known, dict) else {}).items():
            # A name is relative to where the campaign was begun, which may be elsewhere.
            if sha256 is not None and sha256_of(Path(file)) == sha256:
                files[str(here / file)] = sha256
    relative = command is not None or not all(
        any(path.is_absolute() for path in _files_named([spec], None))
        for spec in specs
        if runs_code(spec, None)
    )
    # Without a version that a campaign is against, the names are those of earlier releases.
    against = [others["against"]] if "against" in others else []
    code_named = (vut, command, others.get("pov"), *against)
    return Code(code_named, files, str(here) if relative else "")


def _files_named(specs: Iterable[str], command: str | None) -> list[Path]:
    """Return the files that specs and the words of a command name."""
    names = [path for spec in specs if (path := file_named(spec))]
    with suppress(ValueError):
        names += shlex.split(command or "")
    return [Path(name) for name in names if "\0" not in name]
