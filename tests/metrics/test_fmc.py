"""Failure mode coverage: closed forms, an independent reference, and what must not matter."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import some
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.special import betainc

from merge_sumo.metrics.fmc import (
    RADIUS,
    ball_volume,
    covered,
    fmc,
    fmc_growth,
    growth_bound,
    radius_for,
    regions,
)

Points = NDArray[np.float64]

DISC = math.pi * RADIUS**2


def ball(dimension: int) -> float:
    return ball_volume(dimension) * radius_for(dimension) ** dimension


def common(distance: float, dimension: int) -> float:
    """Volume common to two balls, which is that of two caps (Li, 2011)."""
    times = min(distance / radius_for(dimension) / 2.0, 1.0)
    return ball(dimension) * float(betainc((dimension + 1) / 2.0, 0.5, 1.0 - times**2))


def unit_vector(dimension: int) -> Points:
    vector = np.random.default_rng(dimension).normal(size=dimension)
    return vector / np.linalg.norm(vector)


def monte_carlo(points: Points, seed: int, radius: float) -> tuple[float, float]:
    """The definition: share of a box within a radius of a point. Returns it and its std error."""
    samples = 200_000
    low, high = points.min(axis=0) - radius, points.max(axis=0) + radius
    box = float(np.prod(high - low))
    x = np.random.default_rng(seed).uniform(low, high, size=(samples, points.shape[1]))
    share = float(np.mean(cKDTree(points).query(x)[0] <= radius))
    return box * share, box * math.sqrt(share * (1 - share) / samples)


@pytest.mark.parametrize("dimension", [1, 2, 3, *some([4, 5, 6], 4)])
class TestClosedForms:
    def test_no_points_cover_nothing(self, dimension):
        assert fmc(np.zeros((0, dimension))) == fmc([]) == 0.0

    @pytest.mark.parametrize("times", [1e-5, 1.0, 1.9, 800.0])
    def test_a_row_of_balls(self, dimension, times):
        step = times * radius_for(dimension)
        count = 2 if times < 1.0 else 30
        points = 0.4 + np.outer(np.arange(count), step * unit_vector(dimension))
        expected = count * ball(dimension) - (count - 1) * common(step, dimension)
        assert fmc(points) == pytest.approx(expected, rel=1e-9 if dimension < 3 else 8e-3)


def test_the_radius_keeps_the_volume_of_the_disc_of_three_dimensions():
    assert 4 / 3 * math.pi * radius_for(4) ** 3 == pytest.approx(DISC, rel=1e-12)
    assert [round(radius_for(d), 3) for d in (3, 4, 5, 6)] == [0.05, 0.123, 0.2, 0.272]


@pytest.mark.parametrize("dimension", [2, 3])
def test_monte_carlo_of_the_definition(dimension):
    points = np.random.default_rng(dimension).random((2000, dimension))
    expected, its_error = monte_carlo(points, 7, radius_for(dimension))
    error = 2e-3 * expected if dimension > 2 else 0.0
    assert its_error < 0.02 * expected
    assert abs(fmc(points) - expected) < 4 * math.hypot(its_error, error)


# No deadline: a busy machine is not a failure. Derandomised: neither is luck.
examples = settings(max_examples=25, deadline=None, derandomize=True)

# Coordinates with many ties, tangents and coincident intersections among them.
coordinates = st.one_of(
    st.integers(0, 20).map(lambda i: i * RADIUS / 2),
    st.floats(0.0, 0.4),
    st.floats(0.1, 0.1 + 1e-8),
)


@st.composite
def point_sets(draw, dimensions):
    d = draw(st.sampled_from(dimensions))
    count = draw(st.integers(1, 12))
    return draw(arrays(np.float64, (count, d), elements=coordinates))


@examples
@given(point_sets([1, 2, 3]), st.randoms(use_true_random=False))
def test_order_and_repetition_do_not_matter(points, random):
    rows = list(range(len(points))) * 2
    random.shuffle(rows)
    assert fmc(points[rows]) == fmc(points)


@pytest.mark.parametrize(
    ("points", "sentence"),
    [
        ([0.1, 0.2], r"points must have shape \(n, d\) with d from 1 to 6, got \(2,\)"),
        (np.zeros((0, 7)), r"points must have shape .* got \(0, 7\)"),
        ([[0.1, 0.2], [0.3, math.nan]], "points must be finite"),
    ],
)
def test_bad_points_are_refused(points, sentence):
    with pytest.raises(ValueError, match=sentence):
        fmc(points)


class TestRegions:
    def test_by_hand(self):
        points = [
            [0.90, 0.9],  # alone
            [0.10, 0.1],  # a chain of three: its ends are further apart than the radius
            [0.14, 0.1],
            [0.18, 0.1],
            [0.50, 0.5],  # a pair
            [0.50, 0.54],
            [0.10, 0.9],  # alone, later than the other one
        ]
        assert regions(points).tolist() == [2, 0, 0, 0, 1, 1, 3]

    def test_a_grid_with_the_spacing_of_the_radius_is_one_region(self):
        axis = np.arange(11) * 0.05
        assert not (np.diff(axis) <= 0.05).all()  # rounding
        assert set(regions(axis[:, None])) == {0}
        assert regions([[0.0], [0.0501]]).tolist() == [0, 1]
        assert regions([[0.1], [0.11]], radius=0.0).tolist() == [0, 1]


def test_the_balls_around_failures_cover_places_within_the_radius_inclusively():
    points = [[0.5, 0.5 + RADIUS], [0.5, 0.5 + 1.001 * RADIUS], [0.9, 0.9]]
    assert covered(points, [[0.5, 0.5], [0.1, 0.1]]).tolist() == [True, False, False]
    assert covered(np.zeros((0, 2)), [[0.5, 0.5]]).tolist() == []
    assert covered([[0.5, 0.5]], np.zeros((0, 2))).tolist() == [False]


class TestTheBoundOfGrowth:
    def test_is_1_where_no_balls_overlap_and_0_where_all_are_double(self):
        assert growth_bound([[0.1, 0.1], [0.9, 0.9]]) == 1.0
        assert growth_bound([[0.1, 0.1], [0.1, 0.1 + 1e-9]]) == pytest.approx(0.0, abs=1e-3)
        assert growth_bound(np.zeros((0, 2))) == growth_bound([]) == 0.0

    @pytest.mark.parametrize("dimension", [2, 4])
    def test_is_no_less_than_the_mean_growth_with_twice_the_cases(self, dimension):
        rng = np.random.default_rng(dimension)
        bounds, growths = [], []
        for _ in range(20):
            points = rng.random((4000, dimension))
            fails = np.abs(points.sum(axis=1) - dimension / 2) < 0.02
            before, after = fmc(points[:2000][fails[:2000]]), fmc(points[fails])
            bounds.append(growth_bound(points[:2000][fails[:2000]]) * before)
            growths.append(after - before)
        assert np.mean(growths) <= np.mean(bounds)
        assert np.mean(growths) >= 0.4 * np.mean(bounds)


@pytest.mark.parametrize("dims", [1, 2, 3, 4])
def test_growth_is_the_fmc_of_the_first_points(dims):
    points = np.random.default_rng(dims).random((150, dims))
    growth = fmc_growth(points)
    for n in (1, 50, 150):
        assert growth[n - 1] == pytest.approx(fmc(points[:n]), rel=0.03)
