"""Several versions in one page: regions that were fixed and that broke, by records alone."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import math
import re
from dataclasses import asdict, replace
from html import escape
from pathlib import Path

import numpy as np
import pytest
from handmade import drive, write_run

import merge_sumo as ms
from merge_sumo.campaigns.store import Journal, Run
from merge_sumo.errors import UserError
from merge_sumo.reports.version_pages import axis_end, history_page
from merge_sumo.studies.history import RegionChange, history_of
from merge_sumo.values.case import from_unit
from merge_sumo.values.scenario import US23
from merge_sumo.values.score import Outcome, measure
from merge_sumo.values.trajectory import End

BALL = math.pi * 0.05**2
Point = tuple[float, float, str]


def write(folder: Path, *points: Point, level: int = 0, **settings: object) -> Run:
    """Write a campaign with cases at points of the unit square that pass, fail or err."""
    record = {"vut": folder.name, "levels": [level], "sampler": "by hand", "cases": len(points)}
    record |= settings
    journal = Journal.create(folder, record)
    ran = []
    for index, (x, v, became) in enumerate(points):
        case = from_unit(np.array([[x, v]]), level, scenario=US23)[0]
        trajectory = drive(case, "answered nan" if became == "errs" else None)
        measures = measure(trajectory)
        if became != "errs":
            end, score = (End.MERGED, -560.0) if became == "fails" else (End.MERGED, -100.0 - index)
            measures = replace(measures, end=end, score=score)
        ran.append((Outcome(index, 0, case, measures), trajectory))
    journal.append(ran)
    return Run(folder)


def became(*runs: Run) -> list[list[RegionChange]]:
    return [[region.became for region in step.regions] for step in history_of(runs).steps]


class TestARegion:
    def test_is_fixed_where_the_later_version_tested_cases_and_none_failed(self, tmp_path):
        a = write(tmp_path / "a", (0.5, 0.5, "fails"))
        b = write(tmp_path / "b", (0.5, 0.54, "passes"))
        (step,) = history_of([a, b]).steps
        (region,) = step.regions
        assert (region.became, region.of, region.cases, region.failed) == (
            RegionChange.FIXED,
            1,
            1,
            0,
        )
        # Two discs of radius r with centres 0.8 r apart: the lens that both cover.
        lens = 2.0 * math.acos(0.4) - 0.8 * math.sqrt(1.0 - 0.4**2)
        assert region.fmc == pytest.approx(BALL)
        assert region.looked_at == pytest.approx(lens / math.pi)

    def test_broke_where_the_earlier_version_tested_cases_and_none_failed(self, tmp_path):
        a = write(tmp_path / "a", (0.5, 0.54, "passes"))
        b = write(tmp_path / "b", (0.5, 0.5, "fails"))
        assert became(a, b) == [[RegionChange.BROKE]]

    def test_still_fails_where_one_of_the_later_versions_cases_fails(self, tmp_path):
        a = write(tmp_path / "a", (0.5, 0.5, "fails"))
        b = write(tmp_path / "b", (0.5, 0.52, "passes"), (0.5, 0.47, "fails"))
        (step,) = history_of([a, b]).steps
        assert [(r.became, r.of, r.cases, r.failed) for r in step.regions] == [
            (RegionChange.STILL, 1, 2, 1)
        ], "it is given once, as one of the earlier version"

    @pytest.mark.parametrize("other", [(0.5, 0.56, "passes"), (0.5, 0.5, "errs")])
    def test_is_nothing_known_of_without_a_verdict_inside(self, tmp_path, other):
        a = write(tmp_path / "a", (0.5, 0.5, "fails"))
        b = write(tmp_path / "b", other)
        assert became(a, b) == [[RegionChange.NOT_SEEN_AFTER]]
        assert became(b, a) == [[RegionChange.NOT_SEEN_BEFORE]]

    def test_is_what_is_linked_and_what_broke_comes_first(self, tmp_path):
        a = write(
            tmp_path / "a",
            *((0.2, 0.2 + 0.04 * n, "fails") for n in range(3)),
            (0.8, 0.8, "passes"),
        )
        b = write(tmp_path / "b", (0.2, 0.31, "passes"), (0.8, 0.8, "fails"))
        (step,) = history_of([a, b]).steps
        assert [(r.became, r.failures) for r in step.regions] == [
            (RegionChange.BROKE, 1),
            (RegionChange.FIXED, 3),
        ]


def test_cases_that_both_tested_are_compared_one_by_one(tmp_path):
    a = write(tmp_path / "a", (0.1, 0.1, "fails"), (0.5, 0.5, "passes"), (0.9, 0.9, "fails"))
    b = write(tmp_path / "b", (0.1, 0.1, "passes"), (0.5, 0.5, "fails"), (0.9, 0.9, "errs"))
    (step,) = history_of([a, b]).steps
    assert (step.same, step.same_fixed, step.same_broke) == (2, 1, 1)


def test_a_version_in_which_nothing_was_tested_has_no_fmc(tmp_path):
    a = write(tmp_path / "a", (0.5, 0.5, "fails"))
    b = write(tmp_path / "b", (0.5, 0.5, "errs"))
    first, second = (version.levels[0] for version in history_of([a, b]).versions)
    assert first.fmc == pytest.approx(BALL)
    assert first.regions == 1
    assert (second.fmc, second.regions, second.verdict.errors) == (None, None, 1)


def test_a_version_without_a_level_is_passed_over_there(tmp_path):
    a = write(tmp_path / "a", (0.5, 0.5, "fails"))
    b = write(tmp_path / "b", (0.5, 0.5, "fails"), level=1)
    c = write(tmp_path / "c", (0.5, 0.5, "passes"))
    history = history_of([a, b, c])
    assert [(step.before, step.after, step.level) for step in history.steps] == [(1, 3, 0)]
    assert any("Not every campaign has every POV level" in note for note in history.notes)
    page = history_page(history)
    assert page.count('<polyline class="line level0"') == 0, "no line leads over the gap"


def test_kinds_of_all_levels_are_drawn_where_all_levels_are(tmp_path):
    whole, part = (
        write_run(tmp_path / name, 20, levels=levels, error=None)
        for name, levels in (("a", (0, 1)), ("b", (0,)))
    )
    page = history_page(history_of([whole, part]))
    assert "version 1, stalemate: " in page or "version 1, forced merge: " in page
    assert not re.search(r"version 2, (?!level)", page)


def test_kinds_and_who_avoids_are_counted_where_they_are_known(tmp_path):
    run = write_run(tmp_path / "a", 20, levels=(0,), error=None)
    line = {"index": next(o.index for o in run.outcomes if o.failed), "avoided_by": ["careful"]}
    line |= {"careful_until_s": 2.0, "pov_careful": False}
    (run.folder / "avoidance.jsonl").write_text(json.dumps(line) + "\n")
    found = history_of([run, run]).versions[0].levels[0]
    assert (found.avoidance_known, found.avoided) == (1, 1)
    assert sum(found.kinds.values()) == found.verdict.failures > 0
    assert "100% (1 of 1)" in history_page(history_of([run, run]))


class TestIsRefused:
    @pytest.mark.parametrize(
        ("settings", "said"),
        [
            ({"scenario": asdict(replace(US23, tau_s=2.0))}, "scenario"),
            ({"policies_sha256": {"pov1": "other"}}, "POV of level 1"),
        ],
    )
    def test_what_is_of_another_pool(self, tmp_path, settings, said):
        own = {"policies_sha256": {"pov1": "one"}}
        a = write(tmp_path / "a", (0.5, 0.5, "passes"), level=1, **own)
        b = write(tmp_path / "b", (0.5, 0.5, "passes"), level=1, **{**own, **settings})
        with pytest.raises(UserError, match=said):
            history_of([a, b])

    def test_another_criterion_and_a_single_version(self, tmp_path):
        a = write(tmp_path / "a", (0.5, 0.5, "errs"))
        b = write(tmp_path / "b", (0.5, 0.5, "errs"), fail_when="contact")
        with pytest.raises(UserError, match="--fail-when"):
            history_of([a, b])
        with pytest.raises(UserError, match="two campaigns"):
            history_of([a])


def test_the_page_runs_nothing_loads_nothing_and_shows_names_as_text(tmp_path):
    a = write(tmp_path / "a", (0.5, 0.5, "fails"), vut="<script>alert(1)</script>")
    page = history_page(history_of([a, a]))
    assert "&lt;script&gt;alert(1)" in page
    assert "<script" not in page
    assert not re.search(r"(?:src|href)=|url\(|@import", page)
    assert "default-src 'none'; style-src 'sha256-" in page


@pytest.mark.parametrize(
    ("most", "top"), [(0.0, 1.0), (0.0915, 0.1), (0.11, 0.2), (36, 40), (45, 100), (2, 2)]
)
def test_an_axis_ends_at_a_number_whose_half_is_round(most, top):
    assert axis_end([most]) == top


class TestTheCommand:
    def test_writes_a_page_and_says_the_same_as_json(self, command_line, tmp_path):
        a = write(tmp_path / "a", (0.5, 0.5, "fails"))
        b = write(tmp_path / "b", (0.5, 0.5, "passes"))
        out = tmp_path / "page.html"
        code, said, err = command_line("history", a.folder, b.folder, "--out", out)
        assert code == 0, err
        assert "from 1 to 2 at POV level 0: regions: 1 fixed\n" in said
        assert "from 0.0079 (version 1) to 0.0000 (version 2)" in out.read_text()
        other = tmp_path / "other.html"
        code, said, err = command_line("history", a.folder, b.folder, "--out", other, "--json")
        record = json.loads(said)
        assert record["steps"][0]["counts"]["fixed"] == 1
        assert [v["levels"]["0"]["failures"] for v in record["versions"]] == [1, 0]
        assert other.read_bytes() == out.read_bytes()


class TestFromPython:
    def test_is_what_the_command_prints_and_writes(self, command_line, tmp_path):
        a = write(tmp_path / "a", (0.5, 0.5, "fails"), (0.1, 0.1, "errs"), vut="<b>a</b>\a")
        b = write(tmp_path / "b", (0.5, 0.5, "passes"))
        page, other = tmp_path / "page.html", tmp_path / "other.html"
        found = ms.history([a.folder, ms.open_run(b.folder)], out=page)
        _, said, _ = command_line("history", a.folder, b.folder, "--out", other)
        assert said == f"{found}\npage: {other}\n"
        assert page.read_bytes() == other.read_bytes()
        assert found.steps[0].count(RegionChange.FIXED) == 1
        assert repr(found).startswith("<History: FMC went at POV level 0 from 0.0079 (version 1)")
        assert found._repr_html_() == f"<pre>{escape(str(found))}</pre>"

    def test_writes_no_page_unless_asked_and_replaces_none(self, tmp_path, monkeypatch):
        a = write(tmp_path / "a", (0.5, 0.5, "fails"))
        monkeypatch.chdir(tmp_path)
        ms.history([a.folder, a.folder])
        assert [file.name for file in tmp_path.iterdir()] == ["a"]
        (tmp_path / "page.html").write_text("mine")
        with pytest.raises(ms.UserError, match="exists"):
            ms.history([a.folder, a.folder], out="page.html")
        assert (tmp_path / "page.html").read_text() == "mine"
        with pytest.raises(ms.UserError, match="two campaigns"):
            ms.history([a.folder])
