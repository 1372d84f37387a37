"""Scenarios by name or as files: TOML that says what differs from the paper's scenario.

name = "my-ramp"
net = "my-ramp.net.xml"          # next to this file
mainline = ["e1", "e2"]          # edges in driving order, past the merge point M
ramp = ["r1", "e2"]
x_pov0_m = [-220, -90]
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

from merge_sumo.errors import UserError
from merge_sumo.files import resource
from merge_sumo.printable import meant
from merge_sumo.records import convert, read_toml, toml_value
from merge_sumo.scenario.scenario import US23, Scenario

SUFFIX = ".toml"


def shipped_scenarios() -> list[str]:
    """Return the names of the scenarios that the package brings: its files, and the paper's."""
    files = sorted(resource("sumo_net").glob(f"*{SUFFIX}"))
    return [US23.name, *(path.stem for path in files)]


def named_scenario(name: str) -> Scenario:
    """Return the scenario of a name or of a file; `UserError` where there is none.

    An error in a file is reported with its line.
    """
    if name == US23.name:
        return US23
    if name in shipped_scenarios():
        return _read(resource("sumo_net") / f"{name}{SUFFIX}")
    if not name.endswith(SUFFIX):
        known = shipped_scenarios()
        raise UserError(
            f"there is no scenario {name!r}: {meant(name, known)}choose {', '.join(known)}, or a "
            f"file NAME{SUFFIX}"
        )
    return read_scenario(Path(name))


def spoken_name(scenario: Scenario) -> str | None:
    """Return the name of a scenario for commands in this folder; None where they find none."""
    if scenario.name in shipped_scenarios():
        return scenario.name
    file = f"{scenario.name}{SUFFIX}"
    return file if Path(file).is_file() else None


def read_scenario(path: Path) -> Scenario:
    """Return the scenario that a file describes; its net is found next to the file."""
    scenario = _read(path)
    if scenario.net is None:
        return scenario
    return replace(scenario, net=str((path.parent / scenario.net).resolve()))


def _read(path: Path) -> Scenario:
    """Return the scenario of a file, with its net as the file names it."""
    text, record = read_toml(path, "scenario")
    try:
        return convert({"name": path.stem, **record}, Scenario)
    except UserError as error:
        raise UserError(f"{path}{_line(text, str(error))}: {error}") from error


def _line(text: str, sentence: str) -> str:
    """Return ", line N" of the first key of a file that a sentence begins with or quotes."""
    for number, line in enumerate(text.splitlines(), start=1):
        key = re.match(r"\s*([\w-]+)\s*=", line)
        if key and re.search(rf"(^|'){re.escape(key[1])}('| is )", sentence):
            return f", line {number}"
    return ""


COMMENTS = {
    "net": "the SUMO net, next to this file",
    "mainline": "edges of the mainline in driving order, past the merge point M",
    "ramp": "edges of the ramp in driving order, past M",
    "x_pov0_m": "where the POV may start: low, high; metres of its front bumper before M",
    "v_pov0_mps": "how fast it may be then",
    "x_vut0_m": "where the VUT starts",
    "v_vut0_mps": "how fast it is then; a range, as in [14.0, 22.0], is tested as a whole",
    "tau_s": "a car of the mainline follows the one ahead of it with this reaction time,",
    "min_gap_m": "and this distance at a stand",
    "pov_length_m": "length of the cars of the mainline",
    "vut_length_m": "length of the VUT",
    "a_min_mps2": "hardest braking of both",
    "a_max_mps2": "hardest acceleration of both",
    "timeout_s": "an episode that has not ended by then is a TIMEOUT",
    "follow_up_s": "all drive on after the merge for so long",
    "v_hw_min_mps": "speeds between which the mainline drives",
    "v_min_mps": "below this the VUT is slow",
    "ttc_min_s": "a time to collision below this is short",
    "dx_crash_m": "front bumpers nearer than this at the merge: a collision",
    "dx_critical_m": "nearer than this is critical",
    "level0_a_mps2": "a VUT that does not think accelerates so,",
    "level0_v_mps": "up to this speed",
    "reach_m": "no vehicle starts farther from M than this,",
    "v_start_max_mps": "nor faster than this",
    "lane_m": "where the acceleration lane begins, at the gore or behind it, and ends",
    "lane_end": 'its end moves a VUT to the mainline; "stop" brakes it to a stand before it',
}
"""Comments on the values of a file that is written."""


def to_toml(scenario: Scenario, found: Sequence[str]) -> str:
    """Return a scenario as a commented file; `found` is what was found out, in lines."""
    lines = [*(f"# {line}" for line in found), ""]
    recorded = scenario.to_record()
    for field in fields(scenario):
        value = getattr(scenario, field.name)
        if value is None or field.name not in recorded:
            continue
        comment = COMMENTS.get(field.name)
        text = f"{field.name} = {toml_value(value)}"
        lines.append(f"{text:<44}# {comment}" if comment else text)
    return "\n".join(lines) + "\n"
