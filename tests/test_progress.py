"""What a person sees while a campaign runs, on a terminal and elsewhere."""

from __future__ import annotations

import io
import sys
import types

import pytest
from handmade import write_run
from rich.console import Console

from merge_sumo.reports import progress
from merge_sumo.reports.progress import (
    Bars,
    CampaignPanel,
    Counter,
    is_watched,
    left_text,
    rate_text,
)
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
    assert lines[-1].endswith("cases/s, 0:00 left")


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


@pytest.fixture
def clock(monkeypatch):
    """Return a clock that goes when it is told to."""
    now = [100.0]
    monkeypatch.setattr("merge_sumo.reports.progress.time.monotonic", lambda: now[0])
    return now


class TestARate:
    @pytest.mark.parametrize(
        ("count", "elapsed_s", "text"),
        [
            (7140, 1.0, "7,140 cases/s"),
            (12, 1.0, "12 cases/s"),
            (5, 2.0, "2.5 cases/s"),
            (1, 20.0, "3.0 cases/min"),
            (1, 1200.0, "3.0 cases/h"),
            (1, 36_000.0, "0.1 cases/h"),
            (0, 5.0, "- cases/s"),
        ],
    )
    def test_is_readable(self, count, elapsed_s, text):
        assert rate_text(count, elapsed_s, "cases") == text

    def test_of_a_vut_that_takes_its_time_is_true_from_the_first_case_on(self, outcomes, clock):
        panel = CampaignPanel("a", 180, (0, 1, 2), quiet=True)
        clock[0] += 40.0
        for outcome in outcomes[:20]:  # they end together, as a batch does
            panel.case_ended(outcome)
        assert "20/180 cases" in panel._line()
        assert panel._line().endswith("30 cases/min, 5:20 left")

    def test_leaves_out_what_ran_before(self, outcomes, clock):
        panel = CampaignPanel("a", 180, (0, 1, 2), quiet=True)
        for outcome in outcomes[:100]:
            panel.ran_before(outcome)
        clock[0] += 10.0
        for outcome in outcomes[100:120]:
            panel.case_ended(outcome)
        assert "120/180 cases" in panel._line()
        assert panel._line().endswith("2.0 cases/s, 0:30 left")

    def test_of_a_bar_counts_from_its_opening(self, clock, capsys):
        with Counter("runs", 4, "runs") as counter:
            clock[0] += 2.0
            counter.ended(1)
        assert capsys.readouterr().err == "runs: 1/4, 30 runs/min  0:06 left\n"


class TestABar:
    def test_is_a_line_for_every_tenth_where_there_is_no_terminal(self, clock, capsys):
        with Counter("truth", 1000, "cases") as counter:
            for _ in range(40):
                clock[0] += 0.5
                counter.ended(25, "of 3 levels")
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 10
        assert lines[0] == "truth: 100/1,000, 50 cases/s  of 3 levels  0:18 left"
        assert lines[-1] == "truth: 1,000/1,000, 50 cases/s  of 3 levels"

    def test_on_a_terminal_shows_the_time_that_its_rate_leaves(self, clock):
        drawn = io.StringIO()
        with Bars(Console(file=drawn, force_terminal=True, width=100)) as bars:
            clock[0] += 2.0
            bars.show("truth", 50, 200, "25 cases/s")
        assert "50/200" in drawn.getvalue()
        assert "0:06 left" in drawn.getvalue()
        assert " 0/200" not in drawn.getvalue()


def test_what_is_left_is_in_hours_where_it_takes_that_long():
    assert left_text(1, 3, 3600.0) == "2:00:00 left"
    assert left_text(0, 3, 5.0) == ""


class TestInANotebook:
    @pytest.fixture
    def shown(self, monkeypatch):
        """Return what a notebook shows, as HTML, the newest last."""
        texts: list[str] = []
        handle = types.SimpleNamespace(update=lambda shown, raw: texts.append(shown["text/html"]))
        module = types.ModuleType("IPython.display")
        vars(module).update(display=lambda _shown, **_: handle)
        shell = types.SimpleNamespace(kernel=object())
        notebook = types.ModuleType("IPython")
        vars(notebook).update(get_ipython=lambda: shell)
        monkeypatch.setitem(sys.modules, "IPython", notebook)
        monkeypatch.setitem(sys.modules, "IPython.display", module)
        return texts

    def test_a_bar_and_a_line_are_shown_and_brought_up_to_date(self, outcomes, shown, monkeypatch):
        monkeypatch.setattr(progress, "FRESH_S", -1.0)
        assert is_watched()
        assert said(outcomes[:30], terminal=False) == ""
        assert len(shown) == 31
        assert shown[-1].startswith('<progress value="30" max="30"></progress> a [b]: 30/30 cases')

    def test_quiet_is_quiet(self, outcomes, shown):
        said(outcomes, terminal=False, quiet=True)
        assert shown == []
