"""Who would have avoided a failure: checked against eq. (4) worked out here, without SUMO."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import shutil
from concurrent.futures import BrokenExecutor, Future

import numpy as np
import pytest

import merge_sumo as ms
from merge_sumo.campaigns.avoidance import (
    AVOIDANCE,
    avoidance,
    in_a_sentence,
    read_avoidance,
    write_avoidance,
)
from merge_sumo.campaigns.driven_again import EVERY_STEPS, Avoidance, _Found
from merge_sumo.campaigns.ground import road_for
from merge_sumo.campaigns.run import Run, failures
from merge_sumo.campaigns.settings import settings_of
from merge_sumo.drivers.base import Scene
from merge_sumo.drivers.reference import REFERENCES, CarefulPov
from merge_sumo.errors import UserError
from merge_sumo.reports.report import report_page
from merge_sumo.system.workers import InProcess, Workers, open_workers
from merge_sumo.values.scenario import US23


def avoidance_of(run, workers=None, **other):
    settings = settings_of(run.folder, run.settings, trust=True)
    return avoidance(run, settings, road_for(US23), workers=workers, **other)


@pytest.fixture(scope="module")
def found(run):
    return avoidance_of(run)


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
            gap, closing = abs(x_pov - x) - 5.0, max(v_pov - v if x_pov < x else v - v_pov, 0.0)
            # Whoever is behind has 0.75 s, and then 4 m/s2.
            return gap >= 1.0 and closing**2 <= 8.0 * max(gap - 0.75 * closing, 0.0)
    return False


def last_of(passed, steps):
    """Return the last success of all half seconds, and of the steps from there to the next one."""
    coarse = [n for n in range(0, steps, EVERY_STEPS) if passed(n)]
    if not coarse:
        return None
    return max(n for n in range(coarse[-1], min(coarse[-1] + EVERY_STEPS, steps)) if passed(n))


def answered(search, passing):
    """Say of each take-over that is asked for whether it passes; return which ones were."""
    asked, case = [], next(search)
    while True:
        asked.append(case.until)
        try:
            case = search.send(case.until in passing)
        except StopIteration:
            return asked


class DiesAt(InProcess):
    """A worker that is ended by one failure, each time."""

    def __init__(self, index):
        self.index = index

    def submit(self, fn, /, *args, **kwargs):
        if self.index not in [index for index, _ in args[0]]:
            return super().submit(fn, *args, **kwargs)
        future: Future = Future()
        future.set_exception(BrokenExecutor())
        return future


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

    def test_is_searched_from_the_end_and_finds_what_looking_everywhere_finds(self, run, found):
        for one in found[:2]:
            failure = run.trajectory(one.index)
            drivers = REFERENCES["careful"]
            last = last_of(lambda n: passes(failure, drivers(1), n), len(failure.motion) - 1)  # noqa: B023
            assert round(10.0 * one.careful_until_s) == last

    @pytest.mark.parametrize("passing", [set(), {0}, {3, 7}, {0, 5, 9}, {5, 20, 23}, {60}, {0, 61}])
    def test_is_searched_in_as_few_episodes_as_it_takes(self, run, found, passing):
        failure = run.trajectory(found[0].index)
        steps = len(failure.motion) - 1
        one = _Found(failure)
        asked = answered(one.take_over(), passing)
        last, said = last_of(passing.__contains__, steps), one.avoidance(7)
        assert said.careful_until_s == (None if last is None else last / 10.0)
        assert said.by_careful == (0 in passing)
        # Whatever is later, and nothing before the half second in which it lies.
        assert len(asked) == len(set(asked))
        first = 0 if last is None else last - last % EVERY_STEPS
        assert set(range(first, steps, EVERY_STEPS)) <= set(asked) <= {0, *range(first, steps)}

    def test_says_whether_a_careful_driver_on_the_mainline_avoids_it(self, run, found):
        for one in found[:3]:
            failure = run.trajectory(one.index)
            avoids = passes(failure, CarefulPov(1), 0, in_the_povs_place=True)
            assert one.pov_careful == avoids


class TestWorkers:
    def test_of_any_number_find_the_same(self, run, found):
        with open_workers(2) as two:
            assert avoidance_of(run, two) == found
        with Workers(InProcess, 3) as three:
            assert avoidance_of(run, three) == found

    def test_that_die_at_a_failure_leave_out_that_one_and_no_other(self, run, found):
        left_out = found[1].index
        with Workers(lambda: DiesAt(left_out), 1) as workers:
            assert avoidance_of(run, workers) == [one for one in found if one.index != left_out]

    def test_are_asked_in_between_whether_to_stop(self, run, found):
        class EnoughError(Exception):
            pass

        def stop():
            raise EnoughError

        with Workers(InProcess, 3) as workers, pytest.raises(EnoughError):
            avoidance_of(run, workers, check=stop)


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
