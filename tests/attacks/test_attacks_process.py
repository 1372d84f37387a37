"""One process that goes on for long, and threads."""

from __future__ import annotations

import json
import threading

import pytest
from attacks import World
from campaigning import campaign_settings, run_campaign

from merge_sumo.campaigns.run import OUTCOMES

MANY = """
import gc, json, os, sys, tempfile, threading
from pathlib import Path
import merge_sumo as ms

def used():
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return {
        "descriptors": len(os.listdir("/proc/self/fd")),
        "threads": len(os.listdir("/proc/self/task")),
        "MB": pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
        "temporary": len(os.listdir(tempfile.gettempdir())),
        "children": len(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()),
    }

vut, count = sys.argv[1], int(sys.argv[2])
seen = []
for number in range(count):
    run = ms.campaign(vut, level=number % 3, cases=1, seed=number, out=f"run-{number}")
    assert len(run.cases) == 1, number
    assert not run.errors, run.errors
    if number in (count // 10, count // 2, count - 1):
        seen.append(used())
print(json.dumps(seen))
"""


@pytest.mark.long
@pytest.mark.parametrize(("vut", "count"), [("design1", 200), ("steady.py:drive", 60)])
def test_campaigns_in_one_process_keep_nothing(vut, count, tmp_path):
    world = World(tmp_path / "world")
    (world.root / "steady.py").write_text("def drive(seen):\n    return 1.0\n")
    script = f"import sys; sys.argv[1:] = {[vut, str(count)]!r}\n{MANY}"
    code, out, err = world.run(script=script)
    assert code == 0, err
    first, _, last = json.loads(out.splitlines()[-1])
    for name in ("descriptors", "threads", "temporary", "children"):
        assert last[name] <= first[name], name
    assert last["MB"] < first["MB"] + 0.25 * count, "a quarter of a megabyte for each at most"
    assert not world.processes()
    assert world.left_in_temporary() == []


SETTINGS = {
    name: campaign_settings(vut="design1", sampler=name, cases=40, batch=20, seed=4)
    for name in ("uniform", "gpr")
}


class TestThreads:
    def test_at_the_same_time_do_not_disturb_each_other(self, tmp_path):
        wrong: list[BaseException] = []

        def work(name: str, number: int) -> None:
            try:
                run_campaign(SETTINGS[name], tmp_path / f"{name}-{number}")
            except BaseException as error:
                wrong.append(error)

        threads = [
            threading.Thread(target=work, args=(name, number))
            for name in SETTINGS
            for number in range(2)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert wrong == []
        for name, settings in SETTINGS.items():
            run_campaign(settings, tmp_path / f"{name}-alone")
            written = {path.joinpath(OUTCOMES).read_bytes() for path in tmp_path.glob(f"{name}-*")}
            assert len(written) == 1
