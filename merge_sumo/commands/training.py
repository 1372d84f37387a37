"""Commands on the learned drivers: train."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_sumo.commands.shared import JsonOption, app, show
from merge_sumo.errors import UserError

if TYPE_CHECKING:
    from merge_sumo.values.scenario import Scenario


@app.command()
def train(
    only: Annotated[
        list[str] | None, typer.Option(help="Network to train: pov1, vut1, pov2 or vut2.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same weights on one machine.")] = 0,
    scenario: Annotated[
        str | None, typer.Option(help="Scenario, or a file of one.  [default: us23]")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder.  [default: the shipped policies, for us23 only]")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Train nothing: measure regret of what is there.")
    ] = False,
    cases: Annotated[int, typer.Option(help="Random cases of a check.")] = 300,
    as_json: JsonOption = False,
) -> None:
    """Train the learned drivers in SUMO, level by level, and measure their regret.

    The regret is what a driver loses to its best response, as a share of what that gains over
    level-0 behaviour. An interrupted training goes on with what is not finished.

    Example:  merge-sumo train --out my-policies --seed 1
    """
    from merge_sumo.drivers.policies import (
        NETWORKS,
        plays_as,
        policies_of,
        read_manifest,
        scenario_of,
    )
    from merge_sumo.scenarios.scenario_file import named_scenario
    from merge_sumo.values.scenario import US23

    played = US23 if scenario is None else named_scenario(scenario)
    folder = out or policies_of(played)
    if out is None and not check and not plays_as(played, US23):
        raise UserError(
            f"the shipped policies are for {US23.name}: say with --out where those for "
            f"{played.name} are to go"
        )
    unknown = set(only or ()) - set(NETWORKS)
    if unknown:
        raise UserError(f"there is no network {unknown.pop()!r}: choose {', '.join(NETWORKS)}")
    names = tuple(name for name in NETWORKS if name in (only or NETWORKS))
    _need_training_packages()
    if not check:
        _train(folder, names, seed, played)
    manifest = read_manifest(folder)
    missing = [name for name in names if name not in manifest]
    if missing:
        raise UserError(f"{folder} has no {missing[0]}: run `merge-sumo train` to make it")
    trained_for = scenario_of(manifest[names[0]])
    if scenario is None and not plays_as(trained_for, US23):
        raise UserError(
            f"{folder} was trained for {trained_for.name}: say with --scenario in which one to "
            f"check it, or --scenario {US23.name}"
        )
    if check:
        from merge_sumo.training.check import check_policy

        checks = {
            name: asdict(check_policy(name, folder, count=cases, scenario=played)) for name in names
        }
    else:
        checks = {name: manifest[name]["check"] for name in names}
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


def _need_training_packages() -> None:
    from importlib.util import find_spec

    for package in ("torch", "gymnasium"):
        if find_spec(package) is None:
            raise UserError(
                f"training needs {package}, which is not installed: run "
                "`pip install 'merge-sumo[train]'`"
            )


def _train(folder: Path, names: tuple[str, ...], seed: int, scenario: Scenario) -> None:
    from merge_sumo.reports.progress import TrainingBars
    from merge_sumo.training.helix import train_library

    with TrainingBars() as bars:
        train_library(
            folder,
            names,
            seed,
            scenario=scenario,
            on_progress=bars.progressed,
            on_done=bars.done,
        )
