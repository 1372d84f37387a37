"""Commands on what a person brings: VUTs, scenarios and learned drivers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from merge_sumo.commands.application import Commands, Given, app
from merge_sumo.commands.options import HOSTING, PANEL_OF, Shared, flag, option, optional

scenario = Commands(help="The road and the numbers of a merge.", no_args_is_help=True)
app.add_typer(scenario, name="scenario", rich_help_panel=PANEL_OF["scenario"])


def _scenario_option(help: str, show_default: str) -> Shared:
    return optional(str, help, metavar="NAME|FILE", show_default=show_default)


@app.verb(options=["policies"])
def vuts(given: Given) -> None:
    """List the vehicles that can be tested: by name, and the kinds that you can bring.

    Example:  merge-sumo vuts
    """
    from merge_sumo import api

    given.print(api.vuts(**given.keywords))


@app.verb(
    "check-vut",
    options=(*HOSTING, "policies"),
    own={"scenario": _scenario_option("Scenario to drive in, or a file of one.", "us23")},
)
def check_vut(
    given: Given,
    vut: Annotated[
        str,
        typer.Argument(help="Vehicle under test, as after --vut."),
    ],
) -> None:
    """Let a VUT drive a few cases, and print what is wrong with it and the cost of a step.

    Says "nothing wrong" (exit code 0), or what is wrong in sentences (exit code 1).

    Example:  merge-sumo check-vut design1
    """
    from merge_sumo import api

    result = api.check_vut(vut, **given.keywords)
    given.print(result)
    raise typer.Exit(0 if result.ok else 1)


@scenario.verb("list")
def list_scenarios(given: Given) -> None:
    """List the scenarios that the package brings.

    Example:  merge-sumo scenario list
    """
    from merge_sumo import api

    given.print(api.scenarios())


@scenario.verb(
    "new",
    own={
        "net": option(
            Path, ..., "SUMO net, or a map of which netconvert makes one beside FILE: .osm, .xodr."
        ),
        "mainline": option(str, ..., 'Edges of the mainline, past M: "e1 e2".'),
        "ramp": option(str, ..., 'Edges of the ramp, past M: "r1 e2".'),
        "point": flag("Make M a point, also where the ramp has an acceleration lane.", "--point"),
    },
)
def new_scenario(
    given: Given, file: Annotated[Path, typer.Argument(help="New TOML file to write.")]
) -> None:
    """Write a scenario for a merge in a net of your own, with a suggested pool.

    On a ramp with an acceleration lane the VUT chooses on it where to merge.
    A picture of the road is written beside it, as SVG.

    Example:  merge-sumo scenario new my-ramp.toml --net my.net.xml --mainline "a b" --ramp "r b"
    """
    from merge_sumo import api

    given.print(api.new_scenario(file, **given.keywords))


@scenario.verb("check", options=["policies"])
def check_scenario(
    given: Given,
    name: Annotated[
        str,
        typer.Argument(metavar="NAME|FILE", help="Scenario to check."),
    ],
) -> None:
    """Check that a scenario can be hosted, and that the learned drivers were trained on it.

    Example:  merge-sumo scenario check us23
    """
    from merge_sumo import api

    given.print(api.check_scenario(name, **given.keywords))


@app.verb(
    options=["quiet"],
    own={
        "only": optional(list[str], "Network to train: pov1, vut1, pov2 or vut2."),
        "seed": option(int, 0, "Same seed, same weights on one machine."),
        "scenario": _scenario_option("Scenario, or a file of one.", "us23"),
        "out": optional(
            Path, "Folder to write.", show_default="the shipped policies, for us23 only"
        ),
        "a_min": optional(
            float,
            "Hardest braking of the POVs in m/s2, below 0, such as -2.",
            "--a-min",
            show_default="that of the scenario",
        ),
        "check": flag(
            "Train nothing: measure the regret of the networks in the folder.", "--check"
        ),
        "cases": option(int, 300, "Random cases of a check."),
    },
)
def train(given: Given) -> None:
    """Train the learned drivers in SUMO, level by level, and measure their regret.

    The regret is the loss of a driver against its best response, as a share of the gain of the best
    response over level-0 behaviour. An interrupted training continues.

    Example:  merge-sumo train --out my-policies --seed 1
    """
    from merge_sumo import api

    given.print(api.train(**given.keywords))
