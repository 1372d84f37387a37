"""What the commands share: the application, common options, and talking to a person."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Protocol

import typer

from merge_sumo.commands import complete
from merge_sumo.commands.grouped import Commands
from merge_sumo.errors import UserError
from merge_sumo.system.printable import printable

if TYPE_CHECKING:
    from merge_sumo.analysis.verdict import Verdict
    from merge_sumo.campaigns.run import Run


app = Commands(
    help="""Find where a merging controller fails against drivers who react to it.

    A vehicle under test (VUT) merges from an on-ramp of US-23 in SUMO while a primary other
    vehicle (POV) on the mainline interacts with it. A sampler chooses the test cases; a case fails
    where both reach the merge point within 6 m, or by a rule of your own, and failure mode
    coverage (FMC) says how much of the failing region was found.

    Start with:  merge-sumo campaign --vut design2
    """,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

VutOption = Annotated[
    str,
    typer.Option(
        metavar="SPEC",
        help="Vehicle under test: level0, level1, level2, design1 or design2, or your own: "
        "`merge-sumo vuts` lists the kinds.",
        autocompletion=complete.vuts,
    ),
]
LevelOption = Annotated[
    str, typer.Option(help="POV level: 0, 1, 2, own or all.", autocompletion=complete.levels)
]
OneLevelOption = Annotated[
    str, typer.Option(help="POV level: 0, 1, 2 or own.", autocompletion=complete.one_level)
]
WorkersOption = Annotated[
    int, typer.Option(help="Processes that run cases; the outcomes are the same.")
]
CoresOption = Annotated[
    int | None,
    typer.Option(
        help="Processes that run cases; the outcomes are the same.", show_default="one a core"
    ),
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")]
NetOption = Annotated[
    Path | None, typer.Option(help="SUMO net to use instead of the shipped US-23 ramp.")
]
DenseOption = Annotated[
    bool | None,
    typer.Option(
        "--dense/--no-dense",
        help="Make the dense truths, of 1,000,000 cases, or go without.",
        show_default="those kept",
    ),
]

JsonOption = Annotated[
    bool, typer.Option("--json", help="Print the result as one JSON object on standard output.")
]
DaskOption = Annotated[
    str | None,
    typer.Option(help="Address of a Dask scheduler whose workers run the cases: tcp://HOST:PORT."),
]
VutCommandOption = Annotated[
    str | None,
    typer.Option(
        help="Command that starts the controller of --vut traci; {port} stands for the port."
    ),
]
DeadlineOption = Annotated[
    float, typer.Option(help="Seconds that a VUT may take for a step before it is a VUT_ERROR.")
]
InProcessOption = Annotated[
    bool,
    typer.Option(
        "--in-process",
        help="Run a VUT of your own in this process, where a debugger reaches it, instead of in "
        "one of its own that it may ruin.",
    ),
]
VutMemoryOption = Annotated[
    float, typer.Option(help="GiB of memory that the process of a VUT of your own may take.")
]
TrustOption = Annotated[
    bool,
    typer.Option(
        "--trust-vut",
        help="Run the controller that a folder names although it is not known to be yours.",
    ),
]
ScenarioOption = Annotated[
    str,
    typer.Option(
        metavar="NAME|FILE",
        help="Scenario that `merge-sumo scenario list` names, or a TOML file of your own: "
        "`merge-sumo scenario new` writes one.",
        autocompletion=complete.scenarios,
    ),
]
PoliciesOption = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        help="Folder of learned drivers, as `train --out DIR` makes it, instead of the shipped "
        "ones.",
    ),
]
PovOption = Annotated[
    str | None,
    typer.Option(
        metavar="SPEC",
        help="A POV of your own, of any kind that --vut takes but traci: it drives at level own.",
        autocompletion=complete.vuts,
    ),
]
FailWhenOption = Annotated[
    str,
    typer.Option(
        metavar="EXPR",
        help="What counts as a failure: paper (front bumpers within 6 m at M), contact, unsafe, or "
        "a condition over the measures of outcomes.jsonl: 'ttc_s < 1.5 or end == \"TIMEOUT\"'.",
    ),
]
RequireOption = Annotated[
    str | None,
    typer.Option(
        metavar="STL",
        help="What is to hold over time, instead of --fail-when, in signal temporal logic: "
        "'always ((x_vut_m > -20) implies (bumper_gap_m > 2))'. Needs the extra stl.",
    ),
]
FollowUpOption = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS",
        help="How long both drive on behind M: what happens there is measured.",
        show_default="the scenario's, 0",
    ),
]
ToleranceOption = Annotated[
    float,
    typer.Option(
        help="Growth of FMC, or of the share of cases without a verdict, at a level that is still "
        "no regression."
    ),
]
RunArgument = Annotated[
    Path, typer.Argument(help="Folder of a campaign.", autocompletion=complete.runs)
]


KEYWORDS: Final = {
    "v_vut0": "v_vut0_mps",
    "deadline": "deadline_s",
    "vut_memory": "vut_memory_gib",
    "follow_up": "follow_up_s",
}
"""Keywords of the API, by the options whose names are others."""
SETTINGS: Final = (
    *("vut", "level", "sampler", "cases", "batch", "seed", "stop_after_converged", "vut_command"),
    *("in_process", "policies", "pov", "learn_from", "scenario", "fail_when", "require"),
    *KEYWORDS,
)
"""Options that are settings of a campaign."""


def written(context: typer.Context) -> set[str]:
    """Return the names of the options that a person wrote."""
    found = {name: context.get_parameter_source(name) for name in context.params}
    return {name for name, source in found.items() if source and source.name == "COMMANDLINE"}


def settings_in(context: typer.Context, *others: str) -> dict[str, Any]:
    """Return the settings of a command, written or by default, as keywords of the API.

    `others` are options of the command with which it is the same.
    """
    names = [name for name in context.params if name in (*SETTINGS, *others)]
    return {KEYWORDS.get(name, name): context.params[name] for name in names}


def written_settings(context: typer.Context) -> dict[str, Any]:
    """Return the settings that a person wrote, as keywords of the API."""
    names = written(context) & {*SETTINGS}
    return {KEYWORDS.get(name, name): context.params[name] for name in names}


class Result(Protocol):
    """What a verb of the API returns."""

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""

    def lines(self) -> list[str]:
        """Return it as a person reads it."""


def print_result(result: Result, *, as_json: bool) -> None:
    """Print what a verb of the API returned, in lines or as JSON."""
    if as_json:
        typer.echo(json.dumps(result.to_record(), allow_nan=False))
        return
    for line in result.lines():
        show(line)


def check_tolerance(tolerance: float) -> None:
    """Raise `UserError` for a tolerance that is none."""
    if not tolerance >= 0.0:
        raise UserError(f"--tolerance is {tolerance}: it must be 0 or more")


def print_troubles(verdict: Verdict) -> None:
    """Print what ended in an error or a timeout, by message; nothing where nothing did."""
    for line in verdict.trouble_lines():
        show(line)


def print_unrepeatable(run: Run) -> None:
    """Print that cases went differently when they ran again; nothing where none did."""
    from merge_sumo.campaigns.repeats import read_repeats, unrepeatable

    said = unrepeatable(read_repeats(run))
    if said is not None:
        show(said)


def show(line: object) -> None:
    """Print a line of a result on standard output; JSON goes there as it is."""
    typer.echo(printable(str(line)))


def say(line: str) -> None:
    """Print a line for a person, on standard error: standard output is for results."""
    typer.echo(printable(line), err=True)
