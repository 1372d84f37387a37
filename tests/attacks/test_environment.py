"""What surrounds a command: streams, limits, terminals, folders that vanish, threads."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest
from support.attacks import Workspace
from support.campaigning import campaign_settings, run_campaign
from support.plans import plan_for

from merge_sumo.campaigns.recorded import OUTCOMES, RecordedCampaign
from merge_sumo.errors import UserError
from merge_sumo.simulation.simulator import Simulator

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a shell of POSIX is needed")

CAMPAIGN = "campaign --vut design1 --level 0 --cases 4 --sampler uniform --quiet --workers 2"
COMPARE = "compare run run"
SETTINGS = campaign_settings(vut="design1", sampler="annealing", cases=40, batch=20, seed=1)
NASTY = "a%41 b,c\n$(id)'\"\\ \x1b[31m日é" + os.fsdecode(b"\xff")


@pytest.fixture
def workspace(run, tmp_path):
    shutil.copytree(run.folder, tmp_path / "run")
    return Workspace(tmp_path)


def shell(
    workspace: Workspace, command: str, streams: str = "", before: str = ""
) -> tuple[int, str, str]:
    """Run a command of merge-sumo by a shell."""
    run = f"{shlex.quote(sys.executable)} -m merge_sumo.cli {command} {streams}"
    return Workspace(workspace.root, prefix=("bash", "-c", f"{before}\n{run}\nexit $?")).run()


@pytest.mark.slow
def test_streams_that_are_closed_or_full_change_nothing_else(workspace):
    code, out, _ = shell(workspace, COMPARE)
    assert (code, bool(out)) == (0, True)
    for streams in ("<&-", "<&- >&- 2>&-", "2> /dev/full"):
        found, said, errors = shell(workspace, COMPARE, streams)
        assert found == code, (streams, errors)
        assert said == ("" if ">&-" in streams.split() else out)
    found, _, errors = shell(workspace, COMPARE, "> /dev/full")
    assert found == 2
    assert errors.endswith("cannot write the result to standard output: No space left on device\n")


def test_a_reader_that_has_gone_ends_a_command_as_it_ends_others(workspace):
    code, _, errors = shell(workspace, "scenario list", "| true; exit ${PIPESTATUS[0]}")
    assert (code, errors) in ((128 + 13, ""), (0, ""))  # it may have been faster


@pytest.mark.slow
@pytest.mark.parametrize("limit", ["-f 1", "-n 12", "-v 1000000"])
def test_under_a_limit_a_campaign_ends_in_a_sentence_or_as_without(workspace, limit):
    code, _, errors = shell(workspace, f"{CAMPAIGN} --out new", before=f"ulimit {limit}")
    assert "Traceback" not in errors
    assert code == 0 or (code == 2 and errors.splitlines()[-1].startswith("merge-sumo: "))
    assert not [n for n in workspace.left_in_temporary() if not n.startswith("merge-sumo")]


@pytest.mark.slow
def test_a_terminal_of_ascii_shows_results_in_a_folder_of_any_name(workspace):
    (workspace.root / "run").rename(workspace.root / NASTY)
    ascii_only = "export LC_ALL=C PYTHONIOENCODING=ascii:strict"
    code, out, err = shell(workspace, "compare *31m* *31m*", "", ascii_only)
    assert (code, err) == (0, "")
    assert "\x1b" not in out
    assert "\\x1b[31m" in out


class TestAFolderThatVanishes:
    @pytest.mark.parametrize(("gone", "at"), [("above", 5), ("above/run/trajectories", 15)])
    def test_ends_a_campaign_in_a_sentence_and_keeps_the_outcomes(self, tmp_path, gone, at):
        left = iter(range(at, 0, -1))

        def remove(*_: object) -> None:
            if next(left, 0) == 1:
                shutil.rmtree(tmp_path / gone)

        (tmp_path / "above").mkdir()
        with pytest.raises(UserError, match=r"cannot write .*No such file or directory"):
            run_campaign(SETTINGS, tmp_path / "above" / "run", on_case=remove)
        if gone.endswith("trajectories"):
            assert len(RecordedCampaign(tmp_path / "above" / "run").outcomes) == 20

    def test_in_which_one_works_is_named(self, workspace):
        script = (
            "import os, sys; os.mkdir('here'); os.chdir('here'); os.rmdir('../here');"
            "from merge_sumo.cli import main; sys.argv[0] = 'merge-sumo'; main()"
        )
        code, _, err = workspace.run(*CAMPAIGN.split(), "--out", "new", script=script)
        assert (code, "Traceback" in err) == (2, False), err

    def test_for_temporary_files_is_named(self, tmp_path, monkeypatch):
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "gone"))
        with pytest.raises(UserError, match="set TMPDIR to a writable folder"):
            Simulator(plan_for("design1", corridors=1))


def test_campaigns_in_threads_do_not_disturb_each_other(tmp_path):
    run_campaign(SETTINGS, tmp_path / "alone")
    with ThreadPoolExecutor(3) as threads:
        for number in range(3):
            threads.submit(run_campaign, SETTINGS, tmp_path / str(number))
    written = [path.read_bytes() for path in tmp_path.glob(f"*/{OUTCOMES}")]
    assert written == [written[0]] * 4
