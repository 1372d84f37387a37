"""Acceleration lanes in the observation of VUTs, and merge requests in their answers."""

# mypy: no-strict-optional

from __future__ import annotations

import re
from contextlib import closing

import numpy as np
import pytest
from support.vut_contract import begin, factory, on_lane

from merge_sumo.controllers.controller import seen_in
from merge_sumo.drivers.base import MERGE, NO_REQUEST, STAY, EpisodesLostError


def begun(vut, corridors, **options):
    """Return a driver with an episode in each corridor."""
    driver = factory(vut, **options).open(corridors)
    begin(driver)
    return driver


@pytest.mark.parametrize(
    ("x_m", "merged", "may_merge"),
    [(-72.01, False, False), (-72.0, False, True), (100.0, False, True), (-60.0, True, False)],
)
def test_on_a_lane_the_observation_says_whether_a_request_is_granted(x_m, merged, may_merge):
    seen = seen_in(0.0, 0, [x_m - 30.0, x_m], [30.0, 20.0], (-70.0, 130.0), merged=merged)
    assert (seen.may_merge, seen.merged) == (may_merge, merged)
    assert (seen.lane_begin_m, seen.lane_end_m) == (-70.0, 130.0)
    assert seen[1:] == (x_m - 30.0, 30.0, x_m, 20.0)
    assert [car.x_m for car in seen.others] == [x_m - 30.0]


@pytest.mark.parametrize("x_m", [-1e-9, 0.0])
def test_without_a_lane_it_sees_none_and_has_merged_from_m_on(x_m):
    seen = seen_in(0.0, 0, [0.0, x_m, 9.0, -9.0], [30.0] * 4)
    assert (seen.lane_begin_m, seen.lane_end_m, seen.may_merge) == (0.0, 0.0, False)
    assert (seen.merged, len(seen.others)) == (x_m == 0.0, 3)


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
def test_a_controller_answers_an_acceleration_or_it_and_a_merge_request(write_vut, process):
    with closing(begun(write_vut(OF_EACH), 4, in_process=process == "this")) as driver:
        answer = driver.act(on_lane([-150.0, -90.0, -71.0, -50.0], [False, False, False, True]))
        assert answer.tolist() == [1.0, 1.0, 1.0, 0.5]
        assert driver.merge_requests().tolist() == [NO_REQUEST, STAY, MERGE, NO_REQUEST]
        assert driver.merge_requests().dtype == np.int8
        driver.act(on_lane([-150.0] * 4, [False] * 4))
        assert driver.merge_requests() is None


@pytest.mark.parametrize("process", ["this", "own"])
def test_a_batched_controller_answers_merge_requests_in_a_second_row(write_vut, process):
    idle = on_lane([-90.0, -71.0, -50.0], [False, False, True])
    idle = idle._replace(active=np.array([True, True, False]))
    with closing(begun(write_vut(OF_ALL), 3, in_process=process == "this")) as driver:
        assert driver.act(idle).tolist() == [1.0, 1.0, 0.5]
        assert driver.merge_requests().tolist() == [STAY, MERGE, NO_REQUEST]


REQUESTS = {"True": MERGE, "0.0": STAY, "np.array(1)": MERGE}
WRONG = {
    "(1.0, float('nan'))": "requested the merge with nan (float) instead of True or False",
    "(1.0, 'yes')": "requested the merge with 'yes' (str) instead of True or False",
    "('1', True)": "answered '1' (str) instead of a number",
    "(1.0, True, 2)": "answered (1.0, True, 2) (tuple) instead of a number or (number, merge)",
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


@pytest.mark.parametrize("request_", REQUESTS)
def test_a_merge_request_is_true_or_false(write_vut, request_):
    driver = begun(write_vut(ANSWERS.format(f"(1, {request_})")), 1, in_process=True)
    assert driver.act(on_lane([-71.0], [False])).tolist() == [1.0]
    assert driver.merge_requests().tolist() == [REQUESTS[request_]]


@pytest.mark.parametrize("answer", WRONG)
def test_another_answer_is_an_error_of_its_own_corridor(write_vut, answer):
    driver = begun(write_vut(ANSWERS.format(answer)), 2, in_process=True)
    assert np.isnan(driver.act(on_lane([-71.0, -90.0], [False] * 2))).tolist() == [True, False]
    assert WRONG[answer] in driver.reason(0)
    assert driver.reason(1) is None


@pytest.mark.parametrize(
    ("answer", "said"),
    [
        (
            "np.zeros((3, 2))",
            "shape (3, 2) of float64 instead of 2 numbers, or 2 numbers and 2 merge requests",
        ),
        ("([1.0, 1.0], ['yes', 'no'])", "of <U"),
    ],
)
def test_a_batch_of_another_shape_is_an_error_of_all(write_vut, answer, said):
    source = OF_ALL.replace("np.where(seen.merged, 0.5, 1.0), seen.may_merge", answer)
    driver = begun(write_vut(source), 2, in_process=True)
    with pytest.raises(EpisodesLostError, match=re.escape(said)):
        driver.act(on_lane([-71.0, -90.0], [False, False]))


def test_a_wrong_merge_request_of_a_batch_is_an_error_of_its_own_corridor(write_vut):
    wishes = "np.where(seen.x_vut_m > -80.0, np.nan, 0.0)"
    driver = begun(write_vut(OF_ALL.replace("seen.may_merge", wishes)), 3, in_process=True)
    idle = on_lane([-71.0, -90.0, -71.0], [False] * 3)
    idle = idle._replace(active=np.array([True, True, False]))
    assert np.isnan(driver.act(idle)).tolist() == [True, False, False]
    assert driver.reason(0) == "requested the merge with nan instead of 1 or 0"
    assert driver.merge_requests().tolist() == [NO_REQUEST, STAY, NO_REQUEST]


def test_a_process_that_forges_merge_requests_loses_its_episodes_and_no_more(write_vut):
    source = """
from merge_sumo.controllers.child_main import HostReply, _Host
_Host._act = lambda host, request: HostReply(accelerations_mps2=[1.0, 1.0], merge_requests=[7, 7])
def Vut(seen):
    return 1.0, True
"""
    driver, said = begun(write_vut(source), 2, deadline_s=1.0), "broke the connection to its"
    with closing(driver), pytest.raises(EpisodesLostError, match=said):
        driver.act(on_lane([-71.0, -71.0], [False, False]))
