"""The start page of the site leads to a failing case of a VUT of one's own: its steps are run."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", PAGE, flags=re.DOTALL | re.MULTILINE)
(SOURCE,) = (block for kind, block in BLOCKS if kind == "python")
CHECK, CAMPAIGN, RUN, WINDOW, RERUN = (
    shlex.split(block)[1:] for kind, block in BLOCKS if kind == "bash"
)
(PRINTED,) = (block for kind, block in BLOCKS if kind == "text")
FAILS = 1
SHARE = re.compile(r"[\d.]+ % \[.*?\] of all starts fail, by [\d,]+")
"""Of as many starts as fit into a part of the time of the campaign."""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory) -> tuple[Path, str]:
    """Return the folder in which the page's campaign has run, and the worst case by its name."""
    folder = tmp_path_factory.mktemp("start")
    (folder / "my_vut.py").write_text(SOURCE, encoding="utf-8")
    command = [sys.executable, "-m", "merge_sumo.cli", *CAMPAIGN]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (folder / "first" / "report.html").is_file()
    printed, shown = (SHARE.sub("SHARE", text) for text in (done.stdout, PRINTED))
    assert printed.endswith(shown), "the page shows what the command prints"
    (worst,) = re.findall(r"worst case .* (\d+) --gui", done.stdout)
    return folder, worst


def the_worst(arguments: list[str], case: str) -> list[str]:
    """Return the arguments with the case that the campaign named in the place of the page's."""
    assert "27" in arguments
    return [case if argument == "27" else argument for argument in arguments]


def test_installing_is_all_that_comes_before():
    assert [block for kind, block in BLOCKS if kind == "sh"] == ["pip install .\n"]
    assert len(SOURCE.splitlines()) <= 10


@pytest.mark.slow
def test_the_steps_lead_to_a_failing_case(campaign, command_line, monkeypatch):
    folder, worst = campaign
    monkeypatch.chdir(folder)
    code, _, err = command_line(*CHECK)
    assert code == 0, err
    code, out, _ = command_line(*the_worst(RUN, worst))
    assert (code, "contact" in out) == (FAILS, True)
    assert command_line(*RERUN)[0] == 0, "nothing has changed yet"


@pytest.mark.slow
def test_the_last_step_opens_it_in_sumo_gui(campaign, command_line, monkeypatch):
    folder, worst = campaign
    monkeypatch.chdir(folder)
    monkeypatch.setenv("DISPLAY", ":99")
    monkeypatch.setattr("merge_sumo.sumo.replay.open_gui", lambda *_, **_options: 0)
    arguments = the_worst(WINDOW, worst)
    assert arguments == [*the_worst(RUN, worst), "--gui"]
    code, _, err = command_line(*arguments)
    assert code == FAILS, err
