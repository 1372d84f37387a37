"""What the commands share: the application, common options, and talking to a person."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from merge_sumo.commands.once import Application
from merge_sumo.errors import UserError
from merge_sumo.system.printable import printable

if TYPE_CHECKING:
    from merge_sumo.reports.verdict import Verdict
    from merge_sumo.values.scenario import Scenario


app = Application(
    help="""Find where a merging controller fails against drivers who react to it.

    A vehicle under test (VUT) merges from an on-ramp of US-23 in SUMO while a primary other
    vehicle (POV) on the mainline interacts with it. A sampler chooses the test cases; a case fails
    where both reach the merge point within 6 m, or by a rule of your own, and failure mode
    coverage (FMC) says how much of the failing region was found.

    Start with:  merge-sumo campaign --vut design2
    """,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

NetOption = Annotated[
    Path | None, typer.Option(help="SUMO net to use instead of the shipped US-23 ramp.")
]
DenseOption = Annotated[
    bool | None,
    typer.Option(
        "--dense/--no-dense",
        help="Make the dense truths, of 1,000,000 cases, or go without.  [default: those kept]",
        show_default=False,
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
        help="Run the controller that a folder names although the folder was not made here.",
    ),
]
ScenarioOption = Annotated[
    str,
    typer.Option(
        metavar="NAME|FILE",
        help="Scenario that `merge-sumo scenario list` names, or a TOML file of your own: "
        "`merge-sumo scenario new` writes one.",
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
        help="How long both drive on behind M: what happens there is measured.  [default: the "
        "scenario's, 0]",
    ),
]
ToleranceOption = Annotated[
    float,
    typer.Option(
        help="Growth of FMC, or of the share of cases without a verdict, at a level that is still "
        "no regression."
    ),
]
RunArgument = Annotated[Path, typer.Argument(help="Folder of a campaign.")]


SETTINGS: Final = {
    **{
        name: name
        for name in (
            *("vut", "sampler", "cases", "batch", "seed", "stop_after_converged", "vut_command"),
            *("in_process", "policies", "pov", "learn_from", "scenario", "fail_when", "require"),
        )
    },
    "v_vut0": "v_vut0_mps",
    "deadline": "deadline_s",
    "vut_memory": "vut_memory_gib",
}
"""Names in `CampaignSettings`, by the options for them."""


def written(context: typer.Context) -> set[str]:
    """Return the names of the options that a person wrote."""
    found = {name: context.get_parameter_source(name) for name in context.params}
    return {name for name, source in found.items() if source and source.name == "COMMANDLINE"}


def written_settings(context: typer.Context) -> dict[str, Any]:
    """Return the settings that a person wrote, by their names in `CampaignSettings`.

    Levels are not among them: which there are, the other settings say.
    """
    from merge_sumo.scenarios.scenario_file import named_scenario

    given = {
        SETTINGS[option]: context.params[option] for option in written(context) & SETTINGS.keys()
    }
    if "policies" in given:
        given["policies"] = str(given["policies"])
    if "learn_from" in given:
        given["learn_from"] = tuple(map(str, given["learn_from"]))
    if "scenario" in given:
        given["scenario"] = followed_up(
            named_scenario(given["scenario"]), context.params.get("follow_up")
        )
    elif "follow_up" in written(context):
        raise UserError("--follow-up is of the scenario: name that, too, with --scenario")
    return given


def check_tolerance(tolerance: float) -> None:
    """Raise `UserError` for a tolerance that is none."""
    if not tolerance >= 0.0:
        raise UserError(f"--tolerance is {tolerance}: it must be 0 or more")


def print_troubles(verdict: Verdict) -> None:
    """Print what ended in an error or a timeout, by message; nothing where nothing did."""
    for line in verdict.trouble_lines():
        show(line)


def followed_up(scenario: Scenario, seconds: float | None) -> Scenario:
    """Return a scenario in which both drive on behind M for so long, if that was said."""
    return scenario if seconds is None else replace(scenario, follow_up_s=seconds)


def show(line: object) -> None:
    """Print a line of a result on standard output; JSON goes there as it is."""
    typer.echo(printable(str(line)))


def say(line: str) -> None:
    """Print a line for a person, on standard error: standard output is for results."""
    typer.echo(printable(line), err=True)
