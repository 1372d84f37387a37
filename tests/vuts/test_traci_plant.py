"""A controller with a vehicle model of its own: the speeds that it reaches move the VUT."""

# mypy: no-strict-optional

from __future__ import annotations

import math
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import traci
from controllers import STOCK_CLIENT, program
from traci_pair import Drive
from vut_contract import factory, in_process, run_on

from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.imperfection import Actuation
from merge_sumo.vuts.traci.session import NotFiniteError

LAW = """
from math import sin

def wanted_mps2(t_s, v_pov_mps, v_vut_mps):
    return 2.5 * sin(0.9 * t_s) + 0.3 * (v_pov_mps - v_vut_mps)

def act(seen):
    return wanted_mps2(seen.t_s, seen.v_pov_mps, seen.v_vut_mps), seen.x_vut_m > -50.0
"""
COSIMULATION = (
    STOCK_CLIENT
    + LAW
    + """
from math import exp
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.road.merge import road_for

vehicle, scenario = traci.vehicle, named_scenario(sys.argv[3])
road, by = road_for(scenario), sys.argv[2]
starts_m = {piece.lane: piece.start_m for piece in road.ramp.pieces}
decay = exp(-0.1 / 0.3)
while traci.simulation.getMinExpectedNumber() > 0:
    traci.simulationStep()
    if "vut" not in vehicle.getIDList():
        continue
    if "vut" in traci.simulation.getDepartedIDList():
        step, a, merges = 0, 0.0, False
        x, v = starts_m[vehicle.getLaneID("vut")] + vehicle.getLanePosition("vut"), None
    u = wanted_mps2(0.1 * step, vehicle.getSpeed("pov"), vehicle.getSpeed("vut"))
    u = min(max(u, scenario.a_min_mps2), scenario.a_max_mps2)
    # The vehicle model drives by itself: it reads back neither its speed nor, but for one way
    # to use it, its place.
    v = vehicle.getSpeed("vut") if v is None else v
    v = max(v + 0.1 * (u + (a - u) * 3.0 * (1.0 - decay)), 0.0)
    a = u + (a - u) * decay
    if by == "getPosition":
        x = road.ramp.nearest(*vehicle.getPosition("vut"))[1]
    x, step = x + 0.1 * v, step + 1
    lane = vehicle.getLaneID("vut")
    if road.lane_m is not None and lane in starts_m:
        merges |= starts_m[lane] + vehicle.getLanePosition("vut") > -50.0
    if by == "setPreviousSpeed":
        if merges and lane == "lane_0":
            vehicle.changeLane("vut", 1, 0.0)
        vehicle.setPreviousSpeed("vut", v)
        vehicle.setSpeed("vut", 1.0)
    else:
        path = road.mainline if merges else road.ramp
        vehicle.moveToXY("vut", "", -1, *path.point(x)[2:4], keepRoute=2)
traci.close()
"""
)


def lagged(tmp_path, scenario, law, count):
    """Return the motion of a law behind the actuator of the scenario."""
    (tmp_path / "law.py").write_text(law)
    behind = replace(scenario, act=Actuation(lag_s=0.3))
    return run_on(in_process(f"{tmp_path / 'law.py'}:act"), behind, 0, count, corridors=1)


@pytest.mark.parametrize(
    ("name", "by"),
    [
        *(("us23", by) for by in ("setPreviousSpeed", "moveToXY", "getPosition")),
        *(("roundabout", by) for by in ("setPreviousSpeed", "moveToXY", "getPosition")),
        *(("us23-lane", by) for by in ("setPreviousSpeed", "moveToXY")),
    ],
)
def test_a_vehicle_model_with_a_lag_moves_as_the_actuator_with_the_same_lag(tmp_path, name, by):
    scenario = named_scenario(name)
    command = program(tmp_path, COSIMULATION) + f" {by} {name}"
    ours = run_on(factory("traci:" + command, deadline_s=20.0), scenario, 0, 3, corridors=1)
    for one, other in zip(ours, lagged(tmp_path, scenario, LAW, 3), strict=True):
        assert one.error is None
        for mine, theirs in ((one.motion, other.motion), (one.after, other.after)):
            assert mine[..., :2] == pytest.approx(theirs[..., :2], abs=1e-6, rel=0)
        assert np.ptp(one.v_vut_mps) > 1.0


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    made = Drive(tmp_path_factory.mktemp("drive"))
    yield made
    made.close()


def stepped(drive):
    """Make a step, answer it, and return the speed of the VUT."""
    drive.step()
    drive.session.results()
    return drive.speeds()[0]


def moved(drive, x_m):
    """Move the VUT to a place of its path, as a client does."""
    drive.ours.vehicle.moveToXY("vut", "", -1, *drive.road.ramp.point(x_m)[2:4], keepRoute=2)


def test_a_reached_speed_goes_before_commands_and_places_in_its_step_alone(drive):
    for order in permutations(range(3)):
        drive.begin()
        commands = (
            lambda: drive.ours.vehicle.setPreviousSpeed("vut", 18.15, 1.5),
            lambda: drive.ours.vehicle.setSpeed("vut", 17.9),
            lambda: moved(drive, -182.0 + 1.83),
        )
        for place in order:
            commands[place]()
        assert stepped(drive) == pytest.approx(18.15, abs=1e-12)
        assert stepped(drive) == pytest.approx(17.9, abs=1e-12)


def test_where_nothing_else_is_commanded_the_vut_keeps_the_speed_that_it_reached(drive):
    drive.begin()
    drive.ours.vehicle.setPreviousSpeed("vut", 18.15)
    assert [stepped(drive) for _ in range(3)] == pytest.approx([18.15] * 3, abs=1e-12)
    drive.ours.vehicle.setPreviousSpeed("vut", 25.0)
    assert [stepped(drive) for _ in range(3)] == pytest.approx([18.35] * 3, abs=1e-12)


def test_it_acts_in_all_steps_that_a_client_makes_at_once_and_in_no_other_episode(drive):
    drive.begin()
    drive.ours.vehicle.setPreviousSpeed("vut", 18.15)
    drive.step()
    drive.step()
    assert drive.speeds()[0] == pytest.approx(18.15, abs=1e-12)
    drive.again()
    assert stepped(drive) == 18.0


def test_points_count_from_the_one_before_and_the_first_from_where_the_vut_is(drive):
    drive.begin()
    speeds, x_m = [18.1, 18.2, 18.05, 17.9, 18.0], -182.0
    for v_mps in speeds:
        x_m += 0.1 * v_mps
        moved(drive, x_m)
        assert stepped(drive) == pytest.approx(v_mps, abs=1e-9)
        point = drive.road.ramp.point(x_m)[2:4]
        assert drive.ours.vehicle.getPosition("vut") == point
        assert drive.ours.vehicle.getPosition3D("vut") == (*point, 0.0)
    assert drive.x_m[1] == pytest.approx(x_m - 0.1 * (speeds[-1] - 18.0), abs=1e-9), "eq. (4)"
    place_m = drive.road.ramp.before_m + drive.x_m[1]
    assert drive.ours.vehicle.getLanePosition("vut") == pytest.approx(place_m, abs=1e-9)
    stepped(drive)
    point = drive.road.ramp.point(drive.x_m[1])[2:4]
    assert drive.ours.vehicle.getPosition("vut") == point
    moved(drive, drive.x_m[1] + 1.81)
    assert stepped(drive) == pytest.approx(18.1, abs=1e-9)
    assert drive.session.notes == []


def test_points_beside_the_lane_count_by_their_nearest_and_those_away_are_refused(drive):
    drive.begin()
    x, y = drive.road.ramp.point(-182.0 + 1.81)[2:4]
    heading = math.radians(drive.road.ramp.point(-180.0).angle_deg)
    right = math.cos(heading), -math.sin(heading)
    for away_m in (-1.9, 1.9):
        drive.ours.vehicle.moveToXY("vut", "none", 7, x + away_m * right[0], y + away_m * right[1])
        assert drive.session._reached_mps == {"vehicle.moveToXY": pytest.approx(18.1, abs=1e-6)}
    for point, said in (
        ((x + 2.5 * right[0], y + 2.5 * right[1]), r"this one is 2\.5 m away"),
        ((1e308, -1e308), "this one is nan m away"),
        ((1e200, 0.0), r"this one is 1e\+200 m away"),
    ):
        with pytest.raises(traci.TraCIException, match=said):
            drive.ours.vehicle.moveToXY("vut", "", -1, *point)
    assert stepped(drive) == pytest.approx(18.1, abs=1e-6)


def test_what_cannot_have_been_reached_is_refused_or_a_fault(drive):
    drive.begin()
    vehicle = drive.ours.vehicle
    with pytest.raises(traci.TraCIException, match="Previous speed must not be negative"):
        vehicle.setPreviousSpeed("vut", -0.1)
    for name, said in (("pov", "'pov' is not the controller's to command"), ("x", "not known")):
        with pytest.raises(traci.TraCIException, match=said):
            vehicle.setPreviousSpeed(name, 1.0)
        with pytest.raises(traci.TraCIException, match=said):
            vehicle.moveToXY(name, "", -1, 0.0, 0.0)
    with pytest.raises(traci.TraCIException, match="was given no number"):
        vehicle._setCmd(traci.constants.VAR_PREV_SPEED, "vut", "s", "fast")
    assert stepped(drive) == 18.0


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("function", "before"), [("setPreviousSpeed", ()), ("moveToXY", ("", -1, 0.0))]
)
def test_what_is_no_number_is_a_fault(drive, function, before, value):
    drive.begin()
    with pytest.raises(NotFiniteError, match=rf"vehicle\.{function}\("):
        getattr(drive.ours.vehicle, function)("vut", *before, value)


def test_the_speed_that_the_driver_of_sumo_wanted_can_still_be_asked_for(drive):
    drive.begin((-900.0, 1.0))
    drive.ours.vehicle.setSpeedMode("vut", 31)
    drive.ours.vehicle.setSpeed("vut", -1.0)
    drive.ours.vehicle.setPreviousSpeed("vut", 18.02)
    assert stepped(drive) == pytest.approx(18.02, abs=1e-12)
    assert drive.ours.vehicle.getSpeedWithoutTraCI("vut") == pytest.approx(18.2, abs=1e-9)


LEAPS = """
while traci.simulation.getMinExpectedNumber() > 0:
    traci.simulationStep()
    if "vut" not in traci.vehicle.getIDList():
        continue
    seed = int(traci.vehicle.getParameter("vut", "seed"))
    v_mps = traci.vehicle.getSpeed("vut")
    leaps = "vut" in traci.simulation.getDepartedIDList()
    traci.vehicle.setPreviousSpeed("vut", v_mps + (5.0 if leaps else seed % 1000 * 1e-4))
traci.close()
"""


def test_limits_clip_a_reached_speed_which_is_said_and_each_case_has_its_seed(tmp_path):
    command, log = program(tmp_path, STOCK_CLIENT + LEAPS), tmp_path / "controller.log"
    vut = factory("traci:" + command, deadline_s=20.0, log=log)
    found = run_on(vut, named_scenario("us23"), 0, 3, corridors=1)
    for trajectory in found:
        assert trajectory.error is None
        assert trajectory.clipped_steps == 1
        expected = trajectory.case.told_seed % 1000 * 1e-3
        assert trajectory.a_vut_mps2[:4] == pytest.approx([2.0, *[expected] * 3], abs=1e-9)
    assert len({trajectory.case.told_seed for trajectory in found}) == 3
    (note,) = log.read_text().splitlines()
    assert "outside -4 to 2 m/s2" in note
    assert "clipped_steps" in note
