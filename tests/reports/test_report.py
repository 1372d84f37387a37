"""What the report says, what it holds, and what it lets in."""

# mypy: no-strict-optional

from __future__ import annotations

import base64
import hashlib
import json
from typing import Any

import numpy as np
import pytest
from lxml import html
from support.handmade import write_run

from merge_sumo.analysis.surface import learn_surface
from merge_sumo.campaigns.recorded import RecordedCampaign, failures, spread_failures
from merge_sumo.controllers.process import LINES, LOG
from merge_sumo.reports import report_model
from merge_sumo.reports.report import report_page
from merge_sumo.reports.report_data import SPEED_UNIT_MPS
from merge_sumo.reports.report_model import ReportModel
from merge_sumo.scenario.case import to_unit
from merge_sumo.scenario.scenario import DT_S, US23

EVIL = "</script><script>alert(1)</script><img src=x onerror=alert(2)>&\"'"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> RecordedCampaign:
    return write_run(tmp_path_factory.mktemp("made") / "run")


@pytest.fixture(scope="module")
def page(made) -> str:
    return report_page(ReportModel(made))


def root_of(page: str) -> Any:
    return html.fromstring(page)


def data_of(page: str) -> dict:
    (element,) = root_of(page).xpath("//script[@id='data']")
    return json.loads(element.text)


class TestThePage:
    def test_says_the_result_first(self, made, page):
        (total,) = root_of(page).xpath("//p[@class='total']/b/text()")
        assert int(total) == len(failures(made.outcomes))

    def test_loads_nothing_and_runs_nothing_but_its_own_script(self, page):
        root = root_of(page)
        assert "//" not in "".join(root.xpath("//@href | //@src"))
        assert "http:" not in page
        assert "https:" not in page
        (policy,) = root.xpath("//meta[@http-equiv='Content-Security-Policy']/@content")
        assert policy.startswith("default-src 'none'")
        for name in ("style", "script"):
            (source,) = root.xpath(f"//{name}[not(@type)]")
            digest = hashlib.sha256(source.text.encode()).digest()
            assert f"'sha256-{base64.b64encode(digest).decode()}'" in policy
        assert root.xpath("//@style") == []

    def test_lists_the_worst_and_the_nearest_misses(self, made, page):
        root = root_of(page)
        listed = [int(n) for n in root.xpath("//section[@id='cases']//@data-case")]
        assert listed[0] == 179, "the case that ended with an error"
        assert listed[1:11] == [o.index for o in spread_failures(made.outcomes)[:10]]
        passing = [o for o in made.outcomes if o.margin is not None and not o.failed]
        passing.sort(key=lambda outcome: outcome.margin)
        near = [made.outcome(index).margin for index in listed[11:]]
        assert near == [outcome.margin for outcome in passing[:10]]


class TestWhatWasNotTested:
    def test_is_listed_by_message_with_counts_before_all_else(self, tmp_path):
        errors = {3: f"{EVIL}\x1b[31m", 6: f"{EVIL}\x1b[31m", 9: "other"}
        run = write_run(tmp_path / "run", 20, errors=errors, timeouts=(0, 1, 2, 4))
        page = report_page(ReportModel(run, learns=False))
        root = root_of(page)
        rows = root.xpath("//section[@aria-labelledby='untested']//tbody/tr")
        assert [[cell.text_content() for cell in row] for row in rows] == [
            [f"{EVIL}\\x1b[31m", "VUT_ERROR", "2 cases", "first 3"],
            ["other", "VUT_ERROR", "1 case", "first 9"],
            ["the VUT did not reach the merge point in 12 s", "TIMEOUT", "4 cases", "first 0"],
        ]
        assert page.index('id="untested"') < page.index('class="total"')

    def test_ends_with_what_the_controller_printed_last(self, tmp_path):
        run = write_run(tmp_path / "run", 10, errors={})
        lines = [f"line {n} </pre><script>" for n in range(1000)]
        (run.folder / LOG).write_text("\x1b[31m" + "\n".join(lines), encoding="utf-8")
        page = report_page(ReportModel(run, learns=False))
        (shown,) = root_of(page).xpath("//section[@aria-labelledby='about']//pre")
        assert shown.text.splitlines() == lines[-LINES:]


class TestTheMotion:
    def test_follows_from_the_speeds_to_within_2_cm(self, made, page):
        data = data_of(page)
        packed = np.frombuffer(base64.b64decode(data["speeds"]), dtype="<u2").reshape(-1, 2)
        first = 0
        for i, index in enumerate(data["cases"]["index"]):
            rows = data["cases"]["rows"][i]
            motion = made.trajectory(index).motion
            assert rows == len(motion)
            speeds = packed[first : first + rows] * SPEED_UNIT_MPS
            assert np.abs(speeds - motion[:, :, 1]).max() <= SPEED_UNIT_MPS / 2
            moved = np.cumsum(speeds * DT_S, axis=0)[:-1]
            assert np.abs(data["cases"]["starts"][i] + moved - motion[1:, :, 0]).max() < 0.02
            first += rows


class TestALongCampaign:
    def test_shows_some_cases_and_counts_the_others(self, made, monkeypatch):
        monkeypatch.setattr(report_model, "SHOWN", 50)
        page = report_page(ReportModel(made, learns=False))
        data = data_of(page)
        assert len(data["cases"]["index"]) == 50
        counted = 0
        for of_level in data["maps"].values():
            counted += np.sum(of_level["counts"][0])
        assert counted == len(made.outcomes) - 50
        root = root_of(page)
        assert f"counts of the {counted} further cases" in " ".join(root.text_content().split())
        shown = set(data["cases"]["index"])
        assert {int(n) for n in root.xpath("//button/@data-case")} <= shown


def test_the_surrogate_gives_failures_a_higher_chance_than_other_cases(made):
    for level in (0, 1):
        surface = learn_surface(made.outcomes, level)
        told = [o for o in made.outcomes if o.case.level == level and o.measures.score]
        chance = surface(to_unit([o.case for o in told], level, scenario=US23))
        failed = np.array([o.failed for o in told])
        assert chance[failed].min() > np.median(chance[~failed])
        assert chance[failed].mean() > 0.5
        assert chance[~failed].mean() < 0.1
    few = [o for o in made.outcomes if not o.failed] + failures(made.outcomes)[:4]
    assert all(learn_surface(few, level) is None for level in (0, 1, 2))
