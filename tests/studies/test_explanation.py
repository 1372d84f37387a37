"""Why a case fails: each sentence is true of the simulation, and the smallest change by hand."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import math
import re
import shutil
from dataclasses import replace
from typing import Any

import pytest
from plans import plan_for

import merge_sumo as ms
from merge_sumo.campaigns.store import Run, spread_failures
from merge_sumo.engine.evaluate import run_cases
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.studies.counterfactuals import Avoidance
from merge_sumo.studies.explanation import (
    EXPLANATIONS,
    Alone,
    Explanation,
    OtherPov,
    in_sentences,
    read_explanations,
)
from merge_sumo.studies.parameter_changes import ParameterChange
from merge_sumo.studies.parameter_ranges import Range, default_ranges
from merge_sumo.values.case import MergeCase
from merge_sumo.values.criterion import Criterion
from merge_sumo.values.scenario import US23

WAYS = {
    "further back": ("x_pov0_m", -1, 0.1),
    "further ahead": ("x_pov0_m", 1, 0.1),
    "slower": ("v_pov0_mps", -1, 0.01),
    "faster": ("v_pov0_mps", 1, 0.01),
    "psi lower": ("svo_rad", -1, 0.01),
    "psi higher": ("svo_rad", 1, 0.01),
    "headway ahead lower": ("headway_ahead_s", -1, 0.01),
    "headway ahead higher": ("headway_ahead_s", 1, 0.01),
    "headway behind lower": ("headway_behind_s", -1, 0.01),
    "headway behind higher": ("headway_behind_s", 1, 0.01),
}
"""Words of a change: its coordinate, its sign, and the unit of its last digit."""
CHANGE = re.compile(
    r"(\d+\.\d+) (?:m/s|m|rad|s) (further back|further ahead|slower|faster|lower|higher)"
)
SUBJECT = re.compile(r"(the POV starts|psi is|headway ahead is|headway behind is)")


def said(text: str) -> list[tuple[str, float, float]]:
    """Return (field, change, unit) of each change in a sentence."""
    changes, subject = [], ""
    for part in SUBJECT.split(text):
        if SUBJECT.fullmatch(part):
            subject = "" if part == "the POV starts" else part.removesuffix("is")
            continue
        for size, way in CHANGE.findall(part):
            field, sign, unit = WAYS[subject + way]
            changes.append((field, sign * float(size), unit))
    return changes


def moved(case, *changes):
    values = {field: getattr(case, field) + change for field, change in changes}
    return replace(case, **values)


def claimed(case, sentence):
    """Return the cases of which a sentence says something, each with whether it passes."""
    if sentence.startswith("It passes if"):
        for field, change, unit in said(sentence):
            yield moved(case, (field, change)), True
            nearer = change - math.copysign(unit, change)
            yield moved(case, (field, nearer)), False
    elif sentence.startswith("Of all starts"):
        yield moved(case, *((field, change) for field, change, _ in said(sentence))), True
    elif sentence.startswith("The very same start"):
        passing, _, others = sentence.partition(", and does not at ")
        if sentence.startswith("The very same start does not"):
            passing, others = "", sentence
        for text, passes in ((passing, True), (others, False)):
            for level, psis in re.findall(
                r"level ([012])(?: with (any psi|psi [\d., to]+\d))?", text
            ):
                for psi in psi_of(psis):
                    yield replace(case, level=int(level), svo_rad=psi), passes


def psi_of(text):
    if not text:
        return [None]
    if text == "any psi":
        return [number / 10.0 for number in range(16)]
    values: list[int] = []
    for run in text.removeprefix("psi ").split(", "):
        first, _, last = run.partition(" to ")
        values += range(round(10 * float(first)), round(10 * float(last or first)) + 1)
    return [value / 10.0 for value in values]


def sentences_that_are_false(run, found, plan):
    """Return the sentences that are not true in SUMO, and how many cases were checked."""
    claims = []
    for one in found:
        outcome = run.outcome(one.index)
        for sentence in in_sentences(one, outcome):
            claims += [(sentence, *claim) for claim in claimed(outcome.case, sentence)]
    verdicts = run_cases(plan, [case for _, case, _ in claims]).verdicts()
    wrong = [
        (sentence, case)
        for (sentence, case, passes), verdict in zip(claims, verdicts, strict=True)
        if passes != (verdict.is_tested and not verdict.failed)
    ]
    return wrong, len(claims)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("explained") / "run"
    return ms.campaign("design2", cases=72, level="all", seed=1, out=folder, workers=1).run


def uniform(vut, folder, cases, **keywords: Any):
    """Return a campaign of uniform cases, which takes the least time."""
    keywords = {"sampler": "uniform", "seed": 1, "workers": 1, **keywords}
    return ms.campaign(vut, cases=cases, out=folder, **keywords)


class TestACampaign:
    def test_explains_its_ten_listed_failures(self, made):
        listed = sorted(o.index for o in spread_failures(made.outcomes)[:10])
        assert list(read_explanations(made)) == listed
        assert {made.outcome(index).case.level for index in listed} >= {1, 2}

    def test_says_nothing_that_is_not_so(self, made):
        found = read_explanations(made).values()
        wrong, checked = sentences_that_are_false(made, found, plan_for("design2"))
        assert wrong == []
        assert checked > 100

    def test_of_ones_own_controller_explains_none_by_itself(self, tmp_path):
        (tmp_path / "mine.py").write_text("def drive(seen):\n    return 1.0\n")
        own = uniform(f"{tmp_path / 'mine.py'}:drive", tmp_path / "run", 60, level=0)
        assert own.failures
        assert not (own.folder / EXPLANATIONS).exists()

    def test_is_not_explained_where_the_engines_differ(self, made, tmp_path, monkeypatch):
        monkeypatch.setattr(
            "merge_sumo.studies.explanation.pass_of", lambda results: [True] * len(results)
        )
        run = uniform("level0", tmp_path / "run", 60, level=0)
        assert run.failures
        assert not (run.folder / EXPLANATIONS).exists()
        with pytest.raises(UserError, match=r"case \d+ passes now: the VUT is another"):
            ms.explain(run)


@pytest.mark.parametrize(
    ("vut", "scenario", "level", "fail_when"),
    [
        ("design1", "us23-traffic", 0, "paper"),
        ("level0", "us23-lane", 2, "dx_m < 12 and dx_m > -12"),
        pytest.param("sumo:Krauss", "us23", 0, "contact", marks=pytest.mark.slow),
    ],
)
def test_sentences_are_true_on_other_roads_too(tmp_path, vut, scenario, level, fail_when):
    keywords: dict[str, Any] = {"scenario": scenario, "level": level, "fail_when": fail_when}
    run = uniform(vut, tmp_path / "run", 60, **keywords).run
    some = [o.index for o in spread_failures(run.outcomes)[:2]]
    assert some
    found = ms.explain(run.folder, some).found
    road = named_scenario(scenario)
    plan = plan_for(vut, scenario=road, criterion=Criterion(fail_when))
    wrong, checked = sentences_that_are_false(run, found, plan)
    assert wrong == []
    assert checked > 8


def arrival(case):
    """Return dx and the time at M of a level-0 VUT and a level-0 POV: eq. (4) worked out here."""
    x, v, t = -182.0, 18.0, 0
    while x < 0.0:
        x, v, t = x + 0.1 * v, min(v + 0.1, 28.0), t + 1
    return case.x_pov0_m + case.v_pov0_mps * 0.1 * t - x, 0.1 * t


def test_the_smallest_change_by_hand(tmp_path):
    run = uniform("level0", tmp_path / "run", 120, level=0).run
    for index, one in read_explanations(run).items():
        case = run.outcome(index).case
        dx_m, t_s = arrival(case)
        assert abs(dx_m) < 6.0
        x, v = one.alone
        back, ahead = (
            -math.ceil(round((dx_m + 6.0) / 0.1, 6)),
            math.ceil(round((6.0 - dx_m) / 0.1, 6)),
        )
        assert (x.below, x.above) == pytest.approx((back / 10.0, ahead / 10.0))
        slower, faster = (math.ceil(gap / t_s / 0.01) / 100.0 for gap in (dx_m + 6.0, 6.0 - dx_m))
        assert v.below == (pytest.approx(-slower) if case.v_pov0_mps - slower >= 25.0 else None)
        assert v.above == (pytest.approx(faster) if case.v_pov0_mps + faster <= 35.0 else None)
        # The nearest point of the two lines dx = 6 and dx = -6 in the unit cube, 160 m by 10 m/s.
        together = [one.together.get(name, 0.0) for name in ("x_pov0_m", "v_pov0_mps")]
        length = math.hypot(together[0] / 160.0, together[1] / 10.0)
        nearest = min(6.0 - dx_m, dx_m + 6.0) / math.hypot(160.0, 10.0 * t_s)
        assert nearest - 1e-9 <= length <= 1.1 * nearest + 0.0015
    assert len(read_explanations(run)) > 4


VALUES = re.compile(r"(\w+) is ([\d., or-]+) \((\S+) today, searched from (\S+) to (\S+)\)")


def claimed_of_parameters(sentences):
    """Return (name, value, passes) of what sentences say: values that pass, a unit nearer not."""
    found = []
    for sentence in sentences:
        if not sentence.startswith("The same start passes if the VUT's"):
            continue
        for name, values, *numbers in VALUES.findall(sentence):
            today, low, high = map(float, numbers)
            for text in values.split(" or "):
                value = float(text)
                nearer = value + math.copysign((high - low) / 320.0, today - value)
                found += [(name, value, True), (name, nearer, False)]
    return found


class TestParameters:
    def test_of_a_built_in_vut_are_changed_as_said(self, made, tmp_path):
        again = shutil.copytree(made.folder, tmp_path / "run")
        case = next(o.case for o in made.outcomes if o.failed)
        index = next(o.index for o in made.outcomes if o.failed)
        result = ms.explain(again, index, params=["gap_m=8..32", "kp=1..2"])
        claims = claimed_of_parameters(result.sentences()[index])
        assert {name for name, _, _ in claims} == {"gap_m"}
        for name, value, passes in claims:
            (verdict,) = run_cases(plan_for(f"design2?{name}={value!r}"), [case]).verdicts()
            assert passes == (verdict.is_tested and not verdict.failed), (name, value)
        none = "No value of the VUT's kp (searched from 1 to 2) was found with which this start"
        assert f"{none} passes." in result.sentences()[index]
        # What the file says is what the report says.
        assert read_explanations(Run(again))[index] == result.found[0]
        assert "The same start passes if the VUT" in ms.report(again).read_text(encoding="utf-8")

    def test_of_ones_own_controller_by_hand(self, tmp_path):
        mine = tmp_path / "mine.py"
        mine.write_text(
            "class Brakes:\n"
            "    def __init__(self, brake_mps2=3.0):\n"
            "        self.brake_mps2 = brake_mps2\n"
            "    def act(self, seen):\n"
            "        return -self.brake_mps2 if seen.t_s < 0.05 else 1.0\n"
        )
        keywords: dict[str, Any] = {"level": 0, "fail_when": "vut_max_brake_mps2 > 2.001"}
        run = uniform(f"{mine}:Brakes", tmp_path / "run", 2, **keywords)
        (one,) = ms.explain(run, 0, params=["brake_mps2=0..4"]).found
        # In steps of .1 from 3 on, then in eighths of that: it fails above 2.001.
        assert one.parameters == (ParameterChange("brake_mps2", 3.0, 0.0, 4.0, below=2.0),)
        (plain,) = ms.explain(run, 0).found
        assert plain.parameters == ()

    def test_ends_of_a_range_are_values(self):
        change = ParameterChange("gap_m", 16.2, 8.1, 32.4, below=8.1, above=32.4)
        assert [value for value, passes in change.claims() if passes] == [8.1, 32.4]
        nearer = [value for value, passes in change.claims() if not passes]
        assert nearer == pytest.approx([8.1 + 0.076, 32.4 - 0.076], abs=0.05)

    def test_ranges_by_default_are_from_half_to_double(self):
        ranges = default_ranges(plan_for("design2?gap_m=20").vut)
        assert ranges[2] == Range("gap_m", 10.0, 40.0)
        assert [one.name for one in ranges] == ["x1_m", "x2_m", "gap_m", "target_m", "kp", "lag_s"]
        assert default_ranges(plan_for("sumo:IDM?tau=1").vut) == ()

    @pytest.mark.parametrize(
        ("params", "words"),
        [
            (["gap=1..2"], "has no such parameter: did you mean gap_m"),
            (["gap_m=1..2"], "it is 16.2 today, which is not in that range"),
            (["gap_m=8..32", "gap_m=8..32"], "--param gap_m is given twice"),
            (["gap_m=8"], "write NAME=LOW..HIGH"),
        ],
    )
    def test_that_cannot_be_searched_are_refused_in_a_sentence(self, made, params, words):
        with pytest.raises(UserError, match=words):
            ms.explain(made.folder, params=params)


class TestTheFile:
    @pytest.mark.slow
    def test_is_the_same_wherever_its_cases_ran(self, made, tmp_path):
        again = shutil.copytree(made.folder, tmp_path / "run")
        lines = (again / EXPLANATIONS).read_bytes().splitlines()
        by_campaign = {record["index"]: record for record in map(json.loads, lines)}
        first, second = list(by_campaign)[:2]
        (again / EXPLANATIONS).unlink()
        ms.explain(again, [first, second], workers=2)
        together = (again / EXPLANATIONS).read_bytes()
        (again / EXPLANATIONS).unlink()
        ms.explain(again, second)
        ms.explain(again, first)
        assert (again / EXPLANATIONS).read_bytes() == together
        # A campaign leaves the parameters of its controller to the command.
        for record in map(json.loads, together.splitlines()):
            known = by_campaign[record["index"]]
            assert record.pop("cases") > known.pop("cases")
            assert record.pop("parameters")
            assert known.pop("parameters") == []
            assert record == known

    @pytest.mark.parametrize(
        "changes",
        [
            {"index": 10**6},
            {"alone": []},
            {"together": {"level": 1.0}},
            {"cases": -1},
            {"parameters": [{"name": "kp", "today": 1.0, "low": 1.0, "high": 1.0}]},
        ],
    )
    def test_of_somebody_else_is_refused_in_a_sentence(self, made, tmp_path, changes):
        folder = shutil.copytree(made.folder, tmp_path / "run")
        lines = (folder / EXPLANATIONS).read_text().splitlines()
        lines[0] = json.dumps({**json.loads(lines[0]), **changes})
        (folder / EXPLANATIONS).write_text("\n".join(lines))
        with pytest.raises(UserError, match=EXPLANATIONS):
            read_explanations(Run(folder))


class TestWhatCannotBeExplained:
    def test_is_a_case_that_did_not_fail(self, made):
        passed = next(o.index for o in made.outcomes if not o.failed)
        with pytest.raises(UserError, match=f"case {passed} did not fail: name a failure, such as"):
            ms.explain(made.folder, passed)

    def test_is_a_campaign_without_failures(self, tmp_path):
        own = uniform("design2", tmp_path / "run", 5, level=0)
        assert not own.failures
        with pytest.raises(UserError, match="has no failure: nothing can be explained"):
            ms.explain(own)

    @pytest.mark.parametrize(
        ("now", "words"),
        [
            ("return -0.5 if seen.t_s < 4.0 else 0.5", "the VUT is another than that"),
            pytest.param("return next(TURNS)", "the VUT", marks=pytest.mark.slow),
        ],
    )
    def test_is_a_controller_that_is_another_now_or_decides_by_chance(self, tmp_path, now, words):
        mine = tmp_path / "mine.py"
        mine.write_text("def drive(seen):\n    return 1.0\n")
        own = uniform(f"{mine}:drive", tmp_path / "run", 60, level=0)
        turns = "import itertools\nTURNS = itertools.cycle([1.0] * 997 + [-2.0] * 991)\n"
        mine.write_text(f"{turns}def drive(seen):\n    {now}\n")
        with pytest.raises(UserError, match=f"{words}.* nothing can be said of its changes"):
            ms.explain(own, own.failures[0]["index"])


def test_sentences_by_hand(made):
    outcome = next(o for o in made.outcomes if o.failed and o.case.level == 2)
    measures = replace(outcome.measures, last_avoidable_s=5.2, avoidable=True)
    outcome = replace(outcome, measures=measures)
    x = Alone("x_pov0_m", 1.0, -100.0, 60.0, -3.1, 12.0)
    v = Alone("v_pov0_mps", 0.06, -5.0, 5.0, -0.4, None)
    psi = Alone("svo_rad", 0.01, -0.3, 1.27)
    povs = (OtherPov(0, None, False), OtherPov(1, None, True))
    found = Explanation(outcome.index, (x, v, psi), {"x_pov0_m": -2.0, "v_pov0_mps": -0.1}, povs, 9)
    assert in_sentences(found, outcome, Avoidance(outcome.index, ("fsm",), 4.9, False)) == [
        "It passes if the POV starts 3.1 m further back, 0.40 m/s slower or 12.0 m further ahead.",
        "Within the pool no change of psi (tried every 0.01 rad) alone makes it pass.",
        "Of all starts that were tried, the nearest that passes: the POV starts 2.0 m further back "
        "and 0.10 m/s slower.",
        "The very same start passes at level 1, and does not at level 0.",
        "The last way out closes at 5.2 s: after that neither full braking nor full acceleration "
        "of the VUT keeps 6 m at M, with the POV moving as it did, and then at its last speed.",
        "The fuzzy safety model can take over until 4.9 s and avoid it.",
    ]


def test_psi_in_words(made):
    outcome = next(o for o in made.outcomes if o.failed and o.case.level == 1)
    measures = replace(outcome.measures, last_avoidable_s=None, avoidable=False)
    by_psi = [OtherPov(2, psi, psi in (0.1, 0.3)) for psi in (0.0, 0.1, 0.2, 0.3)]
    stuck = tuple(Alone(name, 0.1, -1.0, 1.0) for name in ("x_pov0_m", "v_pov0_mps"))
    found = Explanation(outcome.index, stuck, None, (OtherPov(0, None, False), *by_psi), 9)
    assert in_sentences(found, replace(outcome, measures=measures))[1:] == [
        "No start that was tried passes with this POV.",
        "The very same start passes at level 2 with psi 0.1, 0.3, and does not at level 0 and "
        "level 2 with psi 0.0, 0.2.",
        "At no time would full braking or full acceleration of the VUT have kept 6 m at M.",
    ]


def test_a_case_at_the_edge_of_the_pool_moves_to_one_side_only(tmp_path):
    edge = MergeCase(level=0, x_pov0_m=-180.0, v_pov0_mps=25.0, scenario=US23)
    dx_m, _ = arrival(edge)
    scenario = replace(US23, name="edge", x_pov0_m=(-181.0, -180.0), v_pov0_mps=(25.0, 25.1))
    keywords: dict[str, Any] = {
        "scenario": scenario,
        "level": 0,
        "fail_when": f"dx_m < {dx_m + 99}",
    }
    run = uniform("level0", tmp_path / "run", 4, **keywords).run
    for one in read_explanations(run).values():
        assert one.together is None
        for alone in one.alone:
            value = getattr(run.outcome(one.index).case, alone.field)
            low, high = scenario.bounds(alone.field)
            assert low <= value + alone.lowest <= value + alone.highest <= high
            assert alone.passing == ()
