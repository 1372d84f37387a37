"""Workers of every kind give the same results, and lose none of them when a worker dies."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.attacks import Workspace
from support.campaigning import campaign_settings, run_campaign
from support.plans import plan_for
from support.processes import wait_for

from merge_sumo import api
from merge_sumo.campaigns.recorded import OUTCOMES
from merge_sumo.errors import Notice, UserError
from merge_sumo.scenario.case import from_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End
from merge_sumo.simulation.evaluate import lost_episode, simulate
from merge_sumo.workers import (
    dask_workers,
    open_workers,
)

SETTINGS = campaign_settings(
    vut="design1", levels=(0, 1, 2), sampler="gpr", cases=60, batch=20, seed=3
)


def squares(items):
    return [item * item for item in items]


def process_ids(items):
    return [os.getpid() for _ in items]


def refuse(items):
    raise UserError(f"nothing like {items[0]} here")


def killed_once_at(flag: Path, deadly: int, items):
    """Square, but let the worker die the first time that it comes to one item."""
    if deadly in items and not flag.exists():
        flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return squares(items)


def run_but_die_at(plan, deadly, cases):
    if any(case.x_pov0_m in deadly for case in cases):
        os.kill(os.getpid(), signal.SIGKILL)
    return simulate(plan, cases)


def no_loss(item):
    pytest.fail(f"{item} was given up")


@pytest.fixture(scope="module")
def two():
    """Return two processes; where a test kills one, another takes its place."""
    with open_workers(2) as opened:
        yield opened


@pytest.fixture(params=["in process", "2 processes"])
def workers(request):
    if request.param == "2 processes":
        yield request.getfixturevalue("two")
        return
    with open_workers(1) as opened:
        yield opened


@pytest.fixture(scope="module")
def expected(tmp_path_factory) -> bytes:
    """Return the outcomes of a campaign that ran in this process."""
    folder = tmp_path_factory.mktemp("one") / "run"
    run_campaign(SETTINGS, folder)
    return (folder / OUTCOMES).read_bytes()


class TestAnyWorkers:
    @pytest.mark.parametrize(
        ("count", "chunk"), [(0, None), (1, None), (2, 1), (7, 1), (7, 3), (1003, None)]
    )
    def test_give_the_result_of_every_item_once_and_at_its_place(self, workers, count, chunk):
        found = list(workers.run(squares, range(count), no_loss, chunk=chunk))
        assert found == [place * place for place in range(count)]

    def test_raise_what_the_function_raises_and_work_on(self, workers):
        with pytest.raises(UserError, match=r"nothing like [56] here"):
            list(workers.run(refuse, [5, 6], no_loss))
        assert list(workers.run(squares, [5, 6], no_loss)) == [25, 36]


class TestAWorkerThatDies:
    def test_once_loses_nothing(self, two, tmp_path):
        work = partial(killed_once_at, tmp_path / "flag", 7)
        found = list(two.run(work, range(20), no_loss, chunk=4))
        assert (tmp_path / "flag").exists()
        assert found == [item * item for item in range(20)]

    @pytest.mark.slow
    def test_each_time_at_one_case_makes_that_one_a_sim_error_with_a_reason(self, two):
        cases = from_unit(np.random.default_rng(0).random((4, 2)), 0, scenario=US23)
        plan = plan_for("design1", corridors=4)
        work = partial(run_but_die_at, plan, {cases[2].x_pov0_m})
        ran = list(two.run(work, cases, partial(lost_episode, plan), chunk=2))
        ends = [one.outcome.measures.end for one in ran]
        assert ends[2] is End.SIM_ERROR
        assert "worker process died twice" in ran[2].outcome.measures.error
        assert ran[2].outcome.measures.score is None
        assert End.SIM_ERROR not in ends[:2] + ends[3:]


class TestLocalProcesses:
    @pytest.mark.slow
    def test_end_with_a_parent_that_is_killed(self, tmp_path):
        script = tmp_path / "parent.py"
        script.write_text(
            "import os, sys\n"
            "from merge_sumo.workers import open_workers\n"
            "sys.path[:0] = sys.argv[1:]\n"
            "from test_workers import process_ids\n"
            "if __name__ == '__main__':\n"
            "    with open_workers(2) as workers:\n"
            "        found = workers.run(process_ids, range(4), None, chunk=1)\n"
            "        print(*set(found), flush=True)\n"
            "        os.kill(os.getpid(), 9)\n"
        )
        tests = Path(__file__).parents[1]
        folders = [str(tests / name) for name in (".", "files")]
        parent = subprocess.run(
            [sys.executable, str(script), *folders], capture_output=True, text=True, check=False
        )
        assert parent.returncode == -signal.SIGKILL, parent.stderr
        orphans = [int(word) for word in parent.stdout.split()]
        assert orphans
        assert wait_for(lambda: not any(running(orphan) for orphan in orphans))


def running(process: int) -> bool:
    """Return whether a process is there and is no zombie."""
    try:
        status = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] != "Z"


@pytest.fixture
def cluster(tmp_path):
    """Start a Dask scheduler and two workers on loopback; give its address and the workers."""
    pytest.importorskip("distributed", reason="needs merge-sumo[dask]")
    contact = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "dask"]
    on_loopback = ("--host", "127.0.0.1", "--no-dashboard")
    scheduler = [*dask, "scheduler", *on_loopback, "--port", "0", "--scheduler-file", str(contact)]
    worker = [*dask, "worker", "--scheduler-file", str(contact), *on_loopback]
    worker += ["--nthreads", "2", "--no-nanny", "--local-directory", str(tmp_path)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([p for p in sys.path if p])}
    log = (tmp_path / "log").open("wb")
    start = partial(subprocess.Popen, stdout=log, stderr=log, env=environment)
    processes = [start(scheduler)]
    try:
        assert wait_for(lambda: contact.exists() and contact.stat().st_size > 0)
        processes += [start(worker), start(worker)]
        address = json.loads(contact.read_text())["address"]
        assert address.startswith("tcp://127.0.0.1:")
        assert wait_for(lambda: workers_at(address) == 2)
        yield address, processes[1:], processes[0]
    finally:
        for process in processes:
            process.kill()
            process.wait()
        log.close()


def workers_at(address: str) -> int:
    try:
        with dask_workers(address) as workers:
            return workers.count
    except UserError:
        return 0


@pytest.fixture
def daemonic(monkeypatch):
    """Let this process be one that may start no others, as a worker of multiprocessing.Pool."""
    process: Any = multiprocessing.current_process()
    monkeypatch.setitem(process._config, "daemon", True)


class TestADaemonicProcess:
    def test_runs_a_campaign_itself_with_a_note(self, daemonic, tmp_path):
        keywords: dict[str, Any] = {"cases": 20, "seed": 1, "progress": False}
        alone = api.campaign("design2", out=tmp_path / "alone", **keywords)
        with pytest.warns(Notice, match="in this process"):
            run = api.campaign("design2", out=tmp_path / "run", workers=2, **keywords)
        texts = [(one.folder / OUTCOMES).read_bytes() for one in (alone, run)]
        assert texts[0] == texts[1]


class TestADaskCluster:
    @pytest.mark.slow
    def test_that_is_gone_is_a_sentence_that_says_how_to_go_on(self, cluster, tmp_path):
        address, _, scheduler = cluster
        simulation = Workspace(tmp_path / "simulation")
        words = "campaign --vut design1 --level 0 --sampler uniform --cases 20000 --out run"
        process = simulation.start(*words.split(), "--gate", "fmc>0.5", "--workers", address)
        outcomes = simulation.root / "run" / OUTCOMES
        assert wait_for(lambda: outcomes.exists() or process.poll() is not None)
        scheduler.kill()
        _, err = process.communicate(timeout=120)
        assert process.returncode == 2, err
        *before, last = err.splitlines()
        assert last == (
            "merge-sumo: lost the connection to the Dask workers; check the cluster; "
            f"continue with: merge-sumo campaign --resume run --gate 'fmc>0.5' --workers {address}"
        )
        assert all(line.startswith(("design1 v level 0", "cases: ", "so far")) for line in before)

    @pytest.mark.slow
    def test_gives_the_same_outcomes_although_a_worker_is_killed(self, cluster, expected, tmp_path):
        address, (first, _), _ = cluster
        seen = []

        def on_case(outcome) -> None:
            seen.append(outcome.index)
            if len(seen) == 30:  # in the middle of the second batch of three
                first.kill()

        with dask_workers(address) as workers:
            assert workers.count == 2
            run_campaign(SETTINGS, tmp_path / "run", on_case=on_case, workers=workers)
        assert first.wait() == -signal.SIGKILL
        assert (tmp_path / "run" / OUTCOMES).read_bytes() == expected

    def test_that_is_not_there_is_refused_in_a_sentence(self, monkeypatch):
        pytest.importorskip("distributed", reason="needs merge-sumo[dask]")
        monkeypatch.setattr("merge_sumo.workers.DASK_TIMEOUT_S", 1.0)
        with pytest.raises(UserError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:1"):
            open_workers("tcp://127.0.0.1:1")
        with pytest.raises(UserError, match="no Dask scheduler answers at"):
            dask_workers("nonsense://")
