"""Answers with a layout of their own, against a real SUMO where there is something to answer."""

# mypy: no-strict-optional

from __future__ import annotations

import subprocess
from contextlib import closing, contextmanager

from support.traci_pair import (
    Pair,
    ToSession,
    answer,
    close_mirror,
    end_program,
    mirror,
    open_program,
)

from merge_sumo.controllers.traci.session import Session
from merge_sumo.sumo.binding import sumo_program
from merge_sumo.sumo.mirror import NET


@contextmanager
def lit_crossing(folder):
    """Give connections to our SUMO and a real one, each with two cars before a traffic light."""
    sumo = mirror(folder)
    netgenerate = [sumo_program("netgenerate"), "--grid", "--grid.number", "3"]
    netgenerate += ["--grid.length", "90", "-j", "traffic_light", "-o", str(folder / NET)]
    subprocess.run(netgenerate, check=True, capture_output=True)
    process, real = open_program(folder)
    sumo._libsumo.load(sumo._options)
    ours = ToSession(Session(sumo))
    try:
        for api in (sumo._libsumo, real):
            api.route.add("r.vut", ["A1B1", "B1C1"])
            api.route.add("r.pov", ["B0B1", "B1B2"])
            for name in ("vut", "pov"):
                api.vehicle.add(name, f"r.{name}", typeID=name, departPos="20", departSpeed="9")
            api.vehicle.setStop("vut", "B1C1", 60.0, 0, 2.0)
            for _ in range(10):
                api.simulation.step()
        sumo.at_m = {"vut": 0.0}
        yield ours, real
    finally:
        close_mirror()
        end_program(process)


def test_questions_of_collisions_get_what_a_real_sumo_says(tmp_path):
    with closing(Pair(tmp_path, pov=(-184.0, 18.0), change_mps=0.0, steps=110)) as pair:
        question = "simulation", "getCollisions", ()
        ours, real = answer(pair.ours, *question), answer(pair.real, *question)
    assert "'collider': \"'pov'\"" in ours
    assert ours == real


def test_questions_of_lights_and_stops_get_what_a_real_sumo_says(tmp_path):
    with lit_crossing(tmp_path) as connections:
        ours, real = connections
        for question in (
            ("vehicle", "getNextTLS", ("vut",)),
            ("vehicle", "getStops", ("vut",)),
            ("vehicle", "getNextStops", ("vut",)),
            ("vehicle", "getJunctionFoes", ("vut", 500.0)),
            ("lane", "getFoes", (real.vehicle.getLaneID("vut"), "B1C1_0")),
        ):
            told = answer(real, *question)
            assert answer(ours, *question) == told
            assert len(told) > 4, question
