"""The table at the end of a campaign, letter by letter, and how it shows what is not a success."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from support.handmade import write_run

from merge_sumo.campaign_run import CampaignRun
from merge_sumo.metrics.summary import summarise
from merge_sumo.reports import facts as f
from merge_sumo.reports.campaign_table import campaign_lines, level_table
from merge_sumo.scenario.scenario import US23

RULE = "front bumpers within 6 m when the VUT reaches the merge point"
PRINTED = f"""\
design2 on us23: 480 cases, 180 failures ({RULE})

POV level   all starts that fail      failures found   regions    FMC
0           < 0.15 %                               0
1           1.1 %  (0.69 to 1.7)                  44         2   .102
2           0.2 %  (0.06 to 0.51)                136         7   .018

Not counted: 25 cases with contact (`fail_when` unsafe counts them)
Avoidable:   all 180 by careful, fsm, reg157, rss; 169 by a careful POV
Worst:       case 157, late brake, contact at 12.2 m/s
             merge-sumo replay runs/latest 157 --gui"""


def campaign(values: dict[Any, Any]) -> tuple[Any, list[f.Fact]]:
    """Return a campaign, and facts by hand: of all cases by name, of a level by level and name."""
    facts = []
    for key, value in values.items():
        level, name = key if isinstance(key, tuple) else (None, key)
        facts.append(f.Fact(name, value, "", level=level))
    return SimpleNamespace(folder=Path("runs/latest"), scenario=US23, record={}), facts


def of_level(level: int, share: str, failures: int, regions: int, fmc: float) -> dict[Any, Any]:
    found = {(level, f.STARTS_THAT_FAIL): share, (level, f.CASES): 160}
    found |= {(level, f.FAILURES): failures, (level, f.REGIONS): regions, (level, f.FMC): fmc}
    return found


def test_is_that_of_the_page():
    values: dict[Any, Any] = {f.VUT: "design2", f.RULE: RULE, f.CASES: 480, f.FAILURES: 180}
    values |= of_level(0, "< 0.15 %", 0, 0, 0.0)
    values |= of_level(1, "1.1 %  (0.69 to 1.7)", 44, 2, 0.1018)
    values |= of_level(2, "0.2 %  (0.06 to 0.51)", 136, 7, 0.01802)
    values |= {f.AVOIDED.format(name): 180 for name in ("careful", "fsm", "reg157", "rss")}
    values |= {f.AVOIDED_BY_POV: 169, f.CONTACT: 25, f.WORST: 157}
    values[f.KIND] = "late brake, contact at 12.2 m/s"
    run, facts = campaign(values)
    lines = campaign_lines(run, replace(summarise(()), cases=480, failures=180), facts)
    assert "\n".join(lines) == PRINTED
    # Of drivers who do not avoid all failures, each number stands once.
    values |= {f.DRIVEN: 500, f.AVOIDED.format("fsm"): 500, f.AVOIDED.format("rss"): 0}
    run, facts = campaign(values)
    lines = campaign_lines(run, replace(summarise(()), cases=480, failures=180), facts)
    assert "\n".join(lines[8:10]) == (
        "Avoidable:   of 500 that were driven again: all 500 by fsm; 180 by careful, reg157; "
        "none by rss; 169\n             by a careful POV"
    )


def test_never_shows_as_a_zero_what_was_not_tested():
    head = ["POV level", "failures found", "undecided", "no verdict"]
    values: dict[Any, Any] = {(0, f.CASES): 0, (0, f.FAILURES): 0, (1, f.CASES): 4}
    values |= {(1, f.WITHOUT_VERDICT): 4, (2, f.CASES): 4, (2, f.FAILURES): 0, (2, f.UNDECIDED): 1}
    rows = [["0", "not run", "", ""], ["1", "nothing tested", "", "4"], ["2", "0", "1", ""]]
    assert level_table(campaign(values)[1]) == [head, *rows]


def test_begins_with_errors_and_says_what_they_are(tmp_path):
    run = write_run(tmp_path / "run", 1, errors={0: "boom", 1: "boom"}, timeouts=(2,))
    lines = CampaignRun(run).lines()
    assert lines[:2] == [
        "handmade on us23: 3 cases, 2 errors, 1 timeout, nothing tested",
        f"({RULE})",
    ]
    assert "\n".join(lines[3:10]) == (
        "POV level   failures found   no verdict\n"
        "0           nothing tested            1\n"
        "1           nothing tested            1\n"
        "2           nothing tested            1\n"
        "\n"
        "Not judged:  2 VUT_ERROR, the first in case 0: boom\n"
        "             1 TIMEOUT, the first in case 2: "
        "the VUT did not reach the merge point in 12 s"
    )
    assert lines[-1] == f"Report:      {run.folder / 'report.html'}"
