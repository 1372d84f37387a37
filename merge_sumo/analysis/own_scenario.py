"""Scenarios of a user: written for a merge in a net, and checked before they run."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

from merge_sumo import config
from merge_sumo.campaigns.scenario_suggestion import (
    about,
    suggested,
    suggested_lane_m,
    unseen,
)
from merge_sumo.files import check_new, write_new
from merge_sumo.printable import quoted
from merge_sumo.result import Shown
from merge_sumo.road.drawing import road_svg
from merge_sumo.road.loader import road_for, road_of
from merge_sumo.road.scenario_file import SUFFIX, named_scenario, shipped_scenarios, to_toml
from merge_sumo.scenario.scenario import Scenario


def shipped() -> Shown:
    """Return the scenarios of the package, by name."""
    record, lines = {}, []
    for name in shipped_scenarios():
        scenario = named_scenario(name)
        record[name] = scenario.to_record()
        x, v = scenario.dimensions(0)[:2]
        line = f"{name}: POV from {x.low:g} to {x.high:g} m at {v.low:g} to {v.high:g} m/s"
        if scenario.lane_m is not None:
            line += "; acceleration lane from {:g} to {:g} m".format(*scenario.lane_m)
        lines.append(line)
    return Shown(record, lines)


def write_scenario(options: config.NewScenario) -> Shown:
    """Write a scenario for a merge in a net, and a picture of the road.

    Args:
        options: options of the verb.

    Returns:
        Sentences on the road, and the paths that were written.

    Raises:
        UserError: for a net without such a merge, and for files that exist.
    """
    file, net = Path(options.file), Path(options.net)
    check_new(file, "FILE", (SUFFIX,))
    picture = file.with_suffix(".svg")
    check_new(picture, "FILE")
    edges = tuple(options.mainline.split()), tuple(options.ramp.split())
    road = road_of(net, *edges)
    if not options.point:
        road = road_of(net, *edges, lane_m=suggested_lane_m(road))
    scenario, found = suggested(road, file.stem), about(road)
    relative = os.path.relpath(net.resolve(), file.parent.resolve())
    write_new(picture, road_svg(road, scenario), "FILE")
    write_new(file, to_toml(replace(scenario, net=relative), found).encode(), "FILE")
    lines = [*found, f"wrote {file} and its picture {picture}"]
    return Shown({"about": found, "written": [str(file), str(picture)]}, lines)


def check_scenario(scenario: Scenario, name: str, policies: Path | None) -> Shown:
    """Return the road of a scenario, and the differences to the training of the learned drivers.

    Args:
        scenario: the scenario.
        name: its name or file, for commands.
        policies: folder of the learned drivers; None for the shipped ones.
    """
    road = road_for(scenario)
    sentences, differing = about(road), unseen(scenario, policies)
    lines = sentences.copy()
    if differing:
        made = quoted(f"{scenario.name}-policies")
        lines += [
            "the learned drivers (levels 1 and 2) were trained elsewhere, so they extrapolate "
            "here:",
            *(f"  {sentence}" for sentence in differing),
            f"train them: merge-sumo train --scenario {quoted(name)} --out {made}",
            f"then use them in campaigns with `policies`: {made}",
        ]
    else:
        lines.append(
            "the learned drivers (levels 1 and 2) were trained on these starts or similar ones"
        )
    return Shown({"about": sentences, "unseen": differing}, lines)
