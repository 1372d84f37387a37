"""Cases for other tools: OpenSCENARIO with OpenDRIVE, and tables of motion."""

# mypy: no-strict-optional

from __future__ import annotations

import math
import warnings

import numpy as np
import polars
import pytest
from lxml import etree
from scenariogeneration import xosc
from support.handmade import write_run

import merge_sumo as ms
from merge_sumo.campaigns.campaign import export_case
from merge_sumo.campaigns.recorded import failures
from merge_sumo.errors import Notice, UserError
from merge_sumo.reports.exports import write_openscenario, write_table
from merge_sumo.road.loader import road_for, road_of
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.scenario import DT_S


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("exports") / "run", per_level=10)


@pytest.fixture(scope="module")
def scenario(made, tmp_path_factory):
    """Return the OpenSCENARIO file of the worst case."""
    index = failures(made.outcomes)[0].index
    return write_openscenario(made, index, tmp_path_factory.mktemp("osc") / "case", road_of())


def vertices(tree: etree._ElementTree, who: str) -> list[tuple[float, ...]]:
    """Return (time, x, y, heading) of a car's trajectory as written."""
    found = []
    for vertex in tree.iterfind(f".//Trajectory[@name='{who} recorded']//Vertex"):
        place = vertex.find("Position/WorldPosition")
        found.append((float(vertex.get("time")), *(float(place.get(n)) for n in ("x", "y", "h"))))
    return found


class TestOpenScenario:
    @pytest.mark.parametrize("name", ["{}.xosc", "{}-free.xosc"])
    def test_is_valid_by_the_schema_of_the_standard_and_is_read_back(self, scenario, name):
        path = scenario.with_name(name.format(scenario.stem))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            read = xosc.ParseOpenScenario(str(path))
        assert {car.name for car in read.entities.scenario_objects} == {"pov", "vut"}
        header = etree.parse(path).find("FileHeader")
        assert (header.get("revMajor"), header.get("revMinor")) == ("1", "2")

    def test_has_the_places_of_sumos_record_at_every_step(self, made, scenario, tmp_path):
        index = failures(made.outcomes)[0].index
        export_case(made, index, tmp_path / "sumo")
        record = etree.parse(tmp_path / "sumo" / "episode.fcd.xml")
        tree = etree.parse(scenario)
        rows = len(made.trajectory(index).motion)
        for who in ("pov", "vut"):
            written = vertices(tree, who)
            assert len(written) == rows
            recorded = [
                tuple(float(car.get(name)) for name in ("x", "y", "angle"))
                for car in record.iterfind(f"timestep/vehicle[@id='{who}']")
            ][:rows]
            for step, (ours, sumos) in enumerate(zip(written, recorded, strict=True)):
                assert ours[:3] == pytest.approx((step * DT_S, *sumos[:2]), abs=1e-8)
                # Degrees clockwise from north there, radians the other way from east here.
                turned = math.remainder(ours[3] + math.radians(sumos[2] - 90.0), math.tau)
                assert turned == pytest.approx(0.0, abs=1e-8)


def test_a_free_vut_has_the_controller_that_a_parameter_names(scenario):
    tree = etree.parse(scenario.with_name(f"{scenario.stem}-free.xosc"))
    (assigned,) = tree.findall(".//Private[@entityRef='vut']//AssignControllerAction")
    assert assigned.get("activateLateral") == assigned.get("activateLongitudinal") == "true"
    assert assigned.find("Controller").get("name") == "$EgoController"
    (declared,) = tree.findall("ParameterDeclarations/ParameterDeclaration")
    assert (declared.get("name"), declared.get("value")) == ("EgoController", "user")


@pytest.fixture(scope="module")
def lane_run(tmp_path_factory):
    """Return a campaign in which the VUT merges at M, on the lane, or never."""
    folder, scenario = tmp_path_factory.mktemp("lane") / "run", named_scenario("us23-lane")
    return write_run(folder, 2, levels=(1,), timeouts=[1], scenario=scenario)


@pytest.fixture(scope="module")
def lane_scenario(lane_run, tmp_path_factory):
    road, folder = road_for(lane_run.scenario), tmp_path_factory.mktemp("osc") / "case"
    return write_openscenario(lane_run, 0, folder, road)


class TestAMergeFromALane:
    def test_is_a_step_of_the_trajectory_from_lane_to_lane(self, lane_run, lane_scenario):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            xosc.ParseOpenScenario(str(lane_scenario))
        tree, trajectory = etree.parse(lane_scenario), lane_run.trajectory(0)
        *before, merge = vertices(tree, "vut")
        x_vut = trajectory.x_vut_m
        assert {y for _, x, y, _ in before if x > -70.0} == {-3.2}
        assert len([x for _, x, _, _ in before if x > -70.0]) > 30
        assert merge == pytest.approx((trajectory.t_end_s, x_vut[-1], 0.0, 0.0), abs=1e-8)
        stop = tree.find(".//Storyboard/StopTrigger//SimulationTimeCondition")
        assert float(stop.get("value")) == pytest.approx(trajectory.t_end_s)

    def test_is_a_column_of_a_table(self, lane_run, tmp_path):
        path = write_table(lane_run, [0, 1], tmp_path / "merges.csv")
        assert path == tmp_path / "merges.csv"
        frame = polars.read_csv(path)
        assert frame.columns.index("a_vut_mps2") + 1 == frame.columns.index("merged")
        first, second = (frame.filter(case=case)["merged"].to_list() for case in (0, 1))
        assert first == [*(0 for _ in first[1:]), 1]
        assert set(second) == {0}


def test_a_table_has_a_row_for_every_step_of_every_case(made, tmp_path):
    frame = polars.read_csv(write_table(made, [0, 3], tmp_path))
    motion = ["x_pov_m", "v_pov_mps", "a_pov_mps2", "x_vut_m", "v_vut_mps", "a_vut_mps2"]
    start = ["x_pov0_m", "v_pov0_mps", "svo_rad"]
    assert frame.columns == ["case", "level", "time_s", *motion, *start, "severity"]
    recorded = np.concatenate([made.trajectory(i).motion for i in (0, 3)])
    assert np.array_equal(frame[motion].to_numpy(), recorded.reshape(-1, 6))
    case = made.outcome(0).case
    # Level 0 has no psi.
    assert frame[start].row(5) == (case.x_pov0_m, case.v_pov0_mps, None)
    assert set(frame["severity"]) == {made.outcome(i).measures.severity for i in (0, 3)}
    assert set(frame["case"]) == {0, 3}
    assert frame["time_s"][5] == pytest.approx(5 * DT_S)


def test_a_cases_file_of_more_says_how_many_it_has(tmp_path):
    run = write_run(tmp_path / "run", per_level=15)
    with pytest.warns(Notice, match="^the file has 40 of 45 cases"):
        ms.export(run.folder, file_format="cases", out=tmp_path / "cases.toml")
    with pytest.raises(UserError, match=r"must end in \.csv"):
        ms.export(run.folder, file_format="csv", out=tmp_path / "table.txt")
