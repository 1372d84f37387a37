"""Commands that are killed or stopped at any moment lose nothing, and can be given again.

`pytest -m long -s tests/attacks/test_attacks_kills.py` prints what was seen. Campaigns have a tool
of their own: `python tools/kill_campaigns.py`.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from attacks import SIGNALS, World, stop, tell
from processes import wait_for

from merge_sumo.system import folders
from merge_sumo.system.folders import TEMPORARY

ROUNDS = 6
"""Rounds of all signals for a command that takes seconds; those that take longer have fewer."""
CHILD = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_training import SMALL
from merge_sumo.training.helix import train_library
if __name__ == "__main__":
    train_library(Path("policies"), ("pov1", "vut1"), settings=SMALL)
"""


def without_times(text: str) -> object:
    """Return what JSON says, without what a clock decided."""
    if not text.strip():
        return None
    found = json.loads(text)
    for summary in found.get("samplers", {}).values():
        summary.pop("sampler_s", None)
    return found


@dataclass(frozen=True)
class Command:
    """A command to kill.

    Attributes:
        arguments: of the command line.
        rounds: how often each signal comes.
        makes: names of what it writes; the last one says that it is whole.
        script: runs instead of the command line.
    """

    arguments: tuple[str, ...]
    rounds: int
    makes: tuple[str, ...] = ()
    script: str | None = None


SMALL_COMPARE = ("--seeds", "2", "--cases", "60", "--truth-cases", "400", "--workers", "2")
COMMANDS = {
    "truth": Command(
        (
            *("truth", "--vut", "design1", "--level", "0", "--cases", "3000"),
            *("--workers", "2", "--json"),
        ),
        ROUNDS,
    ),
    "benchmark": Command(
        (
            *("benchmark", "--vut", "design1", "--level", "0", "--samplers", "uniform,gpr"),
            *(*SMALL_COMPARE, "--figure", "curves.svg", "--json"),
        ),
        2,
        ("curves.svg",),
    ),
    "reproduce": Command(
        ("reproduce", "--quick", "--seeds", "1", "--out", "paper", "--workers", "2"),
        1,
        ("paper", "paper/index.html"),
    ),
    "probability": Command(
        ("probability", "run", "--cases", "600", "--json"),
        ROUNDS,
        ("run/probability.json",),
    ),
    "export csv": Command(
        ("export", "run", "--format", "csv", "--out", "tables"),
        ROUNDS,
        ("tables/trajectories.csv",),
    ),
    "export sumo": Command(
        ("export", "run", *map(str, range(20)), "--out", "folders"), ROUNDS, ("folders",)
    ),
    "report": Command(("report", "run"), ROUNDS),
    "train": Command((str(Path(__file__).parents[1] / "training"),), 1, script=CHILD),
}


@pytest.mark.long
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_that_is_stopped_at_any_moment_can_be_given_again(name, run, tmp_path):
    command = COMMANDS[name]
    undisturbed = prepared(run, tmp_path / "undisturbed")
    start = time.monotonic()
    code, out, err = undisturbed.run(*command.arguments, script=command.script)
    whole_s = time.monotonic() - start
    assert code == 0, err
    expected, made = (
        without_times(out) if "--json" in command.arguments else out,
        files(undisturbed),
    )
    rng = np.random.default_rng(8)
    seen: Counter[str] = Counter()
    for how in SIGNALS:
        for number in range(command.rounds):
            world = prepared(run, tmp_path / f"{how}-{number}".replace(" ", "-"))
            before = files(world)
            process = world.start(*command.arguments, script=command.script)
            time.sleep(float(rng.random()) * whole_s)
            code, err = stop(process, how)
            assert "Traceback" not in err or command.script, (how, err)
            assert wait_for(world.has_ended), (how, "left running")
            kept = world.left_in_temporary()
            seen[f"{how} exit {code}"] += 1
            seen[f"{how}: temporary folders left"] += bool(kept)
            # What was there is as it was; what is there of the new is whole, or has no name yet.
            after = files(world)
            assert {n: after.get(n) for n in before if n != "run/report.html"} == {
                n: text for n, text in before.items() if n != "run/report.html"
            }
            assert_nothing_half_written(after, made)
            again, out, err = world.run(*command.arguments, script=command.script)
            assert "Traceback" not in err, err
            if again == 0:
                seen[f"{how}: again"] += 1
                found = without_times(out) if "--json" in command.arguments else out
                assert found == expected
                assert {n: t for n, t in files(world).items() if TEMPORARY not in n} == made
            else:
                seen[f"{how}: says what is in its way"] += 1
                assert again == 2, err
                assert "exists: choose another name with" in err
                assert any((world.root / path).exists() for path in command.makes), err
                for path in command.makes:  # as the sentence says
                    removed(world.root / path)
                again, _, err = world.run(*command.arguments, script=command.script)
                assert again == 0, err
            shutil.rmtree(world.root)
    tell(seen, f"{name}, {whole_s:.1f} s undisturbed: ")


def prepared(run, root: Path) -> World:
    world = World(root)
    shutil.copytree(run.folder, root / "run")
    (root / "thesis.txt").write_text("mine")
    return world


VARYING = ("manifest.json", ".training.jsonl", ".png", ".md", "table2.json", "index.html")
"""Ends of names of files that hold times, or that a test has no second copy of."""


def files(world: World) -> dict[str, bytes]:
    """Return the files, with nothing for the content of those that vary."""
    return {
        name: b"" if name.endswith(VARYING) else content for name, content in world.files().items()
    }


def assert_nothing_half_written(after: dict[str, bytes], made: dict[str, bytes]) -> None:
    for name, content in after.items():
        if TEMPORARY in name:
            continue
        assert name in made, name
        if name.endswith(".jsonl"):  # a journal: whole lines, and not more of them
            assert made[name].startswith(content)
        else:
            assert content == made[name], f"{name} is half written"


def removed(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_a_file_whose_writer_is_killed_has_no_name_yet(tmp_path, share):
    content = b"x" * 100_000

    def write() -> None:
        with folders.new_file(tmp_path / "table.csv") as file:
            file.write(content[: int(share * len(content))])
            file.flush()
            os._exit(0)

    pid = os.fork()
    if pid == 0:
        write()
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(TEMPORARY)
    folders.write_new(tmp_path / "table.csv", content)
    assert (tmp_path / "table.csv").read_bytes() == content
