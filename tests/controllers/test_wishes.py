"""What VUTs see of an acceleration lane, and how they say when to merge."""

# mypy: no-strict-optional

from __future__ import annotations

import numpy as np
import pytest
from support.vut_contract import ON_LANE, begin, factory, in_process, on_lane

from merge_sumo.controllers.controller import Seen, Start, seen_in
from merge_sumo.drivers.base import MERGE, NO_WISH, STAY, VutLostError


def begun(vut, corridors, **options):
    """Return a driver with an episode in each corridor."""
    driver = factory(vut, **options).open(corridors) if isinstance(vut, str) else vut
    begin(driver)
    return driver


def test_it_sees_the_lane_and_whether_a_wish_would_be_granted():
    seen = [
        seen_in(0.0, 0, [x - 30.0, x], [30.0, 20.0], (-70.0, 130.0), merged=merged)
        for x, merged in ((-72.01, False), (-72.0, False), (100.0, False), (-60.0, True))
    ]
    assert [s.may_merge for s in seen] == [False, True, True, False]
    assert [s.merged for s in seen] == [False, False, False, True]
    assert {(s.lane_begin_m, s.lane_end_m) for s in seen} == {(-70.0, 130.0)}
    assert all(isinstance(s, Seen) for s in seen)
    assert seen[0][1:] == (-102.01, 30.0, -72.01, 20.0)
    assert [car.x_m for car in seen[0].others] == [-102.01]
    start = Start.of(ON_LANE).seen
    assert (start.lane_begin_m, start.may_merge, start.merged) == (-70.0, False, False)


def test_without_a_lane_it_sees_none_and_has_merged_from_m_on():
    before, past = (seen_in(0.0, 0, [0.0, x], [30.0, 20.0]) for x in (-1e-9, 0.0))
    assert type(before) is Seen
    assert (before.lane_begin_m, before.lane_end_m, before.may_merge) == (0.0, 0.0, False)
    assert (before.merged, past.merged, past.may_merge) == (False, True, False)
    traffic = seen_in(0.0, 0, [0.0, -5.0, 9.0, -9.0], [30.0] * 4)
    assert (traffic.may_merge, traffic.merged, len(traffic.others)) == (False, False, 3)


OF_EACH = """
class Vut:
    def reset(self, seen):
        self.lane = seen.lane_begin_m, seen.lane_end_m
    def act(self, seen):
        assert self.lane == (seen.lane_begin_m, seen.lane_end_m), self.lane
        if seen.merged:
            return 0.5
        return (1.0, seen.may_merge) if seen.x_vut_m > -100.0 else 1
"""
OF_ALL = """
import numpy as np
class Vut:
    def __init__(self, corridors):
        pass
    def reset(self, corridor, seen):
        assert (seen.lane_begin_m, seen.lane_end_m) == (-70.0, 130.0)
    def act_batch(self, seen):
        assert seen.lane_begin_m[0] == -70.0 and seen.lane_end_m[0] == 130.0
        return np.where(seen.merged, 0.5, 1.0), seen.may_merge
"""


@pytest.mark.parametrize("process", ["this", "own"])
def test_a_controller_answers_an_acceleration_or_it_and_a_wish(write_vut, process):
    driver = begun(write_vut(OF_EACH), 4, in_process=process == "this")
    try:
        answer = driver.act(on_lane([-150.0, -90.0, -71.0, -50.0], [False, False, False, True]))
        assert answer.tolist() == [1.0, 1.0, 1.0, 0.5]
        assert driver.wishes().tolist() == [NO_WISH, STAY, MERGE, NO_WISH]
        assert driver.wishes().dtype == np.int8
        driver.act(on_lane([-150.0] * 4, [False] * 4))
        assert driver.wishes() is None
    finally:
        driver.close()


@pytest.mark.parametrize("process", ["this", "own"])
def test_a_batched_controller_answers_one_row_or_two(write_vut, process):
    driver = begun(write_vut(OF_ALL), 3, in_process=process == "this")
    try:
        idle = on_lane([-90.0, -71.0, -50.0], [False, False, True])
        idle = idle._replace(active=np.array([True, True, False]))
        assert driver.act(idle).tolist() == [1.0, 1.0, 0.5]
        assert driver.wishes().tolist() == [STAY, MERGE, NO_WISH]
    finally:
        driver.close()
    one_row = begun(in_process(write_vut(OF_ALL.replace(", seen.may_merge", ""))).open(3), 3)
    assert one_row.act(on_lane([-90.0, -71.0, -50.0], [False] * 3)).tolist() == [1.0] * 3
    assert one_row.wishes() is None


WISHES = {
    "True": MERGE,
    "False": STAY,
    "1": MERGE,
    "0.0": STAY,
    "np.array(1)": MERGE,
}
WRONG = {
    "(1.0, float('nan'))": "wishes nan (float) instead of True or False",
    "(1.0, 'yes')": "wishes 'yes' (str) instead of True or False",
    "(1.0, 0.5)": "wishes 0.5 (float) instead of True or False",
    "('1', True)": "answered '1' (str) instead of a number",
    "(1.0, True, 2)": "answered (1.0, True, 2) (tuple) instead of a number, or (number, merge)",
    "np.array([1.0, 1.0])": "answered array([1., 1.]) (ndarray) instead of a number",
    "Pair((1.0, True))": "ZeroDivisionError: division by zero",
}
ANSWERS = """
import numpy as np
class Pair(tuple):
    def __iter__(self):
        1 / 0
def Vut(seen):
    return {} if seen.x_vut_m > -80.0 else 1.0
"""


@pytest.mark.parametrize("wish", WISHES)
def test_a_wish_is_true_or_false(write_vut, wish):
    driver = begun(in_process(write_vut(ANSWERS.format(f"(1, {wish})"))).open(1), 1)
    assert driver.act(on_lane([-71.0], [False])).tolist() == [1.0]
    assert driver.wishes().tolist() == [WISHES[wish]]


@pytest.mark.parametrize("answer", WRONG)
def test_another_answer_is_an_error_of_its_own_corridor(write_vut, answer):
    driver = begun(in_process(write_vut(ANSWERS.format(answer))).open(2), 2)
    assert np.isnan(driver.act(on_lane([-71.0, -90.0], [False] * 2))).tolist() == [True, False]
    assert WRONG[answer] in driver.reason(0)
    assert driver.reason(1) is None


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        ("np.zeros((3, 2))", "shape (3, 2) of float64 instead of 2 numbers, or these and 2 wishes"),
        ("([1.0, 1.0], [True])", "ValueError"),
        ("([1.0, 1.0], ['yes', 'no'])", "of <U"),
    ],
)
def test_a_batch_of_another_shape_is_an_error_of_all(write_vut, answer, said):
    source = OF_ALL.replace("np.where(seen.merged, 0.5, 1.0), seen.may_merge", answer)
    driver = begun(in_process(write_vut(source)).open(2), 2)
    with pytest.raises(VutLostError, match=r".*") as lost:
        driver.act(on_lane([-71.0, -90.0], [False, False]))
    assert said in str(lost.value)


def test_a_wrong_wish_of_a_batch_is_an_error_of_its_own_corridor(write_vut):
    wishes = "np.where(seen.x_vut_m > -80.0, np.nan, 0.0)"
    driver = begun(in_process(write_vut(OF_ALL.replace("seen.may_merge", wishes))).open(3), 3)
    idle = on_lane([-71.0, -90.0, -71.0], [False] * 3)
    idle = idle._replace(active=np.array([True, True, False]))
    assert np.isnan(driver.act(idle)).tolist() == [True, False, False]
    assert driver.reason(0) == "wishes nan instead of 1 or 0, to merge or not"
    assert driver.wishes().tolist() == [NO_WISH, STAY, NO_WISH]


def test_a_process_that_forges_wishes_loses_its_episodes_and_no_more(write_vut):
    source = """
from merge_sumo.controllers.host import HostReply, _Host
_Host._act = lambda host, request: HostReply(accelerations_mps2=[1.0, 1.0], wishes=[7, 7])
def Vut(seen):
    return 1.0, True
"""
    driver = factory(write_vut(source), deadline_s=1.0).open(2)
    try:
        begun(driver, 2)
        with pytest.raises(VutLostError, match="broke the channel to its process"):
            driver.act(on_lane([-71.0, -71.0], [False, False]))
    finally:
        driver.close()
