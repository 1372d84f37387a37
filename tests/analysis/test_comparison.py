"""Comparisons of versions of a VUT: cases that broke or were fixed, and changes by chance."""

# mypy: no-strict-optional

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lxml import etree, html
from support.calling import assert_refused
from support.campaigning import campaign_settings, run_campaign
from support.handmade import drive
from support.histories import CASE, ended

from merge_sumo.analysis.comparison import Change, ComparedCase, compare
from merge_sumo.analysis.rerun import rerun
from merge_sumo.analysis.run_study import RunStudy
from merge_sumo.campaigns.journal import Journal
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.settings import settings_from_folder
from merge_sumo.errors import UserError
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.reports import comparison_page as pages
from merge_sumo.reports.text import change_in_words
from merge_sumo.scenario.case import from_unit
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End

Point = tuple[float, float, str]


SAFE, HARSH = (ended(CASE, -20.0, severity=severity) for severity in ("safe", "harsh"))
CONTACT, TOUCHES = (ended(CASE, score, severity="contact") for score in (-600.0, -20.0))
TIMEOUT, ERROR = ended(CASE, -1.0, end=End.TIMEOUT), ended(CASE, None)


@pytest.mark.parametrize(
    ("before", "after", "change", "words"),
    [
        (CONTACT, SAFE, Change.FIXED, "contact -> safe"),
        (SAFE, CONTACT, Change.BROKE, "safe -> contact"),
        (HARSH, ERROR, Change.BROKE, "harsh -> vut error"),
        (CONTACT, TIMEOUT, Change.NEITHER, "contact -> timeout"),
        (SAFE, HARSH, Change.BOTH, "safe -> harsh"),
        # Bodies still touch, although the criterion is met.
        (CONTACT, TOUCHES, Change.STILL_CONTACT, "contact, margin -0.2 -> contact, margin 0.96"),
    ],
)
def test_the_change_of_a_case(before, after, change, words):
    one = ComparedCase.of([before], [after])
    assert (one.change, change_in_words(one)) == (change, words)


def changed(folder, run, **settings) -> RecordedCampaign:
    """Return a copy of a run with other settings."""
    folder.mkdir()
    for name in ("outcomes.jsonl", "campaign.json"):
        (folder / name).write_bytes((run.folder / name).read_bytes())
    record = {**run.record, **settings}
    (folder / "campaign.json").write_text(json.dumps(record))
    return RecordedCampaign(folder)


def write(folder: Path, *points: Point, level: int = 0, **settings: object) -> RecordedCampaign:
    """Write a campaign with cases at points of the unit square that pass, fail or err."""
    record = {"vut": folder.name, "levels": [level], "sampler": "by hand", "cases": len(points)}
    journal = Journal.create(folder, record | settings)
    ran = []
    for index, (x, v, became) in enumerate(points):
        case = from_unit(np.array([[x, v]]), level, scenario=US23)[0]
        trajectory = drive(case, "answered nan" if became == "errs" else None)
        measures = Measures.of(trajectory)
        if became != "errs":
            score = -560.0 if became == "fails" else -100.0 - index
            measures = Measures(**measures.values | {"end": End.MERGED, "score": score})
        ran.append(Episode(Outcome(index, 0, case, measures), trajectory))
    journal.append(ran)
    return RecordedCampaign(folder)


def test_shared_cases_are_paired_wherever_they_stand(tmp_path):
    a = write(tmp_path / "a", (0.1, 0.1, "passes"), (0.5, 0.5, "fails"), (0.9, 0.9, "passes"))
    b = write(tmp_path / "b", (0.5, 0.5, "passes"), (0.9, 0.9, "fails"), (0.1, 0.1, "passes"))
    found = compare([a, b])
    (version_change,) = found.version_changes
    assert [(c.change, c.earlier.index, c.later.index) for c in version_change.cases] == [
        (Change.BROKE, 2, 1),
        (Change.FIXED, 1, 0),
        (Change.BOTH, 0, 2),
    ]
    assert (found.broke, found.worse) == (1, True)
    assert found.lines()[:8] == [
        f"1  a, {a.folder}  1 failure (0 with contact) in 3 cases",
        "   level 0: FMC 0.0079",
        f"2  b, {b.folder}  1 failure (0 with contact) in 3 cases",
        "   level 0: FMC 0.0079",
        "from version 1 to version 2: of 3 shared cases 1 worse, 1 better, 1 same verdict",
        "  worse            1  safe -> safe (broke)",
        "  better           1  safe -> safe (fixed)",
        "  same verdict     1  safe -> safe (pass with both)",
    ]


def test_a_version_that_passes_less_often_than_chance_explains_is_worse(call, tmp_path):
    shared = [(0.1, y / 9.0, "passes") for y in range(8)]
    own = [(0.9, y / 9.0) for y in range(8)]
    a = write(tmp_path / "a", *shared, *((x, y + 0.02, "passes") for x, y in own))
    b = write(tmp_path / "b", *shared, *((x, y, "fails") for x, y in own))
    files = "--out", tmp_path / "page.html", "--junit", tmp_path / "junit.xml"
    said = call("compare", a.folder, b.folder, *files)
    assert (
        "\nfrom version 1 to version 2: version 2 passes less often than version 1, "
        "by Fisher's exact test p = 0.0024; "
        "of 8 shared cases 0 worse, 0 better, 8 same verdict\n"
    ) in said.out
    assert said.code == 1
    assert "Version 2 passes in a smaller share" in (tmp_path / "page.html").read_text()
    assert etree.parse(tmp_path / "junit.xml").getroot().get("failures") == "1"
    assert not compare([b, a]).worse, "it passes more often"
    other = changed(tmp_path / "other", b, sampler="uniform")
    assert not compare([a, other]).worse, "another sampler finds other shares in one version"


def test_three_versions_are_two_changes(tmp_path):
    a = write(tmp_path / "a", (0.5, 0.5, "passes"))
    b = write(tmp_path / "b", (0.5, 0.5, "fails"))
    c = write(tmp_path / "c", (0.5, 0.5, "passes"))
    found = compare([a, b, c])
    assert [version_change.count(Change.BROKE) for version_change in found.version_changes] == [
        1,
        0,
    ]
    assert [line for line in found.lines() if line.startswith("from ")] == [
        "from version 1 to version 2: of 1 shared case 1 worse, 0 better",
        "from version 2 to version 3: of 1 shared case 0 worse, 1 better",
    ]


def test_what_does_not_compare_is_refused(tmp_path, run):
    with pytest.raises(UserError, match="needs at least two campaigns"):
        compare([run])
    with pytest.raises(UserError, match="no POV level in common"):
        compare([run, run, write(tmp_path / "1", (0.1, 0.1, "passes"), level=1)])
    with pytest.raises(UserError, match="differ in the tolerated share"):
        compare([run, changed(tmp_path / "tolerant", run, tolerated=0.2)])


def test_the_page_has_both_motions_of_each_listed_case_for_one_player(run):
    compared = compare([run, run])
    object.__setattr__(compared.versions[0], "motion", lambda _: None)  # lost
    root: Any = html.fromstring(pages.comparison_page(compared))
    cases = json.loads(root.get_element_by_id("data").text)["cases"]
    listed = [int(button.text) for button in root.xpath("//button[@data-pair]")]
    assert sorted(listed) == [outcome.index for outcome in run.outcomes if outcome.failed]
    assert cases["index"][::2] == cases["index"][1::2] == listed
    assert cases["rows"][::2] == [0] * len(listed)
    assert cases["rows"][1::2] == [len(run.trajectory(index).whole) for index in listed]


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("60",), "has no case 60"),
        (("--level", "2"), "has no cases at level '2': it has 0, or all"),
        (("3", "--stress"), "--stress runs all cases"),
    ],
)
def test_bad_use_of_rerun_is_refused(command_line, run, arguments, part):
    assert_refused(command_line("rerun", run.folder, *arguments), part)


def runs(failing: int, count: int) -> list[Outcome]:
    """Return runs of a case, the failing ones first."""
    made = []
    for draw in range(count):
        score = -600.0 if draw < failing else -20.0
        made.append(ended(replace(CASE, draw=draw), score, draw, dx_m=score + draw))
    return made


@pytest.mark.parametrize(
    ("before", "after", "tolerated", "change"),
    [
        ((3, 10), (5, 10), 0.4, Change.WITHIN_CHANCE),  # p = 0.65
        ((0, 10), (6, 10), 0.4, Change.BROKE),
        ((6, 10), (0, 10), 0.4, Change.FIXED),
    ],
)
def test_shares_that_chance_may_give_are_no_change(before, after, tolerated, change):
    assert ComparedCase.of(runs(*before), runs(*after), tolerated).change is change


COIN = """
import random
class Coin:
    def reset(self, seen, seed):
        self.stops = random.Random(seed).random() < {share}
    def act(self, seen):
        return -3.0 if self.stops else 0.5
"""


def test_campaigns_with_repeats_are_compared_case_by_case(tmp_path):
    made = []
    for name, share in (("a", 0.3), ("b", 0.4)):
        (tmp_path / f"{name}.py").write_text(COIN.format(share=share))
        settings = campaign_settings(
            vut=f"{tmp_path / name}.py:Coin",
            sampler="uniform",
            cases=60,
            repeat=10,
            tolerated=0.35,
            fail_when='end == "TIMEOUT"',
        )
        made.append(run_campaign(settings, tmp_path / f"run-{name}"))
    (version_change,) = compare(made).version_changes
    assert len(version_change.cases) == 6
    for one in version_change.cases:
        assert (one.earlier_runs.runs, one.later_runs.runs) == (10, 10)
        # The same seeds: what stops below .3 stops below .4, too.
        assert one.earlier_runs.failures <= one.later_runs.failures
    assert version_change.count(Change.BROKE) == 0, "no case is told apart by ten runs"
    today = settings_from_folder(made[0].folder, made[0].record, {"vut": made[0].vut})
    again = rerun(RunStudy(made[0], today, today.load_plan()), made[0].outcomes)
    assert {case.change for case in again.version_changes[0].cases} <= {Change.BOTH, Change.NEITHER}
