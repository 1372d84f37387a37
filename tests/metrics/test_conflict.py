"""The first conflict of motions that are made by hand: bodies are 5 m long."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.histories import CASE

from merge_sumo.errors import UserError
from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.metrics.merge import Conflict, check_from
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End, Trajectory, cut_at


def motion(gaps_m: list[float], closing_mps: list[float]) -> FloatArray:
    """Return a VUT at 10 m/s and a POV behind it: bumper gap and closing speed of each row."""
    x_vut_m = np.arange(len(gaps_m)) - 2.0
    rows = zip(x_vut_m, gaps_m, closing_mps, strict=True)
    return np.array([[[x - 5.0 - gap, 10.0 + w, 0.0], [x, 10.0, 0.0]] for x, gap, w in rows])


@pytest.mark.parametrize(
    ("gaps_m", "closing_mps", "expected"),
    [
        # Of an unknown road: bodies overlap before the merge, row 2, and again in rows 4 and 5.
        ([-1.0, 9.0, 4.0, 1.0, 0.0, -2.0], [5.0] * 6, (4, "the contact")),
        # 2, 1.5 and 3 s; then as low again, which is not the first.
        ([1.0, 1.0, 4.0, 3.0, 3.0, 1.5], [9.0, 9.0, 2.0, 2.0, 1.0, 1.0], (3, "the lowest time to")),
        ([1.0, 1.0, 4.0, 5.0, 6.0, 7.0], [9.0, 9.0, 0.0, -1.0, 0.0, -1.0], (2, "the merge")),
    ],
)
def test_is_looked_for_from_the_merge_on(
    gaps_m: list[float], closing_mps: list[float], expected: tuple[int, str]
) -> None:
    before, after = cut_at(motion(gaps_m, closing_mps), 2)
    row, what = Conflict.of(Trajectory(CASE, before, End.MERGED, after=after), None)
    assert (row, what.startswith(expected[1])) == (expected[0], True)


@pytest.mark.parametrize(
    ("gaps_m", "end", "expected"),
    [
        ([1.0, 2.0, 1.0], End.TIMEOUT, (2, "the end of the episode")),
        ([3.0, -1.0, 9.0], End.TIMEOUT, (1, "the contact")),
        ([3.0, -1.0, 9.0], End.MERGED, (1, "the contact")),
    ],
)
def test_is_a_contact_also_before_the_merge(gaps_m, end, expected) -> None:
    straight = np.array([[-400.0, -400.0, 0.0], [400.0, 400.0, 0.0]])
    trajectory = Trajectory(CASE, motion(gaps_m, [5.0] * 3), end)
    assert Conflict.of(trajectory, CentreLines.of(straight, straight)) == expected


@pytest.mark.parametrize(
    ("gaps_m", "expected"), [([3.0, -1.0], (1, "the contact")), ([3.0, 4.0], (0, "the start"))]
)
def test_of_cars_in_one_lane_is_looked_for_from_the_start_on(gaps_m, expected) -> None:
    case = replace(CASE, scenario=replace(US23, ramp=US23.mainline))
    cars = motion(gaps_m, [1.0 if expected[0] else -1.0] * 2)
    assert Conflict.of(Trajectory(case, cars, End.TIMEOUT), None) == expected


@pytest.mark.parametrize(("pov_m", "vut_m", "row"), [(4.9, 5.0, 0), (5.0, 4.9, 1)])
def test_takes_the_length_of_the_car_ahead(pov_m: float, vut_m: float, row: int) -> None:
    # The front bumper of the POV is 5 m behind that of the VUT, or ahead of it.
    cars = motion([0.0], [1.0])
    cars = cars[:, ::-1] * [1.0, -1.0, 1.0] if row else cars
    case = replace(CASE, scenario=replace(US23, pov_length_m=pov_m, vut_length_m=vut_m))
    assert Conflict.of(Trajectory(case, cars, End.MERGED), None).what == "the contact"


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
    with pytest.raises(UserError, match=r"`from_s` is .*: it must be 0 or below, such as -3"):
        check_from(from_s)
