"""The follow-up after M, and its measures."""

# mypy: no-strict-optional

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from metrics.test_score import ending
from support.handmade import FOLLOWED_UP
from support.histories import CASE
from support.vut_contract import in_process, run_cases

from merge_sumo.errors import UserError
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.timeline import timeline
from merge_sumo.scenario.case import Pool
from merge_sumo.scenario.scenario import US23, VUT
from merge_sumo.scenario.trajectory import End

FOLLOWED, AT_M = US23, replace(US23, follow_up_s=0.0)
CASES = Pool(levels=(0,), scenario=FOLLOWED).cases(np.random.default_rng(3).random((12, 2)), 0)


def followed(*states):
    """Return a merge with (x_pov, v_pov, x_vut, v_vut) at each step of the follow-up."""
    after = np.array([[[xp, vp, 0.0], [xv, vv, 0.0]] for xp, vp, xv, vv in states])
    merged = ending(20.0)
    return replace(merged, case=replace(CASE, scenario=FOLLOWED), after=after)


def after(episode):
    """Return gap, time to collision and needed braking in the follow-up."""
    return [Measures.of(episode).value(name) for name in FOLLOWED_UP[:3]]


class TestMeasures:
    def test_by_hand(self):
        # The VUT is 15 m behind the POV's rear and 5 m/s faster, then 10 m and 4 m/s.
        episode = followed((20.0, 20.0, 0.0, 25.0), (22.0, 20.0, 7.0, 24.0))
        assert after(episode) == pytest.approx([10.0, 2.5, max(25.0 / 30.0, 16.0 / 20.0)])

    def test_of_a_gap_that_opens(self):
        # The POV is behind, 5 m between bumpers, and slower.
        measures = Measures.of(followed((-10.0, 20.0, 0.0, 25.0)))
        assert [getattr(measures, name) for name in FOLLOWED_UP] == [5.0, None, 0.0, 0.0]

    def test_of_bodies_that_touch(self):
        episode = followed((-10.0, 30.0, 0.0, 20.0), (-4.0, 30.0, 0.5, 20.0))
        measures = Measures.of(episode)
        assert (measures.after_gap_m, measures.after_ttc_s) == (-0.5, 0.0)
        assert measures.after_drac_mps2 is None
        for met in ("after_drac_mps2 > 99", "after_ttc_s < 0.1", "contact", "unsafe"):
            assert Criterion(met).margin(measures) < 0.0, met

    def test_need_a_follow_up(self):
        with pytest.raises(UserError, match="`follow_up_s` above 0"):
            Criterion("after_ttc_s < 2").check(AT_M)
        Criterion("after_ttc_s < 2").check(FOLLOWED)


def run(vut, scenario):
    """Return the trajectories of the cases in a scenario."""
    cases = [replace(case, scenario=scenario) for case in CASES]
    return run_cases(in_process(vut), cases, corridors=5)


@pytest.mark.parametrize(("braking", "severity"), [(-3.1, "harsh"), (-2.9, "safe")])
def test_a_merge_is_harsh_where_a_car_behind_did_brake(braking, severity):
    episode = followed((-40.0, 30.0, 0.0, 25.0), (-37.0, 29.7, 2.5, 25.0))
    episode.after[0, :, 2] = braking, -4.0  # the VUT is ahead, so its braking does not count
    measures = Measures.of(replace(episode, motion=episode.after[:1]))
    assert (measures.severity, measures.after_brake_mps2) == (severity, -braking)


class TestFollowUp:
    def test_changes_nothing_up_to_m(self):
        for merged, on in zip(run("design1", AT_M), run("design1", FOLLOWED), strict=True):
            assert np.array_equal(on.motion, merged.motion)
            assert (on.end, on.clipped_steps) == (merged.end, merged.clipped_steps)
            assert Measures.of(on).score == Measures.of(merged).score
            assert merged.after is None

    def test_takes_3_s_from_m_on(self):
        for trajectory in run("level0", FOLLOWED):
            assert trajectory.after.shape == (31, 2, 3)
            assert np.array_equal(trajectory.after[0, :, :2], trajectory.motion[-1, :, :2])

    def test_has_a_car_that_brakes_behind_the_vut(self):
        slow = replace(US23, v_vut0_mps=12.0, level0_a_mps2=0.1)
        behind = [t for t in run("level0", slow) if t.after[0, 0, 0] < t.after[0, VUT, 0]]
        assert behind
        assert min(t.after[:, 0, 2].min() for t in behind) < -1.0

    def test_ends_with_an_error_of_the_vut_and_the_merge_counts(self, tmp_path):
        (tmp_path / "ends.py").write_text(
            "def ends(seen):\n    return 1.0 if seen.x_vut_m < 10.0 else 1 / 0\n", encoding="utf-8"
        )
        for trajectory in run(f"{tmp_path / 'ends.py'}:ends", FOLLOWED):
            assert trajectory.end is End.MERGED
            assert "ZeroDivisionError" in trajectory.error
            assert trajectory.after[-1, VUT, 0] >= 10.0
            assert len(trajectory.after) < 10
            without = replace(trajectory, error=None)
            assert Measures.of(trajectory).score == Measures.of(without).score
            outcome = Criterion().outcome(trajectory)
            (*_, last) = timeline(outcome, trajectory, None).events
            ends = "an error ends the follow-up: ZeroDivisionError"
            assert last.text.startswith("the VUT reaches" if outcome.failed else ends)
