"""Controllers as text, commands that start them, and what they must do."""

from __future__ import annotations

import socket
import sys
from pathlib import Path

import pytest
from support.vut_contract import factory, run_cases

from merge_sumo.controllers.spec import ControllerKind
from merge_sumo.scenario.case import Case

STOCK_CLIENT = "import sys, time, traci\ntraci.init(int(sys.argv[1]), numRetries=600)\n"
"""Begins a program that drives by SUMO's own client."""


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return server.getsockname()[1]


def program(folder: Path, source: str, name: str = "controller.py") -> str:
    """Write a Python program into a folder; return the command that starts it with the port."""
    (folder / name).write_text(source, encoding="utf-8")
    return f"{sys.executable} {folder / name} {{port}}"


def assert_drives_as_level0(vut: ControllerKind, cases: list[Case], within: float = 1e-9) -> None:
    """Assert that a VUT drives by the law of level 0, and makes no error."""
    level0 = run_cases(factory("level0"), cases)
    for one, other in zip(run_cases(vut, cases), level0, strict=True):
        assert one.error is None
        assert one.motion == pytest.approx(other.motion, abs=within, rel=0)
