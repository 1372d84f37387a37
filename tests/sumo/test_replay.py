"""Exported folders replay in real SUMO with nothing else running, and a replay tells the truth."""

# mypy: no-strict-optional

from __future__ import annotations

import copy
import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from lxml import etree
from support.foreign_nets import LANE_M, lane_corridor_of

from merge_sumo.campaigns.campaign import export_case
from merge_sumo.campaigns.run import failures
from merge_sumo.errors import UserError
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.merge import road_for, road_of
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, US23, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.sumo import replay as replay_module
from merge_sumo.sumo.binding import run_program, sumo_program
from merge_sumo.sumo.replay import MAX_TIMESTEPS, replay
from merge_sumo.sumo.replay_folder import (
    CASE,
    CONFIG,
    HOLD_STEPS,
    HOSTED_NET,
    LABELS,
    NET,
    RECORD,
    SCENARIO,
    TYPES,
    VIEW,
    write_scenario,
)

SHIPPED = sorted(path.parent for path in Path(__file__).parents[2].glob(f"scenarios/*/{CONFIG}"))
FILES = {CONFIG, NET, TYPES, LABELS, RECORD, VIEW, CASE}
ROW = 40
"""A row of the record in the middle of the episode, at 4.0 s."""

Command = Callable[[int], float]
"""The acceleration that a vehicle is given at a step, m/s2."""


def drive(case: Case, pov: Command, vut: Command, steps: int, end: End) -> Trajectory:
    """Return the motion of eq. (4) under given accelerations; speeds do not fall below 0."""
    x = np.array([case.x_pov0_m, US23.x_vut0_m])
    v = np.array([case.v_pov0_mps, case.v_vut0_mps])
    rows = []
    for step in range(steps):
        a = np.maximum([pov(step), vut(step)], -v / DT_S)
        rows.append([x[0], v[0], a[0], x[1], v[1], a[1]])
        x, v = x + v * DT_S, np.maximum(v + a * DT_S, 0.0)
    rows.append([x[0], v[0], 0.0, x[1], v[1], 0.0])
    return Trajectory(case, np.array(rows).reshape(-1, 2, 3), end)


def constant(_: int) -> float:
    return 0.0


def at_level_0(x_pov0_m: float, v_pov0_mps: float, v_vut0_mps: float = 18.0) -> Case:
    return Case(
        level=0, x_pov0_m=x_pov0_m, v_pov0_mps=v_pov0_mps, v_vut0_mps=v_vut0_mps, scenario=US23
    )


def write(folder: Path, trajectory: Trajectory) -> Path:
    write_scenario(
        folder, road_of(), Outcome(0, 0, trajectory.case, Measures.of(trajectory)), trajectory
    )
    return folder


def edit_number(path: Path, who: str, column: str, by: float, row: int = ROW) -> None:
    """Add to one number of one row of an FCD file."""
    tree = etree.parse(path)
    vehicle = [v for v in tree.iter("vehicle") if v.get("id") == who][row]
    vehicle.set(column, f"{float(vehicle.get(column)) + by:.9f}")
    tree.write(path)


def assert_identical(folder: Path, steps: int | None = None) -> None:
    result = replay(folder)
    assert (result.diverged_at_s, result.detail) == (None, "")
    if steps is None:
        assert result.rows > 0
    else:
        assert result.rows == 2 * (steps + 1 + HOLD_STEPS)


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


@pytest.fixture
def sumo_plays(monkeypatch):
    """Return a function that has SUMO play something else than what the folder says.

    It takes the change, which is applied to the temporary folder where SUMO is started.
    """

    def otherwise(change: Callable[[Path], object]) -> None:
        def changed(name, arguments, stage, **options):
            change(stage)
            return run_program(name, arguments, stage, **options)

        monkeypatch.setattr(replay_module, "run_program", changed)

    return otherwise


class TestAnExport:
    def test_is_exactly_these_files(self, collision):
        assert {path.name for path in collision.iterdir()} == FILES


OF_LEVEL_2 = Case(level=2, x_pov0_m=-273.0, v_pov0_mps=33.0, svo_rad=0.6, scenario=US23)
MOTIONS: dict[str, tuple[Case, Command, Command, int, End]] = {
    "a timeout": (at_level_0(-250.0, 30.0), constant, lambda _: -4.0, 300, End.TIMEOUT),
    "bodies that overlap": (at_level_0(-182.0, 18.0), constant, constant, 102, End.MERGED),
    "a fast POV": (at_level_0(-180.0, 35.0), lambda _: 2.0, lambda _: -4.0, 300, End.TIMEOUT),
    "no step": (at_level_0(-250.0, 30.0), constant, constant, 0, End.VUT_ERROR),
    "level 2": (OF_LEVEL_2, lambda s: (s // 5) % 7 - 4.0, lambda _: 1.0, 83, End.MERGED),
}
"""Case, acceleration of the POV and of the VUT, steps and end."""


class TestAnHonestRecordReplaysIdentically:
    @pytest.mark.parametrize("failed", [False, True])
    def test_of_a_campaign(self, run, tmp_path, failed):
        outcome = next(o for o in run.outcomes if o.failed is failed)
        export_case(run, outcome.index, tmp_path / "case")
        steps = len(run.trajectory(outcome.index).whole) - 1
        assert_identical(tmp_path / "case", steps)

    @pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
    def test_that_is_shipped(self, folder):
        found = {path.name for path in folder.iterdir()}
        assert found >= FILES - {NET}
        assert NET in found or HOSTED_NET in found
        assert_identical(folder)

    @pytest.mark.parametrize("name", MOTIONS)
    def test_of_any_motion(self, tmp_path, name):
        case, pov, vut, steps, end = MOTIONS[name]
        trajectory = drive(case, pov, vut, steps, end)
        assert_identical(write(tmp_path / "case", trajectory), steps)


@pytest.fixture
def lane_road(tmp_path):
    """Return a function that finds the road of a net with an acceleration lane."""

    def find(name: str) -> tuple[Corridor, Scenario]:
        if name == "us23-lane":
            scenario = named_scenario(name)
            assert isinstance(scenario, Scenario)
            return road_for(scenario), scenario
        return lane_corridor_of(name, tmp_path), replace(US23, lane_m=LANE_M)

    return find


class TestAMergeFromALane:
    """The VUT drives at 20 m/s from 201 m before M, and merges in the first row past a place."""

    def motion(self, scenario: Scenario, place_m: float, end: End) -> Trajectory:
        steps = int(np.ceil((place_m + 201.0) / 2.0))
        x_m = -201.0 + 2.0 * np.arange(steps + 1)
        vut = np.stack((x_m, np.full_like(x_m, 20.0), np.zeros_like(x_m)), axis=1)
        pov = vut + np.array([-30.0, 0.0, 0.0])
        case = Case(level=0, x_pov0_m=-231.0, v_pov0_mps=20.0, scenario=scenario)
        return Trajectory(case, np.stack((pov, vut), axis=1), end)

    def written(self, folder: Path, road: Corridor, trajectory: Trajectory) -> Path:
        write_scenario(
            folder, road, Outcome(0, 0, trajectory.case, Measures.of(trajectory)), trajectory
        )
        return folder

    def lanes(self, path: Path) -> list[str]:
        return [
            car.get("lane") for car in etree.parse(path).iter("vehicle") if car.get("id") == "vut"
        ]

    @pytest.mark.parametrize("name", ["us23-lane", "two edges", "lane drop", "OSM"])
    @pytest.mark.parametrize("place", ["gore", "lane", "end"])
    def test_is_seen_in_the_row_in_which_it_happens(self, lane_road, tmp_path, name, place):
        road, scenario = lane_road(name)
        begin_m, end_m = road.lane_m
        place_m = {"gore": max(begin_m, -198.0), "lane": 21.0, "end": end_m}[place]
        trajectory = self.motion(scenario, place_m, End.MERGED)
        folder = self.written(tmp_path / "case", road, trajectory)
        assert_identical(folder, len(trajectory.motion) - 1)
        share = (trajectory.x_vut_m[-1] - scenario.lane_m[0]) / np.ptp(scenario.lane_m)
        merges = "where the lane ends" if share >= 1.0 else f"at {share:.2f} of the lane"
        assert f"the VUT merges {merges}" in (folder / LABELS).read_text()
        lanes = self.lanes(folder / RECORD)
        *before, first = lanes[: len(trajectory.motion)]
        assert {*lanes[len(before) :]} == {first}
        assert first in (("out1.0_0", ":M.0_out0_0") if place == "end" else ("lane.0_1",))
        assert "lane.0_1" not in before
        assert ("lane.0_0" in before) is (place != "gore" or begin_m < -198.0)


class TestAReplayThatIsNotTheRecord:
    """What SUMO plays is made to differ from the record that the replay is compared with."""

    @pytest.mark.parametrize(
        ("who", "column", "by"), [("pov", "x", 0.5), ("vut", "y", -0.5), ("vut", "speed", 0.5)]
    )
    def test_diverges_where_a_vehicle_is_elsewhere_or_at_another_speed(
        self, folder, sumo_plays, who, column, by
    ):
        sumo_plays(lambda stage: edit_number(stage / RECORD, who, column, by))
        result = replay(folder)
        assert result.diverged_at_s == pytest.approx(ROW * DT_S)
        assert result.detail.startswith(f"{column} of {who} ")

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


CHANGES: list[tuple[Callable[[etree._Element], object], str]] = [
    (many(HOLD_STEPS), "in 11 or more rows"),
    (many(MAX_TIMESTEPS + 1), "has 1512 timesteps, and at most 1511 are read"),
    (lambda record: record[ROW].set("time", "4.05"), "at 4.05 s: there is one every 0.1 s"),
    (lambda record: record[ROW].attrib.pop("time"), "it has no time"),
    (lambda record: record[ROW].append(copy.deepcopy(record[ROW][1])), "two rows of vut at 4 s"),
    (without_vut, "must have pov, vut every 0.1 s"),
    (lambda record: record[ROW][0].set("lane", "ramp_0"), "has pov on lane ramp_0, which is not"),
    *(
        (
            lambda record, number=number: record[ROW][0].set("pos", number),
            ": pos is ",
        )
        for number in ("nan", "1e8", "", "0x10", "\u0661")
    ),
]
"""How a record is changed, and the sentence of the refusal."""


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
            (NET, b'priority="', b'priority="1'),
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
        assert "there is no folder" in refusal(tmp_path / "nowhere")


def test_a_folder_of_an_older_version_is_played_on_the_shipped_road(folder):
    record = json.loads((folder / CASE).read_bytes())
    del record[SCENARIO]
    (folder / CASE).write_text(json.dumps(record))
    assert_identical(folder)


class TestARecordThatSumoPlays:
    """The record itself is changed, and so what SUMO plays and what the replay compares."""

    @pytest.mark.parametrize("who", ["pov", "vut"])
    def test_is_not_identical_when_the_end_is_not_held(self, folder, who):
        record = etree.parse(folder / RECORD)
        rows = record.findall("timestep")
        place = {v.get("id"): v for v in rows[-4]}[who]
        before = {v.get("id"): v for v in rows[-12]}[who]
        for name in ("x", "y", "pos", "speed"):
            place.set(name, before.get(name))
        record.write(folder / RECORD)
        result = replay(folder)
        assert result.diverged_at_s == pytest.approx((len(rows) - 4) * DT_S)
        assert result.detail.startswith(f"x of {who} is ")


@pytest.mark.parametrize("folder", SHIPPED, ids=lambda folder: folder.name)
def test_plain_sumo_replays_a_folder_that_is_shipped(folder, tmp_path):
    """Start sumo from elsewhere, on the configuration of a folder; the record must come out."""
    output = tmp_path / "plain.fcd.xml"
    command = [sumo_program("sumo"), "-c", str(folder / CONFIG), "--fcd-output", str(output)]
    subprocess.run([*command, "--precision", "9"], check=True, cwd=tmp_path, capture_output=True)
    recorded, played = (
        [
            (float(step.get("time")), car.get("id"), float(car.get("x")), float(car.get("speed")))
            for step in etree.parse(path).getroot()
            for car in sorted(step, key=lambda car: car.get("id"))
        ]
        for path in (folder / RECORD, output)
    )
    assert len(recorded) > 100
    assert [row[:2] for row in played] == [row[:2] for row in recorded]
    assert np.allclose([row[2:] for row in played], [row[2:] for row in recorded], 0.0, 1e-6)
