"""A copy of the sampler in a process of its own changes no case, whatever becomes of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import pytest
from campaigning import campaign_settings
from processes import wait_for

from merge_sumo.campaigns import sampler_copy
from merge_sumo.campaigns.campaign import run_campaign
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.sampler_copy import CopyBeside
from merge_sumo.campaigns.store import OUTCOMES
from merge_sumo.errors import UserError
from merge_sumo.system import workers as workers_module
from merge_sumo.system.workers import HERE_S, open_workers

SETTINGS = campaign_settings(vut="design2", levels=(0, 1), cases=60, seed=4)


def ran(folder, workers=None):
    """Return the outcomes of the campaign as bytes."""
    run_campaign(SETTINGS, resolve(SETTINGS), folder, workers=workers)
    return (folder / OUTCOMES).read_bytes()


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    return ran(tmp_path_factory.mktemp("alone") / "run")


@pytest.fixture
def worth_it(monkeypatch):
    """Let the copy search from the first batch on; return the batches that it has begun."""
    monkeypatch.setattr(sampler_copy, "WORTH_FROM", 0)
    began: list[int] = []
    begin = CopyBeside.begin

    def at_once(copy: CopyBeside, n: int) -> bool:
        if copy._began is not None:
            copy._began.result()
        begins = begin(copy, n)
        began.extend([n] * begins)
        return begins

    monkeypatch.setattr(CopyBeside, "begin", at_once)
    return began


def beside():
    """Return two workers that run cases in this process for a while, as they do by default."""
    return open_workers(2, here_s=10.0 * HERE_S)


@pytest.mark.slow
def test_outcomes_are_those_of_one_process(worth_it, alone, tmp_path):
    with beside() as workers:
        assert ran(tmp_path / "run", workers) == alone
        assert worth_it


@pytest.mark.slow
def test_when_it_dies_this_process_searches_all_levels(worth_it, alone, tmp_path, monkeypatch):
    proposals = CopyBeside.proposals
    pids = []

    def killed(copy):
        pids.append(copy._beside.submit(os.getpid).result())
        os.kill(pids[-1], signal.SIGKILL)
        # Its answer may be on the way already: only then has it died before it.
        with pytest.raises(BrokenProcessPool):
            copy._beside.submit(os.getpid).result()
        return proposals(copy)

    monkeypatch.setattr(CopyBeside, "proposals", killed)
    with beside() as workers:
        assert ran(tmp_path / "run", workers) == alone
        assert len(pids) == 1


def test_one_worker_and_a_full_system_have_no_process_beside(monkeypatch):
    with open_workers(1) as workers:
        assert workers.start_beside() is None

    def refuse(_: int) -> None:
        raise UserError("no more threads")

    monkeypatch.setattr(workers_module, "check_threads", refuse)
    with beside() as workers:
        assert workers.start_beside() is None


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_it_ends_with_the_campaign(number, tmp_path):
    command = [sys.executable, "-m", "merge_sumo.cli", "campaign", "--vut", "design2"]
    campaign = subprocess.Popen([*command, "--workers", "2", "--out", str(tmp_path / "run"), "-q"])
    try:
        assert wait_for((tmp_path / "run" / OUTCOMES).exists)
        task = Path(f"/proc/{campaign.pid}/task/{campaign.pid}/children")
        children = [Path("/proc", number) for number in task.read_text().split()]
        assert children
        campaign.send_signal(number)
        campaign.wait(60.0)
        assert wait_for(lambda: not any(child.exists() for child in children))
    finally:
        campaign.kill()
        campaign.wait()
