"""A cases file: what is in it, what `rerun` says of it, and that nothing else is taken for one."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import os
import tomllib
from collections import Counter
from dataclasses import replace
from typing import Any

import pytest
from calling import assert_refused
from campaigning import campaign_settings, run_campaign
from handmade import write_run
from lxml import etree

import merge_sumo as ms
from merge_sumo.road.scenario_file import named_scenario, shipped_scenarios
from merge_sumo.scenario.scenario import US23
from merge_sumo.studies.cases_file import CasesFile, watching, write_cases

CONTROLLER = """
class Controller:
    SLACK_S, AHEAD_M = 2.0, 500.0

    def act(self, seen):
        if seen.x_pov_m > 0.0 or seen.x_vut_m < -self.AHEAD_M:
            return 1.0
        pov_arrives_s = -seen.x_pov_m / max(seen.v_pov_mps, 1.0)
        wanted_mps = -seen.x_vut_m / (pov_arrives_s + self.SLACK_S)
        return min(max(wanted_mps - seen.v_vut_mps, -3.0), 1.5)


class Sooner(Controller):
    SLACK_S = 0.5


class Later(Controller):
    AHEAD_M = 60.0


class Blind(Controller):
    def act(self, seen):
        return 1.0


class Lost(Controller):
    def act(self, seen):
        return 1.0 / 0.0 if seen.x_vut_m > -50.0 else super().act(seen)
"""


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    """Return by scenario a campaign of design2."""
    folder = tmp_path_factory.mktemp("campaigns")
    return {
        name: run_campaign(
            campaign_settings(
                vut="design2",
                levels=(0, 1, 2),
                scenario=(scenario := named_scenario(name)),
                fail_when=scenario.criterion,
                cases=120,
            ),
            folder / name,
        )
        for name in ("us23", "us23-lane")
    }


@pytest.fixture
def file(campaigns, tmp_path):
    """Return the path of a file of 40 cases on US 23."""
    run = campaigns["us23"]
    return write_cases(run, watching(run), tmp_path)


def edited(path, old, new, count=1):
    text = path.read_text()
    assert text.count(old) >= 1
    path.write_text(text.replace(old, new, count))


@pytest.mark.parametrize("name", ["us23", "us23-lane"])
def test_a_file_of_40_cases_has_fewer_than_60_lines_and_all_of_each_case(campaigns, tmp_path, name):
    run = campaigns[name]
    path = write_cases(run, watching(run), tmp_path / "new")
    assert path == tmp_path / "new" / "cases.toml"
    assert len(path.read_text().splitlines()) == 40 + 11
    kept, text = CasesFile(path), path.read_text()
    assert [(o.case.level, o.index) for o in kept.outcomes] == sorted(
        (o.case.level, o.index) for o in kept.outcomes
    )
    assert set(Counter(o.case.level for o in kept.outcomes)) == {0, 1, 2}
    for outcome in kept.outcomes:
        before = run.outcome(outcome.index)
        assert outcome.case == before.case, "to the last digit"
        assert outcome.margin == pytest.approx(before.margin, rel=1e-5)
        assert outcome.measures.became == before.measures.became
    names = {"us23": {"score"}, "us23-lane": {"clearance_m", "brake_after_mps2"}}[name]
    first = tomllib.loads(text)["cases"][0]
    assert first.keys() - {"severity"} == names | {
        *("index", "level", "verdict", "margin", "x_pov0_m", "v_pov0_mps")
    }
    assert str(run.folder) not in text, "no path of this machine"


def test_the_chosen_cases_are_failures_and_near_and_far_passes(campaigns):
    run = campaigns["us23"]
    picked = watching(run)
    assert picked == watching(run)
    assert len(set(picked)) == 40
    outcomes = [run.outcome(index) for index in picked]
    assert [o.failed for o in outcomes] == [True] * 10 + [False] * 30
    for level in (0, 1, 2):
        passing = [o for o in run.outcomes if o.case.level == level and not o.failed]
        nearest = min(passing, key=lambda o: o.margin)
        assert nearest.index in picked
        assert min(passing, key=lambda o: o.measures.clearance_m).index in picked
    few = [o.index for o in run.outcomes[:5]]
    assert set(watching(type(run)(run.folder, run.outcomes[:5]))) == set(few)


@pytest.mark.parametrize("name", ["us23", "us23-lane"])
def test_a_changed_controller_is_caught_and_the_same_one_changes_nothing(campaigns, tmp_path, name):
    run = campaigns[name]
    path = write_cases(run, watching(run), tmp_path / "cases.toml")
    edited(path, "tolerance = 0.01", "tolerance = 0.0")
    same = ms.rerun(path)
    assert same.lines() == [same.headline]
    assert same.text == path.read_text()
    assert not same.worse
    edited(path, "tolerance = 0.0", "tolerance = 0.01")
    for changed in ("design2?gap_m=12", "design2?x1_m=40", "level0"):
        now = ms.rerun(path, vut=changed)
        assert now.worse, changed


def test_a_controller_of_a_persons_own_is_run_by_its_host(command_line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(CONTROLLER)
    settings = campaign_settings(vut="own.py:Controller", levels=(0, 1), cases=60)
    run = run_campaign(settings, tmp_path / "run")
    assert command_line("export", run.folder, "--format", "cases", "--out", "c.toml").code == 0
    assert_refused(command_line("rerun", "c.toml"), "c.toml was run with vut own.py:Controller")
    said = command_line("rerun", "c.toml", "--vut", "own.py:Controller")
    assert (said.code, said.out) == (0, "0 cases broke, 40 pass with both\n")
    for name, words in (
        ("Sooner", ", pass with less margin: Safe: "),
        ("Later", ", pass with less margin: Safe: "),
        ("Blind", ", broke: "),
        ("Lost", ", broke: VUT_ERROR at "),
    ):
        said = command_line("rerun", "c.toml", "--vut", f"own.py:{name}")
        assert said.code == 1, name
        assert words in said.out, name


def test_the_diff_has_the_lines_of_the_file_that_change(file, command_line):
    lines = file.read_text().splitlines()
    said = command_line("rerun", file, "--vut", "design2?x1_m=40", "--out", file.parent / "n.toml")
    out = said.out.splitlines()
    removed = [line[2:] for line in out if line.startswith("- ")]
    added = [line[2:] for line in out if line.startswith("+ ")]
    assert len(removed) == len(added) > 3
    assert removed[0] == 'vut = "design2"'
    assert added[0] == 'vut = "design2?x1_m=40"'
    stripped = [line.strip() for line in lines]
    assert set(removed) <= set(stripped)
    now = [line.strip() for line in (file.parent / "n.toml").read_text().splitlines()]
    swapped = dict(zip(removed, added, strict=True))
    assert now == [swapped.get(line, line) for line in stripped]
    assert command_line("rerun", file.parent / "n.toml").code == 0, "the new file holds now"


def failing_line(path):
    """Return a case that passes, and with another controller fails."""
    now = ms.rerun(path, vut="design2?kp=0.7")
    return next(one.b.index for one in now.steps[0].cases if one.change == "broke")


def test_a_failure_that_is_accepted_is_said_and_not_counted(file, command_line, tmp_path):
    changed = "design2?kp=0.7"
    index = failing_line(file)
    (line,) = (t for t in file.read_text().splitlines() if f"{{index = {index}," in t)
    edited(file, line, line.replace("},", ', accepted = "known: it waits"},'))
    args = ("rerun", file, index, "--vut", changed, "--junit", tmp_path / "j.xml")
    said = command_line(*args, "--out", tmp_path / "now.toml")
    assert said.code == 0
    assert said.out.startswith("0 cases broke, 1 accepted\n")
    assert f"case {index} is accepted (known: it waits) and fails, not counted" in said.out
    assert etree.parse(tmp_path / "j.xml").getroot().xpath("//skipped/@message") == [
        "accepted: known: it waits"
    ]
    assert CasesFile(tmp_path / "now.toml").accepted == {index: "known: it waits"}
    passing = command_line("rerun", file, index)
    assert passing.code == 0
    assert "(known: it waits) and passes now: take the mark away" in passing.out
    told = json.loads(command_line("rerun", file, index, "--vut", changed, "--json").out)
    assert told["steps"][0]["cases"][0]["accepted"] == "known: it waits"


def test_an_error_is_never_accepted(file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(CONTROLLER)
    edited(file, "},\n", ', accepted = "never mind"},\n', 40)
    now = ms.rerun(file, vut="own.py:Lost")
    assert now.worse
    assert now.broke == 30


def test_junit_has_every_case_and_says_how_much_margin_is_lost(file, tmp_path):
    ms.rerun(file, junit=tmp_path / "same.xml")
    root = etree.parse(tmp_path / "same.xml").getroot()
    assert (root.get("tests"), root.get("failures")) == ("40", "0")
    now = ms.rerun(file, vut="design2?kp=0.7", junit=tmp_path / "worse.xml")
    root = etree.parse(tmp_path / "worse.xml").getroot()
    counts = Counter(str(one.change) for one in now.steps[0].cases)
    assert int(root.get("failures")) == counts["broke"] + counts["pass with less margin"] > 3
    found: Any = root.xpath("//failure/@message")
    less = [text for text in found if ", margin " in text]
    assert len(less) == counts["pass with less margin"]


def test_the_tolerance_decides_what_is_worse(file):
    edited(file, "tolerance = 0.01", "tolerance = 100.0")
    now = ms.rerun(file, vut="design2?gap_m=12")
    assert not now.worse
    assert len(now.lines()) > 1, "the diff is shown all the same"


def test_run_takes_a_case_of_a_file(file, command_line):
    index = CasesFile(file).outcomes[0].index
    told = json.loads(command_line("run", "--case", file, index, "--json").out)
    measured = CasesFile(file).outcome(index).measures
    assert told["score"] == pytest.approx(measured.score, rel=1e-5)
    assert_refused(command_line("run", "--case", file, 999), f"{file} has no case 999")


def test_each_shipped_scenario_and_a_changed_one_are_what_they_were(tmp_path):
    scenarios = [named_scenario(name) for name in shipped_scenarios()]
    scenarios += [replace(US23, name='od"d', follow_up_s=0.0, dx_crash_m=1.0 / 3.0)]
    for number, scenario in enumerate(scenarios):
        run = write_run(tmp_path / str(number), 4, scenario=scenario)
        path = write_cases(run, [0, 3, 11], tmp_path / f"{number}.toml")
        assert CasesFile(path).scenario == scenario
        assert [o.index for o in CasesFile(path).outcomes] == [0, 3, 11]


def test_a_net_of_ones_own_is_found_from_the_file(tmp_path):
    nets = tmp_path / "nets"
    nets.mkdir()
    (nets / "mine.net.xml").touch()
    scenario = replace(US23, net=str(nets / "mine.net.xml"))
    run = write_run(tmp_path / "run", 4, scenario=scenario)
    (tmp_path / "checks").mkdir()
    path = write_cases(run, [0], tmp_path / "checks" / "c.toml")
    assert 'net = "./../nets/mine.net.xml"' in path.read_text()
    (tmp_path / "elsewhere").mkdir()
    nets.rename(tmp_path / "elsewhere" / "nets")
    (tmp_path / "checks").rename(tmp_path / "elsewhere" / "checks")
    moved = CasesFile(tmp_path / "elsewhere" / "checks" / "c.toml")
    assert moved.scenario.net == str(tmp_path / "elsewhere" / "nets" / "mine.net.xml")


def test_errors_and_timeouts_are_kept_with_their_reason(tmp_path):
    run = write_run(tmp_path / "run", 4, errors={3: 'said "no"'}, timeouts=(5,))
    path = write_cases(run, [5, 3], tmp_path)
    by_index = {line["index"]: line for line in tomllib.loads(path.read_text())["cases"]}
    assert (by_index[3]["verdict"], by_index[3]["error"]) == ("error", 'said "no"')
    assert by_index[5]["verdict"] == "timeout"
    assert [o.measures.end for o in CasesFile(path).outcomes] == ["VUT_ERROR", "TIMEOUT"]


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ('vut = "design2"', "vut = 2", "vut is 2: it must be a text"),
        ('vut = "design2"', "", "it has no vut"),
        ("tolerance = 0.01", "tolerance = nan", "tolerance is nan"),
        ("tolerance = 0.01", "tolerance = -1.0", "tolerance is -1.0: it must be a number of 0 or"),
        ("tolerance = 0.01", "tolerence = 0.01", "has no 'tolerence': did you mean tolerance?"),
        ('scenario = {name = "us23"}', 'scenario = "us99"', "scenario is 'us99': it must be a"),
        ('name = "us23"', 'kind = "us99"', "there is no kind of scenario 'us99'"),
        ('fail_when = "paper"', 'fail_when = "scores < 3"', "there is no measure 'scores'"),
        ('fail_when = "paper"', 'fail_when = "x_merge_m < 3"', "has no acceleration lane"),
        ("level = 0", "level = 7", "level is 7: choose 0, 1 or 2"),
        ("level = 0", "level = true", "level is True: it must be a whole number"),
        ("x_pov0_m = -", "x_pov0_m = -500.5, dx_m = -", "is outside of the pool, -340 to -180 m"),
        ("x_pov0_m = -", "x_pov0_m = -9", "choose between -900 and 0"),
        ("x_pov0_m = -", 'x_pov0_m = "far", dx_m = -', "x_pov0_m is 'far': it must be a number"),
        ("level = 0", "level = 0, was = 1", "has no 'was'"),
        ("x_pov0_m = -", "dx_m = -", "x_pov0_m is None: it must be a number"),
        ("v_pov0_mps = ", "v_pov0_mps = nan, dx_m = ", "it has a number that is not finite"),
        ('"pass"', '"fail"', "verdict is 'fail', but by margin and end it is pass"),
        ('"pass"', "[[]]", "verdict is [[]], but by margin and end it is pass"),
        ("},", ', accepted = " "},', "accepted is ' ': it must be a reason"),
        ("},", ", accepted = true},", "accepted is True: it must be a reason"),
        ("cases = [", "cases = [1, ", "cases is "),
        ("cases = [", "cases = [[", "is no TOML: "),
        ("net_sha256 = ", "net_sha256 = 1 #", "net_sha256 is 1: it must be a text"),
        ('net_sha256 = "', 'net_sha256 = "0', "was run on another net than"),
        ('pov1 = "', 'pov1 = "0', "was run against another POV of level 1 than today's"),
    ],
)
def test_what_is_no_cases_file_is_refused_in_a_sentence(file, command_line, old, new, part):
    edited(file, old, new)
    assert_refused(command_line("rerun", file), str(file), part)


def test_an_index_is_there_once(file, command_line):
    (line, *_) = (text for text in file.read_text().splitlines() if "{index" in text)
    edited(file, line, f"{line}\n{line}")
    assert_refused(command_line("rerun", file), "its index is there twice")


def test_what_is_no_file_is_refused(command_line, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "noise.toml").write_bytes(bytes(range(256)))
    (tmp_path / "giant.toml").write_bytes(b"#" * (1 << 21))
    (tmp_path / "deep.toml").write_text(f"a = {'[' * 9000}")
    (tmp_path / "empty.toml").touch()
    for name, part in (
        ("pipe", "it is no file, or a giant one"),
        ("giant.toml", "it is no file, or a giant one"),
        ("noise.toml", "is no text in UTF-8"),
        ("deep.toml", "is no TOML"),
        ("none.toml", "it is no file, or a giant one"),
        ("empty.toml", "it has no vut"),
        (".", "is not a campaign"),
    ):
        assert_refused(command_line("rerun", tmp_path / name), part)


def test_a_file_has_no_page_and_is_never_written_over(file, command_line):
    before = file.read_bytes()
    assert_refused(command_line("rerun", file, "--out", "p.html"), "--out of a cases file is one")
    assert_refused(command_line("rerun", file, "--out", file), "exists")
    assert_refused(command_line("rerun", file, "--stress"), "is not a campaign")
    assert_refused(command_line("rerun", file, "--stress", "--junit", "j"), "leave indices")
    assert file.read_bytes() == before


def test_named_cases_and_a_level_alone_run(file):
    indices = [outcome.index for outcome in CasesFile(file).outcomes if outcome.case.level == 1]
    by_level, by_index = ms.rerun(file, level=1), ms.rerun(file, indices)
    for found in (by_level, by_index):
        assert [one.index for one in found.versions[1].outcomes] == indices
        assert found.text == file.read_text()
