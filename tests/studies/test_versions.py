"""Two versions of a VUT: what got fixed, what broke, and recorded cases again."""

from __future__ import annotations

import json
import math
import re
import shutil
from pathlib import Path

import pytest
from calling import assert_refused
from campaigning import campaign_settings, run_campaign
from lxml import html
from typer.testing import CliRunner

from merge_sumo import cli
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.store import Run, failures
from merge_sumo.errors import UserError
from merge_sumo.reports import version_pages
from merge_sumo.reports.version_pages import OVER_TIME, comparison_page
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.studies.versions import (
    Change,
    LevelChange,
    RunComparison,
    Untested,
    compare_runs,
    rerun,
    settings_today,
)


@pytest.fixture(scope="module")
def fixed(tmp_path_factory) -> Run:
    """Return a campaign of a VUT that does not fail at level 0: design2."""
    settings = campaign_settings(vut="design2", cases=60, batch=20, seed=1)
    return run_campaign(settings, tmp_path_factory.mktemp("fixed") / "run")


@pytest.fixture(scope="module")
def other_seed(tmp_path_factory) -> Run:
    settings = campaign_settings(vut="design1", cases=60, batch=20, seed=2)
    return run_campaign(settings, tmp_path_factory.mktemp("other") / "run")


def level_change(
    fmc_a: float = 0.0, fmc_b: float = 0.0, a: tuple[int, int] = (0, 0), b: tuple[int, int] = (0, 0)
) -> LevelChange:
    """Return a change at a level of 100 cases; `a` and `b` are numbers of errors and timeouts."""
    return LevelChange(Untested(100, *a), Untested(100, *b), fmc_a, fmc_b, 0.0, 0.0, {})


def changed(folder, run, **settings) -> Run:
    """Return a copy of a run with other settings."""
    folder.mkdir()
    for name in ("outcomes.jsonl", "campaign.json"):
        (folder / name).write_bytes((run.folder / name).read_bytes())
    record = {**run.settings, **settings}
    (folder / "campaign.json").write_text(json.dumps(record))
    return Run(folder)


class TestFromABadVutToAGoodOne:
    def test_everything_is_fixed(self, run, fixed):
        compared = compare_runs(run, fixed)
        found = compared.levels[0]
        count = len(failures(run.outcomes))
        assert found.changes[Change.FIXED] == count == len(compared.cases)
        assert found.fmc_b == found.fmc_broke == 0.0
        assert found.fmc_a == found.fmc_fixed > 0.0
        assert compared.worse(0.0) == []
        assert compared.look_first() == []

    def test_and_back_everything_broke(self, run, fixed):
        compared = compare_runs(fixed, run)
        found = compared.levels[0]
        assert found.changes[Change.BROKE] == len(failures(run.outcomes))
        assert found.fmc_a == found.fmc_fixed == 0.0
        assert found.fmc_b == found.fmc_broke > 0.0
        assert len(compared.worse(0.0)) == 1
        assert compared.worse(found.fmc_b + 0.01) == []
        worst = failures(run.outcomes)[0]
        assert compared.look_first()[0].index == worst.index


class TestTheSameVut:
    def test_with_another_seed_is_not_worse(self, run, other_seed):
        compared = compare_runs(run, other_seed)
        found = compared.levels[0]
        assert found.changes[Change.BOTH_FAIL] == len(compared.cases) > 5
        assert found.fmc_a == found.fmc_b
        assert found.fmc_fixed == found.fmc_broke == 0.0
        assert compared.worse(0.0) == []

    def test_that_does_not_do_again_what_it_did_is_not_believed(self, tmp_path, run, other_seed):
        # The record says design2, as if the design had been changed under its name since.
        before = changed(tmp_path / "before", run, vut="design2")
        compared = compare_runs(before, other_seed)
        assert compared.levels[0].changes[Change.NOT_RUN_AGAIN] == len(
            failures(other_seed.outcomes)
        )
        assert "does not do again" in compared.evidence
        assert compared.look_first()[0].change is Change.NOT_RUN_AGAIN


class TestRecordsOnly:
    def test_run_nothing_again(self, run, other_seed, monkeypatch):
        monkeypatch.setattr("merge_sumo.studies.versions.resolve", None)
        compared = compare_runs(run, other_seed, rerun=False)
        found = compared.levels[0]
        assert found.changes[Change.NOT_RUN_AGAIN] == len(compared.cases)
        # Union and differences of the balls.
        assert found.fmc_a + found.fmc_broke == pytest.approx(found.fmc_b + found.fmc_fixed)


class TestWorse:
    @pytest.mark.parametrize(
        ("fmc_b", "tolerance", "worse"),
        [(0.1, 0.0, False), (0.11, 0.0, True), (0.11, 0.02, False), (0.09, 0.0, False)],
    )
    def test_is_a_growth_beyond_the_tolerance(self, fmc_b, tolerance, worse):
        compared = RunComparison({0: level_change(0.1, fmc_b)}, [], "")
        assert bool(compared.worse(tolerance)) is worse

    def test_at_one_level_is_not_made_good_at_another(self):
        levels = {0: level_change(0.5, 0.0), 1: level_change(0.1, 0.2)}
        (why,) = RunComparison(levels, [], "").worse(0.05)
        assert why == "at POV level 1 FMC is 0.2000 with B, 0.1000 with A"

    @pytest.mark.parametrize(
        ("a", "b", "tolerance", "reasons"),
        [
            ((0, 0), (1, 0), 0.0, ["an error in 1", "an error or timeout in 1"]),
            ((0, 0), (0, 1), 0.0, ["an error or timeout in 1"]),
            ((0, 1), (1, 0), 0.0, ["an error in 1"]),
            ((1, 0), (0, 1), 0.0, []),
            ((2, 3), (2, 3), 0.0, []),
            ((5, 5), (0, 0), 0.0, []),
            ((0, 0), (3, 2), 0.06, []),
            ((1, 0), (7, 0), 0.06, []),
            ((0, 0), (3, 4), 0.06, ["an error or timeout in 7"]),
        ],
    )
    def test_is_a_larger_share_of_errors_or_of_errors_and_timeouts(self, a, b, tolerance, reasons):
        said = RunComparison({1: level_change(a=a, b=b)}, [], "").worse(tolerance)
        assert len(said) == len(reasons)
        for sentence, reason in zip(said, reasons, strict=True):
            assert sentence.startswith(f"at POV level 1 B has {reason} of 100 cases")

    def test_is_to_have_tested_nothing_whatever_the_tolerance_and_whatever_a_did(self):
        silent = Untested(100, 100, 0, nothing_tested=True)
        compared = RunComparison({0: LevelChange(silent, silent, 0.0, 0.0, 0.0, 0.0, {})}, [], "")
        assert compared.worse(9.0) == [
            "at POV level 0 B reached the merge point in no case of its campaign"
        ]


class TestRefused:
    def test_without_a_common_level(self, tmp_path, run):
        with pytest.raises(UserError, match="no POV level in common"):
            compare_runs(run, changed(tmp_path / "b", run, levels=[1]))

    def test_without_a_case(self, tmp_path, run):
        empty = changed(tmp_path / "b", run)
        (empty.folder / "outcomes.jsonl").write_bytes(b"")
        for pair in ((run, Run(empty.folder)), (Run(empty.folder), run)):
            with pytest.raises(UserError, match="has no case at a POV level of both"):
                compare_runs(*pair)

    def test_on_another_net_unless_only_records_count(self, tmp_path, run):
        other = changed(tmp_path / "b", run, net_sha256="0")
        with pytest.raises(UserError, match="--no-rerun"):
            compare_runs(run, other)
        assert compare_runs(run, other, rerun=False)


class TestTheCommand:
    def test_exits_with_1_when_b_is_worse(self, run, fixed):
        worse = CliRunner().invoke(cli.app, ["compare-runs", str(fixed.folder), str(run.folder)])
        assert worse.exit_code == 1
        assert "look first at:" in worse.output
        assert f"broke: merge-sumo export {run.folder} {failures(run.outcomes)[0].index}" in (
            worse.output
        )
        better = CliRunner().invoke(cli.app, ["compare-runs", str(run.folder), str(fixed.folder)])
        assert better.exit_code == 0
        assert "B is not worse than A" in better.output

    def test_prints_one_json_object(self, run, fixed):
        said = CliRunner().invoke(
            cli.app,
            ["compare-runs", str(fixed.folder), str(run.folder), "--json", "--tolerance", "9"],
        )
        assert said.exit_code == 0
        found = json.loads(said.stdout)
        assert found["worse"] is False
        assert found["levels"]["0"]["fmc_b"] > 0.0
        assert {case["change"] for case in found["cases"]} == {"broke"}

    def test_refuses_a_negative_tolerance(self, run, fixed):
        for tolerance in (-1.0, math.nan):
            said = CliRunner().invoke(
                cli.app,
                ["compare-runs", str(run.folder), str(fixed.folder), "--tolerance", str(tolerance)],
            )
            assert isinstance(said.exception, UserError)


@pytest.fixture(scope="module")
def page(run, fixed, tmp_path_factory):
    """Return the page of the command, from the good VUT to the bad one, as a tree."""
    file = tmp_path_factory.mktemp("page") / "page.html"
    arguments = ["compare-runs", str(fixed.folder), str(run.folder), "--out", str(file)]
    result = CliRunner().invoke(cli.app, arguments)
    assert result.exit_code == 1
    assert result.stdout.splitlines()[-1] == f"page: {file}"
    return html.parse(file).getroot()


class TestThePage:
    def test_says_what_changed_and_lists_each_case(self, page, run):
        count = len(failures(run.outcomes))
        (verdict,) = page.xpath("//p[contains(@class, 'verdict')]")
        assert verdict.text_content().startswith("B is worse than A, with a tolerance of 0.")
        assert f"{count} broke" in verdict.text_content()
        titles = page.xpath("//details/summary/b/text()")
        assert sorted(titles) == sorted(f"case {o.index} of B" for o in failures(run.outcomes))
        assert len(page.xpath("//*[@class='map']//*[@class='mark broke']")) == count

    def test_draws_both_motions_over_the_same_axes(self, page, run):
        for details in page.xpath("//details"):
            left, right = details.xpath(".//div[@class='pair']")
            assert left.xpath(".//text[@class='end']/text()") == right.xpath(
                ".//text[@class='end']/text()"
            )
            ends = []
            for pair in (left, right):
                points = [line.get("points").split() for line in pair.xpath(".//polyline")]
                assert len(points) == 4, "speeds and positions of two cars"
                ends.append(max(float(p.split(",")[0]) for line in points for p in line))
                for line in points:
                    for x, y in (map(float, p.split(",")) for p in line):
                        assert OVER_TIME.left <= x <= OVER_TIME.right
                        assert OVER_TIME.top <= y <= OVER_TIME.bottom
            assert max(ends) == OVER_TIME.right, "the longer one fills the axis"
            index = int(details.xpath("./summary/b/text()")[0].split()[1])
            rows = len(
                details.xpath(".//div[@class='pair'][1]//polyline")[-1].get("points").split()
            )
            assert len(run.trajectory(index).motion) == rows

    def test_loads_nothing_and_runs_nothing(self, page):
        assert page.xpath("//script | //@src | //@href | //@style | //img") == []
        (policy,) = page.xpath("//meta[@http-equiv='Content-Security-Policy']/@content")
        assert policy.startswith("default-src 'none'; style-src 'sha256-")

    def test_of_records_alone_draws_what_is_known(self, run, other_seed):
        compared = compare_runs(run, other_seed, rerun=False)
        page = comparison_page(compared, run, other_seed, {})
        root = html.fromstring(page)
        assert len(root.findall(".//details")) == len(compared.cases)
        assert len(root.findall(".//div[@class='pair']")) == len(compared.cases)
        assert page.count("Its motion is not known.") == len(compared.cases)

    def test_draws_so_many_and_counts_the_others(self, run, fixed, monkeypatch):
        compared = compare_runs(run, fixed, rerun=False)
        monkeypatch.setattr(version_pages, "SHOWN", 3)
        page = comparison_page(compared, run, fixed, {})
        assert len(html.fromstring(page).findall(".//details")) == 3
        assert f"{len(compared.cases) - 3} further cases" in page

    def test_is_written_nowhere_where_something_is(self, run, fixed, tmp_path):
        file = tmp_path / "page.html"
        file.write_text("mine")
        arguments = ["compare-runs", str(run.folder), str(fixed.folder), "--out", str(file)]
        result = CliRunner().invoke(cli.app, arguments)
        assert isinstance(result.exception, UserError)
        assert file.read_text() == "mine"


SEVERE = ("contact", "conflict")


@pytest.fixture
def folder(run, tmp_path) -> Path:
    return Path(shutil.copytree(run.folder, tmp_path / "campaign"))


class TestRerunOfTheSameVut:
    def test_gives_every_verdict_and_score_again(self, run):
        found = rerun(RunStudy(run, today := settings_today(run), resolve(today)))
        assert [o.measures for o in found.after] == [o.measures for o in run.outcomes]
        assert found.changed == []
        assert found.compared.worse(0.0) == []

    def test_is_said_to_change_nothing(self, command_line, folder):
        code, out, _ = command_line("rerun", folder, "3", "7")
        assert code == 0
        assert "no verdict changed" in out
        assert "it is not worse" in out


class TestRerunOfAChangedVut:
    def test_that_stands_times_out_in_all_cases_and_is_worse(
        self, command_line, folder, tmp_path, monkeypatch
    ):
        monkeypatch.chdir(tmp_path)
        Path("still.py").write_text("def f(seen):\n    return -4.0\n")
        first, second = (outcome.index for outcome in failures(Run(folder).outcomes)[:2])
        code, out, _ = command_line("rerun", folder, first, second, "--vut", "still.py:f", "--json")
        told = json.loads(out)
        assert code == 1
        assert {
            (c["index"], c["severity_before"] in SEVERE, c["end_after"]) for c in told["changed"]
        } == {(first, True, "TIMEOUT"), (second, True, "TIMEOUT")}
        assert any("in no case" in why for why in told["why"])
        assert any(
            "B has an error or timeout in 2 of 2 cases, A in 0 of 2" in w for w in told["why"]
        )

    def test_that_is_better_says_what_it_fixed(self, command_line, folder):
        fixed = [o.index for o in failures(Run(folder).outcomes)]
        code, out, _ = command_line("rerun", folder, "--vut", "design2")
        assert code == 0
        assert all(
            re.search(rf"case {index}: con\w+ -> (safe|harsh) \(fixed\)", out) for index in fixed
        )
        assert f"merge-sumo run --case {folder} " in out


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("60",), "has no case 60"),
        (("--vut", "design9"), "design9"),
        (("--tolerance", "-1"), "--tolerance"),
    ],
)
def test_bad_use_of_rerun_is_refused(command_line, folder, arguments, part):
    assert_refused(command_line("rerun", folder, *arguments), part)


def test_rerun_on_another_net_is_refused(command_line, folder):
    settings = json.loads((folder / "campaign.json").read_text())
    settings.pop("sha256")
    settings["net_sha256"] = "0"
    (folder / "campaign.json").write_text(json.dumps(settings))
    code, _, err = command_line("rerun", folder)
    assert (code, "another net" in err) == (2, True)
