"""What surrounds a command: closed and full streams, limits, folders that vanish, threads."""

from __future__ import annotations

import shlex
import shutil
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest
from support.attacks import World
from support.campaigning import campaign_settings, run_campaign

from merge_sumo.campaigns.run import OUTCOMES, Run
from merge_sumo.errors import UserError

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a shell of POSIX is needed")

CAMPAIGN = "campaign --vut design1 --level 0 --cases 4 --sampler uniform --quiet --workers 2"
COMPARE = "compare run run"
SETTINGS = campaign_settings(vut="design1", sampler="uniform", cases=40, batch=20, seed=1)


@pytest.fixture
def world(run, tmp_path):
    shutil.copytree(run.folder, tmp_path / "run")
    return World(tmp_path)


def shell(world: World, command: str, streams: str = "", before: str = "") -> tuple[int, str, str]:
    """Run a command of merge-sumo by a shell."""
    run = f"{shlex.quote(sys.executable)} -m merge_sumo.cli {command} {streams}"
    script = f"{before}\n{run}\nexit $?"
    return World(world.root, prefix=("bash", "-c", script)).run()


@pytest.mark.slow
def test_streams_that_are_closed_or_full_change_nothing_else(world):
    code, out, _ = shell(world, COMPARE)
    assert (code, bool(out)) == (0, True)
    for streams in ("<&-", ">&-", "2>&-", "<&- >&- 2>&-"):
        found, said, errors = shell(world, COMPARE, streams)
        assert found == code, (streams, errors)
        assert said == ("" if ">&-" in streams.split() else out)
    assert shell(world, COMPARE, "2> /dev/full")[:2] == (code, out)
    found, _, errors = shell(world, COMPARE, "> /dev/full")
    assert found == 2
    assert errors.endswith("cannot write the result to standard output: No space left on device\n")


def test_a_reader_that_has_gone_ends_a_command_as_it_ends_others(world):
    code, _, errors = shell(world, "scenario list", "| true; exit ${PIPESTATUS[0]}")
    assert (code, errors) in ((128 + 13, ""), (0, ""))  # it may have been faster


@pytest.mark.slow
@pytest.mark.parametrize("limit", ["-f 1", "-n 12", "-v 1000000"])
def test_under_a_limit_a_campaign_ends_in_a_sentence_or_as_without(world, limit):
    code, _, errors = shell(world, f"{CAMPAIGN} --out new", before=f"ulimit {limit}")
    assert "Traceback" not in errors
    assert code == 0 or (code == 2 and errors.splitlines()[-1].startswith("merge-sumo: "))
    assert not [n for n in world.left_in_temporary() if not n.startswith("merge-sumo")]


class Vanishing:
    """Removes a folder at one of the cases."""

    def __init__(self, folder: Path, at: int = 5) -> None:
        self.folder, self.left = folder, at

    def __call__(self, *_: object) -> None:
        self.left -= 1
        if self.left == 0:
            shutil.rmtree(self.folder)


class TestAFolderThatVanishes:
    @pytest.mark.parametrize("gone", ["above/run", "above"])
    def test_under_or_above_a_campaign_ends_it_in_a_sentence(self, tmp_path, gone):
        (tmp_path / "above").mkdir()
        with pytest.raises(UserError, match=r"cannot write .*No such file or directory"):
            run_campaign(SETTINGS, tmp_path / "above" / "run", on_case=Vanishing(tmp_path / gone))

    def test_with_trajectories_ends_it_and_keeps_the_outcomes(self, tmp_path):
        # Not uniform: its batches run ahead, and those that end together are written together.
        gone = Vanishing(tmp_path / "run" / "trajectories", at=15)
        with pytest.raises(UserError, match=r"cannot write .*No such file or directory"):
            run_campaign(replace(SETTINGS, sampler="annealing"), tmp_path / "run", on_case=gone)
        assert len(Run(tmp_path / "run").outcomes) == 20

    def test_in_which_one_works_is_named(self, world):
        script = (
            "import os, sys; os.mkdir('here'); os.chdir('here'); os.rmdir('../here');"
            "from merge_sumo.cli import main; sys.argv[0] = 'merge-sumo'; main()"
        )
        code, _, err = world.run(*CAMPAIGN.split(), "--out", "new", script=script)
        assert (code, "Traceback" in err) == (2, False), err


def test_campaigns_in_threads_do_not_disturb_each_other(tmp_path):
    run_campaign(SETTINGS, tmp_path / "alone")
    with ThreadPoolExecutor(3) as threads:
        for number in range(3):
            threads.submit(run_campaign, SETTINGS, tmp_path / str(number))
    written = [path.read_bytes() for path in tmp_path.glob(f"*/{OUTCOMES}")]
    assert written == [written[0]] * 4
