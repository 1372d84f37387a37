"""The page of a campaign whose cases ran several times, for a VUT that fails by chance."""

# mypy: no-strict-optional

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from lxml import html
from reports.test_browser import browser, shown  # noqa: F401 (a fixture)
from scipy.stats import beta, binomtest
from support.campaigning import campaign_settings, run_campaign

from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.reports.report import REPORT, write_report

CONTROLLERS = Path(__file__).parents[1] / "support" / "chance_vuts.py"
TOLERATED, RUNS = 0.2, 4


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> RecordedCampaign:
    settings = campaign_settings(
        vut=f"{CONTROLLERS}:Slope", cases=30 * RUNS, seed=5, repeat=RUNS, tolerated=TOLERATED
    )
    run = run_campaign(settings, tmp_path_factory.mktemp("chance") / "run")
    write_report(run)
    return run


def recorded(run: RecordedCampaign) -> dict[tuple, list[tuple[int, bool]]]:
    """Return index and verdict of each run, by the start of its case, from the file alone."""
    cases: dict[tuple, list[tuple[int, bool]]] = {}
    for line in (run.folder / "outcomes.jsonl").read_text().splitlines():
        record = json.loads(line)
        start = record["x_pov0_m"], record["v_pov0_mps"]
        cases.setdefault(start, []).append((record["index"], record["score"] < -500.0))
    return cases


def test_shows_each_case_once_with_the_share_of_its_runs_that_fail(made, browser):  # noqa: F811
    cases = recorded(made)
    failures = {start: sum(fails for _, fails in runs) for start, runs in cases.items()}
    assert {len(runs) for runs in cases.values()} == {RUNS}
    both_ways = [start for start, failed in failures.items() if 0 < failed < RUNS]
    failing = [start for start, failed in failures.items() if failed > TOLERATED * RUNS]
    assert len(both_ways) > 2, "chance decides"
    page: Any = html.fromstring((made.folder / REPORT).read_text())
    text = " ".join(page.text_content().split())
    totals = page.xpath("//tr[@class='all']//b/text()")
    # Jeffreys' posterior without the first failure: at most 5 % for the tolerated share or less.
    decided = [
        start
        for start in failing
        if beta.cdf(TOLERATED, failures[start] - 0.5, RUNS - failures[start] + 0.5) <= 0.05
    ]
    assert 0 < len(decided) < len(failing)
    assert totals == [str(len(cases)), str(len(decided)), str(len(failing) - len(decided))]
    runs = page.xpath("//dl/div[dt/text()='runs']/dd/text()")
    assert runs == [str(30 * RUNS)]
    assert "An undecided case fails in more than 20 % of its runs so far" in text
    with shown(browser, made.folder / REPORT) as opened:
        # All cases ran more than once: the learned probability is shown around each, nowhere else.
        assert opened.locator("#known0 ellipse").count() == len(cases)
        assert opened.locator(".map image").get_attribute("clip-path") == "url(#known0)"
        words = opened.locator("select[name=verdict] option").all_inner_texts()
        assert f"failure ({len(decided)})" in words
        assert f"undecided ({len(failing) - len(decided)})" in words
        arcs = opened.locator(".map .of-runs")
        assert arcs.count() == len(both_ways)
        drawn = arcs.evaluate_all("all => all.map((arc) => arc.getAttribute('stroke-dasharray'))")
        shares = {f"{100 * failures[start] // RUNS}" for start in both_ways}
        assert {dashes.split()[0] for dashes in drawn} == shares
        start = both_ways[0]
        index = opened.evaluate(
            "([x, v]) => cases.index.find((_, i) => Math.abs(cases.x_pov0_m[i] - x) < 0.01"
            " && Math.abs(cases.v_pov0_mps[i] - v) < 0.01)",
            list(start),
        )
        opened.evaluate("(index) => openCase(place.get(index))", index)
        interval = binomtest(failures[start], RUNS).proportion_ci(method="exact")
        low, high = (round(100.0 * end) for end in interval)
        each = ", ".join(f"{one} {'fails' if fails else 'passes'}" for one, fails in cases[start])
        assert (
            f"Fails in {failures[start]} of {RUNS} runs (95 % interval {low} to {high} %): {each}. "
            f"Run {index} decides the result and is shown."
        ) in opened.locator("#case-words").inner_text()
        assert dict(cases[start])[index] == (failures[start] > TOLERATED * RUNS)
