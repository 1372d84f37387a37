"""What a person sees while a campaign runs, on a terminal and elsewhere."""

from __future__ import annotations

import io
import sys
import types
from dataclasses import replace

import pytest
from handmade import write_run
from lxml import html
from rich.console import Console

from merge_sumo.analysis.summary import summarise
from merge_sumo.campaigns.store import failures
from merge_sumo.reports import campaign_panel, running_page
from merge_sumo.reports.campaign_panel import CampaignPanel
from merge_sumo.reports.campaign_progress import FAILURE_S, LEVEL_S, CampaignProgress, Phase
from merge_sumo.reports.progress import Bars, Counter, Work, clock_text, is_watched, rate_text
from merge_sumo.reports.report import GENERATOR, REPORT, report_page, write_report
from merge_sumo.reports.running_page import EVERY_S, FIRST_S, MOST_SHARE, RunningPage
from merge_sumo.values.case import to_unit
from merge_sumo.values.fmc import fmc


@pytest.fixture(scope="module")
def outcomes(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("progress") / "run").outcomes


def said(outcomes, *, terminal: bool, quiet: bool = False) -> str:
    out = io.StringIO()
    console = Console(file=out, force_terminal=terminal, width=100, color_system=None)
    progress = CampaignProgress("a [b]", len(outcomes), (0, 1, 2))
    with CampaignPanel(progress, quiet=quiet, console=console) as panel:
        for outcome in outcomes:
            panel.case_ended(outcome)
        failing = sum(outcome.failed for outcome in outcomes)
        for done in range(failing + 1 if outcomes else 0):
            panel.advance(Phase.CAREFUL, done, failing)
        for done in range(7 if outcomes else 0):
            panel.advance(Phase.REPORT, done, 6)
    return out.getvalue()


def test_without_a_terminal_a_line_for_every_tenth_of_each_phase(outcomes):
    lines = said(outcomes, terminal=False).splitlines()
    failing = sum(outcome.failed for outcome in outcomes)
    cases = [line for line in lines if "/180 cases, " in line]
    assert lines[:10] == cases
    assert cases[0].startswith("a [b]: 18/180 cases, ")
    assert cases[-1].startswith(f"a [b]: 180/180 cases, 1 error, {failing} failures, ")
    careful = [line for line in lines if line.startswith("a [b]: careful drivers, ")]
    assert careful[0].startswith(f"a [b]: careful drivers, 0/{failing} failures, about 0:")
    assert f"{failing}/{failing} failures" in careful[-1]
    assert 2 < len(careful) <= 12
    counts = [f"a [b]: report, {done}/6 parts, about 0:0" for done in range(7)]
    assert [line[:-6] for line in lines[10 + len(careful) :]] == counts
    assert lines[-1] == "a [b]: report, 6/6 parts, about 0:00 left"


def test_without_a_terminal_the_last_line_comes_however_many_cases_there_are(outcomes):
    lines = said(outcomes[:25], terminal=False).splitlines()
    assert any("25/25 cases" in line for line in lines)


@pytest.mark.parametrize("terminal", [True, False])
def test_quiet_is_quiet(outcomes, terminal):
    assert said(outcomes, terminal=terminal, quiet=True) == ""


def test_on_a_terminal_the_panel_ends_with_what_was_found(outcomes):
    shown = said(outcomes, terminal=True)
    last = shown[shown.rindex("a [b]") :]
    failing = sum(outcome.failed for outcome in outcomes)
    for text in ("180/180 cases", f"{failing}/{failing} failures", "6/6 parts", "0:00 left"):
        assert text in last
    for level, found in summarise(outcomes, (0, 1, 2)).levels.items():
        *_, row = (line for line in last.splitlines() if line.startswith(f"│ {level} "))
        assert row.split()[2:5] == [str(found.cases), str(found.failures), f"{found.fmc:.4f}"]


def test_nothing_is_shown_before_the_first_case():
    assert said([], terminal=True) == ""


@pytest.fixture
def clock(monkeypatch):
    """Return a clock that goes when it is told to."""
    now = [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
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
        progress = CampaignProgress("a", 180, (0, 1, 2))
        clock[0] += 40.0
        for outcome in outcomes[:20]:  # they end together, as a batch does
            progress.case_ended(outcome)
        assert "20/180 cases" in progress.line
        assert ", 30 cases/min, " in progress.line
        assert progress.work[Phase.CASES].left_s == 320.0

    def test_leaves_out_what_ran_before(self, outcomes, clock):
        progress = CampaignProgress("a", 180, (0, 1, 2))
        for outcome in outcomes[:100]:
            progress.ran_before(outcome)
        clock[0] += 10.0
        for outcome in outcomes[100:120]:
            progress.case_ended(outcome)
        assert "120/180 cases" in progress.line
        assert ", 2.0 cases/s, " in progress.line
        assert progress.work[Phase.CASES].left_s == 30.0

    def test_and_what_is_left_are_of_the_phase_and_the_time_left_is_of_the_whole(
        self, outcomes, clock
    ):
        progress = CampaignProgress("a", 180, (0, 1, 2), workers=2)
        assert progress.left_s is None
        for outcome in outcomes[:60]:
            clock[0] += 1.0
            progress.case_ended(outcome)
        failing = sum(outcome.failed for outcome in outcomes[:60])
        assert failing
        careful_s, report_s = FAILURE_S * 3 * failing / 2, 3 * LEVEL_S
        assert progress.left_s == pytest.approx(120.0 + careful_s + report_s)
        for outcome in outcomes[60:]:
            clock[0] += 1.0
            progress.case_ended(outcome)
        progress.advance(Phase.CAREFUL, 0, 40)
        clock[0] += 10.0
        progress.advance(Phase.CAREFUL, 10, 40)
        assert "careful drivers, 10/40 failures, 1.0 failures/s" in progress.line
        assert progress.left_s == pytest.approx(30.0 + report_s)
        progress.advance(Phase.REPORT, 0, 6)
        assert progress.left_s == pytest.approx(report_s)
        clock[0] += 8.0
        progress.advance(Phase.REPORT, 4, 6)
        assert progress.left_s == pytest.approx(4.0)
        assert progress.rate(Phase.CASES) == "1.0 cases/s", "a phase that ended keeps its rate"

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
    assert clock_text(7200.0) == "2:00:00"
    assert Work(3, 5.0).left_s is None


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
        monkeypatch.setattr(campaign_panel, "FRESH_S", -1.0)
        assert is_watched()
        assert said(outcomes[:30], terminal=False) == ""
        assert any(
            text.startswith('<progress value="30" max="30"></progress> a [b]: 30/30 cases')
            for text in shown
        )
        assert shown[-1].startswith('<progress value="6" max="6"></progress> a [b]: report, 6/6')

    def test_quiet_is_quiet(self, outcomes, shown):
        said(outcomes, terminal=False, quiet=True)
        assert shown == []


class TestThePageOfACampaignThatRuns:
    @pytest.fixture
    def folder(self, tmp_path, outcomes):
        folder = tmp_path / "run"
        folder.mkdir()
        return folder

    def counted(self, folder, outcomes, clock, *, quiet=True):
        """Return a panel with a page, after some cases and the time after which it appears."""
        panel = CampaignPanel(
            CampaignProgress("a <b>", len(outcomes), (0, 1, 2)), RunningPage(folder), quiet=quiet
        )
        for outcome in outcomes[:90]:
            panel.case_ended(outcome)
        assert not (folder / REPORT).exists(), "a short campaign goes without"
        clock[0] += FIRST_S
        panel.case_ended(outcomes[90])
        return panel

    def test_says_what_is_known_and_asks_to_be_loaded_again(self, folder, outcomes, clock):
        panel = self.counted(folder, outcomes, clock)
        root = html.parse(folder / REPORT).getroot()
        assert root.xpath("//meta[@http-equiv='refresh']/@content") == [str(EVERY_S)]
        assert root.xpath("//script | //@src | //@href | //img | //b[text()='<b>']") == []
        assert root.xpath("//h1")[0].text == "a <b>"
        failing = [o for o in outcomes[:91] if o.failed]
        text = root.text_content()
        assert f"{len(failing)} failures in 91/180 cases" in text
        assert len(root.xpath("//*[@class='map']//*[contains(@class, ' fail')]")) == len(failing)
        assert len(root.xpath("//*[@class='map']//*[contains(@class, 'mark ')]")) == 91
        worst = [int(row.text) for row in root.xpath("//tbody/tr/td[1]")]
        assert worst == [o.index for o in failures(failing)[:10]]
        before = (folder / REPORT).read_bytes()
        panel.case_ended(outcomes[91])
        assert (folder / REPORT).read_bytes() == before, "it is not written for each case"
        clock[0] += EVERY_S
        panel.case_ended(outcomes[92])
        assert b"93/180 cases" in (folder / REPORT).read_bytes()

    def test_of_one_that_was_stopped_is_loaded_no_more_and_says_how_to_go_on(
        self, folder, outcomes, clock
    ):
        with pytest.raises(KeyboardInterrupt), self.counted(folder, outcomes, clock):
            raise KeyboardInterrupt
        page = (folder / REPORT).read_text()
        assert 'http-equiv="refresh"' not in page
        assert f"merge-sumo campaign --resume {folder}" in page

    def test_is_replaced_by_the_report_alone(self, tmp_path, clock):
        run = write_run(tmp_path / "run")
        with self.counted(run.folder, run.outcomes, clock) as panel:
            page = (run.folder / REPORT).read_bytes()
            panel.advance(Phase.REPORT, 0, 6)
            clock[0] += 10 * EVERY_S
            panel.advance(Phase.REPORT, 1, 6)
            assert (run.folder / REPORT).read_bytes() == page
            write_report(run)
        final = (run.folder / REPORT).read_text()
        assert 'http-equiv="refresh"' not in final
        assert final == report_page(run)

    def test_is_said_on_the_terminal_once(self, folder, outcomes, clock, capsys):
        panel = self.counted(folder, outcomes, clock, quiet=False)
        for outcome in outcomes[91:]:
            panel.case_ended(outcome)
        said = f"a <b>: watch it in a browser: {folder / REPORT}"
        assert capsys.readouterr().err.splitlines().count(said) == 1

    @pytest.mark.parametrize("what", ["a link", "somebody's page", "no folder"])
    def test_is_left_away_where_it_cannot_be_written(
        self, folder, outcomes, clock, what, capsys, tmp_path
    ):
        other = tmp_path / "other.html"
        other.write_text("mine")
        if what == "a link":
            (folder / REPORT).symlink_to(other)
        elif what == "somebody's page":
            (folder / REPORT).write_text("mine")
        else:
            folder.rmdir()
        panel = CampaignPanel(CampaignProgress("a", 180, (0, 1, 2)), RunningPage(folder))
        clock[0] += FIRST_S
        for outcome in outcomes:
            panel.case_ended(outcome)
        assert "watch it" not in capsys.readouterr().err
        assert other.read_text() == "mine"
        if what == "somebody's page":
            assert (folder / REPORT).read_text() == "mine"

    def test_takes_no_more_than_its_share_of_the_time(self, folder, outcomes, clock, monkeypatch):
        written = []

        def slow(*_, **__):
            clock[0] += 2.0
            written.append(clock[0])
            return GENERATOR.decode()

        monkeypatch.setattr(running_page, "running_page", slow)
        page, now = RunningPage(folder), CampaignProgress("a", 180, (0, 1, 2))
        for _ in range(1000):
            clock[0] += 1.0
            page.show(now)
        assert 2.0 * len(written) <= MOST_SHARE * clock[0]
        assert len(written) > 10


def test_counts_a_case_once_and_as_failing_while_more_of_its_runs_fail_than_are_tolerated(outcomes):
    fails = next(outcome for outcome in outcomes if outcome.failed)
    passes = next(outcome for outcome in outcomes if not outcome.failed).measures
    progress = CampaignProgress("a", 4, (0, 1, 2), tolerated=0.5)
    found = []
    for draw, measures in enumerate((fails.measures, passes, fails.measures, fails.measures)):
        case = replace(fails.case, draw=draw)
        progress.case_ended(replace(fails, index=draw, case=case, measures=measures))
        progress.refresh()
        found.append((progress.found, round(progress.fmc[fails.case.level], 4)))
    ball = round(fmc(to_unit([fails.case], fails.case.level)), 4)
    one, none = ("1 failure", ball), ("0 failures", 0.0)
    assert found == [one, none, one, one]
