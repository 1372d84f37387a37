"""The table at the end of a campaign, letter by letter, and how it shows what is not a success."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

from support.handmade import write_run

from merge_sumo.campaign_run import CampaignRun
from merge_sumo.metrics.summary import LevelSummary, Summary
from merge_sumo.reports.campaign_table import campaign_lines, level_table
from merge_sumo.reports.facts import STARTS_THAT_FAIL, Fact
from merge_sumo.scenario.scenario import US23

FACTS = """\
VUT: design2
failure criterion: front bumpers within 6 m when the VUT reaches the merge point
cases: 480
failures: 180
cases with contact that are not failures: 25
failures that driver careful avoids: 180
failures that driver fsm avoids: 180
failures that driver reg157 avoids: 180
failures that driver rss avoids: 180
failures that a careful POV avoids: 169
worst case: 157
kind of the worst case: late brake, contact at 12.2 m/s"""
PRINTED = """\
design2 on us23: 480 cases, 180 failures (front bumpers within 6 m when the VUT reaches the merge point)

POV level   starts that fail          failures found   regions    FMC
0           < 0.15 %                               0
1           1.1 %  (0.69 to 1.7)                  44         2   .102
2           0.2 %  (0.06 to 0.51)                136         7   .018

Not counted: 25 cases with contact (`fail_when` unsafe counts them)
Avoidable:   all 180 by careful, fsm, reg157, rss; 169 if the POV brakes carefully
Worst:       case 157, late brake, contact at 12.2 m/s
             merge-sumo replay runs/latest 157 --gui"""  # noqa: E501 (as it is printed)
SHARES = ("< 0.15 %", "1.1 %  (0.69 to 1.7)", "0.2 %  (0.06 to 0.51)")
LEVELS = {
    0: LevelSummary(160, 160, 0, 0.0, 0),
    1: LevelSummary(160, 160, 44, 0.1018, 2),
    2: LevelSummary(160, 160, 136, 0.01802, 7),
}


def printed(text: str) -> str:
    """Return what a campaign with facts of a text prints."""
    facts = [Fact(STARTS_THAT_FAIL, one, "", level=level) for level, one in enumerate(SHARES)]
    for line in text.splitlines():
        name, _, value = line.partition(": ")
        facts.append(Fact(name, int(value) if value.isdigit() else value, ""))
    run: Any = SimpleNamespace(folder=Path("runs/latest"), scenario=US23)
    found = Summary(480, 180, 0, 0, 0, frozenset(), (), US23.goal, LEVELS)
    return "\n".join(campaign_lines(run, found, facts))


def test_says_each_number_once_in_columns():
    assert printed(FACTS) == PRINTED
    some = FACTS.replace("fsm avoids: 180", "fsm avoids: 0")
    assert "180 by careful, reg157, rss; none by fsm; 169 if the POV brakes" in printed(some)
    some += "\nfailures that ran again with reference drivers: 500"
    assert "Avoidable:   of the 500 worst: 180 by careful, reg157" in printed(some)


def test_never_shows_as_a_zero_what_was_not_tested():
    levels = {0: LevelSummary(0, 0, 0, 0.0, 0), 1: LevelSummary(4, 0, 0, 0.0, 0)}
    levels[2] = LevelSummary(4, 4, 0, 0.0005, 1, undecided=1)
    found = Summary(8, 0, 0, 4, 0, frozenset({7}), (), US23.goal, levels)
    head, *rows = ["   ".join(row) for row in level_table(found, {})]
    assert head == "POV level   failures found   undecided   no verdict   regions   FMC"
    rows = [" ".join(row.split()) for row in rows]
    assert rows == ["0 not run", "1 nothing tested 4", "2 0 1 1 < .001"]


def test_begins_with_errors_and_says_what_they_are(tmp_path):
    run = write_run(tmp_path / "run", 1, errors={0: "boom", 1: "boom"}, timeouts=(2,))
    lines = str(CampaignRun(run))
    assert lines.startswith("handmade on us23: 3 cases, 2 errors, 1 timeout, nothing tested\n(")
    assert (
        "\nNot judged:  2 VUT_ERROR, the first in case 0: boom\n             1 TIMEOUT, " in lines
    )
    assert lines.endswith(f"\nReport:      {run.folder / 'report.html'}")
