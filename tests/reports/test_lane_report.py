"""What is said and drawn of merges from an acceleration lane, and that nothing of it is without."""

# mypy: no-strict-optional

from __future__ import annotations

import re

import pytest
from handmade import write_run
from test_browser import browser, shown  # noqa: F401 (a fixture)
from test_report import data_of, text_of

from merge_sumo.api import CampaignRun
from merge_sumo.campaigns.run import Run
from merge_sumo.reports.pages import X_AXIS
from merge_sumo.reports.report import report_page
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.verdict.severity import Severity, meanings

LANE = named_scenario("us23-lane")
OF_M = (
    *("due at M (at constant speed)", X_AXIS, "M, where a merge is expected"),
    "M = 0, where a merge is expected",
)
"""What M, the place at which a merge is expected, is still named in."""


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Run:
    """Merges at M, one error, and timeouts on the lane; cases fail by the paper's rule."""
    folder = tmp_path_factory.mktemp("lane") / "run"
    return write_run(folder, scenario=LANE, errors={179: "answered nan"}, timeouts=[5, 6])


@pytest.fixture(scope="module")
def page(made) -> str:
    return report_page(made)


def without(text: str, phrases: tuple[str, ...]) -> str:
    for phrase in phrases:
        text = text.replace(phrase, "")
    return text


class TestSentences:
    def test_call_no_merge_by_m_on_a_lane(self, made, page):
        text = text_of(page)
        assert re.findall(r".{20}\bM\b.{20}", without(text, OF_M)) == []
        assert "front bumpers are within 6 m as the VUT reaches the merge" in text
        assert "would have kept 6 m at the merge" in text
        assert "the VUT did not reach the mainline in 12 s" in text
        titles = [measure["title"] for measure in data_of(page)["measures"]]
        assert {"Δx at the merge m", "braking asked after the merge m/s²"} <= {*titles}
        found = meanings(LANE)
        assert found[Severity.CONTACT] == "bodies touch at the merge or within 5 s after it"
        assert found[Severity.HARSH].endswith("harder than 3 m/s² within 5 s after the merge")


def test_merges_are_among_the_facts_of_each_level_beside_published_figures(made, page):
    assert "exiD, Li et al. 2023, arXiv 2303.11531" in text_of(page)
    run = CampaignRun(made)
    facts = {fact.name: fact.shown for fact in run.facts if fact.level == 0}
    assert facts["place of the merge, median"] == "35.4 % of the lane"
    assert facts["merges where the lane ends"] == "0"
    stood = [f.value for f in run.facts if f.name == "cases that stood on the lane"]
    assert sum(map(int, stood)) == 2
