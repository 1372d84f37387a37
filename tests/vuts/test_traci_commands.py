"""What a TraCI client commands, and what SUMO does with the same commands on an open road."""

from __future__ import annotations

import inspect
import math
import struct
import warnings

import pytest
import traci
from traci_pair import Drive

from merge_sumo.sumo.traci_names import EXAMPLES, functions
from merge_sumo.vuts.traci.session import QUESTIONS, Effect, NotFiniteError, effect_of

V, T = "vehicle", "vehicletype"
SCRIPTS: dict[str, list[tuple]] = {
    "all three": [
        (0, V, "setAccel", 0.7),
        (0, V, "setDecel", 1.3),
        (0, V, "setMaxSpeed", 18.5),
        (0, V, "setSpeed", 30.0),
        (8, V, "setSpeed", 10.0),
        (12, V, "setMaxSpeed", 17.9),
    ],
    "an acceleration after another": [
        (0, V, "setAcceleration", 1.0, 0.5),
        (3, V, "setAcceleration", -2.0, 1.5),
    ],
    "numbers of the car-following model": [
        (0, V, "setTau", 3.0),
        (0, V, "setMinGap", 9.0),
        (0, V, "setImperfection", 0.5),
        (0, V, "setApparentDecel", 2.0),
        (0, V, "setEmergencyDecel", 9.0),
        (0, V, "setSpeedFactor", 0.3),
        (1, V, "setSpeed", 18.3),
    ],
    "limits of the type behind its own": [
        (0, T, "setAccel", 0.8),
        (0, V, "setDecel", 1.1),
        (1, T, "setAccel", 0.1),
        (1, T, "setDecel", 0.1),
        (1, V, "setSpeed", 25.0),
        (7, V, "setSpeed", 10.0),
    ],
}
READS = (
    *("getMaxSpeed", "getAccel", "getDecel", "getEmergencyDecel", "getApparentDecel", "getTau"),
    *("getMinGap", "getImperfection", "getSpeedFactor", "getAllowedSpeed", "getTypeID"),
    *("getSpeedMode", "getLaneChangeMode", "getSpeed", "getColor"),
)


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    made = Drive(tmp_path_factory.mktemp("drive"))
    yield made
    made.close()


@pytest.mark.parametrize("name", SCRIPTS)
def test_the_speeds_and_the_answers_that_follow_are_those_of_sumo(drive, name):
    drive.begin()
    for step in range(14):
        for at, domain, function, *values in SCRIPTS[name]:
            if at == step:
                drive.both(
                    lambda c, d=domain, f=function, v=values: getattr(getattr(c, d), f)("vut", *v)
                )
        drive.step()
        ours, real = drive.speeds()
        assert ours == pytest.approx(real, abs=1e-9), step
    for question in READS:
        ours, real = drive.both(lambda c, q=question: getattr(c.vehicle, q)("vut"))
        assert ours == pytest.approx(real, abs=1e-9) if isinstance(real, float) else ours == real
    for question in ("getMaxSpeed", "getAccel", "getDecel", "getTau"):
        ours, real = drive.both(lambda c, q=question: getattr(c.vehicletype, q)("vut"))
        assert ours == real


@pytest.mark.parametrize("value", [-1.0, float("inf")])
@pytest.mark.parametrize(
    "function",
    [
        *("setMaxSpeed", "setAccel", "setDecel", "setEmergencyDecel", "setApparentDecel"),
        *("setTau", "setMinGap", "setImperfection"),
    ],
)
def test_numbers_that_cannot_be_are_refused_as_by_sumo(drive, function, value):
    drive.begin()

    def refused(c):
        with pytest.raises(traci.TraCIException, match="Invalid"):
            getattr(c.vehicle, function)("vut", value)

    drive.both(refused)
    drive.both(lambda c: c.vehicle.setSpeed("vut", 18.1))
    drive.step()
    assert drive.speeds() == pytest.approx((18.1, 18.1))


class TestWhatSumoDecides:
    """What the emulation of commands could not do: SUMO's own models drive the VUT."""

    FOLLOWS = (
        ("car-following in mode 31", ("setSpeedMode", 31), ("setSpeed", -1.0)),
        ("a headway", ("setSpeedMode", 31), ("setTau", 3.0), ("setSpeed", -1.0)),
        ("a gap that is opened", ("openGap", 3.0, 30.0, 5.0, 1.0), ("setSpeed", -1.0)),
        ("a stop", ("setStop", "main_out", 60.0, 0, 2.0), ("setSpeed", -1.0)),
        ("an acceleration that runs out", ("setAcceleration", 1.0, 0.3)),
        ("slowing down that runs out", ("slowDown", 17.0, 0.5)),
    )

    @pytest.mark.parametrize(("name", "commands"), [(n, c) for n, *c in FOLLOWS])
    def test_moves_the_vut_as_the_same_commands_move_a_car_of_sumo(self, drive, name, commands):
        """What differs is eq. (4), which moves by the speed before the step."""
        drive.begin((-900.0, 1.0))
        for function, *values in commands:
            drive.both(lambda c, f=function, v=values: getattr(c.vehicle, f)("vut", *v))
        apart = []
        for _ in range(60):
            drive.step()
            ours, real = drive.speeds()
            apart.append(abs(ours - real))
        # A stop ends a step sooner or later.
        assert max(apart) < (2.0 if name == "a stop" else 0.4)
        assert ours != pytest.approx(18.0, abs=1e-3)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("function", ["setSpeed", "slowDown", "setAcceleration"])
def test_a_speed_that_is_no_number_is_a_fault(drive, function, value):
    drive.begin()
    values = (value,) if function == "setSpeed" else (value, 1.0)
    with pytest.raises(NotFiniteError, match=rf"vehicle\.{function}\("):
        getattr(drive.ours.vehicle, function)("vut", *values)


@pytest.mark.parametrize(
    ("domain", "function", "arguments"),
    [
        ("vehicle", "add", ("new", "route.vut")),
        ("vehicle", "setActionStepLength", ("vut", 1.0)),
        ("vehicle", "setTau", ("pov", 1.0)),
        ("vehicletype", "setTau", ("pov", 1.0)),
        ("edge", "setMaxSpeed", ("ramp", 5.0)),
        ("simulation", "saveState", ("x.xml",)),
    ],
)
def test_what_is_refused_is_named(drive, domain, function, arguments):
    drive.begin()
    with pytest.raises(traci.TraCIException) as error:
        getattr(getattr(drive.ours, domain), function)(*arguments)
    assert f"{domain}.{function}" in str(error.value) or "'pov' is not" in str(error.value)
    assert drive.ours.vehicle.getSpeed("vut") == 18.0


def test_devices_that_would_write_files_do_not_reach_sumo(drive, tmp_path):
    drive.begin()
    drive.ours.vehicle.setParameter("vut", "device.ssm.file", str(tmp_path / "written"))
    drive.ours.vehicle.setParameter("vut", "has.ssm.device", "true")
    drive.step()
    with pytest.raises(traci.TraCIException, match="no device of type 'ssm' exists"):
        drive.ours.vehicle.getParameter("vut", "device.ssm.file")
    assert list(tmp_path.iterdir()) == []


def test_a_parameter_of_the_controllers_own_is_kept(drive):
    drive.begin()
    drive.both(lambda c: c.vehicle.setParameter("vut", "mine", "7"))
    ours, real = drive.both(lambda c: c.vehicle.getParameter("vut", "mine"))
    assert ours == real == "7"
    drive.ours.vehicle.setParameter("pov", "mine", "7")
    assert drive.ours.vehicle.getParameter("pov", "mine") == ""


def test_what_is_commanded_in_vain_is_known_of_each_episode(drive):
    drive.begin()
    vehicle = drive.ours.vehicle
    vehicle.setColor("vut", (1, 2, 3, 4))
    vehicle.setParameter("vut", "mine", "7")
    drive.ours.gui.trackVehicle("View #0", "vut")
    vehicle.setSpeed("vut", 18.0)
    assert drive.session.in_vain == set(), "in SUMO neither changes how a car drives"
    vehicle.changeSublane("vut", 0.5)
    vehicle.changeLane("vut", 0, 1.0)
    lane = "vehicle.changeLane or vehicle.changeLaneRelative"
    assert drive.session.in_vain == {"vehicle.changeSublane", lane}
    drive.again()
    assert drive.session.in_vain == set()


def commanded(connection, function: str) -> str | None:
    """Return what is said to a command of the client on "vut"; None where it takes no dummies."""
    domain, _, name = function.partition(".")
    call = getattr(getattr(connection, domain), name)
    parameters = inspect.signature(call).parameters.values()
    needed = sum(p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD for p in parameters)
    off = {p.name: False for p in parameters if p.default is True}
    for dummy in EXAMPLES:
        try:
            call(*["vut", *[dummy] * (needed - 1)][:needed], **off)
        except traci.TraCIException as error:
            return str(error)
        except (TypeError, ValueError, LookupError, AttributeError, struct.error):
            connection._string, connection._queue = b"", []
        else:
            return ""
    return None


def test_every_command_that_the_client_has_goes_to_sumo_or_changes_nothing_or_is_refused(drive):
    """No command but those on the VUT and its type reaches SUMO, and none moves the VUT away."""
    effects = {f: effect_of(n) for n in functions().values() for f in n}
    names = [f for key, n in functions().items() if key[0] not in QUESTIONS for f in n]
    tried, called = 0, []
    for function in names:
        drive.begin()
        sumo = drive.session.sumo
        call = sumo.call

        def noted(name, *arguments, call=call):
            called.append((name, arguments[0]))
            return call(name, *arguments)

        with warnings.catch_warnings(), pytest.MonkeyPatch.context() as patch:
            warnings.simplefilter("ignore")
            patch.setattr(sumo, "call", noted)
            said = commanded(drive.ours, function)
        if said is None:
            continue
        tried += 1
        if effects[function] is Effect.REFUSED:
            assert said.startswith("merge-sumo does not carry out ")
            assert function in said
        elif effects[function] in (Effect.LOOKS, Effect.IN_VAIN):
            assert said == "", function
        assert drive.ours.vehicle.getLanePosition("vut") == pytest.approx(425.0 - 182.0)
    assert tried > 200
    assert {name.partition(".")[0] for name, _ in called} <= {"vehicle", "vehicletype"}
    assert {object_id for _, object_id in called} == {"vut"}
    assert {effects[name] for name, _ in called} == {Effect.CARRIED_OUT, Effect.OWN_KEYS}
