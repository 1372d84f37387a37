"""Exported folders replay in real SUMO by themselves, and a replay tells the truth."""

# mypy: no-strict-optional

from __future__ import annotations

import copy
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from lxml import etree
from support.foreign_nets import LANE_M, foreign_lane_road
from support.replays import assert_identical, commanded, write_replay

from merge_sumo.campaigns.campaign import export_case
from merge_sumo.campaigns.recorded import failures
from merge_sumo.errors import UserError
from merge_sumo.road.loader import road_for, road_of
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, US23
from merge_sumo.scenario.trajectory import End
from merge_sumo.sumo import replay as replay_module
from merge_sumo.sumo.binding import run_program, sumo_program
from merge_sumo.sumo.replay import MAX_TIMESTEPS, replay
from merge_sumo.sumo.replay_folder import (
    CASE,
    CONFIG,
    HOLD_STEPS,
    LABELS,
    NET,
    RECORD,
    TYPES,
    VIEW,
)

SHIPPED = sorted(path.parent for path in Path(__file__).parents[2].glob(f"scenarios/*/{CONFIG}"))
FILES = {CONFIG, NET, TYPES, LABELS, RECORD, VIEW, CASE}
ROW = 40
"""A row of the record in the middle of the episode, at 4.0 s."""


def refusal(folder: Path) -> str:
    """Return the sentence with which a replay is refused."""
    with pytest.raises(UserError) as error:
        replay(folder)
    message = str(error.value)
    assert "\n" not in message
    assert str(folder) in message
    return message


@pytest.fixture(scope="module")
def collision(run, tmp_path_factory) -> Path:
    """Return an exported collision; tests copy it before they change it."""
    folder = tmp_path_factory.mktemp("replay") / "collision"
    export_case(run, failures(run.outcomes)[0].index, folder)
    return folder


@pytest.fixture
def folder(collision, tmp_path) -> Path:
    return Path(shutil.copytree(collision, tmp_path / "case"))


CASE_OF_LEVEL_2 = Case(level=2, x_pov0_m=-182.0, v_pov0_mps=18.0, svo_rad=0.6, scenario=US23)
MOTIONS = {
    "a timeout": (-1.0, -4.0, 300, End.TIMEOUT),
    "no step": (0.0, 0.0, 0, End.VUT_ERROR),
}
"""Acceleration of the POV and of the VUT, steps and end."""


class TestAnHonestRecordReplaysIdentically:
    @pytest.mark.parametrize("failed", [False, True])
    def test_of_a_campaign(self, run, tmp_path, failed):
        outcome = next(o for o in run.outcomes if o.failed is failed)
        export_case(run, outcome.index, tmp_path / "case")
        assert {path.name for path in (tmp_path / "case").iterdir()} == FILES
        assert_identical(tmp_path / "case", len(run.trajectory(outcome.index).whole))

    @pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
    def test_that_is_shipped(self, folder):
        assert {path.name for path in folder.iterdir()} >= FILES
        assert_identical(folder)

    @pytest.mark.parametrize("name", MOTIONS)
    def test_of_any_motion(self, tmp_path, name):
        pov, vut, steps, end = MOTIONS[name]
        trajectory = commanded(CASE_OF_LEVEL_2, np.full((steps, 2), (pov, vut)), end=end)
        assert_identical(write_replay(tmp_path / "case", road_of(), trajectory), steps + 1)


@pytest.mark.parametrize("name", ["us23-lane", "two edges", "lane drop", "OSM"])
@pytest.mark.parametrize("place", ["gore", "lane", "end"])
def test_a_merge_from_a_lane_is_seen_in_the_row_in_which_it_happens(tmp_path, name, place):
    """The VUT drives at 20 m/s from 201 m before M, and merges in the first row past a place."""
    if name == "us23-lane":
        scenario = named_scenario(name)
        road = road_for(scenario)
    else:
        scenario, road = replace(US23, lane_m=LANE_M), foreign_lane_road(name, tmp_path)
    begin_m, end_m = road.used_lane_m
    place_m = {"gore": max(begin_m, -198.0), "lane": 21.0, "end": end_m}[place]
    steps = int(np.ceil((place_m + 201.0) / 2.0))
    case = Case(level=0, x_pov0_m=-231.0, v_pov0_mps=20.0, v_vut0_mps=20.0, scenario=scenario)
    trajectory = commanded(case, np.zeros((steps, 2)), [-231.0, -201.0], End.MERGED)
    folder = write_replay(tmp_path / "case", road, trajectory)
    assert_identical(folder, steps + 1)
    share = (trajectory.x_vut_m[-1] - scenario.lane_m[0]) / np.ptp(scenario.lane_m)
    assert f"the VUT merges at {share:.2f} of the lane" in "".join(replay(folder).words)
    lanes = [car.get("lane") for car in etree.parse(folder / RECORD).iterfind(".//*[@id='vut']")]
    *before, first = lanes[: steps + 1]
    assert {*lanes[steps:]} == {first}
    assert first in (("out1.0_0", ":M.0_out0_0") if place == "end" else ("lane.0_1",))
    assert "lane.0_1" not in before
    assert ("lane.0_0" in before) is (place != "gore" or begin_m < -198.0)


class TestAReplayThatIsNotTheRecord:
    @pytest.mark.parametrize(
        ("who", "column", "by"), [("pov", "x", 0.5), ("vut", "y", -0.5), ("vut", "speed", 0.5)]
    )
    def test_diverges_where_a_vehicle_is_elsewhere_or_at_another_speed(
        self, folder, monkeypatch, who, column, by
    ):
        def changed(name, arguments, stage, **options):
            tree = etree.parse(stage / RECORD)
            vehicle = tree.findall(f".//vehicle[@id='{who}']")[ROW]
            vehicle.set(column, f"{float(vehicle.get(column)) + by:.9f}")
            tree.write(stage / RECORD)
            return run_program(name, arguments, stage, **options)

        monkeypatch.setattr(replay_module, "run_program", changed)
        result = replay(folder)
        assert result.diverged_at_s == pytest.approx(ROW * DT_S)
        assert result.detail.startswith(f"{column} of {who} ")

    def test_diverges_where_a_vehicle_does_not_move_at_its_speed(self, folder):
        record = etree.parse(folder / RECORD)
        record.getroot()[ROW][0].set("speed", "9")
        record.write(folder / RECORD)
        result = replay(folder)
        assert result.diverged_at_s == ROW * DT_S
        assert result.detail == "the recorded motion of pov does not match its speed"

    def test_diverges_where_the_end_is_not_held(self, folder):
        record = etree.parse(folder / RECORD)
        rows = record.findall(".//vehicle[@id='vut']")
        for name in ("x", "y", "pos", "speed"):
            rows[-4].set(name, rows[-12].get(name))
        record.write(folder / RECORD)
        result = replay(folder)
        assert result.diverged_at_s == pytest.approx((len(rows) - 4) * DT_S)
        assert result.detail.startswith("x of vut is ")

    def test_that_sumo_does_not_end_is_refused(self, folder, monkeypatch):
        monkeypatch.setattr(replay_module, "run_program", partial(run_program, limit_s=0.0))
        assert "did not end within 0 s" in refusal(folder)


def many(steps: int) -> Callable[[etree._Element], None]:
    """Return a change that gives a record another number of timesteps."""

    def change(record: etree._Element) -> None:
        first = record[0]
        record[:] = [copy.deepcopy(first) for _ in range(steps)]
        for step, timestep in enumerate(record):
            timestep.set("time", f"{step * DT_S:.2f}")

    return change


def without_vut(record: etree._Element) -> None:
    for vehicle in record.findall(".//vehicle[@id='vut']"):
        vehicle.getparent().remove(vehicle)


WRONG = "has a missing or wrong value in line "
CHANGES: list[tuple[Callable[[etree._Element], object], str]] = [
    (many(HOLD_STEPS), "in 11 or more rows"),
    (many(MAX_TIMESTEPS + 1), WRONG),
    (lambda record: record[ROW].set("time", "4.05"), WRONG),
    (lambda record: record[ROW].append(copy.deepcopy(record[ROW][1])), WRONG),
    (without_vut, "must have pov, vut every 0.1 s"),
    (lambda record: record[ROW][0].set("lane", "ramp_0"), "has pov on lane ramp_0, which is not"),
    (lambda record: record[ROW][0].set("pos", "1e8"), WRONG),
]
"""A change of a record, and the sentence of the refusal."""


class TestAFolderThatCannotBeReplayed:
    @pytest.mark.parametrize(("change", "said"), CHANGES)
    def test_has_another_record(self, folder, change, said):
        record = etree.parse(folder / RECORD)
        change(record.getroot())
        record.write(folder / RECORD, encoding="UTF-8")
        assert said in refusal(folder)

    @pytest.mark.parametrize(
        ("name", "old", "new"),
        [
            (NET, b'id="out1.0"', b'id="gone.0"'),
            (CASE, b'"t_end_s": ', b'"t_end_s": 1'),
            (CASE, b'"vut_length_m": 5.0', b'"vut_length_m": "5"'),
        ],
    )
    def test_has_another_net_or_case(self, folder, name, old, new):
        content = (folder / name).read_bytes()
        assert old in content
        (folder / name).write_bytes(content.replace(old, new))
        refusal(folder)

    def test_lacks_a_file_or_is_missing(self, folder, tmp_path):
        (folder / NET).unlink()
        assert NET in refusal(folder)
        assert "is not a replay folder" in refusal(tmp_path / "nowhere")


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_plain_sumo_replays_a_folder_that_is_shipped(folder, tmp_path):
    """Start sumo from elsewhere, on the configuration of a folder; the record must come out."""
    output = tmp_path / "plain.fcd.xml"
    command = [sumo_program("sumo"), "-c", str(folder / CONFIG), "--fcd-output", str(output)]
    subprocess.run([*command, "--precision", "9"], check=True, cwd=tmp_path, capture_output=True)
    recorded, lanes = replay_module._record(folder / RECORD, "the record")
    played, _ = replay_module._record(output, "the replay")
    assert len(lanes) > 200
    assert np.allclose(played[:, :, :3], recorded[:, :, :3], 0.0, 1e-6, equal_nan=True)
