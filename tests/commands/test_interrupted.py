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
from attacks import SIGNALS, World, stop
from processes import wait_for

CHILD = f"""
import sys
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parents[1] / "training")!r})
from test_training import SMALL
from merge_sumo.training.helix import train_library
if __name__ == "__main__":
    train_library(Path("new"), ("pov1", "vut1"), settings=SMALL)
"""
CONTROLLER = "def old(seen):\n    return 0.4\n\n\ndef new(seen):\n    return 0.6\n"


@dataclass(frozen=True)
class Verb:
    """A verb with small numbers.

    Attributes:
        command: what is given.
        resume: goes on where `new` is there; without it the command is given again.
        has_workers: whether it has that option.
        script: runs instead of the command line.
        how: the signal of the default run.
    """

    command: str
    resume: str = ""
    has_workers: bool = True
    script: str | None = None
    how: str = "SIGKILL"


CAMPAIGN = "campaign --level 0 --cases 40 --seed 1 --out new"
RESUME = "campaign --resume new"
VERSIONS = "--vut own.py:new --against own.py:old"
VERBS = {
    "campaign": Verb(f"{CAMPAIGN} --vut design1 --sampler annealing", RESUME, how="SIGTERM"),
    "campaign in flight": Verb(
        f"{CAMPAIGN} --vut design1 --sampler gpr --in-flight 4", RESUME, how="Ctrl-C twice"
    ),
    "campaign against": Verb(f"{CAMPAIGN} {VERSIONS}", f"{RESUME} {VERSIONS}", how="Ctrl-C"),
    "rerun": Verb("rerun run --json", how="SIGTERM"),
    "rerun --stress": Verb("rerun run --stress --json"),
    "explain": Verb("explain run --json"),
    "truth": Verb("truth --vut design1 --level 0 --cases 1500 --json"),
    "benchmark": Verb(
        "benchmark --vut design1 --level 0 --samplers uniform,gpr --seeds 2 --cases 40 "
        "--truth-cases 400 --figure curves.svg --json"
    ),
    "reproduce": Verb("reproduce --quick --seeds 1 --out new"),
    "probability": Verb("probability run --cases 200 --json"),
    "export csv": Verb("export run --format csv --out new", has_workers=False),
    "export sumo": Verb("export run 0 1 2 3 4 5 6 7 --out new", has_workers=False),
    "report": Verb("report run", has_workers=False),
    "train": Verb("", script=CHILD, has_workers=False),
}
MINUTES = ("reproduce", "train")
CASES = [
    pytest.param(*(name, how), marks=pytest.mark.long if name in MINUTES or how != verb.how else ())
    for name, verb in VERBS.items()
    for how in SIGNALS
]


def given(world: World, verb: Verb, workers: int) -> tuple[object, ...]:
    """Return the words of a verb where it stands."""
    begun = verb.resume and (world.root / "new" / "campaign.json").exists()
    words = (verb.resume if begun else verb.command).split()
    return *words, *(("--workers", workers) if verb.has_workers else ())


@pytest.fixture(scope="module")
def whole(run, tmp_path_factory):
    """Return what a verb says and makes on one worker, and how long it takes."""
    known: dict[str, tuple[Any, dict[str, bytes], float]] = {}

    def get(name: str) -> tuple[Any, dict[str, bytes], float]:
        if name not in known:
            world = prepared(run, tmp_path_factory.mktemp("whole") / "world")
            start = time.monotonic()
            verb = VERBS[name]
            code, out, err = world.run(*given(world, verb, 1), script=verb.script)
            assert code in (0, 1), err
            known[name] = said(out), made(world), time.monotonic() - start
        return known[name]

    return get


@pytest.mark.slow
@pytest.mark.parametrize(("name", "how"), CASES)
def test_what_was_stopped_is_made_to_the_byte_and_nothing_stays(name, how, whole, run, tmp_path):
    verb, (told, expected, whole_s) = VERBS[name], whole(name)
    world = prepared(run, tmp_path / "world")
    before = made(world)
    process = world.start(*given(world, verb, 2), script=verb.script)
    time.sleep(np.random.default_rng([len(name), len(how)]).uniform(0.3, 1.0) * whole_s)
    code, err = stop(process, how)
    assert "Traceback" not in err or verb.script, err
    assert "\x1b" not in err, "there is no terminal"
    assert wait_for(world.has_ended), "left running"
    if how != "SIGKILL" and not verb.script:
        assert code in (0, 1, *(c for n in SIGNALS[how] for c in (128 + n, -n))), err
        assert world.left_in_temporary() == []
    left = made(world)
    assert {n: left.get(n) for n in before if n != "run/report.html"} == {
        n: content for n, content in before.items() if n != "run/report.html"
    }
    again, out, err = world.run(*given(world, verb, 2), script=verb.script)
    if again == 2 and "exists: choose another name" in err:  # a file or a folder of results
        removed(world.root / ("new" if (world.root / "new").exists() else "curves.svg"))
        again, out, err = world.run(*given(world, verb, 2), script=verb.script)
    assert again in (0, 1), err
    if not verb.resume:
        assert said(out) == told
    assert made(world) == expected


def prepared(run, root: Path) -> World:
    world = World(root)
    shutil.copytree(run.folder, root / "run")
    (root / "own.py").write_text(CONTROLLER)
    return world


def said(out: str) -> Any:
    """Return what a verb prints, without what a clock decided."""
    if not out.startswith("{"):
        return out
    return json.loads(out)


VARYING = ("manifest.json", ".training.jsonl", ".png", ".md", "table2.json", ".html")
"""Ends of names of files that hold times."""


def made(world: World) -> dict[str, bytes]:
    """Return the files, with nothing for the content of those that vary."""
    return {
        name: b"" if name.endswith(VARYING) else content for name, content in world.files().items()
    }


def removed(path: Path) -> None:
    (shutil.rmtree if path.is_dir() else Path.unlink)(path)
