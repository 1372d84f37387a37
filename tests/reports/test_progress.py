"""The progress of a campaign, on a terminal and elsewhere."""

# mypy: no-strict-optional

from __future__ import annotations

import io

import pytest
from lxml import html
from rich.console import Console
from support.handmade import write_run

from merge_sumo.metrics.summary import summarise
from merge_sumo.reports.progress import CampaignBars
from merge_sumo.reports.report import FIRST_REPORT_S, REPORT, REPORT_EVERY_S, RunningReport


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("progress") / "run")


@pytest.fixture
def clock(monkeypatch):
    """Return a clock that goes when it is told to."""
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    return now


def bars_for(folder, *, terminal=False):
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=100, color_system=None)
    return CampaignBars(folder, 180, console=console), out


def said(run, tmp_path, clock, **how) -> str:
    bars, out = bars_for(tmp_path, **how)
    with bars:
        bars.begin("a [b]")
        for outcome in run.outcomes:
            clock[0] += 0.5
            bars.ended([outcome])
        for done in range(41):
            clock[0] += 0.5
            bars.counted("careful drivers", done, 40, "failures")
    return out.getvalue()


def test_without_a_terminal_a_line_at_the_begin_every_minute_and_at_the_end(run, tmp_path, clock):
    first, *lines = said(run, tmp_path, clock).splitlines()
    assert first == f"a [b]: 180 cases, watch {tmp_path / REPORT}"
    found = summarise(run.outcomes).found
    assert found.startswith("1 error, ")
    assert len(lines) == 5
    assert lines[0].startswith("cases: 0/180  ")
    assert lines[1].startswith("cases: 120/180  ")
    assert lines[1].endswith("  2.00 cases/s  0:00:30 left")
    assert lines[2:] == [
        f"cases: 180/180  {found}  2.00 cases/s",
        "careful drivers: 0/40  ",
        "careful drivers: 40/40  2.00 failures/s",
    ]


def test_on_a_terminal_bars_end_with_what_was_found(run, tmp_path, clock):
    shown = said(run, tmp_path, clock, terminal=True)
    for text in ("a [b]: 180 cases", "0/180", "180/180", "1 error", "40/40"):
        assert text in shown


class TestTheReportOfACampaignThatRuns:
    @pytest.fixture
    def own(self, tmp_path, clock):
        """Return a campaign with its own folder, and a report whose time has come."""
        run = write_run(tmp_path / "a <b>", per_level=20, cases=90)
        report = RunningReport(run.folder)
        report.rewrite(run.outcomes[:1])
        assert not (run.folder / REPORT).exists(), "a short campaign goes without"
        clock[0] += FIRST_REPORT_S
        return run, report

    def test_is_the_report_without_surrogates_and_is_loaded_again(self, own, clock):
        run, report = own
        report.rewrite()
        root = html.parse(run.folder / REPORT).getroot()
        assert root.xpath("//meta[@http-equiv='refresh']/@content") == [str(REPORT_EVERY_S)]
        assert "This campaign is still running; it has 90 cases in total" in root.text_content()
        failing = [o for o in run.outcomes if o.failed]
        assert root.xpath("//tr[@class='all']//b/text()") == ["60", str(len(failing))]
        before = (run.folder / REPORT).read_bytes()
        report.rewrite()
        assert (run.folder / REPORT).read_bytes() == before, "it is not written for each case"

    def test_of_one_that_was_stopped_is_loaded_no_more_and_says_how_to_go_on(self, own):
        run, report = own
        report.rewrite()
        with pytest.raises(KeyboardInterrupt), report:
            raise KeyboardInterrupt
        page = html.parse(run.folder / REPORT).getroot()
        assert page.xpath("//meta[@http-equiv='refresh']") == []
        assert f"merge-sumo campaign --resume '{run.folder}'" in page.text_content()

    def test_is_left_away_where_something_else_is_in_its_place(self, own, clock, tmp_path):
        run, report = own
        (other := tmp_path / "other.html").write_text("mine")
        (run.folder / REPORT).symlink_to(other)
        for _ in run.outcomes:
            clock[0] += REPORT_EVERY_S
            report.rewrite()
        assert (run.folder / REPORT).read_text() == other.read_text() == "mine"
