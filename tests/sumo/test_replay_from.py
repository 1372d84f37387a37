"""A replay from shortly before the first conflict goes on as the whole replay does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lxml import etree
from support.calling import assert_refused
from support.campaigning import campaign_settings, run_campaign

from merge_sumo.campaigns.campaign import export_case
from merge_sumo.metrics.merge import Conflict
from merge_sumo.road.scenario_file import named_scenario, shipped_scenarios
from merge_sumo.scenario.scenario import DT_S
from merge_sumo.sumo import replay as replay_module
from merge_sumo.sumo.binding import run_program
from merge_sumo.sumo.replay import REPLAYED, Replay, replay
from merge_sumo.sumo.replay_folder import RECORD

STALEMATE = Path(__file__).parents[2] / "scenarios" / "roundabout-stalemate"
"""VUT and POV touch as the VUT reaches M, at 11.5 s, and both have crossed junctions by then."""

Played = Callable[[Path, float | None], tuple[Replay, bytes]]


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Played:
    """Return a function that replays a folder; it gives the rows that SUMO writes, too."""
    written: list[bytes] = []

    def kept(name: str, arguments: Any, stage: Path, **options: Any) -> object:
        end = run_program(name, arguments, stage, **options)
        written.append((stage / REPLAYED).read_bytes())
        return end

    def play(folder: Path, from_s: float | None) -> tuple[Replay, bytes]:
        result = replay(folder, from_s)
        return result, written[-1][written[-1].index(b"    <timestep") :]

    monkeypatch.setattr(replay_module, "run_program", kept)
    return play


def assert_goes_on(played: Played, folder: Path, begins: dict[float, float]) -> None:
    """Replay a folder from times on, in s: what SUMO writes is the end of the whole replay."""
    whole, all_rows = played(folder, None)
    assert (whole.rows, len(whole.words)) == (all_rows.count(b"<vehicle "), 2)
    for from_s, begin_s in begins.items():
        part, rows = played(folder, from_s)
        assert rows.startswith(f'    <timestep time="{begin_s:.3f}">'.encode())
        assert all_rows.endswith(rows)
        assert (part.diverged_at_s, part.detail) == (None, "")
        assert part.rows == rows.count(b"<vehicle ")
        assert part.words[2].startswith(f"from {begin_s:.1f} s, ")


@pytest.mark.parametrize("name", shipped_scenarios())
def test_sumo_writes_the_same_bytes_from_there_on(
    name: str, played: Played, tmp_path: Path
) -> None:
    scenario = named_scenario(name)
    settings = campaign_settings(
        vut="design2", levels=(0, 1, 2), cases=4, batch=4, seed=1, scenario=scenario
    )
    run = run_campaign(settings, tmp_path / "run")
    for outcome in run.outcomes:
        folder = tmp_path / str(outcome.index)
        export_case(run, outcome.index, folder)
        at_s = Conflict.of(run.trajectory(outcome.index)).row * DT_S
        assert_goes_on(played, folder, {s: max(at_s + s, 0.0) for s in (-3.0, -1.0, 0.0)})


def test_also_where_vehicles_are_inside_of_junctions(played: Played) -> None:
    before_s = [-0.1 * row for row in range(0, 116, 5)]
    assert_goes_on(played, STALEMATE, {s: max(11.5 + s, 0.0) for s in before_s})
    record = etree.parse(STALEMATE / RECORD).getroot()
    begins = [record[round((11.5 + s) * 10)] for s in before_s]
    inside = [car for row in begins for car in row if str(car.get("lane")).startswith(":")]
    assert len(inside) > 3


class TestTheCommand:
    def test_says_when_it_begins_and_why(self, command_line: Any) -> None:
        code, out, _ = command_line("replay", STALEMATE, "--from", "-3")
        _, _, begins, verdict = out.splitlines()
        assert (code, begins) == (0, "from 8.5 s, 3 s before the contact at 11.5 s")
        # 8.5 to 14.6 s, and the 10 rows that hold the end: 71 rows of two cars.
        assert verdict == "identical: 142 rows of x, y and speed"

    @pytest.mark.parametrize("number", ["3", "nan", "inf", "-inf"])
    @pytest.mark.parametrize(
        "command", [("replay", STALEMATE), ("replay", STALEMATE, "--gui"), ("run",)]
    )
    def test_refuses_another_number(self, command: Any, number: str, command_line: Any) -> None:
        assert_refused(command_line(*command, "--from", number), "--from", "not above 0, such as")
