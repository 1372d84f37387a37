"""The names of `merge_sumo`: what tools know of them, and where they are documented."""

from __future__ import annotations

import inspect
import pydoc
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.calling import commands

import merge_sumo as ms

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "reference" / "python.md"
FUNCTIONS = sorted(name for name in ms.__all__ if inspect.isfunction(getattr(ms, name)))


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

    @pytest.mark.slow
    def test_sees_the_keywords_of_a_verb(self, tmp_path):
        wrong = ['ms.campaign("a", case=200)', 'ms.campaign("a", cases="many")']
        good = ['ms.campaign("a", cases=200)', 'ms.explain(ms.open_run("run"), 3)']
        source = "\n".join(["import merge_sumo as ms", *good, *wrong, ""])
        config = str(ROOT / "pyproject.toml")
        assert mypy(tmp_path, source, "--config-file", config) == wrong


def shown_classes() -> set[str]:
    """Return the names of the classes that mkdocstrings describes on the page; all are there."""
    paths = re.findall(r"^::: ([\w.]+)$", PAGE.read_text(), re.MULTILINE)
    assert [path for path in paths if pydoc.locate(path) is None] == []
    return {path.rpartition(".")[2] for path in paths}


OF_SCENARIO = {
    "scenario list": "scenarios",
    "scenario new": "new_scenario",
    "scenario check": "check_scenario",
}
NO_COMMAND = {"open_in_gui", "open_run", "resume", "stress"}
"""Functions for `replay --gui`, what a command prints, `campaign --resume`, `rerun --stress`."""


class TestTheNames:
    def test_are_those_of_the_commands(self):
        verbs = {OF_SCENARIO.get(name, name.replace("-", "_")) for name in commands()}
        assert verbs == {name for name in ms.__all__ if name.islower()} - NO_COMMAND - {
            "__version__"
        }

    def test_are_all_there_and_show_nothing_internal_in_dir(self):
        assert dir(ms) == sorted(ms.__all__)
        assert all(getattr(ms, name) is not None for name in ms.__all__)

    def test_are_on_the_page(self):
        functions = re.findall(r"^\| `(\w+)\(", PAGE.read_text(), re.MULTILINE)
        assert set(ms.__all__) - {"__version__"} <= {*functions, *shown_classes()}

    @pytest.mark.parametrize("name", FUNCTIONS)
    def test_return_what_is_on_the_page(self, name):
        returned = str(inspect.signature(getattr(ms, name)).return_annotation)
        ours = set(re.findall(r"[A-Z]\w+", returned)) - {"None", "Path"}
        assert ours <= shown_classes()
