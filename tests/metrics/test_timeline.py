"""The timeline of a case and the kind of a failure, by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from merge_sumo.metrics.criterion import Criterion
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.timeline import Timeline, phases, timeline
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, POV, US23, VUT
from merge_sumo.scenario.trajectory import End, Trajectory, cut_at

STEPS = 81
"""Rows of a hand-made episode of 8 s up to M."""


def parts(*pairs: tuple[float, float]) -> np.ndarray:
    """Return accelerations from (seconds, m/s2) pairs; the last one lasts through a follow-up."""
    a = np.concatenate([np.full(round(s / DT_S), value) for s, value in pairs])
    return np.concatenate([a, np.full(STEPS + 30, pairs[-1][1])])[: STEPS + 30]


def drive(x0: float, v0: float, a: np.ndarray) -> np.ndarray:
    """Return positions, speeds and accelerations by eq. (4), (T, 3)."""
    rows, x, v = [], x0, v0
    for acceleration in a:
        rows.append((x, v, acceleration))
        x, v = x + v * DT_S, max(v + acceleration * DT_S, 0.0)
    return np.array(rows)


def meeting(a_pov: np.ndarray, a_vut: np.ndarray, gap_m: float = 1.0) -> Trajectory:
    """Return an episode in which the POV is `gap_m` ahead as the VUT reaches M after 8 s."""
    vut, pov = drive(0.0, 18.0, a_vut), drive(0.0, 30.0, a_pov)
    vut[:, 0] -= vut[STEPS - 1, 0]
    pov[:, 0] += gap_m - pov[STEPS - 1, 0]
    case = Case(level=1, x_pov0_m=float(pov[0, 0]), v_pov0_mps=30.0, scenario=US23)
    motion, after = cut_at(np.stack([pov, vut], axis=1), STEPS - 1)
    return Trajectory(case, motion, End.MERGED, after=after)


def told(trajectory: Trajectory, fail_when: str = "paper", **measures: Any) -> Timeline:
    outcome = Criterion(fail_when).outcome(trajectory)
    outcome.measures.values.update(measures)
    return timeline(outcome, trajectory, None)


def events(found: Timeline) -> list[str]:
    return [line.strip() for line in found.lines(CASE)[1:]]


KEEP, GOES = parts((8.0, 0.0)), parts((8.0, 1.0))
CASE = meeting(KEEP, GOES).case
BRAKES = parts((3.0, 0.0), (5.0, -1.0), (3.0, 0.0))
LATE = parts((7.0, 1.0), (1.0, -4.0), (3.0, 0.0))
EASES = parts((2.0, 1.0), (6.0, -0.5), (3.0, 0.0))
REACHES = "8.0 s   the VUT reaches the merge point"
MEETS = "the VUT reaches the merge point 1.0 m behind the POV: contact at"


class TestPhases:
    @pytest.mark.parametrize(
        ("a", "expected"),
        [
            (KEEP, []),
            (BRAKES, [(30, 80)]),
            (parts((3.0, 0.0), (0.9, -1.0), (4.1, 0.0)), []),
            (parts((0.5, -1.0), (4.0, 0.0), (2.0, -1.0), (4.0, 0.0)), [(45, 65)]),
            (parts((0.5, -1.0), (0.5, 1.0), (2.0, -1.0), (0.5, 1.0), (4.0, 0.0)), [(10, 30)]),
            (parts((1.0, -1.0), (0.9, 0.0), (1.0, -1.0), (4.0, 0.0)), [(0, 29)]),
            (parts((1.0, -1.0), (1.0, 0.0), (1.0, -1.0), (4.0, 0.0)), [(0, 10), (20, 30)]),
            (
                parts((2.0, -1.0), (0.6, 2.0), (2.0, -1.0), (4.0, 0.0)),
                [(0, 20), (20, 26), (26, 46)],
            ),
            (
                parts(
                    (40.0, -0.09),
                ),
                [],
            ),
        ],
    )
    def test_lose_or_gain_1_mps_without_a_pause_of_a_second(self, a, expected):
        assert sorted(phases(drive(0.0, 30.0, a)[:, 1])) == expected


class TestTheTimelineOfAFailure:
    def test_is_in_order_and_ends_with_the_event_that_broke_the_rule(self):
        found = told(meeting(BRAKES, LATE), last_avoidable_s=6.2)
        assert found.lines(CASE)[0].startswith(
            "case: late brake, contact at 4.0 m/s    POV level 1"
        )
        assert events(found) == [
            "0.0 s   the VUT accelerates: 18.0 to 25.0 m/s",
            "3.0 s   the POV brakes: 30.0 to 25.0 m/s",
            "6.2 s   last way out: full braking or full acceleration",
            "7.0 s   the VUT brakes: 25.0 to 21.0 m/s, 0.8 s too late",
            f"8.0 s   {MEETS} 4.0 m/s",
        ]
        assert found.in_a_line == f"late brake: {MEETS} 4.0 m/s"

    def test_without_a_way_out_says_so(self):
        found = told(meeting(BRAKES, LATE), last_avoidable_s=None)
        never = "no way out: neither full braking nor full acceleration keeps 6 m at M"
        assert f"0.0 s   {never}" in events(found)
        assert found.kind == "late brake"

    @pytest.mark.parametrize(
        ("trajectory", "fail_when", "result", "last"),
        [
            (
                meeting(KEEP, GOES, gap_m=5.5),
                "paper",
                "squeeze, conflict",
                [f"{REACHES} 5.5 m behind the POV: closer than 6 m"],
            ),
            (
                meeting(KEEP, GOES, gap_m=-5.2),
                "paper",
                "squeeze, contact at 3.9 m/s",
                [
                    f"{REACHES} 5.2 m ahead of the POV: closer than 6 m",
                    "8.1 s   contact with the POV at 3.9 m/s",
                ],
            ),
            (
                meeting(parts((8.1, 0.0), (1.0, -4.0), (3.0, 0.0)), GOES, gap_m=-9.0),
                "unsafe",
                "cut in, harsh",
                [
                    f"{REACHES} 9.0 m ahead of the POV: the POV must brake at -8.0 m/s2",
                    "8.1 s   the POV brakes hardest: -4.0 m/s2, down to 26.0 m/s",
                ],
            ),
            (
                meeting(
                    parts((3.0, 0.0), (5.0, -2.5), (3.0, 0.0)),
                    parts((8.0, 1.0), (3.0, -4.0)),
                    gap_m=20.0,
                ),
                "unsafe",
                "squeeze, harsh",
                [
                    f"{REACHES} 20.0 m behind the POV: the VUT must brake at -4.2 m/s2",
                    "8.0 s   the VUT brakes hardest: -4.0 m/s2, down to 14.0 m/s",
                ],
            ),
            (
                meeting(KEEP, GOES, gap_m=30.0),
                "t_end_s > 4",
                "rule broken, safe",
                ["11.0 s   fails: margin -1"],
            ),
            (
                replace(meeting(KEEP, GOES), end=End.TIMEOUT, after=None),
                'end == "TIMEOUT"',
                "did not arrive, timeout",
                ["8.0 s   the VUT did not reach the merge point in 8 s"],
            ),
        ],
        ids=[
            "near",
            "contact after M",
            "POV behind",
            "VUT behind",
            "a rule of the user",
            "a timeout",
        ],
    )
    def test_ends_with_what_broke_its_rule(self, trajectory, fail_when, result, last):
        found = told(trajectory, fail_when)
        assert (found.result, events(found)[-len(last) :]) == (result, last)

    def test_says_a_contact_once_in_a_line(self):
        found = told(meeting(KEEP, GOES, gap_m=-5.2))
        assert found.in_a_line == "squeeze: contact with the POV at 3.9 m/s"

    def test_without_the_motion_is_how_they_arrived(self):
        outcome = Criterion().outcome(meeting(KEEP, GOES, gap_m=5.5))
        found = timeline(outcome, None, None)
        assert found.in_a_line.startswith(
            "failure, conflict: the VUT reaches the merge point 5.5 m"
        )


class TestTheTimelineOfAnotherCase:
    def test_is_told_through_the_follow_up(self):
        found = told(meeting(parts((9.0, 0.0), (2.0, -1.0)), GOES, gap_m=-30.0))
        assert (found.result, found.kind) == ("safe", None)
        assert events(found) == [
            "0.0 s   the VUT accelerates: 18.0 to 29.0 m/s",
            "8.0 s   the VUT reaches the merge point 30.0 m ahead of the POV",
            "9.0 s   the POV brakes: 30.0 to 28.0 m/s",
        ]

    def test_of_an_error_is_its_message(self):
        trajectory = replace(meeting(KEEP, GOES), end=End.VUT_ERROR, error="boom", after=None)
        found = told(trajectory)
        assert found.in_a_line == "VUT_ERROR: boom"
        assert events(found)[-1] == "8.0 s   boom"

    def test_in_traffic_names_the_car_that_is_nearest(self):
        pair = meeting(BRAKES, GOES, gap_m=30.0)
        motion = pair.motion[:, [POV, VUT, POV, POV]].copy()
        motion[:, POV, 0] -= 200.0
        motion[:, 2, 0] += 200.0
        case = Case(
            level=1,
            x_pov0_m=-400.0,
            v_pov0_mps=30.0,
            headway_ahead_s=2.0,
            headway_behind_s=2.0,
            scenario=named_scenario("us23-traffic"),
        )
        found = told(Trajectory(case, motion, End.MERGED))
        assert events(found)[1:] == [
            "3.0 s   the car behind the POV brakes: 30.0 to 25.0 m/s",
            "8.0 s   the VUT reaches the merge point 30.0 m behind the car behind the POV",
        ]


@pytest.mark.parametrize(
    ("a_pov", "a_vut", "way_out_s", "kind"),
    [
        (KEEP, LATE, 6.2, "late brake"),
        (BRAKES, LATE, 7.0, "both brake"),
        (KEEP, LATE, 7.0, "weak brake"),
        (parts((8.0, 0.5)), GOES, 7.0, "both accelerate"),
        (KEEP, GOES, 7.0, "squeeze"),
        (BRAKES, GOES, 7.0, "squeeze"),
        (parts((4.0, -1.0), (4.0, 0.0)), EASES, 7.0, "weak brake"),
        (parts((4.0, -1.0), (4.0, 1.0)), parts((5.0, -1.0), (3.0, 1.0)), 7.0, "both accelerate"),
    ],
)
def test_the_kind_is_of_what_both_do_last_in_3_s_before_the_event(a_pov, a_vut, way_out_s, kind):
    assert told(meeting(a_pov, a_vut), last_avoidable_s=way_out_s).kind == kind


def test_the_outcome_alone_decides_what_is_a_failure():
    trajectory = meeting(KEEP, GOES)
    outcome = Outcome(0, 0, trajectory.case, Criterion().outcome(trajectory).measures, margin=0.5)
    assert timeline(outcome, trajectory, None).kind is None
