"""merge-sumo: an interaction-aware testbed for merging controllers, hosted in SUMO.

From Python:  import merge_sumo as ms;  run = ms.campaign("design2", cases=400, seed=1)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from merge_sumo.api import CampaignRun as CampaignRun
    from merge_sumo.api import campaign as campaign
    from merge_sumo.api import open_run as open_run
    from merge_sumo.errors import UserError as UserError

_WHERE = {
    "CampaignRun": "merge_sumo.api",
    "campaign": "merge_sumo.api",
    "open_run": "merge_sumo.api",
    "UserError": "merge_sumo.errors",
}

__all__ = ["CampaignRun", "UserError", "campaign", "open_run"]


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: to import the package costs nothing."""
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_WHERE[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
