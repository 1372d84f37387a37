"""What a TraCI client commands, next to a real SUMO that is commanded the same."""

# mypy: no-strict-optional

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
import traci
from hypothesis import given, settings
from hypothesis import strategies as st
from support.controllers import STOCK_CLIENT, program
from support.traci_pair import Drive
from support.vut_contract import factory, in_process, run_on

from merge_sumo.controllers.traci import protocol
from merge_sumo.controllers.traci.session import NotFiniteError
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.imperfection import Actuation
from merge_sumo.sumo.traci_names import pack

LIMITS: dict[int, list[tuple]] = {
    0: [("vehicletype", "setAccel", 0.7), ("vehicle", "setDecel", 1.3), ("vehicle", "setTau", 3.0)],
    1: [("vehicle", "setSpeed", 30.0), ("vehicle", "setMaxSpeed", 18.5)],
    8: [("vehicle", "setSpeed", 10.0)],
    12: [("vehicle", "setMaxSpeed", 17.9)],
}
"""Commands on the VUT by step."""
READS = ("getMaxSpeed", "getAccel", "getDecel", "getTau", "getAllowedSpeed")


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    made = Drive(tmp_path_factory.mktemp("drive"))
    yield made
    made.close()


def test_the_speeds_and_the_answers_that_follow_are_those_of_sumo(drive):
    drive.begin()
    for step in range(14):
        for domain, function, value in LIMITS.get(step, ()):
            for connection in (drive.ours, drive.real):
                getattr(getattr(connection, domain), function)("vut", value)
        drive.step()
        ours, real = drive.speeds()
        assert ours == pytest.approx(real, abs=1e-9), step
    for question in READS:
        ours, real = (getattr(c.vehicle, question)("vut") for c in (drive.ours, drive.real))
        assert ours == pytest.approx(real, abs=1e-9)
    ours = drive.ours.vehicle
    first, later = (ours.getDrivingDistance("vut", "main_out", place) for place in (0.0, 20.0))
    assert later == ours.getDrivingDistance2D("vut", 20.0, 0.0) == pytest.approx(first + 20.0)


@pytest.mark.parametrize(
    "commands",
    [
        (("setSpeedMode", 31), ("setTau", 3.0), ("setSpeed", -1.0)),
        (("openGap", 3.0, 30.0, 5.0, 1.0), ("setSpeed", -1.0)),
        (("setStop", "main_out", 60.0, 0, 2.0), ("setSpeed", -1.0)),
        (("setAcceleration", 1.0, 0.3),),
    ],
    ids=lambda commands: commands[0][0],
)
def test_sumo_drives_the_vut_as_the_same_commands_have_it_drive_a_car(drive, commands):
    """What differs is eq. (4), which moves by the speed before the step."""
    drive.begin((-900.0, 1.0))
    for function, *values in commands:
        for connection in (drive.ours, drive.real):
            getattr(connection.vehicle, function)("vut", *values)
    apart_mps = []
    for _ in range(60):
        drive.step()
        ours, real = drive.speeds()
        apart_mps.append(abs(ours - real))
    # A stop ends a step sooner or later.
    assert max(apart_mps) < (2.0 if commands[0][0] == "setStop" else 0.4)
    assert ours != pytest.approx(18.0, abs=1e-3)


@pytest.mark.parametrize(
    ("function", "values"),
    [
        ("setSpeed", (math.nan,)),
        ("slowDown", (math.inf, 1.0)),
        ("setPreviousSpeed", (math.nan,)),
        ("moveToXY", ("", -1, 0.0, -math.inf)),
    ],
)
def test_a_number_that_is_not_finite_is_a_fault(drive, function, values):
    drive.begin()
    with pytest.raises(NotFiniteError, match=rf"vehicle\.{function}\("):
        getattr(drive.ours.vehicle, function)("vut", *values)


@pytest.mark.parametrize(
    ("domain", "function", "arguments"),
    [
        ("vehicle", "add", ("new", "route.vut")),
        ("vehicle", "setTau", ("pov", 1.0)),
        ("vehicle", "setTau", ("vut", -1.0)),
        ("vehicletype", "setTau", ("pov", 1.0)),
        ("vehicle", "setPreviousSpeed", ("pov", 1.0)),
        ("edge", "setMaxSpeed", ("ramp", 5.0)),
        ("simulation", "saveState", ("x.xml",)),
    ],
)
def test_commands_on_other_objects_or_with_invalid_values_are_refused(
    drive, domain, function, arguments
):
    drive.begin()
    with pytest.raises(traci.TraCIException) as error:
        getattr(getattr(drive.ours, domain), function)(*arguments)
    assert f"{domain}.{function}" in str(error.value) or "command 'pov'" in str(error.value)


def test_only_keys_of_the_controllers_own_reach_sumo(drive):
    drive.begin()
    drive.ours.vehicle.setParameter("vut", "mine", "7")
    assert drive.ours.vehicle.getParameter("vut", "mine") == "7"
    drive.ours.vehicle.setParameter("vut", "has.ssm.device", "true")
    drive.step()
    assert "vehicle.setParameter" in str(drive.session.in_vain)
    with pytest.raises(traci.TraCIException, match="no device of type 'ssm' exists"):
        drive.ours.vehicle.getParameter("vut", "device.ssm.file")


class TestBytes:
    VUT = protocol.string("vut")
    COMMANDS = (
        protocol.command(b"\xc4\x40" + VUT + pack("d", 3.0)),
        protocol.command(b"\xa4\x68" + VUT + pack("d", 9.0)),
        protocol.command(b"\xa4\x83" + VUT + protocol.compound(2, pack("r", ("a", 1, 0)))),
        protocol.command(b"\xab\x82" + protocol.string("") + protocol.compound(2, b"\1" * 17)),
        protocol.command(b"\xd4" + struct.pack("!dd", 0, 9) + VUT + b"\1@"),
        protocol.command(b"\x84" + struct.pack("!dd", 0, 9) + VUT + b"\xa3" + b"\0" * 9),
        protocol.command(b"\x02" + struct.pack("!d", 0.0)),
    )

    @settings(max_examples=100, deadline=None)
    @given(st.data())
    def test_of_any_kind_are_answered_or_refused_or_a_protocol_error(self, drive, data):
        content = bytearray(b"".join(data.draw(st.lists(st.sampled_from(self.COMMANDS)))))
        for _ in range(data.draw(st.integers(0, 5))):
            if content:
                place = data.draw(st.integers(0, len(content) - 1))
                content[place] = data.draw(st.integers(0, 255))
        drive.restart()
        try:
            commands = protocol.commands_of(bytes(content)[: data.draw(st.integers(0, 400))])
        except protocol.ProtocolError:
            return
        for one in commands:
            try:
                answer = drive.session.handle(one)
            except (protocol.ProtocolError, NotFiniteError):
                continue
            first, *_ = protocol.commands_of(answer)
            assert first.identifier == one.identifier
            assert answer[0] > 0, "clients read the length of a status as one byte"
        drive.session.results()
        drive.session.step()
        assert "vut" in drive.session.sumo.at_m


class TestAVehicleModelOfItsOwn:
    LAW = "def act(seen):\n    return 2.5 * sin(0.9 * seen.t_s), True\n"
    MODEL = """
from math import exp, sin
from merge_sumo.road.loader import road_of

vehicle, ramp, decay = traci.vehicle, road_of().ramp, exp(-0.1 / 0.3)
while traci.simulation.getMinExpectedNumber() > 0:
    traci.simulationStep()
    if "vut" not in vehicle.getIDList():
        continue
    if "vut" in traci.simulation.getDepartedIDList():
        step, a, v = 0, 0.0, vehicle.getSpeed("vut")
        x = ramp.pieces[0].start_m + vehicle.getLanePosition("vut")
    u = min(max(2.5 * sin(0.9 * (0.1 * step)), -4.0), 2.0)
    v = max(v + 0.1 * (u + (a - u) * 3.0 * (1.0 - decay)), 0.0)
    a = u + (a - u) * decay
    x, step = x + 0.1 * v, step + 1
    if sys.argv[2] == "setPreviousSpeed":
        vehicle.setPreviousSpeed("vut", v)
        vehicle.setSpeed("vut", 1.0)
    else:
        vehicle.moveToXY("vut", "", -1, *ramp.point(x)[2:4], keepRoute=2)
traci.close()
"""

    @pytest.mark.parametrize("by", ["setPreviousSpeed", "moveToXY"])
    def test_with_a_lag_moves_as_the_actuator_with_the_same_lag(self, tmp_path, by):
        (tmp_path / "law.py").write_text("from math import sin\n\n" + self.LAW)
        scenario = named_scenario("us23")
        command = program(tmp_path, STOCK_CLIENT + self.MODEL) + f" {by}"
        ours = run_on(factory("traci:" + command, deadline_s=20.0), scenario, 0, 2, corridors=1)
        lagged = replace(scenario, act=Actuation(lag_s=0.3))
        law = in_process(f"{tmp_path / 'law.py'}:act")
        for one, other in zip(ours, run_on(law, lagged, 0, 2, corridors=1), strict=True):
            assert one.error is None
            mine, theirs = one.motion[..., :2], other.motion[..., :2]
            assert mine == pytest.approx(theirs, abs=1e-6, rel=0)
            assert np.ptp(one.v_vut_mps) > 1.0

    def test_goes_before_commands_and_places_in_its_step_alone(self, drive):
        drive.begin()
        place = drive.road.ramp.point(-182.0 + 1.83)[2:4]
        drive.ours.vehicle.setPreviousSpeed("vut", 18.15, 1.5)
        drive.ours.vehicle.setSpeed("vut", 17.9)
        drive.ours.vehicle.moveToXY("vut", "", -1, *place, keepRoute=2)
        drive.step()
        drive.session.results()
        assert drive.speeds()[0] == pytest.approx(18.15, abs=1e-12)
        assert drive.ours.vehicle.getPosition("vut") == place
        drive.step()
        assert drive.speeds()[0] == pytest.approx(17.9, abs=1e-12)

    def test_cannot_be_away_from_the_lane(self, drive):
        drive.begin()
        x, y = drive.road.ramp.point(-182.0)[2:4]
        with pytest.raises(traci.TraCIException, match="m away"):
            drive.ours.vehicle.moveToXY("vut", "", -1, x, y + 9.0)
