"""Who may drive the VUT by TraCI: processes of the user, and of nobody else on the machine."""

from __future__ import annotations

import os
import socket

import pytest
from controllers import RAW_CLIENT, program, raw_client
from processes import none_left
from vut_contract import cases_of, factory, run_cases

from merge_sumo.scenario.trajectory import End
from merge_sumo.vuts.traci import child
from merge_sumo.vuts.traci.child import user_of


@pytest.mark.parametrize("in_a_session", ["", "setsid "], ids=["of ours", "of its own"])
def test_a_child_of_the_program_may_connect(in_a_session):
    command = f"sh -c '{in_a_session}{raw_client()}& wait'"
    (trajectory,) = run_cases(factory("traci:" + command), cases_of(1))
    assert trajectory.error is None


@pytest.mark.slow
def test_a_program_that_ends_while_its_client_goes_on_is_an_error_of_every_case(tmp_path):
    leaves = "client.step()\nif os.fork():\n    os._exit(0)\nclient.drive(10_000)\n"
    command = program(tmp_path, RAW_CLIENT + leaves)
    with none_left():
        trajectories = run_cases(factory("traci:" + command), cases_of(3))
    for trajectory in trajectories:
        assert trajectory.end is End.VUT_ERROR
        assert "ended with exit code 0, and its connection goes on" in str(trajectory.error)


@pytest.mark.skipif(not child.KNOWN_HERE, reason="needs /proc/net/tcp")
class TestTheUserOfAConnection:
    @pytest.mark.parametrize(
        ("family", "source", "target"),
        [
            (socket.AF_INET, "127.0.0.1", "127.0.0.1"),
            (socket.AF_INET, "127.0.0.2", "127.0.0.1"),
            (socket.AF_INET6, "::ffff:127.0.0.1", "::ffff:127.0.0.1"),
        ],
    )
    def test_is_known(self, family, source, target):
        with socket.create_server(("127.0.0.1", 0)) as listener, socket.socket(family) as client:
            client.bind((source, 0))
            client.connect((target, listener.getsockname()[1]))
            with listener.accept()[0] as connection:
                assert user_of(connection) == os.geteuid()
                client.close()
                assert user_of(connection) is None, "it is gone"

    def test_who_is_another_is_not_served(self, monkeypatch, tmp_path):
        server = child.Server(tmp_path)
        monkeypatch.setattr(child, "user_of", lambda _: os.geteuid() + 1)
        monkeypatch.setattr(child, "MirrorSimulation", lambda _: NoSumo())
        port = server.answer("listen", {"port": 0}).port
        with socket.create_connection(("127.0.0.1", port)):
            answer = server.answer("accept", {"wait_s": 0.1, "deadline_s": 1.0})
        server.drop()
        assert not answer.accepted
        assert answer.notes[0].startswith(f"a process of the user {os.geteuid() + 1} connected")


class NoSumo:
    def load(self) -> None:
        """Load nothing: no client comes so far."""
