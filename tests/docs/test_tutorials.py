"""The start page, the first campaign and the CI page show what their commands print."""

from __future__ import annotations

import re
import shlex

import pytest
from ci_snippets import PAGE, main
from docs_pages import DOCS
from support.calling import run_in_a_process

import merge_sumo as ms


def blocks(page):
    """Return the code blocks of a page by their kind."""
    text = (DOCS / page).read_text(encoding="utf-8")
    found: dict[str, list[str]] = {}
    for kind, block in re.findall(r"^```(\w+)\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        found.setdefault(kind, []).append(block)
    return found


@pytest.mark.slow
def test_the_start_page_leads_to_a_failing_case(tmp_path):
    page = blocks("index.md")
    (tmp_path / "my_vut.py").write_text(*page["python"])
    assert blocks("../README.md")["python"] == page["python"]
    check, campaign, run, _window, rerun = (shlex.split(block)[1:] for block in page["bash"])
    assert run_in_a_process(tmp_path, *check).code == 0
    printed = run_in_a_process(tmp_path, *campaign).out
    assert printed.endswith(page["text"][0])
    (worst,) = re.findall(r"Worst: +case (\d+),", printed)
    assert worst == "27" in run, "the page runs the worst case again"
    code, out, _ = run_in_a_process(tmp_path, *run)
    assert (code, "contact" in out) == (1, True)
    assert run_in_a_process(tmp_path, *rerun).code == 0, "nothing has changed yet"


@pytest.mark.slow
def test_the_first_campaign_prints_its_page(tmp_path):
    page = blocks("tutorials/first-campaign.md")
    command = shlex.split(page["sh"][0].splitlines()[0])[1:]
    printed = run_in_a_process(tmp_path, *command, "-q").out
    assert printed == page["text"][0]
    table, timeline = blocks("../README.md")["text"]
    assert table.replace("runs/first", "runs/first-campaign") == printed
    case = run_in_a_process(tmp_path, "run", "--case", "runs/first-campaign", "456")
    assert case.out.startswith(timeline)


def test_the_cases_of_the_ci_page_are_those_of_its_controller(tmp_path, monkeypatch):
    main("github", tmp_path / "ci")
    monkeypatch.chdir(tmp_path / "ci")
    same = ms.rerun("cases.toml", vut="controller.py:Controller")
    assert same.text == (tmp_path / "ci" / "cases.toml").read_text()
    controller = (tmp_path / "ci" / "controller.py").read_text().replace("+ 2.0", "+ 0.2")
    (tmp_path / "ci" / "controller.py").write_text(controller)
    now = ms.rerun("cases.toml", vut="controller.py:Controller")
    shown = PAGE.read_text("utf-8").partition("instead of `+ 2.0`")[2].partition("```text\n")[2]
    for line in shown.partition("```")[0].splitlines():
        assert line == "..." or line in now.lines()
