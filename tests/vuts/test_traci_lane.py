"""A TraCI controller on an acceleration lane: what it sees of it, and how it changes lanes."""

# mypy: no-strict-optional

from __future__ import annotations

import re
from pathlib import Path

import pytest
from controllers import STOCK_CLIENT, program
from vut_contract import factory, run_on

from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.trajectory import End
from merge_sumo.vuts.traci.session import STAYED

LANE = named_scenario("us23-lane")
DRIVES = """
while traci.simulation.getMinExpectedNumber() > 0:
    traci.simulationStep()
    if "vut" not in traci.vehicle.getIDList():
        continue
    traci.vehicle.setSpeed("vut", min(traci.vehicle.getSpeed("vut") + 0.1, 28.0))
"""
ON_LANE = (
    DRIVES
    + """
    if traci.vehicle.getRoadID("vut") != "lane" or traci.vehicle.getLaneIndex("vut") != 0:
        continue
"""
)


def drive(tmp_path, source, *, cases=2, **options):
    """Return what became of some cases with a stock client on the lane."""
    command = program(tmp_path, STOCK_CLIENT + source + "\ntraci.close()\n")
    vut = factory("traci:" + command, deadline_s=20.0, **options)
    return run_on(vut, LANE, 0, cases, corridors=1)


def test_a_lane_change_merges_in_the_next_step_wherever_it_is_commanded(tmp_path):
    source = (
        ON_LANE
        + """
    if traci.vehicle.getLanePosition("vut") >= 100.0:
        traci.vehicle.changeLaneRelative("vut", 1, 3)
"""
    )
    for trajectory in drive(tmp_path, source):
        assert trajectory.error is None
        assert trajectory.end is End.MERGED
        before, at = trajectory.x_vut_m[-3:-1]
        assert before < 30.0 <= at
        assert len(trajectory.after) > 40, "it drives on itself behind the merge"


def test_the_controller_of_the_tutorial_merges_into_a_gap(tmp_path):
    page = (Path(__file__).parents[2] / "docs/tutorials/traci-controller.md").read_text("utf-8")
    _, source = re.findall(r"```python\n(import sys, traci.*?)```", page, flags=re.DOTALL)
    vut = factory("traci:" + program(tmp_path, source), deadline_s=20.0)
    *_, behind_the_pov = run_on(vut, LANE, 0, 4, corridors=1)
    assert behind_the_pov.error is None
    assert -60.0 < behind_the_pov.x_vut_m[-1] < 20.0
    assert behind_the_pov.x_pov_m[-2] - behind_the_pov.x_vut_m[-2] > 25.0


@pytest.mark.slow
def test_without_a_lane_change_it_comes_to_the_end_and_a_note_says_why(tmp_path):
    log = tmp_path / "controller.log"
    (trajectory,) = drive(tmp_path, DRIVES, cases=1, log=log)
    assert trajectory.end is End.MERGED
    assert trajectory.x_vut_m[-1] >= 130.0
    assert trajectory.clipped_steps == 0
    assert log.read_text().splitlines() == [f"note: {STAYED}"]
