"""A replay from shortly before the first conflict continues as the whole replay does."""

from __future__ import annotations

from pathlib import Path

import pytest
from lxml import etree
from support.calling import assert_refused
from support.campaigning import campaign_settings, run_campaign

from merge_sumo.campaigns.campaign import export_case
from merge_sumo.metrics.merge import Conflict
from merge_sumo.road.loader import centre_lines, road_for
from merge_sumo.road.scenario_file import named_scenario, shipped_scenarios
from merge_sumo.scenario.scenario import DT_S
from merge_sumo.sumo import replay as replay_module
from merge_sumo.sumo.binding import run_program
from merge_sumo.sumo.replay import REPLAYED, replay
from merge_sumo.sumo.replay_folder import RECORD

STALEMATE = Path(__file__).parents[2] / "scenarios" / "roundabout-stalemate"
"""VUT and POV touch at 9.3 s, before M, and both have crossed junctions by then."""


@pytest.fixture
def assert_continues(monkeypatch):
    """Return a function that replays a folder from times on, in s, by the times of the first rows.

    It checks that the rows that SUMO writes are the end of those of the whole replay.
    """
    written = []

    def kept(name, arguments, stage, **options):
        reason = run_program(name, arguments, stage, **options)
        content = (stage / REPLAYED).read_bytes()
        written.append(content[content.index(b"    <timestep") :])
        return reason

    def check(folder, begins):
        assert replay(folder).identical
        whole = written[-1]
        for from_s, begin_s in begins.items():
            part, rows = replay(folder, from_s), written[-1]
            assert rows.startswith(f'    <timestep time="{begin_s:.3f}">'.encode())
            assert whole.endswith(rows)
            assert part.identical
            assert part.rows == rows.count(b"<vehicle ")
            assert part.words[-1].startswith(f"from {begin_s:.1f} s, ")

    monkeypatch.setattr(replay_module, "run_program", kept)
    return check


@pytest.mark.parametrize("name", shipped_scenarios())
def test_sumo_writes_the_same_bytes_from_there_on(name, assert_continues, tmp_path):
    settings = campaign_settings(
        vut="design2", levels=(0, 1), cases=2, batch=2, seed=1, scenario=named_scenario(name)
    )
    run = run_campaign(settings, tmp_path / "run")
    lines = centre_lines(road_for(named_scenario(name)))
    for outcome in run.outcomes:
        folder = tmp_path / str(outcome.index)
        export_case(run, outcome.index, folder)
        at_s = Conflict.of(run.trajectory(outcome.index), lines).row * DT_S
        assert_continues(folder, {s: max(at_s + s, 0.0) for s in (-3.0, 0.0)})


def test_also_where_vehicles_are_inside_of_junctions(assert_continues):
    before_s = [-0.1 * row for row in range(0, 94, 4)]
    assert_continues(STALEMATE, {s: max(9.3 + s, 0.0) for s in before_s})
    record = etree.parse(STALEMATE / RECORD).getroot()
    lanes = [car.get("lane", "") for s in before_s for car in record[round((9.3 + s) * 10)]]
    assert sum(lane.startswith(":") for lane in lanes) > 3


class TestTheCommand:
    def test_prints_the_begin_and_its_reason(self, command_line):
        code, out, _ = command_line("replay", STALEMATE, "--from", "-3")
        *_, begins, verdict = out.splitlines()
        assert (code, begins) == (0, "from 6.3 s, 3 s before the contact at 9.3 s")
        # 6.3 to 14.6 s, and the 10 rows that hold the end: 93 rows of two cars.
        assert verdict == "identical: 186 rows of x, y and speed"

    @pytest.mark.parametrize("number", ["3", "nan", "-inf"])
    @pytest.mark.parametrize("command", [("replay", STALEMATE), ("run",)])
    def test_refuses_another_number(self, command, number, command_line):
        assert_refused(command_line(*command, "--from", number), "--from", "0 or below, such as")
