"""The facts of a campaign: by hand, each once, with its source, wherever they are shown."""

# mypy: no-strict-optional

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from lxml import html
from support.calling import invoke
from support.handmade import write_run

from merge_sumo.analysis.counterfactuals import AVOIDANCE, Avoidance
from merge_sumo.analysis.share import SHARES, LevelShare, Shares
from merge_sumo.campaign_run import CampaignRun
from merge_sumo.campaigns.recorded import RecordedCampaign, failures
from merge_sumo.reports.facts import CONTACT, Fact
from merge_sumo.reports.report import report_page
from merge_sumo.reports.report_model import ReportModel


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> RecordedCampaign:
    run = write_run(tmp_path_factory.mktemp("facts") / "run", errors={3: "boom"}, timeouts=(4, 6))
    worst, *others = (o.index for o in failures(run.outcomes))
    lines = [Avoidance(worst, ("careful", "rss"), 3.0, pov_careful=True)]
    lines += [Avoidance(index, (), None, pov_careful=False) for index in others]
    AVOIDANCE.write_lines(run.folder, lines)
    shares = (LevelShare(0, 2000, 0), LevelShare(1, 2000, 22), LevelShare(2, 200, 0, 200))
    SHARES.write(run.folder, Shares(shares))
    return run


@pytest.fixture(scope="module")
def page(made) -> Any:
    return html.fromstring(report_page(ReportModel(made, learns=False)))


@pytest.fixture(scope="module")
def facts(made) -> dict[tuple[str, int | None], Fact]:
    return {(fact.name, fact.level): fact for fact in CampaignRun(made).facts}


def test_are_what_the_lines_of_the_folder_say(made, facts):
    rows = list(map(json.loads, (made.folder / "outcomes.jsonl").read_text().splitlines()))
    failing = [row for row in rows if (row["score"] or 0.0) < -500.0]
    for name, value in {
        "cases": 180,
        "errors": 1,
        "timeouts": 2,
        "failures": len(failing),
        "failures with contact": sum(row["severity"] == "contact" for row in failing),
        "worst case": min(failing, key=lambda row: (row["score"], row["index"]))["index"],
        "simulated time up to the merge": sum(row["t_end_s"] for row in rows) / 3600.0,
        "failures that driver careful avoids": 1,
        "failures that driver fsm avoids": 0,
        "failures that a careful POV avoids": 1,
    }.items():
        assert facts[name, None].value == pytest.approx(value), name
    for level in (0, 1, 2):
        of_level = [row for row in failing if row["level"] == level]
        assert facts["failures", level].value == len(of_level)
    untested = [fact.value for (name, _), fact in facts.items() if name == "without a verdict"]
    assert sum(untested) == 3


def test_are_listed_once_each_with_a_key_and_a_file_of_the_folder(made, facts):
    found = CampaignRun(made).facts
    assert len(found) == len(facts)
    assert all((made.folder / fact.file).is_file() and fact.key for fact in found)
    assert facts["failures", None].key == "score < -500"


def test_are_all_in_the_report_and_in_its_json(made, facts, page):
    listed = {
        div[0].text: (div[0][0].text, div[1].text)
        for div in page.xpath("//div[@class='facts']/dl/div")
    }
    of_all = {name: fact for (name, level), fact in facts.items() if level is None}
    assert of_all.keys() - listed.keys() == {"cases", "failures"}, "which are in the table"
    for name, shown in listed.items():
        fact = of_all[name]
        assert shown == (f"{fact.file}: {fact.key}", fact.shown)
    (table,) = page.xpath("//table[contains(@class, 'levels')]")
    heads = [head.text.partition(", ") for head in table.xpath(".//th[@class]")]
    for level, row in enumerate(table.xpath("./tbody/tr")[:3]):
        for (name, _, unit), cell in zip(heads, row[1:], strict=True):
            known = facts.get((name, level))
            expected = "–" if known is None else known.shown.removesuffix(unit).strip()
            assert cell.text_content().strip() == expected
    said = json.loads(invoke("report", made.folder, "--json").stdout)
    assert Path(said["report"]).is_file()
    assert [Fact(**row) for row in said["facts"]] == list(facts.values())


def test_stand_on_the_first_screen(made):
    model = ReportModel(made, learns=False)
    model.facts = [*model.facts, Fact(CONTACT, 2, "severity")]
    page: Any = html.fromstring(report_page(model))

    def said(name: str) -> list[str]:
        return [" ".join(one.text_content().split()) for one in page.find_class(name)]

    assert said("sentence") == [
        "handmade drives the vehicle under test (VUT) in 180 cases on the road us23. Another"
        " vehicle (POV) on the main road reacts at three levels. Failure criterion: front"
        " bumpers within 6 m when the VUT reaches the merge point."
    ]
    assert "their front bumpers are more than 6 m apart at the merge point" in said("strip")[0]
    avoided = page.xpath("//div[@class='avoided']//dd/text()")
    # By careful, fsm, reg157, rss, and a careful POV.
    assert avoided == [f"{number} of 60" for number in (1, 0, 0, 1, 1)]
    none, some, unknown = said("map")
    assert "< 0.15 % of all starts fail" in none
    assert "1.1 % of all starts fail" in some
    assert "95 % interval 0.69 to 1.7 %" in some
    assert "of all starts" not in unknown
    # The axis has 37 units for each power of ten, and 6 stands for 0.01 %.
    assert page.xpath("//circle[@class='estimate']/@cx") == ["81.5"]
