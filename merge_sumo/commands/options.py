"""The options that several commands have, and the groups in which all options are shown.

An option has one name, one meaning and one group in all commands.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from merge_sumo.errors import UserError
from merge_sumo.samplers import DEFAULT_SAMPLER
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB

PANELS: Final[Mapping[str, tuple[str, ...]]] = {
    "Search": ("campaign", "run", "probability"),
    "Look": ("report", "explain", "replay", "export"),
    "Change": ("rerun", "compare", "repair"),
    "Bring your own": ("vuts", "check-vut", "scenario", "train"),
    "Research": ("truth", "benchmark", "reproduce"),
}
"""Commands by panel of the help, the most used first."""
PANEL_OF: Final = {name: panel for panel, names in PANELS.items() for name in names}

GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    "What is tested": (
        *("vut", "against", "level", "scenario"),
        *("net", "mainline", "ramp", "point", "follow_up", "sense", "act", "case", "at"),
        *("x", "v", "psi"),
        *("headway_ahead", "headway_behind", "only", "a_min", "check"),
    ),
    "How many cases, and which": (
        *("samplers", "cases", "seed", "seeds"),
        *(
            "truth_cases",
            "quick",
            "distribution",
            "traffic",
        ),
        *("param", "cost", "trials", "rounds"),
        *("stress", "stop_when_converged", "repeat"),
    ),
    "Verdict": (*("fail_when", "tolerate", "gate", "confidence"),),
    "Where it runs, and what it writes": (
        *("out", "resume", "workers", "junit", "figure"),
        *("file_format", "gui", "debug", "quiet", "as_json"),
    ),
    "Limits": ("vut_memory",),
    "For experts": (
        *("require", "pov", "policies", "sampler", "batch", "in_flight"),
        *("engine", "deadline"),
    ),
}
"""Options of the command line by group, in the order in which the groups are shown."""
GROUP_OF: Final = {name: group for group, names in GROUPS.items() for name in names}

KEYWORDS: Final = {
    "deadline": "deadline_s",
    "vut_memory": "vut_memory_gib",
    "follow_up": "follow_up_s",
    "tolerate": "tolerated",
    "x": "x_pov0_m",
    "v": "v_pov0_mps",
    "psi": "svo_rad",
    "headway_ahead": "headway_ahead_s",
    "headway_behind": "headway_behind_s",
}
"""Keywords of the API, by the shared options whose names are others."""


Shared = tuple[Any, object]
"""The annotation of an option, and its default."""


def option(kind: Any, default: object, help: str, *flags: str, **others: Any) -> Shared:
    """Return an option of this type, default and help; the rest is of `typer.Option`."""
    return Annotated[kind, typer.Option(*flags, help=help, **others)], default


def optional(kind: Any, help: str, *flags: str, **others: Any) -> Shared:
    """Return an option that may be left out."""
    return option(kind | None, None, help, *flags, **others)


def flag(help: str, *flags: str) -> Shared:
    """Return an option without a value."""
    return option(bool, False, help, *flags)


VutOption = Annotated[
    str,
    typer.Option(
        metavar="SPEC",
        help="Vehicle under test: level0, level1, level2, design1 or design2, or your own: "
        "`merge-sumo vuts` lists the kinds.",
    ),
]
RunArgument = Annotated[Path, typer.Argument(help="Folder of a campaign.")]


def _runs_of_a_case(text: str) -> int | str:
    if text == "auto":
        return text
    if not text.isdecimal():
        raise UserError(f"--repeat is {text!r}: give the number of runs of a case, or auto")
    return int(text)


def _workers(text: str | None) -> int | str | None:
    """Return a number of processes, or the address of a scheduler, which whoever opens it reads."""
    try:
        return None if text is None else int(text)
    except ValueError:
        return text


def _workers_option(help: str, show_default: str) -> Shared:
    return optional(str, help, metavar="N|ADDRESS", callback=_workers, show_default=show_default)


CORES: Final = _workers_option(
    "Processes that run cases, or a Dask scheduler, tcp://HOST:PORT.", "one a core"
)
SEED: Final = option(int, 0, "Same seed, same cases.")
OPTIONS: Final[Mapping[str, Shared]] = {
    "vut": (VutOption, ""),
    "level": option(str, "all", "POV level: 0, 1, 2, own or all."),
    "against": optional(
        str,
        "An earlier version of the VUT, of any kind but traci: each case runs with both, and the "
        "sampler looks for those that the VUT alone fails.",
        metavar="SPEC",
    ),
    "pov": optional(
        str,
        "A POV of your own, of any kind that --vut takes but traci: it drives at level own.",
        metavar="SPEC",
    ),
    "policies": optional(
        Path,
        "Folder of learned drivers, as `train --out DIR` makes it, or a shipped library such as "
        "human, instead of the default ones.",
        metavar="NAME|DIR",
    ),
    "scenario": option(
        str,
        "us23",
        "Scenario that `merge-sumo scenario list` names, or a TOML file of your own: "
        "`merge-sumo scenario new` writes one.",
        metavar="NAME|FILE",
    ),
    "follow_up": optional(
        float,
        "Time for which both drive on after the merge, with measures of its own.",
        metavar="SECONDS",
        show_default="the scenario's, 0",
    ),
    "sense": optional(
        str,
        "How the VUT senses other cars: delay_s, noise_x_m, noise_v_mps, dropout, range_m, "
        "occluded_until_m; a range, as delay_s=0..0.5, is tested as a whole.",
        metavar="NAME=NUMBER,...",
        show_default="the scenario's, perfectly",
    ),
    "act": optional(
        str,
        "How the VUT obeys its controller: lag_s, delay_s, power_w_per_kg; with ranges as --sense.",
        metavar="NAME=NUMBER,...",
        show_default="the scenario's, perfectly",
    ),
    "x": optional(float, "Initial position of the POV in m; M is 0.", "--x"),
    "v": optional(float, "Initial speed of the POV in m/s.", "--v"),
    "psi": optional(float, "Social value orientation of the POV in rad, at level 2."),
    "headway_ahead": optional(float, "Headway to the car ahead in s, in traffic."),
    "headway_behind": optional(float, "Headway of the car behind in s, in traffic."),
    "sampler": option(str, DEFAULT_SAMPLER, "What chooses the cases: {samplers}."),
    "cases": option(int, 800, "Number of test cases."),
    "in_flight": optional(
        int,
        "Most cases that run or wait for a worker while the sampler is asked for more, instead of "
        "batches: for controllers that take seconds for a case. About three times the workers.",
        metavar="N",
    ),
    "seed": option(int, 0, "Same seed, same outcomes."),
    "stop_when_converged": flag(
        "Stop early when the last 100 cases have added less than 1 % to the coverage.",
        "--stop-when-converged",
    ),
    "repeat": option(
        str,
        "1",
        "Number of runs of each case, each with other random numbers; auto repeats a case where "
        "chance decides on it. Each run is one of the --cases.",
        metavar="N|auto",
        callback=_runs_of_a_case,
    ),
    "tolerate": option(
        float, 0.0, "A case fails where more than this share of its runs do.", metavar="SHARE"
    ),
    "fail_when": optional(
        str,
        "What counts as a failure: {criteria} (paper: front bumpers within 6 m at the merge), or a "
        "condition over the measures of outcomes.jsonl: 'ttc_s < 1.5 or end == \"TIMEOUT\"'.",
        metavar="EXPR",
        show_default="the scenario's: paper where M is a point, unsafe on a lane",
    ),
    "require": optional(
        str,
        "Requirement over time, instead of --fail-when, in signal temporal logic: "
        "'always ((x_vut_m > -20) implies (bumper_gap_m > 2))'. Needs the extra stl.",
        metavar="STL",
    ),
    "engine": optional(
        str,
        "kinematic: the equations of motion alone, and SUMO for at least one case of a "
        "hundred. Or sumo for all.",
        metavar="NAME",
        show_default="kinematic where VUT and POV are of this package",
    ),
    "workers": _workers_option(
        "Processes that run cases, or a Dask scheduler, tcp://HOST:PORT; the outcomes are the "
        "same.",
        "one a core, as soon as it pays",
    ),
    "quiet": flag("Show no progress.", "--quiet", "-q"),
    "deadline": option(
        float, DEADLINE_S, "Seconds that a VUT may take for a step before it is a VUT_ERROR."
    ),
    "vut_memory": option(
        float, MEMORY_GIB, "GiB of memory that the process of a VUT of your own may take."
    ),
}

VUT_AGAIN: Final = optional(
    str,
    "Vehicle under test, perhaps a changed one. A file, module, command or model is always named "
    "here: a run folder names no code to run.",
    metavar="SPEC",
    show_default="the campaign's",
)
"""Option of what drives in cases of a recorded campaign."""
HOSTING: Final = ("deadline", "vut_memory")
OF_SCENARIO: Final = ("follow_up", "sense", "act")
SETUP: Final = ("scenario", "policies", "pov", "fail_when", "require", *OF_SCENARIO, *HOSTING)
RUNNING: Final = ("workers", "quiet")
