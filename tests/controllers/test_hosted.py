"""The process of a user's controller: how it starts, what ends it, and what it may answer."""

# mypy: no-strict-optional

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from support.campaigning import campaign_settings, run_campaign
from support.misbehaviours import STUBBORN
from support.processes import none_left, wait_for
from support.scenes import scene_of

from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.process import append
from merge_sumo.controllers.spec import ControllerOptions
from merge_sumo.drivers.base import Driver, EpisodesLostError, Scene
from merge_sumo.errors import UserError

OPTIONS = ControllerOptions(deadline_s=0.3)
HANGS = f"""
import pathlib, signal, time
signal.signal(signal.SIGIO, signal.SIG_IGN)
def Vut(seen):
    pathlib.Path(__file__).with_name("hangs").touch()
    signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals())
    {STUBBORN.replace(chr(10), chr(10) + "    ")}
"""


def campaign(spec: str, out: Path, *more: str) -> subprocess.Popen:
    command = [sys.executable, "-m", "merge_sumo.cli", "campaign", "--vut", spec, "--level", "0"]
    command += ["--cases", "4", "--sampler", "uniform", "--quiet", "--out", str(out), *more]
    return subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)


@pytest.mark.slow
def test_a_parent_that_is_killed_leaves_no_process_behind_even_if_the_vut_hangs_and_ignores_signals(
    write_vut, tmp_path
):
    with none_left():
        parent = campaign(write_vut(HANGS), tmp_path / "run", "--workers", "2", "--deadline", "600")
        assert wait_for((tmp_path / "hangs").exists)
        os.kill(parent.pid, signal.SIGKILL)
        parent.wait()
        parent.stderr.close()


@pytest.mark.slow
def test_a_second_interrupt_does_not_wait_for_a_vut_that_hangs(write_vut, tmp_path):
    with none_left():
        parent = campaign(write_vut(HANGS), tmp_path / "run", "--deadline", "600")
        assert wait_for((tmp_path / "hangs").exists)
        for _ in range(2):
            os.kill(parent.pid, signal.SIGINT)
            time.sleep(0.5)
        _, said = parent.communicate(timeout=600)
    assert parent.returncode == 130
    assert b"Traceback" not in said
    assert b"continue with" in said


def scene(corridors: int) -> Scene:
    return scene_of(*[np.full(corridors, 20.0)] * 4)


def opened(spec: str, corridors: int) -> closing[Driver]:
    """Return a context with the driver of a spec, which is closed in the end."""
    return closing(load(spec, OPTIONS).open(corridors))


def test_after_a_death_it_starts_again_and_knows_which_files_there_were(write_vut):
    with opened(write_vut("import os\ndef Vut(seen):\n    os._exit(3)\n"), 2) as vut:
        for _ in range(2):
            with pytest.raises(EpisodesLostError, match="exit code 3"):
                vut.act(scene(2))
            assert {file.name for file in vut.files()} == {"my_vut.py"}


def test_half_an_answer_and_no_more_ends_at_the_deadline(write_vut):
    source = """
import os, time
def Vut(seen):
    for descriptor in range(3, 64):
        try:
            if os.readlink(f"/proc/self/fd/{descriptor}").startswith("socket"):
                os.write(descriptor, (1000).to_bytes(4, "big") + b"half")
        except OSError:
            pass
    while True:
        try:
            time.sleep(60)
        except BaseException:
            pass
"""
    late = r"the deadline of 0\.3 s"
    with opened(write_vut(source), 2) as vut, pytest.raises(EpisodesLostError, match=late):
        vut.act(scene(2))


def test_controllers_that_take_long_together_are_not_late(write_vut):
    source = "import time\ndef Vut(seen):\n    time.sleep(0.2)\n    return 1.0\n"
    # 2 s, and the process has 1.7 s
    with opened(write_vut(source), 10) as vut:
        assert vut.act(scene(10)).tolist() == [1.0] * 10


def test_its_code_may_not_change_and_data_that_it_reads_may(write_vut, tmp_path):
    (tmp_path / "helper.py").touch()
    count = tmp_path / "count.txt"
    count.write_text("1")
    source = """
import pathlib, helper
COUNT = pathlib.Path(__file__).with_name("count.txt").read_text()
def Vut(seen):
    return 1.0
"""
    factory = load(write_vut(source))
    assert {Path(name).name for name in factory.files} == {"my_vut.py", "helper.py"}
    count.write_text("2")
    factory.open(1).close()
    (tmp_path / "helper.py").write_text("changed = True")
    with pytest.raises(
        UserError, match=r"helper\.py, code of the VUT .*, has changed since it was loaded"
    ):
        factory.open(1)


def test_what_it_imports_while_it_drives_is_of_its_files(write_vut, tmp_path):
    (tmp_path / "late.py").touch()
    with opened(write_vut("def Vut(seen):\n    import late\n    return 1.0\n"), 1) as vut:
        assert {f.name for f in vut.files()} == {"my_vut.py"}
        vut.act(scene(1))
        assert {f.name for f in vut.files()} == {"my_vut.py", "late.py"}


def test_what_it_prints_is_in_the_folder_of_the_campaign(write_vut, tmp_path, capfd):
    vut = write_vut(
        'print("loading \\x1b[31m")\ndef Vut(seen):\n    print("acting")\n    return 1.0\n'
    )
    run_campaign(campaign_settings(vut=vut, cases=2, sampler="uniform", batch=2), tmp_path / "run")
    log = (tmp_path / "run" / "controller.log").read_bytes()
    assert log.startswith(b"loading \x1b[31m\nacting\n")
    assert capfd.readouterr().out == ""


def test_nothing_else_in_the_place_of_the_log_is_written_or_waited_for(tmp_path):
    (tmp_path / "others").touch()
    (tmp_path / "link").symlink_to(tmp_path / "others")
    append(tmp_path / "link", b"x")
    assert (tmp_path / "others").read_bytes() == b""
    os.mkfifo(tmp_path / "pipe")
    append(tmp_path / "pipe", b"x")
