"""What a person sees while a campaign runs, on a terminal and elsewhere."""

from __future__ import annotations

import io

import pytest
from handmade import write_run
from rich.console import Console

from merge_sumo.reports.progress import CampaignPanel
from merge_sumo.reports.summary import summarise


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("progress") / "run").outcomes


def said(outcomes, *, terminal: bool, quiet: bool = False) -> str:
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=100, color_system=None)
    with CampaignPanel("a [b]", len(outcomes), (0, 1, 2), quiet=quiet, console=console) as panel:
        for outcome in outcomes:
            panel.case_ended(outcome)
    return out.getvalue()


def test_without_a_terminal_a_line_for_every_tenth(outcomes):
    lines = said(outcomes, terminal=False).splitlines()
    assert len(lines) == 10
    assert lines[0].startswith("a [b]: 18/180 cases, ")
    failing = sum(outcome.failed for outcome in outcomes)
    assert lines[-1].startswith(f"a [b]: 180/180 cases, 1 error, {failing} failures, ")
    assert lines[-1].endswith(" cases/s")


def test_without_a_terminal_the_last_line_comes_however_many_cases_there_are(outcomes):
    lines = said(outcomes[:25], terminal=False).splitlines()
    assert "25/25" in lines[-1]


@pytest.mark.parametrize("terminal", [True, False])
def test_quiet_is_quiet(outcomes, terminal):
    assert said(outcomes, terminal=terminal, quiet=True) == ""


def test_on_a_terminal_the_panel_ends_with_what_was_found(outcomes):
    shown = said(outcomes, terminal=True)
    last = shown[shown.rindex("a [b]") :]
    assert "180/180 cases" in last
    assert "0:00 left" in last
    for level, found in summarise(outcomes, (0, 1, 2)).levels.items():
        (row,) = (line for line in last.splitlines() if line.startswith(f"│ {level} "))
        assert row.split()[2:5] == [str(found.cases), str(found.failures), f"{found.fmc:.4f}"]


def test_nothing_is_shown_before_the_first_case():
    assert said([], terminal=True) == ""
