"""Who would have avoided a failure: checked against eq. (4) worked out here, without SUMO."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest

import merge_sumo as ms
from merge_sumo.campaigns.avoidance import (
    AVOIDANCE,
    Avoidance,
    avoidance,
    in_a_sentence,
    read_avoidance,
    write_avoidance,
)
from merge_sumo.campaigns.ground import road_for
from merge_sumo.campaigns.run import Run, failures
from merge_sumo.campaigns.settings import settings_of
from merge_sumo.drivers.base import Scene
from merge_sumo.drivers.reference import REFERENCES, CarefulPov
from merge_sumo.errors import UserError
from merge_sumo.reports.report import report_page
from merge_sumo.values.scenario import US23


@pytest.fixture(scope="module")
def found(run):
    settings = settings_of(run.folder, run.settings, trust=True)
    return avoidance(run, settings, road_for(US23))


@pytest.fixture
def folder(run, tmp_path):
    return shutil.copytree(run.folder, tmp_path / "run")


def passes(failure, driver, until, *, in_the_povs_place=False):
    """Return whether a driver passes a failure: eq. (4), with a POV that keeps its speed."""
    case = failure.case
    driver.begin(0, case)
    (x_pov, v_pov), (x, v) = case.starts()
    for step in range(300):
        state = (np.array([value]) for value in (x_pov, v_pov, x, v))
        seen = Scene.of_pair(np.array([True]), np.array([step]), *state)
        a = a_pov = 0.0
        if in_the_povs_place:
            a, a_pov = failure.a_vut_mps2[step], driver.act(seen)[0]
        elif step < until:
            a = failure.a_vut_mps2[step]
        else:
            a = driver.act(seen)[0]
        x, x_pov = x + 0.1 * v, x_pov + 0.1 * v_pov
        v, v_pov = max(v + 0.1 * a, 0.0), max(v_pov + 0.1 * a_pov, 0.0)
        if x >= 0.0:
            return abs(x_pov - x) >= 6.0
    return False


class TestEveryFailure:
    def test_has_its_line_in_the_order_of_cases(self, run, found):
        assert [one.index for one in found] == sorted(o.index for o in failures(run.outcomes))
        assert found

    def test_names_the_drivers_that_pass_it(self, run, found):
        for one in found[:3]:
            failure = run.trajectory(one.index)
            names = [n for n, make in REFERENCES.items() if passes(failure, make(1), 0)]
            assert list(one.avoided_by) == names

    def test_says_until_when_a_careful_driver_may_take_over(self, run, found):
        for one in found[:3]:
            failure = run.trajectory(one.index)
            assert one.careful_until_s is not None
            until = round(10.0 * one.careful_until_s)
            # Perception and reaction begin when the driver takes over.
            assert passes(failure, REFERENCES["careful"](1), until)
            assert not passes(failure, REFERENCES["careful"](1), until + 1)

    def test_says_whether_a_careful_driver_on_the_mainline_avoids_it(self, run, found):
        for one in found[:3]:
            failure = run.trajectory(one.index)
            avoids = passes(failure, CarefulPov(1), 0, in_the_povs_place=True)
            assert one.pov_careful == avoids


class TestTheFile:
    def test_is_read_as_it_was_written_and_leaves_the_outcomes_alone(self, folder, found):
        before = (folder / "outcomes.jsonl").read_bytes()
        assert read_avoidance(Run(folder)) == {}
        write_avoidance(folder, found)
        assert list(read_avoidance(Run(folder)).values()) == found
        assert (folder / "outcomes.jsonl").read_bytes() == before

    @pytest.mark.parametrize(
        "change",
        [
            {"index": 10_000},
            {"index": True},
            {"avoided_by": ["nobody"]},
            {"avoided_by": "careful"},
            {"careful_until_s": "<b>"},
            {"careful_until_s": 1e9},
            {"pov_careful": 1},
            {"more": 1},
        ],
    )
    def test_of_somebody_else_is_refused_where_it_is_not_as_it_is_written(
        self, folder, found, change
    ):
        write_avoidance(folder, found)
        path = folder / AVOIDANCE
        lines = path.read_text().splitlines()
        lines[0] = json.dumps(json.loads(lines[0]) | change)
        path.write_text("\n".join(lines) + "\n")
        with pytest.raises(UserError, match=r"line 1 of .* is of no failure of the campaign"):
            read_avoidance(Run(folder))

    def test_has_no_failure_twice(self, folder, found):
        write_avoidance(folder, [found[0], found[0]])
        with pytest.raises(UserError, match="line 2"):
            read_avoidance(Run(folder))


class TestItIsShown:
    def test_in_a_sentence(self):
        four = [
            Avoidance(0, ("careful", "rss"), 8.0, pov_careful=True),
            Avoidance(1, ("careful",), 6.0, pov_careful=False),
            Avoidance(2, ("rss",), 7.0, pov_careful=False),
            Avoidance(3, (), None, pov_careful=False),
        ]
        assert in_a_sentence(four) == (
            "2 of 4 failures would have been avoided by a careful and competent driver (who takes "
            "over until 7.0 s, in the median), 1 by a careful driver on the mainline."
        )
        assert in_a_sentence([]) is None

    def test_in_the_report_with_a_filter(self, folder, found):
        assert "avoided-by" not in report_page(Run(folder)).split("<script")[0]
        write_avoidance(folder, found)
        page = report_page(Run(folder))
        assert in_a_sentence(found) in page
        assert '<option value="careful">avoided by careful</option>' in page
        assert "no claim of compliance follows" in page

    def test_by_campaign_and_compare_runs(self, command_line, tmp_path):
        plan = ("campaign", "--vut", "design1", "--level", 0, "--cases", 40, "--batch", 20)
        code, out, err = command_line(*plan, "--seed", 1, "--out", tmp_path / "a", "-q")
        assert code == 0, err
        assert "would have been avoided by a careful and competent driver" in out
        kept = read_avoidance(Run(tmp_path / "a"))
        assert in_a_sentence(kept.values()) in out
        a = tmp_path / "a"
        code, out, err = command_line("compare-runs", a, a, "--no-rerun")
        assert out.count("would have been avoided by a careful and competent driver") == 2

    def test_by_python(self, tmp_path):
        made = ms.campaign("design1", level=0, cases=40, batch=20, seed=1, out=tmp_path / "run")
        assert read_avoidance(Run(tmp_path / "run"))
        assert 'id="avoided-by"' in made.report().read_text()
