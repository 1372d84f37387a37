"""The facts of a campaign: by hand, each once, with its source, wherever they are shown."""

# mypy: no-strict-optional

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from calling import invoke
from handmade import write_run
from lxml import html

from merge_sumo.api.results import CampaignRun
from merge_sumo.campaigns.run import Run, failures
from merge_sumo.reports.facts import Fact
from merge_sumo.reports.report import report_page
from merge_sumo.studies.counterfactuals import AVOIDANCE, Avoidance


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Run:
    run = write_run(tmp_path_factory.mktemp("facts") / "run", errors={3: "boom"}, timeouts=(4, 6))
    worst, *others = (o.index for o in failures(run.outcomes))
    lines = [Avoidance(worst, ("careful", "rss"), 3.0, pov_careful=True)]
    lines += [Avoidance(index, (), None, pov_careful=False) for index in others]
    AVOIDANCE.write_lines(run.folder, lines)
    return run


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
        "simulated time": sum(row["t_end_s"] for row in rows) / 3600.0,
        "failures that driver careful avoids": 1,
        "failures that driver fsm avoids": 0,
        "failures that a careful POV avoids": 1,
    }.items():
        assert facts[name, None].value == pytest.approx(value), name
    for level in (0, 1, 2):
        of_level = [row for row in failing if row["level"] == level]
        assert facts["failures", level].value == len(of_level)
    untested = [facts["without a verdict", level].value for level in (0, 1, 2)]
    assert sum(untested) == 3


def test_stand_once_each_with_a_file_of_the_folder(made):
    found = CampaignRun(made).facts
    assert set(Counter((fact.name, fact.level) for fact in found).values()) == {1}
    assert all((made.folder / fact.file).is_file() and fact.key for fact in found)


def test_are_all_in_the_report_and_in_its_json(made, facts):
    page: Any = html.fromstring(report_page(made))
    rows = page.xpath("//section[@aria-labelledby='facts']//tbody/tr")
    cells = {
        (row[0].text_content(), n): c.text_content() for row in rows for n, c in enumerate(row)
    }
    listed = {div[0].text: (div[0][0].text, div[1].text) for div in page.xpath("//dl/div")}
    for (name, level), fact in facts.items():
        if level is None and name in listed:
            assert listed[name] == (f"{fact.file}: {fact.key}", fact.shown)
    assert {name for name, level in facts if level is None} - listed.keys() == {"cases", "failures"}
    heads = [head.text for head in page.xpath("//table[contains(@class, 'levels')]//th[@class]")]
    for column, head in enumerate(heads, start=1):
        name, _, unit = head.partition(", ")
        for level in (0, 1, 2):
            shown = facts[name, level].shown.removesuffix(unit)
            assert cells[str(level), column].strip() == shown.strip()
    said = json.loads(invoke("report", made.folder, "--json").stdout)
    assert Path(said["report"]).is_file()
    assert [Fact(**row) for row in said["facts"]] == list(facts.values())


def test_stand_once_in_the_terminal_too(made, facts):
    text = str(CampaignRun(made))
    number = facts["failures", None].value
    assert text.startswith(f"1 error, 2 timeouts and {number} failures (")
    assert text.count(f"{number} failures") == 1
    for line in text.splitlines()[1:]:
        if line.startswith(("      0 ", "      1 ", "      2 ")):
            level, cases, untested, *_ = line.split()
            assert cases == "60"
            assert untested == facts["without a verdict", int(level)].shown
