"""Cases and the pool."""

# mypy: no-strict-optional

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case, from_unit, to_unit
from merge_sumo.scenario.scenario import US23


def test_the_corners_of_the_unit_cube_are_the_bounds_of_the_pool():
    low, high = from_unit(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]), level=2, scenario=US23)
    assert (low.x_pov0_m, low.v_pov0_mps, low.svo_rad) == (-340.0, 25.0, 0.0)
    assert (high.x_pov0_m, high.v_pov0_mps) == (-180.0, 35.0)
    assert high.svo_rad < math.pi / 2
    assert high.svo_rad == pytest.approx(math.pi / 2)


def test_orientation_is_a_coordinate_only_at_level_2():
    assert [len(US23.dimensions(level)) for level in (0, 1, 2)] == [2, 2, 3]
    assert from_unit(np.array([[0.5, 0.5]]), level=1, scenario=US23)[0].svo_rad is None


@given(st.sampled_from([0, 1, 2]), st.lists(st.floats(0.0, 0.999), min_size=3, max_size=3))
def test_points_and_cases_are_inverse_to_each_other(level, coordinates):
    points = np.array([coordinates[: len(US23.dimensions(level))]])
    assert to_unit(from_unit(points, level, scenario=US23), level, scenario=US23) == pytest.approx(
        points, abs=1e-12
    )


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"level": 4}, "level is 4"),
        ({"svo_rad": 0.5}, "svo_rad is for level 2 only"),
        ({"level": 2}, "svo_rad is for level 2 only"),
        ({"level": 2, "svo_rad": 2.0}, "svo_rad is 2: choose 0 to"),
        ({"x_pov0_m": 5.0}, "x_pov0_m is 5: choose -900 to 0"),
        ({"x_pov0_m": math.nan}, "x_pov0_m is nan"),
        ({"v_pov0_mps": -1.0}, "v_pov0_mps is -1: choose"),
        ({"v_vut0_mps": 46.0}, "v_vut0_mps is 46: choose 0 to 45"),
    ],
)
def test_a_case_that_is_no_scenario_is_refused_with_a_sentence(change, sentence):
    values = {"level": 1, "x_pov0_m": -273.0, "v_pov0_mps": 33.0} | change
    with pytest.raises(UserError, match=sentence):
        Case(**{"scenario": US23, **values})
