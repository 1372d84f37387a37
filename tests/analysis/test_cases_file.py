"""Cases files: their content, the output of `rerun`, and files that are refused."""

# mypy: no-strict-optional

from __future__ import annotations

import re
import tomllib
from dataclasses import replace

import pytest
from lxml import etree
from support.calling import assert_refused
from support.campaigning import campaign_settings, run_campaign
from support.handmade import write_run

import merge_sumo as ms
from merge_sumo.analysis.cases_file import CasesFile
from merge_sumo.analysis.comparison import ComparedCase
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.merge import Severity
from merge_sumo.reports.cases_toml import write_cases
from merge_sumo.reports.text import comparison_summary
from merge_sumo.road.scenario_file import named_scenario, shipped_scenarios
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End

CONTROLLER = """
class Own:
    AHEAD_M = 500.0

    def act(self, seen):
        if seen.x_pov_m > 0.0 or seen.x_vut_m < -self.AHEAD_M:
            return 1.0
        pov_arrives_s = -seen.x_pov_m / max(seen.v_pov_mps, 1.0)
        wanted_mps = -seen.x_vut_m / (pov_arrives_s + 2.0)
        return min(max(wanted_mps - seen.v_vut_mps, -3.0), 1.5)

class Late(Own):
    AHEAD_M = 120.0

class Lost(Own):
    def act(self, seen):
        return 1.0 / 0.0 if seen.x_vut_m > -50.0 else super().act(seen)
"""
WORSE = "design2?kp=0.7"


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    settings = campaign_settings(vut="design2", levels=(0, 1, 2), seed=2, cases=120)
    return run_campaign(settings, tmp_path_factory.mktemp("campaign") / "run")


@pytest.fixture
def file(run, tmp_path):
    """Return the path of a file of 40 cases."""
    return write_cases(run, [], tmp_path / "kept")


def edit(path, old, new, count=1):
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, count))


def test_a_file_of_40_cases_has_50_lines_and_all_of_each_case(run, file):
    assert len(file.read_text().splitlines()) == 50
    assert str(run.folder) not in file.read_text(), "no path of this machine"
    kept = CasesFile(file).outcomes
    assert kept == sorted(kept, key=lambda outcome: (outcome.case.level, outcome.index))
    for outcome in kept:
        before = run.outcome(outcome.index)
        assert outcome.case == before.case, "to the last digit"
        assert outcome.margin == pytest.approx(before.margin, rel=1e-5)
    assert sum(outcome.failed for outcome in kept) >= 7


def test_a_changed_controller_is_caught_and_the_same_one_changes_nothing(file):
    edit(file, "cases = [", "tolerance = 0.0\ncases = [")
    same = ms.rerun(file)
    assert same.lines() == comparison_summary(same), "no line of the file changes"
    assert same.text == file.read_text()
    assert not same.worse
    assert ms.rerun(file, vut="design2?gap_m=12").worse


def test_a_controller_of_the_user_is_run_by_its_host(command_line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(CONTROLLER)
    run_campaign(campaign_settings(vut="own.py:Own", cases=60), tmp_path / "run")
    assert command_line("export", "run", "--format", "cases", "--out", "c.toml").code == 0
    assert_refused(command_line("rerun", "c.toml"), "c.toml ran with vut own.py:Own")
    said = command_line("rerun", "c.toml", "--vut", "own.py:Own")
    assert said.code == 0
    line = "from version 1 to version 2: of 40 shared cases 0 worse, 0 better, 40 same verdict\n"
    assert line in said.out
    said = command_line("rerun", "c.toml", "--vut", "own.py:Late")
    assert said.code == 0, "a margin that drops is no other verdict"
    assert re.search(r"0 worse, 0 better, [1-9]\d* weaker", said.out)
    assert re.search(r"case \d+, weaker: safe, margin 0\.\d+ -> safe, margin 0\.\d+\n", said.out)
    said = command_line("rerun", "c.toml", "--vut", "own.py:Lost")
    assert said.code == 1
    assert ", broke: VUT_ERROR: " in said.out
    edit(tmp_path / "c.toml", "},\n", ', accepted = "never mind"},\n', 40)
    assert ms.rerun("c.toml", vut="own.py:Lost").broke == 40, "no error is accepted"


def test_a_new_error_or_contact_is_worse(file):
    record = CasesFile(file)
    safe = next(o for o in record.outcomes if o.passes and o.measures.severity == "safe")
    fails = next(o for o in record.outcomes if not o.passes)

    def change(before, **measured):
        after = replace(before, measures=Measures(**before.measures.values | measured))
        return record.change_of(ComparedCase.of([before], [after]))

    assert change(safe, severity=Severity.CONTACT) == "worse but passing"
    assert change(safe, severity=Severity.HARSH) == "pass with both"
    less = ComparedCase.of([replace(safe, margin=0.31)], [replace(safe, margin=0.25)])
    for tolerance, changed in ((None, "weaker"), (0.1, "weaker"), (0.05, "worse but passing")):
        record.tolerance = tolerance
        assert record.change_of(less) == changed
    assert change(safe, error="answered nan") == "broke", "after M"
    record.accepted = {fails.index: "known", safe.index: "known"}
    assert change(fails) == "accepted"
    assert change(fails, end=End.VUT_ERROR, error="answered nan") == "broke"
    assert record.change_of(ComparedCase.of([safe], [replace(safe, margin=-0.1)])) == "accepted"


NOISY = (
    CONTROLLER
    + """
from collections import Counter
TIMES = Counter()

class Drawing(Own):
    def reset(self, seen):
        self.far = seen.x_pov_m < -300.0
        TIMES[seen.x_pov_m] += 1
        self.times = TIMES[seen.x_pov_m]

    def act(self, seen):
        return 1.0 if seen.x_vut_m > -100.0 - self.times else -1.0

class Failing(Drawing):
    def act(self, seen):
        if self.far and seen.x_vut_m > -20.0 * self.times:
            raise ValueError(self.times)
        return Own.act(self, seen)

class Once(Drawing):
    def act(self, seen):
        return -4.0 if self.far and self.times == 1 else Own.act(self, seen)
"""
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Return a campaign of a controller that repeats, and its cases as a file."""
    folder = tmp_path_factory.mktemp("noisy")
    (folder / "own.py").write_text(NOISY)
    searched = {"cases": 16, "levels": (0,), "seed": 1, "sampler": "uniform"}
    run_campaign(campaign_settings(vut=f"{folder}/own.py:Own", **searched), folder / "run")
    (file,) = ms.export(folder / "run", file_format="cases", out=folder / "own.toml")
    return folder / "run", file


class TestAControllerThatDoesNotRepeat:
    @pytest.fixture
    def rerun(self, command_line, recorded):
        """Return what runs the campaign or the file again, 0 or 1, with a controller."""

        def run(of, name, *more):
            vut = f"{recorded[of].with_name('own.py')}:{name}"
            # One process counts the times.
            return command_line("rerun", recorded[of], "--vut", vut, "--workers", 1, *more)

        return run

    def test_is_said_and_its_margins_count_as_nothing(self, rerun, tmp_path):
        code, out, _ = rerun(1, "Drawing", "--junit", tmp_path / "j.xml")
        assert code == 0
        number = int(re.search(r"(\d+) not counted", out)[1])
        assert number > 0
        assert f"Not repeatable: {number} case" in out
        assert f"{number} change{'s' * (number > 1)} may be chance and did not count." in out
        junit = etree.parse(tmp_path / "j.xml").getroot()
        assert len(junit.findall(".//skipped")) == number
        assert not junit.findall(".//failure")

    @pytest.mark.parametrize("of", [0, 1], ids=["run", "file"])
    def test_breaks_nothing_where_a_verdict_is_another_one_once(self, rerun, of):
        code, out, _ = rerun(of, "Once")
        assert code == 0
        assert re.search(r" 0 worse, 0 better, [1-9]\d* not counted", out)
        assert re.search(r"cases ran twice, and \d+ of them .* with another verdict", out)

    @pytest.mark.parametrize("of", [0, 1], ids=["run", "file"])
    def test_is_worse_where_it_passes_neither_time(self, rerun, of):
        code, out, _ = rerun(of, "Failing")
        assert code == 1
        assert re.search(r" [1-9]\d* worse", out)
        assert "Not repeatable: " in out


def test_the_diff_has_the_lines_of_the_file_that_change(file, command_line, tmp_path):
    new, junit = tmp_path / "new.toml", tmp_path / "j.xml"
    said = command_line("rerun", file, "--vut", WORSE, "--out", new, "--junit", junit)
    assert said.code == 1
    removed, added = (
        [line[2:] for line in said.out.splitlines() if line.startswith(sign)] for sign in "-+"
    )
    assert (removed[0], added[0]) == ('vut = "design2"', f'vut = "{WORSE}"')
    swapped = dict(zip(removed, added, strict=True))
    before, after = ([x.strip() for x in path.read_text().splitlines()] for path in (file, new))
    assert set(removed) <= set(before)
    assert after == [swapped.get(line, line) for line in before]
    assert command_line("rerun", new).code == 0, "the new file holds now"
    root = etree.parse(junit).getroot()
    wrong = said.out.count(", broke: ") + said.out.count(", worse but passing: ")
    assert (root.get("tests"), root.get("failures")) == ("40", str(wrong))
    weaker = [text.text for text in root.iter("system-out")]
    assert len(weaker) == said.out.count(", weaker: ") > 0
    assert all(text.startswith("weaker: ") for text in weaker)


def test_a_failure_that_is_accepted_is_said_and_not_counted(file, command_line, tmp_path):
    now = ms.rerun(file, vut=WORSE)
    index = next(one.later.index for one in now.version_changes[0].cases if one.change == "broke")
    (line,) = (text for text in file.read_text().splitlines() if f"{{index = {index}," in text)
    edit(file, line, line.replace("},", ', accepted = "it waits\\u001b"},'))
    new, junit = tmp_path / "new.toml", tmp_path / "j.xml"
    assert_refused(
        command_line("rerun", file, index, "--out", new), "of a cases file: omit indices"
    )
    ms.rerun(file, vut=WORSE, out=new)
    said = command_line("rerun", file, index, "--vut", WORSE, "--junit", junit)
    assert said.code == 0
    assert "of 1 shared case 0 worse, 0 better, 1 not counted\n" in said.out
    assert f"case {index} is accepted (it waits\\x1b) and fails, not counted" in said.out
    assert len(etree.parse(junit).getroot().findall(".//skipped")) == 1
    assert CasesFile(new).accepted == {index: "it waits\x1b"}
    said = command_line("rerun", file, index)
    assert said.code == 0
    assert f"case {index} is accepted (it waits\\x1b) and passes now: remove the mark" in said.out
    assert_refused(command_line("rerun", file, 999), f"{file} has no case 999")


def test_scenarios_errors_and_timeouts_are_what_they_were(tmp_path):
    scenarios = [named_scenario(name) for name in shipped_scenarios()]
    scenarios += [replace(US23, name='od"d', follow_up_s=0.0, dx_crash_m=1.0 / 3.0)]
    for number, scenario in enumerate(scenarios):
        folder, errors = tmp_path / str(number), {3: 'said "no"'}
        run = write_run(folder, 4, scenario=scenario, errors=errors, timeouts=(5,))
        kept = CasesFile(write_cases(run, [5, 3, 0], tmp_path / f"{number}.toml"))
        assert kept.scenario == scenario
        ends = {outcome.index: outcome.measures.end for outcome in kept.outcomes}
        assert ends == {0: "MERGED", 3: "VUT_ERROR", 5: "TIMEOUT"}
        assert kept.outcome(3).measures.error == 'said "no"'


def test_a_net_of_the_user_is_found_from_the_file(tmp_path):
    for name in ("nets", "checks", "elsewhere"):
        (tmp_path / name).mkdir()
    scenario = replace(US23, net=str(tmp_path / "nets" / "mine.net.xml"))
    path = write_cases(write_run(tmp_path / "run", 4, scenario=scenario), [0], tmp_path / "checks")
    assert tomllib.loads(path.read_text())["scenario"]["net"] == "./../nets/mine.net.xml"
    moved = (tmp_path / "checks").rename(tmp_path / "elsewhere" / "checks") / "cases.toml"
    net = tmp_path / "elsewhere" / "nets" / "mine.net.xml"
    assert CasesFile(moved).scenario.net == str(net)


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ('vut = "design2"', "vut = 2", "vut is 2: it must be a text"),
        ('fail_when = "paper"', "tolerance = nan", "tolerance is nan"),
        ('fail_when = "paper"', "tolerence = 0.01", "has no 'tolerence': it has vut, "),
        ('scenario = {name = "us23"}', 'scenario = "us99"', "scenario is 'us99': it must be a"),
        ('fail_when = "paper"', 'fail_when = "scores < 3"', "unknown measure 'scores'"),
        ("x_pov0_m = -", "x_pov0_m = -900.5, dx_m = -", "x_pov0_m is -900.5: choose -900 to 0"),
        ("v_pov0_mps = ", "v_pov0_mps = nan, dx_m = ", "a number is not finite"),
        ('"pass"', '"fail"', "verdict is 'fail', but its margin and end give pass"),
        ("},", ', accepted = " "},', "accepted is ' ': it must be a text with the reason"),
        ('net_sha256 = "', 'net_sha256 = "0', "is not the net on which"),
        ('pov1 = "', 'pov1 = "0', "ran against another POV of level 1"),
    ],
)
def test_a_wrong_cases_file_is_refused_in_a_sentence(file, command_line, old, new, part):
    edit(file, old, new)
    assert_refused(command_line("rerun", file), str(file), part)
