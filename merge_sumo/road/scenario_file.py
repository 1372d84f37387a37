"""Scenarios by name or from TOML files, which give the differences from the paper's scenario.

An example of a file:

name = "my-ramp"
net = "my-ramp.net.xml"          # next to this file
mainline = ["e1", "e2"]          # edges in driving order, past the merge point M
ramp = ["r1", "e2"]
x_pov0_m = [-220, -90]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from merge_sumo.errors import UserError, explained
from merge_sumo.files import resource
from merge_sumo.records import convert, read_toml, toml_value
from merge_sumo.scenario.scenario import US23, Scenario

SUFFIX = ".toml"


def shipped_scenarios() -> list[str]:
    """Return the names of the scenarios of the package, the paper's first."""
    files = sorted(resource("sumo_net").glob(f"*{SUFFIX}"))
    return [US23.name, *(path.stem for path in files)]


def named_scenario(name: str) -> Scenario:
    """Return a scenario of the package or of a file.

    Args:
        name: name of a scenario of the package, or path of a TOML file. A file names its net
            relative to its own folder.

    Returns:
        The scenario.

    Raises:
        UserError: no scenario has this name, or a value of the file is missing or wrong.

    Example:
        >>> named_scenario("us23-lane").lane_m
        (-70.0, 130.0)
    """
    if name == US23.name:
        return US23
    known = shipped_scenarios()
    if name in known:
        return _read(resource("sumo_net") / f"{name}{SUFFIX}")
    if not name.endswith(SUFFIX):
        raise UserError(
            f"unknown scenario {name!r}: choose {', '.join(known)}, or a file NAME{SUFFIX}"
        )
    scenario = _read(Path(name))
    if scenario.net is None:
        return scenario
    return replace(scenario, net=str((Path(name).parent / scenario.net).resolve()))


def _read(path: Path) -> Scenario:
    """Return the scenario of a file, with its net as the file names it."""
    _, record = read_toml(path, "scenario")
    with explained(str(path)):
        return convert({"name": path.stem, **record}, Scenario)


COMMENTS = {
    "net": "the SUMO net; its path is relative to the folder of this file",
    "mainline": "edges of the mainline in driving order, past the merge point M",
    "ramp": "edges of the ramp in driving order, past M",
    "x_pov0_m": "start of the POV: low, high; position of its front bumper, negative before M",
    "v_pov0_mps": "speed of the POV at the start: low, high",
    "x_vut0_m": "start of the VUT",
    "v_vut0_mps": "speed of the VUT at the start; a range such as [14.0, 22.0] is sampled",
    "tau_s": "reaction time of a car of the mainline that follows another",
    "min_gap_m": "its gap to the car ahead at standstill",
    "pov_length_m": "length of the cars of the mainline",
    "vut_length_m": "length of the VUT",
    "a_min_mps2": "hardest braking of both",
    "a_max_mps2": "hardest acceleration of both",
    "timeout_s": "an episode that lasts longer ends as TIMEOUT",
    "follow_up_s": "duration of the simulation after the merge",
    "v_hw_min_mps": "lowest and highest speed of the mainline",
    "v_min_mps": "the VUT is slow below this speed",
    "ttc_min_s": "a lower time to collision is short",
    "dx_crash_m": "front bumpers nearer than this at the merge are a failure",
    "dx_critical_m": "front bumpers nearer than this are critical",
    "level0_a_mps2": "acceleration of a level-0 VUT",
    "level0_v_mps": "speed up to which it accelerates",
    "reach_m": "no vehicle starts farther from M",
    "v_start_max_mps": "no vehicle starts faster",
    "lane_m": "begin and end of the acceleration lane; the beginning is at the gore or after it",
    "lane_end": 'at its end the VUT moves to the mainline; with "stop" it must stop before it',
}
"""Comments on the values of a file that is written."""


def to_toml(scenario: Scenario, notes: Sequence[str]) -> str:
    """Return a scenario as a commented TOML file.

    Args:
        scenario: the scenario.
        notes: lines of a comment at the beginning of the file.
    """
    lines = [f"# {line}" for line in notes]
    lines.append("")
    recorded = scenario.to_record()
    for name in recorded:
        value = getattr(scenario, name)
        if value is None:
            continue
        text, comment = f"{name} = {toml_value(value)}", COMMENTS.get(name)
        lines.append(f"{text:<43} # {comment}" if comment else text)
    return "\n".join(lines) + "\n"
