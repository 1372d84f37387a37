"""merge-sumo: an interaction-aware testbed for merging controllers, hosted in SUMO.

From Python:  import merge_sumo as ms;  run = ms.campaign("design2", cases=400, seed=1)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from merge_sumo.api import CampaignRun as CampaignRun
    from merge_sumo.api import CaseRun as CaseRun
    from merge_sumo.api import campaign as campaign
    from merge_sumo.api import compare_runs as compare_runs
    from merge_sumo.api import export as export
    from merge_sumo.api import history as history
    from merge_sumo.api import open_run as open_run
    from merge_sumo.api import rerun as rerun
    from merge_sumo.api import resume as resume
    from merge_sumo.api import run_case as run_case
    from merge_sumo.api import truth as truth
    from merge_sumo.errors import UserError as UserError

    __version__: str

_API = (
    *("CampaignRun", "CaseRun", "campaign", "compare_runs", "export", "history", "open_run"),
    *("rerun", "resume", "run_case", "truth"),
)

__all__ = ["CampaignRun", "CaseRun", "UserError", "__version__", "campaign", "compare_runs"]
__all__ += ["export", "history", "open_run", "rerun", "resume", "run_case", "truth"]


def __getattr__(name: str) -> Any:
    """Import what is asked for when it is asked for: to import the package costs nothing."""
    if name == "__version__":
        from importlib.metadata import version

        return version("merge-sumo")
    if name not in (*_API, "UserError"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module("merge_sumo.api" if name in _API else "merge_sumo.errors"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
