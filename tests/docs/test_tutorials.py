"""The start page, the first campaign and the CI page show what their commands print."""

from __future__ import annotations

import re
import shlex

import pytest
from ci_snippets import PAGE, files, main
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
    page, vut = blocks("index.md"), tmp_path / "my_vut.py"
    (source,), (table, case, changes) = page["python"], page["text"]
    assert blocks("../README.md")["python"] == [source]
    vut.write_text(source)
    check, campaign, run, _window, rerun = (shlex.split(block)[1:] for block in page["bash"])
    assert run_in_a_process(tmp_path, *check).code == 0
    assert run_in_a_process(tmp_path, *campaign).out.endswith(table)
    code, out, _ = run_in_a_process(tmp_path, *run)
    assert (code, case in out) == (1, True)
    vut.write_text(source.replace("-60.0", "-100.0"))  # what the page changes
    assert changes in run_in_a_process(tmp_path, *rerun).out


def test_readme_shows_the_first_campaign():
    table, timeline = blocks("../README.md")["text"]
    first, case, *_ = blocks("tutorials/first-campaign.md")["text"]
    assert table.replace("runs/first", "runs/first-campaign") == first
    assert case.startswith(timeline.replace("case:", "case 456:"))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["first-campaign", "python-vut", "traci-controller"])
def test_a_tutorial_prints_what_it_shows(tmp_path, name):
    tutorial = f"tutorials/{name}.md"
    page = blocks(tutorial)
    for file, source in files((DOCS / tutorial).read_text("utf-8")).items():
        (tmp_path / file).write_text(source)
    for command, printed in zip(page.get("sh", page["bash"]), page["text"], strict=False):
        assert printed in run_in_a_process(tmp_path, *shlex.split(command)[1:]).out


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
