"""Commands on scenarios: scenario list, scenario new, scenario check."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from merge_sumo.commands import complete
from merge_sumo.commands.grouped import Commands
from merge_sumo.commands.shared import JsonOption, PoliciesOption, app, show
from merge_sumo.errors import UserError

scenario = Commands(help="The road and the numbers of a merge.", no_args_is_help=True)
app.add_typer(scenario, name="scenario")


@scenario.command("list")
def list_scenarios(as_json: JsonOption = False) -> None:
    """List the scenarios that the package brings.

    Example:  merge-sumo scenario list
    """
    from merge_sumo.road.scenario_file import named_scenario, shipped_scenarios

    scenarios = {name: named_scenario(name) for name in shipped_scenarios()}
    if as_json:
        typer.echo(json.dumps({name: asdict(found) for name, found in scenarios.items()}))
        return
    for name, found in scenarios.items():
        x, v = found.x_pov0_m, found.v_pov0_mps
        show(f"{name}: POV from {x[0]:g} to {x[1]:g} m at {v[0]:g} to {v[1]:g} m/s")


@scenario.command("new")
def new_scenario(
    file: Annotated[Path, typer.Argument(help="New TOML file to write.")],
    net: Annotated[
        Path,
        typer.Option(
            help="SUMO net, or a map of which netconvert makes one beside FILE: .osm, .xodr."
        ),
    ],
    mainline: Annotated[str, typer.Option(help='Edges of the mainline, past M: "e1 e2".')],
    ramp: Annotated[str, typer.Option(help='Edges of the ramp, past M: "r1 e2".')],
    as_json: JsonOption = False,
) -> None:
    """Write a scenario for a merge in a net of your own: what was found, and a suggested pool.

    A picture of the road is written beside it, as SVG.

    Example:  merge-sumo scenario new my-ramp.toml --net my.net.xml --mainline "a b" --ramp "r b"
    """
    import os
    from dataclasses import replace

    from merge_sumo.campaigns.scenario_suggestion import about, suggested
    from merge_sumo.road.drawing import road_svg
    from merge_sumo.road.finder import find_corridor
    from merge_sumo.road.merge import road_of
    from merge_sumo.road.netfile import NetFile
    from merge_sumo.road.scenario_file import SUFFIX, to_toml
    from merge_sumo.sumo.conversion import command_for, is_map, net_of_map
    from merge_sumo.system.folders import check_new_file, write_new

    if file.suffix != SUFFIX:
        raise UserError(f"{file} is to be a scenario: name it NAME{SUFFIX}")
    picture = file.with_suffix(".svg")
    edges = tuple(mainline.split()), tuple(ramp.split())
    written, map_file = [file, picture], net if is_map(net) else None
    if map_file is not None:
        net = file.with_suffix(".net.xml")
        written.append(net)
    for path in written:
        check_new_file(path, "FILE")
    if map_file is not None:
        made = net_of_map(map_file)
        try:
            find_corridor(NetFile(map_file, made), *edges)
        except UserError as error:
            raise UserError(f"{error}; to look at its edges: `{command_for(map_file)}`") from error
        write_new(net, made, "FILE")
    road = road_of(net, *edges)
    found = suggested(road, file.stem)
    beside = os.path.relpath(net.resolve(), file.parent.resolve())
    write_new(picture, road_svg(road, found), "FILE")
    write_new(file, to_toml(replace(found, net=beside), about(road)).encode(), "FILE")
    if as_json:
        typer.echo(json.dumps({"about": about(road), "written": list(map(str, written))}))
        return
    for line in about(road):
        show(line)
    made_of = "" if map_file is None else f", and its net {net}, made of {map_file}"
    show(f"written: {file}, and its picture {picture}{made_of}")


@scenario.command("check")
def check_scenario(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE", help="Scenario to check.", autocompletion=complete.scenarios
        ),
    ],
    policies: PoliciesOption = None,
    as_json: JsonOption = False,
) -> None:
    """Say whether a scenario can be hosted, and whether the learned drivers know it.

    Example:  merge-sumo scenario check us23
    """
    from merge_sumo.campaigns.scenario_suggestion import about, unseen
    from merge_sumo.drivers.policies import policies_in
    from merge_sumo.engine.simulator import road_for
    from merge_sumo.road.scenario_file import named_scenario
    from merge_sumo.system.printable import quoted

    if policies is not None:
        policies = policies_in(policies)
    found = named_scenario(name)
    lines, outside = list(about(road_for(found))), unseen(found, policies)
    if as_json:
        typer.echo(json.dumps({"about": lines, "unseen": list(outside)}))
        return
    for line in lines:
        show(line)
    if outside:
        show("the learned drivers (levels 1 and 2) were trained elsewhere; here they extrapolate:")
        for sentence in outside:
            show(f"  {sentence}")
        folder = quoted(f"{found.name}-policies")
        show(f"train them: merge-sumo train --scenario {quoted(name)} --out {folder}")
        show(f"then add to a campaign: --policies {folder}")
    else:
        show("the learned drivers (levels 1 and 2) were trained on such starts, or on like ones")
