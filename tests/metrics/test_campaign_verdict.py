"""The verdict on a campaign: what was not tested, gates, JUnit, and the exit codes."""

# mypy: no-strict-optional

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from lxml import etree
from metrics.test_chance import CASE, outcomes
from support.calling import invoke
from support.campaigning import campaign_settings, run_campaign
from support.handmade import write_run

import merge_sumo as ms
from merge_sumo.campaign_run import CampaignRun
from merge_sumo.campaigns.recorded import RecordedCampaign, failures
from merge_sumo.errors import UserError
from merge_sumo.metrics.summary import Gate, LevelSummary, parse_gates, summarise
from merge_sumo.printable import counted
from merge_sumo.reports.junit import write_junit
from merge_sumo.scenario.trajectory import End

HOSTILE = "</failure><x>\x00\x1b[2J\ud800\uffff\u202e\n&\"'"
CHANCE = f"{Path(__file__).parents[1]}/support/chance_vuts.py:Slope"
MIXED = (
    "def act(seen):\n"
    "    assert seen.v_pov_mps < 33, 'fast'; return 1.0 if seen.v_pov_mps < 30 else -4.0\n"
)
"""Raises in some cases, and stops in others."""


def test_errors_and_timeouts_are_grouped_by_message_errors_first_then_the_most_frequent(tmp_path):
    errors = {2: "boom", 5: "other", 6: "other"}
    run = write_run(tmp_path / "run", 10, levels=(0,), errors=errors, timeouts=(0, 1, 3, 4))
    found = summarise(run.outcomes)
    assert [(t.end, t.message, t.cases) for t in found.error_groups] == [
        (End.VUT_ERROR, "other", (5, 6)),
        (End.VUT_ERROR, "boom", (2,)),
        (End.TIMEOUT, "the VUT did not reach the merge point in 12 s", (0, 1, 3, 4)),
    ]
    assert (found.cases, found.errors, found.timeouts, found.tested) == (10, 3, 4, 3)
    failed = counted(len(failures(run.outcomes)), "failure")
    contacts = f"{found.contacts} with contact"
    assert found.counts == f"3 errors, 4 timeouts, {failed} ({contacts}) in 10 cases"


class TestAGate:
    def test_has_a_name_however_it_is_written_and_is_there_once(self):
        gates = parse_gates(["errors", "fmc>0.05", "fmc > 0.050", "errors", "timeouts"])
        assert [gate.name for gate in gates] == ["errors", "fmc>0.05", "timeouts"]

    @pytest.mark.parametrize("text", ["", "fmc", "fmc>1", "fmc>x", "failures>3", "\x1b"])
    def test_that_is_unknown_is_refused(self, text):
        with pytest.raises(UserError, match="choose failures, errors"):
            parse_gates([text])

    @pytest.mark.parametrize(("fmc", "verb"), [(0.05, "not met"), (0.0501, "met")])
    def test_on_coverage_is_met_beyond_its_bound_at_some_level(self, fmc, verb):
        one, other = (LevelSummary(10, 10, 0, volume, 0) for volume in (0.0, fmc))
        found = Gate("fmc", 0.05).check(replace(summarise([]), levels={0: one, 1: other}))
        assert found.sentence == f"gate fmc>0.05: {verb} (FMC {fmc:.4f} at level 1)"


def read_junit(file: Path) -> etree._Element:
    root = etree.parse(file).getroot()
    etree.XMLSchema(etree.parse(Path(__file__).with_name("junit.xsd"))).assertValid(root)
    return root


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> RecordedCampaign:
    vut = HOSTILE.replace("\ud800", "")
    folder = tmp_path_factory.mktemp("junit") / "run"
    return write_run(folder, 20, (0, 2), vut=vut, errors={3: HOSTILE}, timeouts=(4, 6))


@pytest.fixture(scope="module")
def root(written) -> etree._Element:
    path = written.folder.with_name("junit.xml")
    write_junit(path, CampaignRun(written, gates=("errors", "fmc>0")))
    return read_junit(path)


class TestJUnit:
    def test_has_a_suite_per_level_with_every_case_and_one_of_gates(self, written, root):
        assert [suite.get("name") for suite in root] == ["gates", "POV level 0", "POV level 2"]
        names = root.xpath("//testcase/@name")
        assert len(set(names)) == len(names) == 3 + 40
        assert (root.get("errors"), root[1].get("errors"), root[2].get("errors")) == ("1", "0", "1")
        failed = summarise(written.outcomes).failures
        assert root.get("failures") == str(failed + 2 + 2), "with 2 timeouts and 2 gates"

    def test_has_the_message_of_an_error_as_xml_can_hold_it(self, root):
        (error,) = root.xpath("//error")
        assert error.get("type") == "VUT_ERROR"
        said = "</failure><x>\\x00\\x1b[2J\\ud800\\uffff\\u202e\\n&\"'"
        assert error.get("message") == error.text == f"VUT_ERROR: {said}"

    def test_fails_where_nothing_was_tested(self, tmp_path):
        run = write_run(tmp_path / "run", 4, levels=(0,), timeouts=range(4))
        write_junit(tmp_path / "junit.xml", CampaignRun(run))
        failure, *_ = read_junit(tmp_path / "junit.xml").iter("failure")
        assert failure.text.startswith("nothing was tested")


def test_an_undecided_case_is_not_a_failure_and_meets_the_gate():
    """Two failures of two runs decide, one of one does not (posterior of Jeffreys' prior)."""
    once = replace(CASE, level=0, svo_rad=None)
    ran = outcomes([(CASE, 0, -600.0), (CASE, 1, -700.0), (once, 0, -600.0)])
    summary = summarise(ran, (0, 2), 0.2)
    assert summary.counts == "1 failure (0 with contact), 1 undecided in 2 cases"
    assert [(of.failures, of.undecided) for of in summary.levels.values()] == [(0, 1), (1, 0)]
    assert all(of.fmc > 0.0 and of.regions == 1 for of in summary.levels.values())
    gate = Gate("failures").check(summarise(ran[2:], tolerated=0.2))
    assert gate.sentence == "gate failures: met (0 failures and 1 undecided)"


def test_an_undecided_case_is_skipped_in_junit(tmp_path):
    settings = campaign_settings(vut=CHANCE, cases=40, seed=100, tolerated=0.5, repeat=1)
    opened = ms.open_run(run_campaign(settings, tmp_path / "run").folder)
    number = opened.summary.undecided
    assert number == len(failures(opened.recorded.outcomes)) > 0, "each case ran once"
    write_junit(tmp_path / "junit.xml", opened)
    root = read_junit(tmp_path / "junit.xml")
    assert (root.get("failures"), root[1].get("skipped")) == ("0", str(number))
    assert all(one.get("message").startswith("undecided: ") for one in root.iter("skipped"))


def test_a_campaign_that_tested_nothing_exits_with_1_and_says_why_first(write_vut, tmp_path):
    vut = write_vut("def act(seen):\n    raise RuntimeError('boom')\n", "act")
    few = ("--level", 0, "--cases", 20, "--sampler", "uniform", "-q")
    said = invoke("campaign", "--vut", vut, *few, "--out", tmp_path / "run")
    assert said.exit_code == 1
    assert said.stdout.splitlines()[0].endswith(" on us23: 20 cases, 20 errors, nothing tested")
    assert "\nNot judged:  20 VUT_ERROR, the first in case 0" in said.stdout
    assert said.stderr.endswith("the VUT never reached the merge point without an error\n")
    assert "Nothing was tested." in (tmp_path / "run" / "report.html").read_text()


@pytest.fixture(scope="module")
def mixed(tmp_path_factory) -> tuple[object, ...]:
    """Return options that go on with a finished campaign, whose folder names no code to run."""
    folder = tmp_path_factory.mktemp("mixed")
    (folder / "mixed.py").write_text(MIXED)
    settings = campaign_settings(vut=f"{folder}/mixed.py:act", sampler="uniform", cases=20, seed=1)
    found = summarise(run_campaign(settings, folder / "run").outcomes)
    assert min(found.errors, found.timeouts, found.tested) > 0
    return "--resume", folder / "run", "--vut", settings.vut


class TestACampaignWithGates:
    @pytest.mark.parametrize(("gates", "code"), [((), 0), (("fmc>0.99", "timeouts"), 1)])
    def test_exits_with_1_when_one_is_met_also_when_it_is_resumed(self, mixed, gates, code):
        before = (mixed[1] / "campaign.json").read_bytes()
        options = [word for gate in gates for word in ("--gate", gate)]
        said = invoke("campaign", *mixed, "-q", "--json", *options)
        assert said.exit_code == code
        found = json.loads(said.stdout)
        assert found["passed"] is (code == 0)
        assert found["gates"] == {gate: gate == "timeouts" for gate in gates}
        assert said.stderr.count("gate ") == len(gates)
        assert (mixed[1] / "campaign.json").read_bytes() == before

    def test_writes_junit_and_never_over_a_file(self, tmp_path, mixed):
        file = tmp_path / "junit.xml"
        assert invoke("campaign", *mixed, "--junit", file, "--gate", "errors").exit_code == 1
        root = read_junit(file)
        assert root.get("tests") == "22"
        before = file.read_bytes()
        said = invoke("campaign", *mixed, "--junit", file)
        assert "choose another name with `junit`" in str(said.exception)
        assert file.read_bytes() == before
