"""The process of a user's VUT: how it starts, what ends it, what it leaves, and what it may say."""

# mypy: no-strict-optional

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from campaigning import campaign_settings, run_campaign
from misbehaviours import STUBBORN
from processes import none_left, wait_for

from merge_sumo.drivers.base import Scene, VutLostError
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import MergeCase
from merge_sumo.scenario.scenario import US23, as_merge, lane_of
from merge_sumo.vuts.base import VutOptions
from merge_sumo.vuts.factory import VutFactory
from merge_sumo.vuts.host import wire
from merge_sumo.vuts.host.hosted import HostedVut
from merge_sumo.vuts.process import Echo, append
from merge_sumo.vuts.spec import parse

OPTIONS = VutOptions(deadline_s=0.3)
HANGS = f"""
import pathlib, signal, time
signal.signal(signal.SIGIO, signal.SIG_IGN)
def Vut(seen):
    pathlib.Path(__file__).with_name("hangs").touch()
    signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    {STUBBORN.replace(chr(10), chr(10) + "    ")}
"""


@pytest.fixture
def spec(tmp_path):
    """Return a function that writes a source and returns its spec."""

    def write(source: str) -> str:
        (tmp_path / "my_vut.py").write_text(source, encoding="utf-8")
        return f"{tmp_path / 'my_vut.py'}:Vut"

    return write


def campaign(spec: str, out: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "merge_sumo.cli", "campaign", "--vut", spec, "--level", "0"]
    command += ["--cases", "4", "--sampler", "uniform", "--quiet", "--out", str(out), *more]
    return subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)


@pytest.mark.slow
def test_a_parent_that_is_killed_leaves_no_process_behind_even_if_the_vut_hangs_and_ignores_signals(
    spec, tmp_path
):
    with none_left():
        parent = campaign(spec(HANGS), tmp_path / "run", "--workers", "2", "--deadline", "600")
        assert wait_for((tmp_path / "hangs").exists)
        os.kill(parent.pid, signal.SIGKILL)
        parent.wait()
        parent.stderr.close()


@pytest.mark.slow
def test_a_second_interrupt_does_not_wait_for_a_vut_that_hangs(spec, tmp_path):
    with none_left():
        parent = campaign(spec(HANGS), tmp_path / "run", "--deadline", "600")
        assert wait_for((tmp_path / "hangs").exists)
        for _ in range(2):
            os.kill(parent.pid, signal.SIGINT)
            time.sleep(0.5)
        _, said = parent.communicate(timeout=600)
    assert parent.returncode == 130
    assert b"Traceback" not in said
    assert b"go on with" in said


def scene(corridors: int) -> Scene:
    active, step = np.ones(corridors, dtype=bool), np.zeros(corridors, dtype=np.int64)
    return Scene.of_pair(active, step, *[np.full(corridors, 20.0)] * 4)


def test_after_a_death_it_starts_anew_and_knows_which_files_there_were(spec, tmp_path):
    source = """
import os, pathlib
open(pathlib.Path(__file__).with_name("gains.txt")).close()
def Vut(seen):
    os._exit(3)
"""
    (tmp_path / "gains.txt").touch()
    vut = HostedVut(2, parse(spec(source)), OPTIONS)
    try:
        for _ in range(2):
            with pytest.raises(VutLostError, match="exit code 3") as lost:
                vut.act(scene(2))
            assert lost.value.corridor == 0
            assert {file.name for file in vut.files()} == {"my_vut.py", "gains.txt"}
    finally:
        vut.close()


def test_what_starts_print_is_shown_from_where_it_differs(capsys):
    echo = Echo()
    for parts in ([b"a", b"b"], [b"ab"], [b"a", b"b"], [b""], [b"a", b"c"], [b"a"], [b"a"]):
        echo.show(parts)
    echo.close()
    told = "ab(printed 2 more times)\naca(printed 1 more time)\n"
    assert capsys.readouterr().err == told


def test_what_it_reads_may_be_its_to_write_and_its_code_is_not(spec, tmp_path):
    (tmp_path / "helper.py").touch()
    count = tmp_path / "count.txt"
    count.write_text("1")
    source = """
import pathlib, helper
COUNT = pathlib.Path(__file__).with_name("count.txt").read_text()
def Vut(seen):
    return 1.0
"""
    factory = VutFactory.of(spec(source))
    assert {Path(name).name for name in factory.files} == {"my_vut.py", "helper.py", "count.txt"}
    count.write_text("2")
    factory(1).close()
    (tmp_path / "helper.py").write_text("changed = True")
    with pytest.raises(UserError, match=r"helper\.py, code of the VUT .*, is not as it was"):
        factory(1)


def test_what_it_loads_while_it_drives_is_of_its_files_and_what_it_writes_is_not(spec, tmp_path):
    for name in ("helper.py", "late.py", "gains.txt", "more.txt", "control.so", "never.txt"):
        (tmp_path / name).touch()
    source = """
import ctypes, os, pathlib, helper
HERE = pathlib.Path(__file__).parent
(HERE / "gains.txt").read_text()
try:
    ctypes.CDLL(str(HERE / "control.so"))
except OSError:
    pass
def Vut(seen):
    import late
    os.close(os.open(HERE / "more.txt", os.O_RDONLY))
    (HERE / "log.txt").write_text("x")
    (HERE / "log.txt").read_text()
    return 1.0
"""
    vut = HostedVut(1, parse(spec(source)), OPTIONS)
    try:
        loaded = {"my_vut.py", "helper.py", "gains.txt", "control.so"}
        assert {f.name for f in vut.files()} == loaded
        vut.act(scene(1))
        assert {f.name for f in vut.files()} == loaded | {"late.py", "more.txt"}
    finally:
        vut.close()


def test_what_it_prints_is_in_the_folder_of_the_campaign(spec, tmp_path, capfd):
    vut = spec('print("loading \\x1b[31m")\ndef Vut(seen):\n    print("acting")\n    return 1.0\n')
    run = run_campaign(
        campaign_settings(vut=vut, cases=2, sampler="uniform", batch=2),
        tmp_path / "run",
    )
    log = (run.folder / "controller.log").read_bytes()
    assert log.startswith(b"loading \x1b[31m\nacting\n")
    assert capfd.readouterr().out == ""


def test_nothing_else_in_the_place_of_the_log_is_written_or_waited_for(tmp_path):
    (tmp_path / "others").touch()
    (tmp_path / "link").symlink_to(tmp_path / "others")
    with pytest.raises(OSError, match="symbolic link"):
        append(tmp_path / "link", b"x")
    assert (tmp_path / "others").read_bytes() == b""
    os.mkfifo(tmp_path / "pipe")
    append(tmp_path / "pipe", b"x")


class TestTheWire:
    def test_the_lane_and_who_has_merged_travel_and_the_rest_of_the_case_does_not(self):
        lane = replace(US23, lane_m=(-70.0, 130.0), lane_end="stop", follow_up_s=5.0)
        cases = [
            MergeCase(level=0, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=scenario)
            for scenario in (US23, lane)
        ]
        merged = np.array([False, True])
        sent = scene(2)._replace(merged=merged)
        begun, told = wire.unpack_scene(wire.pack_scene(list(enumerate(cases)), sent))
        assert told.merged.tolist() == [False, True]
        assert told.facing is None
        assert [lane_of(case.scenario) for _, case in begun] == [None, (-70.0, 130.0)]
        assert as_merge(begun[1][1].scenario).lane_end == "merge"
        assert wire.unpack_scene(wire.pack_scene([], scene(2)))[1].merged is None
