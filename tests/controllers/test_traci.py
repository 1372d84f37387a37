"""A controller behind TraCI: its view of the simulation, its starts, and its faults."""

# mypy: no-strict-optional

from __future__ import annotations

import os
import re
import socket
import sys
import threading
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import traci
from support.controllers import (
    STOCK_CLIENT,
    assert_drives_as_level0,
    free_port,
    program,
)
from support.histories import CASE
from support.processes import none_left
from support.vut_contract import cases_of, factory, run_cases, run_on

from merge_sumo.controllers.spec import ControllerOptions, ControllerSpec
from merge_sumo.controllers.traci import vut
from merge_sumo.controllers.traci.vut import TraciDriver, TraciKind
from merge_sumo.drivers.base import Scene
from merge_sumo.errors import UserError
from merge_sumo.road.loader import road_of
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.scenario import DT_S, US23, VUT
from merge_sumo.scenario.trajectory import End

PAGE = (Path(__file__).parents[2] / "docs/tutorials/traci-controller.md").read_text(
    encoding="utf-8"
)
CONTROLLER, ON_A_LANE = re.findall(
    r"```python.*?\n(import sys, traci.*?)```", PAGE, flags=re.DOTALL
)
"""The tutorial's controllers: one with the law of level 0, and one for an acceleration lane."""


class Played:
    """Episodes of eq. (4) with a client in a thread: accelerations, speeds and reasons."""

    def __init__(self, client, episodes=1, steps=30, deadline_s=5.0):
        self.port, self.result, self.error = free_port(), None, None
        self.speeds, self.accelerations, self.reasons = [], [], []
        thread = threading.Thread(target=self._client, args=(client,))
        thread.start()
        options = ControllerOptions(deadline_s=deadline_s, connect_s=10.0)
        kind = TraciKind(ControllerSpec("traci", str(self.port)), options)
        driver = TraciDriver(kind, road_of(), US23)
        try:
            for _ in range(episodes):
                driver.begin(0, CASE)
                self.reasons.append(self._reason(driver, steps))
        finally:
            driver.close()
            thread.join()
        if self.error is not None:
            raise self.error

    def _client(self, client):
        try:
            self.result = client(self.port)
        except (Exception, SystemExit) as error:
            self.error = error

    def _reason(self, driver, steps):
        x_m, v_mps = np.array([[-250.0], [-182.0]]), np.array([[30.0], [18.0]])
        for step in range(steps):
            (a_mps2,) = driver.act(Scene(np.array([True]), np.array([step]), x_m, v_mps))
            if not np.isfinite(a_mps2):
                return driver.reason(0)
            self.accelerations.append(a_mps2)
            x_m = x_m + v_mps * DT_S
            v_mps[VUT] += np.clip(a_mps2, US23.a_min_mps2, US23.a_max_mps2) * DT_S
            self.speeds.append(v_mps[VUT, 0])
        return None


def stock(function):
    """Return a client that speaks by the stock package: a function of its connection."""

    def client(port):
        connection = traci.connect(port, numRetries=200, waitBetweenRetries=0.02)
        try:
            return function(connection)
        finally:
            connection.close()

    return client


class TestAStockClient:
    def test_sees_vehicles_depart_and_arrive_while_time_continues_over_the_episodes(self):
        def drive(c):
            seen = []
            while c.simulation.getMinExpectedNumber() > 0:
                c.simulationStep()
                departed, arrived = (
                    c.simulation.getDepartedIDList(),
                    c.simulation.getArrivedIDList(),
                )
                seen.append((c.vehicle.getIDList(), departed, arrived))
                assert c.simulation.getTime() == pytest.approx(0.1 * len(seen))
            return seen

        both, none = ("pov", "vut"), ()
        episode = [(both, both, none), (both, none, none), (both, none, none), (none, none, both)]
        assert Played(stock(drive), episodes=2, steps=3).result == episode * 2

    def test_holds_the_speed_it_set_until_it_sets_another(self):
        def drive(c):
            c.simulationStep()
            c.vehicle.setSpeedMode("vut", 0)
            c.vehicle.setSpeed("vut", 18.3)
            c.simulationStep(c.simulation.getTime() + 0.35)
            c.vehicle.setSpeed("vut", 18.1)
            c.simulationStep(c.simulation.getTime() + 0.15)

        played = Played(stock(drive), steps=6)
        # Clipped to 2 m/s2 by who moves the vehicle; the wish itself is 3 m/s2.
        assert played.accelerations[:2] == pytest.approx([3.0, 1.0])
        assert played.speeds == pytest.approx([18.2, 18.3, 18.3, 18.3, 18.1, 18.1])

    def test_gets_what_it_subscribed_to_whenever_the_vehicles_are_there(self):
        speed = traci.constants.VAR_SPEED

        def drive(c):
            c.simulationStep()
            c.vehicle.subscribe("vut", [speed])
            c.vehicle.setSpeed("vut", 18.1)
            seen = []
            for _ in range(4):
                c.simulationStep()
                seen.append(dict(c.vehicle.getAllSubscriptionResults()))
            return seen

        seen = Played(stock(drive), episodes=2, steps=3).result
        assert seen[:3] == [{"vut": {speed: pytest.approx(18.1)}}] * 2 + [{}]
        assert seen[3] == {"vut": {speed: 18.0}}, "the next episode"


@pytest.mark.slow
def test_the_controller_of_the_tutorial_drives_like_the_same_law_in_process(tmp_path):
    command = program(tmp_path, CONTROLLER)
    assert_drives_as_level0(factory("traci:" + command), cases_of(20))


def test_the_controller_of_the_tutorial_merges_into_a_gap_on_an_acceleration_lane(tmp_path):
    vut = factory("traci:" + program(tmp_path, ON_A_LANE), deadline_s=20.0)
    *_, after_the_pov = run_on(vut, named_scenario("us23-lane"), 0, 4, corridors=1)
    assert after_the_pov.error is None
    assert -60.0 < after_the_pov.x_vut_m[-1] < 20.0
    assert after_the_pov.x_pov_m[-2] - after_the_pov.x_vut_m[-2] > 25.0


EPISODES = """import sys, traci
for _ in range(2):
    traci.init(int(sys.argv[1]))
    traci.simulationStep()
    while "vut" in traci.vehicle.getIDList():
        traci.vehicle.setSpeed("vut", min(traci.vehicle.getSpeed("vut") + 0.1, 28.0))
        traci.simulationStep()
    traci.close()
"""


def test_a_program_may_connect_for_every_episode_and_is_started_again_when_it_has_ended(tmp_path):
    head = f"open({str(tmp_path / 'started')!r}, 'a').write('.')\n"
    command, cases = program(tmp_path, head + EPISODES), cases_of(4)
    assert_drives_as_level0(factory("traci:" + command), cases)
    assert len((tmp_path / "started").read_text()) == 2


SENDS = "s = traci.getConnection()._socket\ns.sendall({!r})\ns.recv(1)"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("misdeed", "reason"),
    [
        ("1 / 0", "ended with exit code 1: ZeroDivisionError: division by zero"),
        ("traci.close()", "the controller closed the connection during the episode"),
        (
            SENDS.format(b"\x7f\xff\xff\xff"),
            "not TraCI: a message of 2147483647 bytes was announced",
        ),
        ("traci.vehicle.setSpeed('vut', float('nan'))", "commanded vehicle.setSpeed(nan)"),
        ("traci.simulationStep(float('nan'))", "the controller stepped to time nan"),
        (SENDS.format(b"\0\0\0\x20\x05"), "sent only a part of a message within the deadline"),
    ],
    ids=["crashes", "says goodbye", "a huge message", "nan", "time nan", "half a message"],
)
def test_a_program_that_does_wrong_is_started_again_and_leaves_nothing(tmp_path, misdeed, reason):
    command = program(
        tmp_path, f"{STOCK_CLIENT}for _ in range(4):\n    traci.simulationStep()\n{misdeed}"
    )
    with none_left():
        vut = factory("traci:" + command, deadline_s=0.5)
        trajectories = run_cases(vut, cases_of(2))
    for trajectory in trajectories:
        assert trajectory.end is End.VUT_ERROR
        assert reason in trajectory.error
        assert len(trajectory.motion) == 4


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("no-such-program {port}", "cannot find the program 'no-such-program'"),
        ("'unclosed", "cannot be read"),
        (f"{sys.executable} -c 'raise SystemExit(3)'", "ended with exit code 3 (before it"),
    ],
)
def test_a_command_that_cannot_work_is_refused_in_a_sentence(command, said):
    with pytest.raises(UserError, match=r"controller|the command") as refused:
        run_cases(factory("traci:" + command), cases_of(1))
    assert said in str(refused.value)


def test_a_command_that_never_connects_is_told_how():
    command = f"{sys.executable} -c 'import time; time.sleep(9)'"
    with pytest.raises(UserError, match=r"in 0\.3 s: the command receives the port as {port}"):
        run_cases(factory("traci:" + command, connect_s=0.3), cases_of(1))


def test_its_code_is_the_first_file_of_the_command(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("log.txt").touch()
    Path("c.py").touch()
    vut = factory(f"traci:{Path(sys.executable).name} -u c.py {{port}} log.txt")
    assert list(vut.files) == ["c.py"], "others are read and written"


IN_VAIN = """
while True:
    traci.simulationStep()
    if "vut" in traci.vehicle.getIDList():
        traci.vehicle.changeSublane("vut", 0.5)
"""


def test_commands_in_vain_are_named_in_the_end(tmp_path, command_line):
    vut = "traci:" + program(tmp_path, STOCK_CLIENT + IN_VAIN)
    campaign = ("--cases", 3, "--sampler", "uniform", "--level", 0, "--workers", 1)
    _, out, _ = command_line("campaign", "--vut", vut, *campaign, "-q", "--out", tmp_path / "run")
    note = "commands without effect here: vehicle.changeSublane in 3 cases"
    assert f"Note:        {note}" in out.splitlines()


def test_output_of_every_start_of_a_program_is_shown(tmp_path, capfd):
    crash = "traci.simulationStep()\nraise ValueError('my bug')\n"
    run_cases(factory("traci:" + program(tmp_path, STOCK_CLIENT + crash)), cases_of(2))
    assert "ValueError: my bug" in capfd.readouterr().err


def test_a_port_that_is_invalid_or_taken_is_refused(capfd):
    with pytest.raises(UserError, match="the port must be a number"):
        factory("traci:70000")
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with pytest.raises(UserError, match=f"cannot listen on 127.0.0.1:{port}"):
            run_cases(factory(f"traci:{port}"), cases_of(1))
    with pytest.raises(UserError, match=r"no TraCI client connected .* in 0.2 s"):
        run_cases(factory(f"traci:{free_port()}", connect_s=0.2), cases_of(1))
    assert "waiting up to 0.2 s for a TraCI client on 127.0.0.1:" in capfd.readouterr().err


def test_a_client_that_asks_and_makes_no_step_has_until_the_deadline():
    def client(port):
        curious = traci.connect(port, numRetries=200, waitBetweenRetries=0.02)
        curious.simulationStep()
        with suppress(traci.FatalTraCIError):
            while True:
                curious.vehicle.getSpeed("vut")

    (reason,) = Played(client, steps=3, deadline_s=0.3).reasons
    assert reason.endswith("within the deadline of 0.3 s")


@pytest.mark.skipif(not vut.KNOWS_USERS, reason="needs /proc/net/tcp")
class TestUsersOfAConnection:
    @pytest.mark.parametrize(
        ("family", "source", "target"),
        [
            (socket.AF_INET, "127.0.0.2", "127.0.0.1"),
            (socket.AF_INET6, "::ffff:127.0.0.1", "::ffff:127.0.0.1"),
        ],
    )
    def test_are_known(self, family, source, target):
        with socket.create_server(("127.0.0.1", 0)) as listener, socket.socket(family) as client:
            client.bind((source, 0))
            client.connect((target, listener.getsockname()[1]))
            with listener.accept()[0] as connection:
                assert vut.users_of(connection) == {os.geteuid()}
                client.close()
                assert vut.users_of(connection) == set(), "it is gone"

    def test_that_are_others_are_not_served(self, monkeypatch, tmp_path):
        monkeypatch.setattr(vut, "users_of", lambda _: {os.geteuid(), os.geteuid() + 1})
        with pytest.raises(UserError, match="before it connected"):
            run_cases(factory("traci:" + program(tmp_path, STOCK_CLIENT)), cases_of(1))
