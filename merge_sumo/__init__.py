"""merge-sumo: an interaction-aware testbed for merging controllers, hosted in SUMO.

From Python:  import merge_sumo as ms;  run = ms.campaign("design2", cases=400, seed=1)
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from merge_sumo.api import (
        CampaignRun,
        Car,
        CaseRun,
        Seen,
        SeenBatch,
        benchmark,
        campaign,
        check_scenario,
        check_vut,
        compare,
        explain,
        export,
        new_scenario,
        open_in_gui,
        open_run,
        probability,
        replay,
        report,
        reproduce,
        rerun,
        resume,
        run,
        scenarios,
        stress,
        train,
        truth,
        vuts,
    )
    from merge_sumo.errors import Notice, UserError

    __version__: str

__all__ = [
    "CampaignRun",
    "Car",
    "CaseRun",
    "Notice",
    "Seen",
    "SeenBatch",
    "UserError",
    "__version__",
    "benchmark",
    "campaign",
    "check_scenario",
    "check_vut",
    "compare",
    "explain",
    "export",
    "new_scenario",
    "open_in_gui",
    "open_run",
    "probability",
    "replay",
    "report",
    "reproduce",
    "rerun",
    "resume",
    "run",
    "scenarios",
    "stress",
    "train",
    "truth",
    "vuts",
]

if not TYPE_CHECKING:
    # A type checker does not see this function: it would take every name for one of the package.

    def __getattr__(name):  # noqa: ANN001, ANN202
        """Import a public name when it is asked for: the import of the package loads nothing."""
        if name == "__version__":
            from importlib.metadata import version

            return version("merge-sumo")
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        from importlib import import_module

        home = "merge_sumo.errors" if name in ("Notice", "UserError") else "merge_sumo.api"
        return getattr(import_module(home), name)


def __dir__() -> list[str]:
    return sorted(__all__)
