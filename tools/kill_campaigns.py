"""Kill campaigns and resume them: `python tools/kill_campaigns.py --kills 100`.

Every campaign is killed once (SIGKILL), at a place drawn from a seed, and resumed. Then its
outcomes must be those of an undisturbed campaign, byte for byte, and its temporary files must be
gone. The places take turns:

    moment  any time between the start and the end of the campaign
    sync    between a write and its sync to the disk, of any file of the journal
    torn    in the middle of a write, of any file of the journal
    worker  a worker process, at any time; the campaign itself continues
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo.campaigns import journal
from merge_sumo.campaigns.campaign import run_campaign
from merge_sumo.campaigns.recorded import OUTCOMES, SETTINGS, read_settings
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.campaigns.settings import settings_from_folder as settings_in
from merge_sumo.scenario.scenario import US23
from merge_sumo.sumo.binding import load_libsumo
from merge_sumo.workers import open_workers

PLACES = ("moment", "sync", "torn", "worker")
SAMPLERS = ("gpr", "coverage", "uniform")
"""The last one runs ahead, and keeps several batches at a time."""
CASES, BATCH = 60, 12
WRITES = 2 * CASES // BATCH
"""Files that the journal writes: trajectories and outcomes of every batch."""
SYNCS = 3 + 3 * CASES // BATCH
"""Of settings and two folders, then of trajectories, their folder and outcomes of every batch; less
where batches are kept together, so that some kills come too late."""
PATIENCE_S = 600.0


def settings_of(sampler: str) -> CampaignSettings:
    """Return a campaign in which every batch depends on those before it, or runs ahead of them.

    Args:
        sampler: name of the sampler.
    """
    return CampaignSettings(
        vut="design1",
        levels=(0, 1),
        sampler=sampler,
        cases=CASES,
        batch=BATCH,
        seed=1,
        scenario=US23,
    )


def forked(work: Callable[[], object]) -> int:
    """Start work in a process of its own, without importing everything again.

    Args:
        work: the function that runs.

    Returns:
        The id of the process.
    """
    pid = os.fork()
    if pid == 0:
        try:
            work()
            os._exit(0)
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
            os._exit(1)
    return pid


def ended(pid: int) -> int:
    """Wait for a process and return its exit code, negative for a signal.

    Args:
        pid: id of the process.
    """
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def kill_me() -> None:
    """End this process at once."""
    os.kill(os.getpid(), signal.SIGKILL)


def kill_at_sync(nth: int) -> None:
    """Let this process be killed between a write and the sync of it.

    Args:
        nth: number of the write.
    """
    fsync, count = os.fsync, 0

    def counting(file: Any) -> None:
        nonlocal count
        count += 1
        if count == nth:
            kill_me()
        fsync(file)

    os.fsync = counting  # type: ignore[assignment]


def kill_at_write(nth: int, share: float) -> None:
    """Let this process be killed in the middle of a write.

    Args:
        nth: number of the write.
        share: share of its bytes that are written.
    """
    write_all, count = journal._write_all, 0

    def counting(file: FileIO, content: bytes) -> None:
        nonlocal count
        count += 1
        if count == nth:
            file.write(content[: int(share * len(content))])
            kill_me()
        write_all(file, content)

    journal._write_all = counting


def workers_of(pid: int) -> list[int]:
    """Return the worker processes of a process.

    Args:
        pid: id of the process.
    """
    children = Path(f"/proc/{pid}/task/{pid}/children")
    found = [int(child) for child in children.read_text().split()] if children.exists() else []
    return [
        child for child in found if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes()
    ]


def disturb(
    folder: Path, sampler: str, place: str, rng: np.random.Generator, whole_s: float
) -> int:
    """Run a campaign, and kill it.

    Args:
        folder: folder of the campaign.
        sampler: name of the sampler.
        place: where it is killed, as in the table above.
        rng: random generator of the moment.
        whole_s: seconds of an undisturbed campaign.

    Returns:
        The exit code.
    """
    settings = settings_of(sampler)

    def campaign() -> None:
        if place == "sync":
            kill_at_sync(int(rng.integers(1, SYNCS + 1)))
        if place == "torn":
            kill_at_write(int(rng.integers(1, WRITES + 1)), float(rng.random()))
        with open_workers(2 if place == "worker" else 1) as workers:
            run_campaign(settings, settings.load_plan(), folder, workers=workers)

    pid = forked(campaign)
    if place == "moment":
        time.sleep(float(rng.random()) * whole_s)
        os.kill(pid, signal.SIGKILL)
    if place == "worker":
        start = time.monotonic()
        while not (workers := workers_of(pid)) and time.monotonic() - start < PATIENCE_S:
            time.sleep(0.01)
        # While they are starting, or while they are at work.
        at_work = rng.random() < 0.7
        while at_work and not folder.exists() and time.monotonic() - start < PATIENCE_S:
            time.sleep(0.01)
        time.sleep(float(rng.random()) * whole_s / 2.0)
        workers = workers_of(pid) or workers
        try:
            os.kill(int(rng.choice(workers)), signal.SIGKILL)
        except ProcessLookupError:
            print("the campaign was over", file=sys.stderr)
    return ended(pid)


def begin(settings: CampaignSettings, folder: Path) -> None:
    """Run a campaign.

    Args:
        settings: its settings.
        folder: its new folder.
    """
    run_campaign(settings, settings.load_plan(), folder)


def go_on(folder: Path) -> None:
    """Resume a campaign.

    Args:
        folder: its folder.
    """
    settings = settings_in(folder, read_settings(folder))
    run_campaign(settings, settings.load_plan(), folder, resumes=True)


def main() -> None:
    """Kill and resume, and exit with 1 unless all outcomes are the same."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    load_libsumo()
    same = 0
    with tempfile.TemporaryDirectory() as scratch:
        temporary = Path(scratch) / "tmp"
        temporary.mkdir()
        tempfile.tempdir = os.environ["TMPDIR"] = str(temporary)
        expected, whole_s = {}, 0.0
        for sampler in SAMPLERS:
            folder = Path(scratch) / sampler
            start = time.monotonic()
            if ended(forked(partial(begin, settings_of(sampler), folder))) != 0:
                sys.exit("an undisturbed campaign failed")
            whole_s = max(whole_s, time.monotonic() - start)
            expected[sampler] = (folder / OUTCOMES).read_bytes()
        for kill in range(chosen.kills):
            rng = np.random.default_rng([chosen.seed, kill])
            place, sampler = PLACES[kill % len(PLACES)], SAMPLERS[kill // len(PLACES) % 3]
            folder = Path(scratch) / f"run-{kill}"
            code = disturb(folder, sampler, place, rng, whole_s)
            there = (folder / SETTINGS).is_file()
            lines = (folder / OUTCOMES).read_bytes().count(b"\n") if there else 0
            again: Callable[[Path], object] = (
                go_on if there else partial(begin, settings_of(sampler))
            )
            resumed = ended(forked(partial(again, folder)))
            equal = resumed == 0 and (folder / OUTCOMES).read_bytes() == expected[sampler]
            left = [path.name for path in temporary.iterdir()]
            same += equal and not left
            state = f"after {lines} outcomes" if there else "before there was a folder"
            print(
                f"{kill + 1:4d} {place:7s} {sampler:9s} exit {code:3d} {state}, resumed: "
                f"{'the same' if equal else 'NOT THE SAME'}{f', LEFT {left}' if left else ''}",
                flush=True,
            )
    print(f"the same outcomes.jsonl after {same} of {chosen.kills} kills")
    sys.exit(0 if same == chosen.kills else 1)


if __name__ == "__main__":
    main()
