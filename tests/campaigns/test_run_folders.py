"""A run folder is data: it may come from anywhere, and never says which code is run."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any, Final

import pytest
from conftest import require
from support.calling import assert_refused
from support.campaigning import campaign_settings, run_campaign

from merge_sumo.campaigns.printed_commands import campaign_command
from merge_sumo.campaigns.recorded import OUTCOMES, RecordedCampaign, read_settings
from merge_sumo.controllers.in_memory import names_code
from merge_sumo.controllers.kinds import load
from merge_sumo.errors import UserError
from merge_sumo.files import files_now

VUT = """
import pathlib
from helper import GAIN
pathlib.Path(__file__).with_name("it-ran").touch()
def Vut(seen):
    return GAIN
"""
SPEC = "my_vut.py:Vut"
FEW: Final[dict[str, Any]] = {
    "vut": SPEC,
    "batch": 6,
    "sampler": "uniform",
    "seed": 1,
    "fail_when": "t_end_s > 2",
}
"""Settings of a campaign in which every case fails."""


def project(folder):
    """Make a folder with a VUT that leaves a file where it is loaded."""
    folder.mkdir()
    (folder / "my_vut.py").write_text(VUT)
    (folder / "helper.py").write_text("GAIN = 1.0\n")
    return folder


def ran(folder):
    """Return whether the VUT was loaded since this was asked last."""
    found = (folder / "it-ran").exists()
    (folder / "it-ran").unlink(missing_ok=True)
    return found


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """Return a project in which a campaign has run, of 6 of 12 cases."""
    folder = project(tmp_path / "mine")
    monkeypatch.chdir(folder)
    # A module of this name of another test is in another folder.
    monkeypatch.delitem(sys.modules, "my_vut", raising=False)
    run_campaign(campaign_settings(**FEW, cases=6), Path("run"))
    assert ran(folder)
    return folder


def verbs(run, out):
    """Return the commands that drive by the controller of a recorded campaign."""
    return [
        ("campaign", "--resume", run, "--cases", 12, "-q"),
        ("run", "--case", run, 0),
        ("rerun", run, 0, "-q"),
        ("explain", run, "-q"),
        ("probability", run, "--cases", 10, "--out", out / "p.json", "-q"),
    ]


class TestARunFolder:
    def test_has_no_code_run_by_any_command(self, mine, tmp_path, command_line):
        for command in verbs(mine / "run", tmp_path):
            said = command_line(*command)
            assert_refused(said, "A run folder cannot start code by itself: set --vut again")
        for command in (("report", "run"), ("replay", "run", 0), ("compare", "run", "run")):
            assert command_line(*command)[0] == 0
        assert not ran(mine)

    def test_works_elsewhere_with_its_controller_named_again(
        self,
        mine,
        tmp_path,
        command_line,
        monkeypatch,
    ):
        """As in CI, where another machine has another checkout."""
        run_campaign(campaign_settings(**FEW, cases=12), Path("whole"))
        there = project(tmp_path / "there")
        shutil.move(mine / "run", there / "results")
        monkeypatch.chdir(there)
        ran(there)
        assert command_line("run", "--case", "results", 0, "--vut", SPEC)[0] in (0, 1)
        assert command_line("rerun", "results", 0, "--vut", SPEC, "-q")[0] == 0
        resume = ("campaign", "--resume", "results", "--vut", SPEC, "--cases", 12, "-q")
        code, _, err = command_line(*resume)
        assert code == 0, err
        assert ran(there)
        expected = (mine / "whole" / OUTCOMES).read_bytes()
        assert Path("results", OUTCOMES).read_bytes() == expected

    def test_has_no_pov_and_no_earlier_version_run(self, mine, command_line):
        Path("pov.py").write_text(VUT)
        of_pov = {"vut": "design2", "pov": "pov.py:Vut", "levels": (3,)}
        for name, given in (("pov", of_pov), ("against", {"vut": "design2", "against": SPEC})):
            few = {"cases": 4, "batch": 2, "sampler": "uniform"}
            run_campaign(campaign_settings(**given, **few), Path(name))
            ran(mine)
            assert_refused(command_line("campaign", "--resume", name, "-q"), f"set --{name} again")
            assert not ran(mine)
            words = shlex.split(campaign_command("rerun", Path(name), read_settings(Path(name)), 0))
            assert command_line(*words[1:], "-q")[0] == 0


class TestAChangedController:
    @pytest.mark.parametrize("file", ["my_vut.py", "helper.py"])
    def test_begins_a_new_campaign_and_is_noticed(self, mine, file, command_line):
        before = (mine / "run" / OUTCOMES).read_bytes()
        (mine / file).write_text((mine / file).read_text() + "# changed\n")
        said = command_line("campaign", "--resume", "run", "--vut", SPEC, "--cases", 12, "-q")
        assert_refused(said, f"vut_files.{file} differs", "or start a new campaign")
        assert (mine / "run" / OUTCOMES).read_bytes() == before
        _, _, err = command_line("run", "--case", "run", 0, "--vut", SPEC)
        assert f"note: {file} has changed since run" in err
        code, _, err = command_line("rerun", "run", 0, "--vut", SPEC, "-q")
        assert (code, err) == (0, "")

    def test_is_known_by_its_files_wherever_they_are(self, mine, tmp_path):
        recorded = RecordedCampaign(mine / "run").record["vut_files"]
        assert set(recorded) == {"my_vut.py", "helper.py"}
        there = project(tmp_path / "there")
        loaded = {str(there / "my_vut.py"): recorded["my_vut.py"]}
        os.chdir(tmp_path)
        assert files_now(recorded, loaded) == recorded
        (there / "helper.py").unlink()
        assert files_now(recorded, loaded) == {**recorded, "helper.py": None}


class TestCodeThatOthersMayWrite:
    def test_is_not_run(self, mine, command_line, monkeypatch):
        monkeypatch.syspath_prepend(mine)  # before folders of other tests
        (mine / "my_vut.py").chmod(0o666)
        (mine / "link.py").symlink_to(mine / "my_vut.py")
        program = f"traci:{sys.executable} my_vut.py {{port}}"
        for vut in (SPEC, "my_vut:Vut", program, "link.py:Vut"):
            said = command_line("campaign", "--vut", vut, "--cases", 2, "-q")
            assert_refused(said, "is not run: others can write it", "chmod go-w")
        assert not ran(mine)

    def test_of_another_user_is_not_run(self, mine):
        require(os.geteuid() == 0, "needs root to give a file away")
        os.chown(mine / "my_vut.py", 12345, 12345)
        with pytest.raises(UserError, match=r"my_vut\.py is not run: it belongs to the user 12345"):
            load(SPEC)
        assert not ran(mine)


@pytest.mark.parametrize(
    ("spec", "named"),
    [
        *(("design2?a_brake_mps2=-4", False), ("sumo:IDM", False), ("traci:8813", False)),
        *(("traci:python my.py {port}", True), ("my_vut.py:Vut", True), ("here:Object", True)),
        *(("installed", True), ("onnx:policy.onnx", True)),
    ],
)
def test_names_code(spec, named):
    assert names_code(spec) == named
