"""The names of `merge_sumo`: what tools know of them, and where they are documented."""

from __future__ import annotations

import inspect
import pydoc
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

import merge_sumo as ms
from merge_sumo import cli

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reference" / "python.md"
FUNCTIONS = sorted(name for name in ms.__all__ if inspect.isfunction(getattr(ms, name)))

RIGHT = """
from typing import Any

import merge_sumo as ms


class Mine:
    def reset(self, seen: ms.Seen) -> None:
        self.first_m = seen.x_vut_m

    def act(self, seen: ms.Seen) -> float:
        cars: tuple[ms.Car, ...] = seen.others
        return 1.0 if cars[0].x_m > seen.x_vut_m else -seen.v_vut_mps / 10.0


class Batched:
    def __init__(self, corridors: int) -> None:
        self.corridors = corridors

    def act_batch(self, seen: ms.SeenBatch) -> object:
        return seen.v_vut_mps * 0.0


def keep(seen: ms.Seen) -> float:
    return 0.0 * seen.t_s


setup: dict[str, Any] = {"scenario": "us23", "fail_when": "unsafe", "follow_up_s": 2.0}
run: ms.CampaignRun = ms.campaign(Mine, level=0, cases=40, seed=1, **setup)
for vut in (keep, "design2", Batched, Mine()):
    ms.campaign(vut, deadline_s=1.0)
worst: int = run.failures[0]["index"]
print(run.verdict.failures, run.summary.levels[0].fmc, run.report_file, run.facts[0].file)
case: ms.CaseRun = ms.run(Mine, run.failures[0], level=0, x_pov0_m=-300.0, v_pov0_mps=30.0)
again = ms.run(recorded=(run, 3), debug=True)
print(case.measures.end, case.failed, again.trajectory.motion[0, 0, 0])
ms.resume(run, cases=80, workers=2)
print(ms.rerun(run, [1, 2], vut="design2", level=0).broke, ms.stress(run).robust)
print(ms.compare([run, "runs/b"], out="page.html", junit="junit.xml").worse)
print(ms.export(run, 3)[0].name, ms.report(run).lines(), ms.replay(run, 3).diverged_at_s)
code: int = ms.open_in_gui(run, 3)
print(ms.truth(Mine, 0, cases=100).truths[0].failures.shape, ms.vuts().lines())
print(ms.scenarios(), ms.new_scenario("a.toml", net="a.net.xml", mainline="a b", ramp="r b"))
print(ms.check_scenario("us23"), ms.reproduce(quick=True))
print(ms.explain(run, 3).found)
print(ms.benchmark("fsm", 0, samplers=["uniform"], seeds=2).samplers["uniform"].fmc.median)
print(ms.probability(run, cases=100).confidence)
print(ms.repair(run, ["gain=0..1"], trials=9).repaired)
print(ms.check_vut(Mine).problems, ms.train(["pov1"], check=True)["pov1"].mean_regret)
try:
    ms.open_run("nowhere")
except ms.UserError as error:
    print(error, ms.Notice, ms.__version__)
"""
WRONG = """
import merge_sumo as ms

ms.campagn("design2")
ms.Nonsense
ms.campaign("design2", cases="40")
ms.campaign("design2", casse=40)
ms.campaign("design2", scenari="us23")
ms.campaign(3)
ms.open_run("x").failurs


def f(seen: ms.Seen) -> float:
    return seen.x_pow_m
"""


def mypy(tmp_path: Path, source: str, *options: str) -> list[str]:
    """Return the lines of a file in which mypy finds a mistake."""
    file = tmp_path / "user.py"
    file.write_text(source)
    command = [sys.executable, "-m", "mypy", "--strict", "--config-file", "", *options, str(file)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode in (0, 1), done.stderr
    wrong = re.findall(rf"^{file}:(\d+): error", done.stdout, re.MULTILINE)
    return [source.splitlines()[int(number) - 1].strip() for number in dict.fromkeys(wrong)]


class TestATypeChecker:
    def test_refuses_names_that_are_not_there(self, tmp_path):
        # Nothing behind the package is followed, so this takes a second.
        options = "--follow-imports=skip", "--cache-dir", str(tmp_path), "merge_sumo/__init__.py"
        names = 'import merge_sumo as ms\nms.campagn("design2")\nms.Nonsense\nms.campaign("a")\n'
        assert mypy(tmp_path, names, *options) == ['ms.campagn("design2")', "ms.Nonsense"]

    @pytest.mark.long
    def test_takes_right_use_of_everything_public(self, tmp_path):
        assert set(re.findall(r"\bms\.(\w+)", RIGHT)) == set(ms.__all__)
        assert mypy(tmp_path, RIGHT) == []

    @pytest.mark.long
    def test_refuses_wrong_use(self, tmp_path):
        lines = [line.strip() for line in WRONG.splitlines()]
        wrong = [line for line in lines if line.startswith(("ms.", "return"))]
        assert mypy(tmp_path, WRONG) == wrong


def commands(group: Any, front: str = "") -> set[str]:
    """Return what a person types for each command."""
    below = getattr(group, "commands", None)
    if below is None:
        return {front}
    return {
        name for part, one in below.items() for name in commands(one, f"{front} {part}".strip())
    }


OF_SCENARIO = {
    "scenario list": "scenarios",
    "scenario new": "new_scenario",
    "scenario check": "check_scenario",
}
NO_COMMAND = {"open_in_gui", "open_run", "resume", "stress"}
"""Functions for `replay --gui`, what a command prints, `campaign --resume`, `rerun --stress`."""


class TestTheNames:
    def test_are_those_of_the_commands(self):
        typed = commands(typer.main.get_command(cli.app))
        verbs = {OF_SCENARIO.get(name, name.replace("-", "_")) for name in typed}
        assert verbs == {name for name in ms.__all__ if name.islower()} - NO_COMMAND - {
            "__version__"
        }

    def test_are_all_there_and_show_nothing_internal_in_dir(self):
        assert dir(ms) == sorted(ms.__all__)
        assert all(getattr(ms, name) is not None for name in ms.__all__)

    def test_have_docstrings(self):
        nameless = [
            n for n in ms.__all__ if n != "__version__" and not inspect.getdoc(getattr(ms, n))
        ]
        assert nameless == []

    @pytest.mark.parametrize("name", FUNCTIONS)
    def test_have_help_that_fits_a_screen(self, name):
        shown = pydoc.plain(pydoc.render_doc(getattr(ms, name))).splitlines()
        # One line for each parameter, as later versions of Python write a long signature.
        more = len(inspect.signature(getattr(ms, name)).parameters)
        assert len(shown) + more <= 80

    def test_are_on_the_page(self):
        shown = set(re.findall(r"^<!-- [\w.]+\.(\w+) -->$", PAGE.read_text(), re.MULTILINE))
        assert set(ms.__all__) - {"__version__"} <= shown

    @pytest.mark.parametrize("name", FUNCTIONS)
    def test_return_what_is_on_the_page(self, name):
        shown = set(re.findall(r"^<!-- [\w.]+\.(\w+) -->$", PAGE.read_text(), re.MULTILINE))
        returned = str(inspect.signature(getattr(ms, name)).return_annotation)
        ours = set(re.findall(r"[A-Z]\w+", returned)) - {"Path"}
        assert ours <= shown


def test_a_keyword_that_is_unknown_is_a_type_error_that_says_which_was_meant():
    with pytest.raises(TypeError, match="'scenari': did you mean 'scenario'"):
        ms.campaign("design2", scenari="us23")  # type: ignore[call-arg]
