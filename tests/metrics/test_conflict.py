"""The first conflict of motions that are made by hand: bodies are 5 m long."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from merge_sumo.errors import UserError
from merge_sumo.metrics.merge import Conflict, check_from
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End, Trajectory, cut_at

LENGTHS_M = (5.0, 5.0)


def motion(gaps_m: list[float], closing_mps: list[float]) -> FloatArray:
    """Return a VUT at 10 m/s and a POV behind it: bumper gap and closing speed of each row."""
    x_vut_m = np.arange(len(gaps_m)) - 2.0
    rows = zip(x_vut_m, gaps_m, closing_mps, strict=True)
    return np.array([[[x - 5.0 - gap, 10.0 + w, 0.0], [x, 10.0, 0.0]] for x, gap, w in rows])


@pytest.mark.parametrize(
    ("gaps_m", "closing_mps", "expected"),
    [
        # Bodies overlap before the merge, which is row 2, and again in rows 4 and 5.
        ([-1.0, 9.0, 4.0, 1.0, 0.0, -2.0], [5.0] * 6, (4, "the contact")),
        # 2, 1.5 and 3 s; then as low again, which is not the first.
        ([1.0, 1.0, 4.0, 3.0, 3.0, 1.5], [9.0, 9.0, 2.0, 2.0, 1.0, 1.0], (3, "the lowest time to")),
        ([1.0, 1.0, 4.0, 5.0, 6.0, 7.0], [9.0, 9.0, 0.0, -1.0, 0.0, -1.0], (2, "the merge")),
    ],
)
def test_is_looked_for_from_the_merge_on(
    gaps_m: list[float], closing_mps: list[float], expected: tuple[int, str]
) -> None:
    whole = motion(gaps_m, closing_mps)
    row, what = Conflict.find(whole, 2, LENGTHS_M)
    assert (row, what.startswith(expected[1])) == (expected[0], True)
    case = Case(level=0, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=US23)
    before, after = cut_at(whole, 2)
    assert Conflict.of(Trajectory(case, before, End.MERGED, after=after)) == (row, what)


def test_is_the_end_without_a_merge() -> None:
    case = Case(level=0, x_pov0_m=-250.0, v_pov0_mps=30.0, scenario=US23)
    trajectory = Trajectory(case, motion([-1.0, 2.0, 1.0], [5.0] * 3), End.TIMEOUT)
    assert Conflict.of(trajectory) == (2, "the end of the episode")


@pytest.mark.parametrize(
    ("gaps_m", "expected"), [([3.0, -1.0], (1, "the contact")), ([3.0, 4.0], (0, "the start"))]
)
def test_of_cars_in_one_lane_is_looked_for_from_the_start_on(gaps_m, expected) -> None:
    closing_mps = 1.0 if expected[0] else -1.0
    assert Conflict.find(motion(gaps_m, [closing_mps] * 2), 0, LENGTHS_M) == expected


def test_takes_the_length_of_the_car_ahead() -> None:
    # The front bumper of the POV is 5 m behind that of the VUT, then ahead of it.
    behind = motion([0.0], [1.0])
    ahead = behind[:, ::-1] * [1.0, -1.0, 1.0]
    assert Conflict.find(behind, 0, (4.9, 5.0)).what == "the contact"
    assert Conflict.find(ahead, 0, (5.0, 4.9)).what == "the contact"


@pytest.mark.parametrize(
    ("from_s", "row", "said"),
    [
        (None, 0, None),
        (-3.0, 51, "from 5.1 s, 3 s before the contact at 8.1 s"),
        (-1e300, 0, "from 0.0 s, 8.1 s before the contact at 8.1 s"),
    ],
)
def test_what_is_before_it(from_s: float | None, row: int, said: str | None) -> None:
    check_from(from_s)
    assert Conflict(81, "the contact").begin(from_s) == (row, [said] if said else [])


@pytest.mark.parametrize("from_s", [0.1, float("nan"), "-3"])
def test_what_is_not_before_it_is_refused(from_s: Any) -> None:
    with pytest.raises(UserError, match=r"`from_s` is .*: give a number not above 0, such as -3"):
        check_from(from_s)
