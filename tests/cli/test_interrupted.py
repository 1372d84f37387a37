"""The contract of every verb that runs cases or writes: to be stopped at any moment costs nothing.

A verb runs undisturbed on one worker. Another call of it, on two, is stopped; then it is given
again, or gone on with, and has made the same files, to the byte, and says the same.
"""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.attacks import SIGNALS, Workspace, stop
from support.processes import wait_for

from merge_sumo.files import TEMPORARY

CONTROLLER = "def old(seen):\n    return 0.4\n\n\ndef new(seen):\n    return 0.6\n"


@dataclass(frozen=True)
class Verb:
    """A verb with small numbers.

    Attributes:
        command: what is given.
        resume: goes on where `new` is there; without it the command is given again.
        has_workers: whether it has that option.
        how: the signal.
    """

    command: str
    resume: str = ""
    has_workers: bool = True
    how: str = "SIGKILL"


CAMPAIGN = "campaign --level 0 --cases 30 --seed 1 --out new"
RESUME = "campaign --resume new"
VERSIONS = "--vut own.py:new --against own.py:old"
VERBS = {
    "campaign": Verb(f"{CAMPAIGN} --vut design1 --sampler annealing", RESUME, how="SIGTERM"),
    "campaign in flight": Verb(
        f"{CAMPAIGN} --vut design1 --sampler gpr --in-flight 4", RESUME, how="Ctrl-C twice"
    ),
    "campaign against": Verb(
        f"{CAMPAIGN} {VERSIONS} --sampler gpr", f"{RESUME} {VERSIONS}", how="Ctrl-C"
    ),
    "rerun": Verb("rerun run --json", how="SIGTERM"),
    "explain": Verb("explain run --json"),
    "truth": Verb("truth --vut design1 --level 0 --cases 1500 --json"),
    "benchmark": Verb(
        "benchmark --vut design1 --level 0 --samplers uniform,gpr --seeds 2 --cases 24 "
        "--truth-cases 200 --figure curves.svg --json"
    ),
    "probability": Verb("probability run --cases 200 --json"),
    "export csv": Verb("export run --format csv --out new", has_workers=False),
    "report": Verb("report run", has_workers=False),
}


def given(simulation: Workspace, verb: Verb, workers: int) -> tuple[object, ...]:
    """Return the words of a verb where it stands."""
    begun = verb.resume and (simulation.root / "new" / "campaign.json").exists()
    words = (verb.resume if begun else verb.command).split()
    return *words, *(("--workers", workers) if verb.has_workers else ())


def whole(verb: Verb, simulation: Workspace) -> tuple[Any, dict[str, bytes], float]:
    """Return what a verb says and makes on one worker, and how long it takes."""
    start = time.monotonic()
    code, out, err = simulation.run(*given(simulation, verb, 1))
    assert code in (0, 1), err
    return said(out), made(simulation), time.monotonic() - start


@pytest.mark.slow
@pytest.mark.parametrize("name", VERBS)
def test_what_was_stopped_is_made_to_the_byte_and_nothing_stays(name, run, tmp_path):
    verb, how = VERBS[name], VERBS[name].how
    told, expected, whole_s = whole(verb, prepared(run, tmp_path / "whole"))
    simulation = prepared(run, tmp_path / "simulation")
    before = made(simulation)
    process = simulation.start(*given(simulation, verb, 2))
    time.sleep(np.random.default_rng([len(name), len(how)]).uniform(0.3, 1.0) * whole_s)
    code, err = stop(process, how)
    # A worker that Python is about to start finds its parent killed.
    unborn = how == "SIGKILL" and "EOFError: Ran out of input" in err
    assert unborn or "Traceback" not in err, err
    assert "\x1b" not in err, "there is no terminal"
    assert wait_for(simulation.has_ended), "left running"
    if how != "SIGKILL":
        assert code in (0, 1, *(c for n in SIGNALS[how] for c in (128 + n, -n))), err
        assert simulation.left_in_temporary() == []
    for folder in simulation.temporary.iterdir():  # of a process that was killed
        removed(folder)
    left = made(simulation)
    assert {n: left.get(n) for n in before if n != "run/report.html"} == {
        n: content for n, content in before.items() if n != "run/report.html"
    }
    again, out, err = simulation.run(*given(simulation, verb, 2))
    if again == 2 and "exists: choose another name" in err:  # a file or a folder of results
        removed(simulation.root / ("new" if (simulation.root / "new").exists() else "curves.svg"))
        again, out, err = simulation.run(*given(simulation, verb, 2))
    assert again in (0, 1), err
    assert simulation.left_in_temporary() == []
    if not verb.resume:
        assert said(out) == told
    assert made(simulation) == expected


def prepared(run, root: Path) -> Workspace:
    simulation = Workspace(root)
    shutil.copytree(run.folder, root / "run")
    (root / "own.py").write_text(CONTROLLER)
    return simulation


def said(out: str) -> Any:
    """Return what a verb prints, without what a clock decided."""
    if not out.startswith("{"):
        return out
    return json.loads(out)


VARYING = (".png", ".html")
"""Ends of names of files that hold times."""


def made(simulation: Workspace) -> dict[str, bytes]:
    """Return the files with a name of ours, with nothing for the content of those that vary."""
    return {
        name: b"" if name.endswith(VARYING) else content
        for name, content in simulation.files().items()
        if TEMPORARY not in name
    }


def removed(path: Path) -> None:
    (shutil.rmtree if path.is_dir() else Path.unlink)(path)
