"""Whose folder a campaign is: one of this user's own, or one that somebody sent.

The folder of a campaign names its controller: a file, a module, a command. Going on with a campaign
runs it. In a folder of the user's own that is what is wanted; in one that was received it would be
code of a stranger. So a campaign is sealed with a key that never leaves the user's cache folder.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

from merge_sumo.errors import UserError
from merge_sumo.system.folders import make_place, write_new
from merge_sumo.system.resources import cache_folder

SEAL: Final = "seal"
"""Key of `campaign.json`."""
KEY: Final = "key"
KEY_BYTES: Final = 32


def seal(settings: Mapping[str, Any]) -> str | None:
    """Return the seal of whose code a campaign's settings run; None where no key can be kept."""
    key = _key(cache_folder() / KEY)
    if key is None:
        return None
    named = [settings.get(name) for name in ("vut", "vut_command")]
    if settings.get("pov") is not None:  # a folder without is sealed as it was before there were
        named.append(settings["pov"])
    return hmac.new(key, json.dumps(named).encode(), hashlib.sha256).hexdigest()


def is_own(settings: Mapping[str, Any]) -> bool:
    """Return whether the settings of a campaign, as read from its folder, have our seal."""
    ours, theirs = seal(settings), json.dumps(settings.get(SEAL))
    return ours is not None and hmac.compare_digest(json.dumps(ours), theirs)


def _key(path: Path) -> bytes | None:
    """Return the user's key, made where there is none yet; None where that cannot be."""
    with suppress(UserError):  # it is there, or was made by another process in between
        make_place(path.parent, "MERGE_SUMO_CACHE")
        write_new(path, secrets.token_bytes(KEY_BYTES), mode=0o600)
    try:
        key = path.read_bytes()
    except OSError:
        return None
    return key if len(key) == KEY_BYTES else None
