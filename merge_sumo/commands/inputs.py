"""Commands on what a person brings: VUTs, scenarios and learned drivers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from merge_sumo import verbs
from merge_sumo.commands.application import PANEL_OF, Commands, Given, app

scenario = Commands(help="The road and the numbers of a merge.", no_args_is_help=True)
app.add_typer(scenario, name="scenario", rich_help_panel=PANEL_OF["scenario"])


@app.verb(verbs.Vuts)
def vuts(given: Given) -> None:
    from merge_sumo import api

    given.print(api.vuts(**given.keywords))


@app.verb(verbs.CheckVut, "check-vut")
def check_vut(
    given: Given,
    vut: Annotated[
        str,
        typer.Argument(help="Vehicle under test, as after --vut."),
    ],
) -> None:
    from merge_sumo import api

    result = api.check_vut(vut, **given.keywords)
    given.print(result)
    raise typer.Exit(0 if result.ok else 1)


@scenario.verb(name="list")
def list_scenarios(given: Given) -> None:
    """List the scenarios that the package brings.

    Example:  merge-sumo scenario list
    """
    from merge_sumo import api

    given.print(api.scenarios())


@scenario.verb(verbs.NewScenario, "new")
def new_scenario(
    given: Given, file: Annotated[Path, typer.Argument(help="New TOML file to write.")]
) -> None:
    from merge_sumo import api

    given.print(api.new_scenario(file, **given.keywords))


@scenario.verb(verbs.CheckScenario, "check")
def check_scenario(
    given: Given,
    name: Annotated[
        str,
        typer.Argument(metavar="NAME|FILE", help="Scenario to check."),
    ],
) -> None:
    from merge_sumo import api

    given.print(api.check_scenario(name, **given.keywords))


@app.verb(verbs.Train)
def train(given: Given) -> None:
    from merge_sumo import api

    given.print(api.train(**given.keywords))
