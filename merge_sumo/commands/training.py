"""Commands on the learned drivers: train."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from merge_sumo.commands import complete
from merge_sumo.commands.shared import JsonOption, QuietOption, app, show


@app.command()
def train(
    only: Annotated[
        list[str] | None,
        typer.Option(
            help="Network to train: pov1, vut1, pov2 or vut2.", autocompletion=complete.networks
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same weights on one machine.")] = 0,
    scenario: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE",
            help="Scenario, or a file of one.",
            show_default="us23",
            autocompletion=complete.scenarios,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder to write.", show_default="the shipped policies, for us23 only"),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Train nothing: measure regret of what is there.")
    ] = False,
    cases: Annotated[int, typer.Option(help="Random cases of a check.")] = 300,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Train the learned drivers in SUMO, level by level, and measure their regret.

    The regret is what a driver loses to its best response, as a share of what that gains over
    level-0 behaviour. An interrupted training goes on with what is not finished.

    Example:  merge-sumo train --out my-policies --seed 1
    """
    from merge_sumo import api

    found = api.train(
        only or (),
        seed=seed,
        scenario=scenario,
        out=out,
        check=check,
        cases=cases,
        progress=not quiet,
    )
    checks = {name: asdict(one) for name, one in found.items()}
    if as_json:
        typer.echo(json.dumps(checks))
        return
    show("network  mean regret  p99 regret  collisions  avoidable  mean return  best  level 0")
    for name, found in checks.items():
        show(
            f"{name:<7}  {found['mean_regret']:11.2%}  {found['p99_regret']:10.2%}  "
            f"{found['collisions']:10d}  {found['avoidable_collisions']:9d}  "
            f"{found['mean_return']:11.3f}  {found['mean_best']:.3f}  {found['mean_level0']:.3f}"
        )
