"""The mirror simulation: its vehicles are where ours are, on whatever road."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.foreign_nets import LANE_M, LANES, foreign_lane_road
from support.traci_pair import ToSession, close_mirror, mirror

from merge_sumo.controllers.traci.session import Session
from merge_sumo.road.loader import road_for
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.scenario import DT_S, US23, VEHICLES


@pytest.fixture(autouse=True)
def _closed_in_the_end():
    yield
    close_mirror()


@pytest.mark.parametrize("name", ["roundabout", "us23-traffic"])
def test_the_mirror_has_every_vehicle_in_its_state(name, tmp_path):
    scenario = named_scenario(name)
    road = road_for(scenario)
    sumo = mirror(tmp_path, scenario, road)
    for episode in range(2):  # they may come again
        for step in range(60):
            states = {}
            for number, who in enumerate(VEHICLES[: scenario.vehicles]):
                states[who] = -40.0 - 30.0 * number + step, 10.0, 0.5
            if step:
                sumo.step()
                sumo.put(states)
            else:
                sumo.enter(states)
            for who, (x_m, v_mps, a_mps2) in states.items():
                point = road.lane_point(x_m, on_ramp=who == "vut")
                assert sumo.call("vehicle.getLaneID", who) == point.lane
                at_m = sumo.call("vehicle.getLanePosition", who)
                assert at_m == pytest.approx(point.position_m, abs=1e-9)
                assert sumo.call("vehicle.getSpeed", who) == v_mps
                assert sumo.call("vehicle.getAcceleration", who) == a_mps2
        assert sumo.time_s == pytest.approx(6.0 * (episode + 1))
        sumo.clear()
        assert sumo.call("vehicle.getIDList") == ()


def test_a_vehicle_beyond_the_end_of_the_net_arrives_and_the_others_are_answered_for(tmp_path):
    scenario = named_scenario("roundabout")
    session = Session(mirror(tmp_path, scenario, road_for(scenario)))
    vehicle, vut = ToSession(session).vehicle, (-40.0, 10.0, 0.0)
    session.enter({"pov": (-50.0, 10.0, 0.0), "vut": vut})
    session.step()
    session.put({"pov": (600.0, 10.0, 0.0), "vut": vut})
    assert vehicle.getIDList() == ("vut",)
    assert vehicle.getSpeed("vut") == 10.0
    assert session.sumo.arrived == ["pov"]
    session.step()
    session.put({"vut": (250.0, 10.0, 0.0)})
    assert session.step() is None, "the VUT is beyond the end: it cannot be commanded"
    assert vehicle.getIDList() == ()


@pytest.mark.parametrize("name", LANES)
def test_a_lane_change_anywhere_on_an_acceleration_lane_is_a_merge_request(name, tmp_path):
    road = foreign_lane_road(name, tmp_path)
    session = Session(mirror(tmp_path, replace(US23, lane_m=LANE_M), road))
    vehicle, v_mps = ToSession(session).vehicle, 15.0
    begin_m, end_m = road.used_lane_m or (0.0, 0.0)
    for merges_m in (begin_m + 1.0, (begin_m + end_m) / 2.0, end_m - 8.0, None):
        x_m, merged = begin_m - 20.0, False
        session.enter({"pov": (x_m - 90.0, v_mps, 0.0), "vut": (x_m, v_mps, 0.0)})
        while x_m < end_m + 40.0:
            wishes = merges_m is not None and x_m >= merges_m and not merged
            if wishes:
                vehicle.changeLane("vut", vehicle.getLaneIndex("vut") + 1, 0.0)
            assert session.step() == v_mps
            assert merged or session.sumo.requests_merge == wishes
            x_m += v_mps * DT_S
            merged = merged or wishes or x_m >= end_m
            states = {"pov": (x_m - 90.0, v_mps, 0.0), "vut": (x_m, v_mps, 0.0)}
            session.put(states, merged=merged)
            point = road.lane_point(x_m, on_ramp=not merged)
            assert vehicle.getLaneID("vut") == point.lane
            assert vehicle.getLanePosition("vut") == pytest.approx(point.position_m, abs=1e-9)
        session.step()
        session.sumo.clear()
