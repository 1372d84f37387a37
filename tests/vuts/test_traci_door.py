"""Who may drive the VUT by TraCI: the controller, and nobody else on the machine."""

# mypy: no-strict-optional

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from conftest import some
from controllers import (
    RAW_CLIENT,
    assert_drives_as_level0,
    program,
    raw_client,
)
from processes import none_left
from raw_traci import Client, GoneError
from vut_contract import cases_of, factory, run_cases

from merge_sumo.scenario.trajectory import End
from merge_sumo.vuts.traci import door
from merge_sumo.vuts.traci.door import descends, owner_of

OURS = raw_client()


@contextmanager
def strangers(port: Path, behave, count: int = 3):
    """Let threads of this process connect again and again; the command did not start it."""
    stopped = threading.Event()
    served: list[bool] = []

    def come() -> None:
        while not stopped.is_set():
            with suppress(OSError, GoneError, ValueError):
                client = Client(int(port.read_text()), 0.5)
                port.with_suffix(".met").touch()
                client.socket.settimeout(0.5)
                with client.socket:
                    served.append(bool(behave(client)))
            time.sleep(0.01)

    threads = [threading.Thread(target=come) for _ in range(count)]
    for thread in threads:
        thread.start()
    try:
        yield served
    finally:
        stopped.set()
        for thread in threads:
            thread.join()


def drives(client: Client) -> bool:
    client.drive(3)
    return True


STRANGERS = {
    "drives": drives,
    "says nothing": lambda c: c.read(1),
    "sends garbage": lambda c: c.socket.sendall(os.urandom(200)) or c.read(1),
    "closes": lambda c: None,
}


class TestAProgram:
    @pytest.mark.parametrize("name", some(STRANGERS, "drives"))
    def test_is_served_whoever_of_the_same_user_connects_besides(self, name, tmp_path):
        port, log = tmp_path / "port", tmp_path / "controller.log"
        with strangers(port, STRANGERS[name]) as served:
            wait = f"until [ -e {port}.met ]; do sleep 0.02; done"
            vut = factory(f"traci:sh -c 'echo {{port}} > {port}; {wait}; exec {OURS}'", log=log)
            assert_drives_as_level0(vut, cases_of(2))
        assert not any(served)
        if name == "drives":
            assert "a process that the command did not start connected" in log.read_text()

    @pytest.mark.parametrize("in_a_session", ["", "setsid "], ids=["of ours", "of its own"])
    def test_may_have_a_child_that_connects(self, in_a_session):
        command = f"sh -c '{in_a_session}{OURS}& wait'"
        (trajectory,) = run_cases(factory("traci:" + command), cases_of(1))
        assert trajectory.error is None

    @pytest.mark.slow
    def test_that_ends_while_its_client_goes_on_is_an_error_of_every_case(self, tmp_path):
        leaves = "client.step()\nif os.fork():\n    os._exit(0)\nclient.drive(10_000)\n"
        command = program(tmp_path, RAW_CLIENT + leaves)
        with none_left():
            trajectories = run_cases(factory("traci:" + command), cases_of(3))
        for trajectory in trajectories:
            assert trajectory.end is End.VUT_ERROR
            assert "ended with exit code 0, and its connection goes on" in trajectory.error


@pytest.mark.skipif(not door.KNOWN_HERE, reason="needs /proc/net/tcp")
class TestWhoseAConnectionIs:
    @pytest.mark.parametrize(
        ("family", "address"),
        [
            (socket.AF_INET, "127.0.0.1"),
            (socket.AF_INET, "127.0.0.2"),
            (socket.AF_INET6, "::ffff:127.0.0.1"),
        ],
    )
    def test_is_known_by_user_and_process(self, family, address):
        with socket.socket() as listener, socket.socket(family) as client:
            listener.bind(("127.0.0.1", 0))
            listener.listen()
            if address == "127.0.0.2":
                client.bind((address, 0))
                address = "127.0.0.1"
            client.connect((address, listener.getsockname()[1]))
            with listener.accept()[0] as connection:
                user, inode = owner_of(connection)
                assert user == os.geteuid()
                assert inode == os.fstat(client.fileno()).st_ino
                assert descends(inode, os.getpid())
                waits = [sys.executable, "-c", "input()"]
                with subprocess.Popen(waits, stdin=subprocess.PIPE) as other:
                    assert not descends(inode, other.pid)
                    other.kill()

    def test_of_another_user_is_refused(self, monkeypatch):
        notes: list[str] = []
        entrance = door.Door(0, notes.append)
        monkeypatch.setattr(door, "owner_of", lambda _: (os.geteuid() + 1, 7))
        try:
            with socket.create_connection(("127.0.0.1", entrance.port)):
                assert entrance.accept(None, 0.1) is None
        finally:
            entrance.close()
        assert notes[0].startswith(f"a process of the user {os.geteuid() + 1} connected")
