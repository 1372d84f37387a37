"""Failure mode coverage: closed forms, two independent references, and what must not matter."""

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
    growth_bound,
    has_neighbour,
    radius_for,
    regions,
)

Points = NDArray[np.float64]

BALL = {1: 2 * RADIUS, 2: math.pi * RADIUS**2, 3: 4 / 3 * math.pi * RADIUS**3}
# What the docstring promises; 1e-12 per point is what snapping and rounding may cost.
TOLERANCE = {1: 1e-10, 2: 1e-10, 3: 1e-4}
DIMENSIONS = pytest.mark.parametrize("dimension", [1, 2, 3])


def lens(distance: float, dimension: int) -> float:
    """Volume common to two balls of the default radius."""
    d, r = distance, RADIUS
    if d >= 2 * r:
        return 0.0
    if dimension == 1:
        return 2 * r - d
    if dimension == 2:
        return 2 * r**2 * math.acos(d / (2 * r)) - d / 2 * math.sqrt(4 * r**2 - d**2)
    return math.pi * (4 * r + d) * (2 * r - d) ** 2 / 12


def lattice(count: int, spacing: float, dimension: int) -> Points:
    """Points on a square or cubic lattice."""
    axis = np.arange(count) * spacing
    return np.stack(np.meshgrid(*[axis] * dimension), axis=-1).reshape(-1, dimension)


def unit_vector(seed: int, dimension: int) -> Points:
    vector = np.random.default_rng(seed).normal(size=dimension)
    return vector / np.linalg.norm(vector)


def monte_carlo(points: Points, seed: int, radius: float = RADIUS) -> tuple[float, float]:
    """The definition: share of a box within a radius of a point. Returns it and its std error."""
    samples = 200_000
    low, high = points.min(axis=0) - radius, points.max(axis=0) + radius
    box = float(np.prod(high - low))
    x = np.random.default_rng(seed).uniform(low, high, size=(samples, points.shape[1]))
    share = float(np.mean(cKDTree(points).query(x)[0] <= radius))
    return box * share, box * math.sqrt(share * (1 - share) / samples)


class TestClosedForms:
    @DIMENSIONS
    def test_no_points_cover_nothing(self, dimension):
        assert fmc(np.zeros((0, dimension))) == 0.0
        assert fmc([]) == 0.0

    @DIMENSIONS
    @pytest.mark.parametrize("radius", [RADIUS, 0.31])
    def test_one_ball(self, dimension, radius):
        expected = {1: 2 * radius, 2: math.pi * radius**2, 3: 4 / 3 * math.pi * radius**3}
        # A lone ball is exact in 3-D too: its poles are taken care of.
        assert fmc(np.full((1, dimension), 0.4), radius) == pytest.approx(
            expected[dimension], rel=1e-12
        )

    @DIMENSIONS
    @pytest.mark.parametrize("distance", [1e-6, 0.01, 0.05, 0.08, 0.0999, 0.1 - 1e-9])
    def test_two_overlapping_balls(self, dimension, distance):
        points = 0.3 + np.stack([np.zeros(dimension), distance * unit_vector(1, dimension)])
        expected = 2 * BALL[dimension] - lens(distance, dimension)
        assert fmc(points) == pytest.approx(expected, rel=1e-9 if dimension < 3 else 1e-6)

    @DIMENSIONS
    @pytest.mark.parametrize("distance", [0.1, 40.0])
    def test_touching_and_distant_balls_add_up(self, dimension, distance):
        points = np.outer(np.arange(5) * distance, unit_vector(3, dimension))
        assert fmc(points) == pytest.approx(5 * BALL[dimension], rel=1e-9)

    def test_the_hole_of_a_ring_does_not_count(self):
        count, ring = 24, 0.3
        angles = 2 * math.pi * np.arange(count) / count
        points = 0.5 + ring * np.column_stack([np.cos(angles), np.sin(angles)])
        step = 2 * ring * math.sin(math.pi / count)
        assert step < 2 * RADIUS  # closed, so there is a hole
        expected = count * (BALL[2] - lens(step, 2))
        assert fmc(points) == pytest.approx(expected, rel=1e-12)


class TestLattices:
    """Many circles through one point, arcs that end where others begin, tangents."""

    def test_a_flat_lattice_in_space(self):
        # All slices would meet the balls at the same heights if they were parallel to it.
        points = np.column_stack([lattice(20, 0.08, 2), np.full(400, 0.3)])
        expected = 400 * BALL[3] - 2 * 20 * 19 * lens(0.08, 3)
        assert fmc(points) == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("dimension", [2, 3, *some([4, 5, 6], 4)])
@pytest.mark.parametrize(("count", "width"), [(3, 0.15), (60, 0.3), (400, 0.3), (2000, 1.0)])
def test_monte_carlo_of_the_definition(dimension, count, width):
    points = np.random.default_rng(count + dimension).random((count, dimension)) * width
    expected, its_error = monte_carlo(points, 7, radius_for(dimension))
    error = 5e-3 * expected if dimension > 3 else 0.0
    assert its_error < 0.02 * expected
    assert abs(fmc(points) - expected) < 4 * math.hypot(its_error, error)


# No deadline: a busy machine is no failure. Derandomised: neither is luck.
examples = settings(max_examples=25, deadline=None, derandomize=True)

# Coordinates with many ties, tangents and coincident intersections among them.
coordinates = st.one_of(
    st.integers(0, 20).map(lambda i: i * RADIUS / 2),
    st.floats(0.0, 0.4),
    st.floats(0.1, 0.1 + 1e-8),
)


@st.composite
def point_sets(draw, dimensions=(1, 2, 3), most=12):
    d = draw(st.sampled_from(dimensions))
    count = draw(st.integers(1, most))
    return draw(arrays(np.float64, (count, d), elements=coordinates))


class TestWhatMustNotMatter:
    @examples
    @given(point_sets(), st.randoms(use_true_random=False))
    def test_order_and_repetition(self, points, random):
        result = fmc(points)
        rows = list(range(len(points))) * 2
        random.shuffle(rows)
        assert fmc(points[rows]) == result

    @examples
    @given(point_sets())
    def test_more_points_cover_more_but_no_more_than_their_balls(self, points):
        d = points.shape[1]
        slack = BALL[d] * len(points) * TOLERANCE[d]
        covered = [fmc(points[:n]) for n in range(len(points) + 1)]
        gains = np.diff(covered)
        assert gains.min() >= -slack
        assert gains.max() <= BALL[d] + slack


class TestInMoreDimensions:
    DIMENSIONS = pytest.mark.parametrize("dimension", some([4, 5, 6], 4))

    @staticmethod
    def ball(dimension):
        return ball_volume(dimension) * radius_for(dimension) ** dimension

    @DIMENSIONS
    @pytest.mark.parametrize("times", [0.3, 1.2, 2.0, 50.0])
    def test_a_row_of_balls(self, dimension, times):
        """The volume common to two balls is that of two caps (Li, 2011)."""
        direction = np.random.default_rng(dimension).normal(size=dimension)
        step = times * radius_for(dimension) * direction / np.linalg.norm(direction)
        volume = fmc(0.4 + np.outer(np.arange(30), step))
        cap = betainc((dimension + 1) / 2.0, 0.5, 1.0 - min(times / 2.0, 1.0) ** 2)
        expected = (30 - 29 * cap) * self.ball(dimension)
        assert volume == pytest.approx(expected, rel=8e-3)

    def test_the_radius_is_that_of_a_ball_whose_disc_is_as_large_as_the_one_of_three(self):
        disc = math.pi * RADIUS**2
        assert 4 / 3 * math.pi * radius_for(4) ** 3 == pytest.approx(disc, rel=1e-12)
        assert [round(radius_for(d), 3) for d in (3, 4, 5, 6)] == [0.05, 0.123, 0.2, 0.272]


class TestBadInput:
    @pytest.mark.parametrize("function", [fmc, regions])
    @pytest.mark.parametrize(
        ("points", "sentence"),
        [
            ([0.1, 0.2], r"points must have shape \(n, d\) with d from 1 to 6, got \(2,\)"),
            ([[0.1] * 7], r"points must have shape .* got \(1, 7\)"),
            (np.zeros((0, 7)), r"points must have shape .* got \(0, 7\)"),
            (np.zeros((3, 0)), r"points must have shape .* got \(3, 0\)"),
            (0.5, r"points must have shape .* got \(\)"),
            ([[0.1, 0.2], [0.3, math.nan]], r"points must be finite, but point 1 is \[0.3, nan\]"),
            ([[math.inf, 0.0]], r"points must be finite, but point 0 is \[inf, 0.0\]"),
        ],
    )
    def test_points(self, function, points, sentence):
        with pytest.raises(ValueError, match=sentence):
            function(points)

    @pytest.mark.parametrize("function", [fmc, regions])
    @pytest.mark.parametrize("radius", [0.0, -0.05, math.nan, math.inf])
    @pytest.mark.parametrize("points", [[[0.1, 0.2]], []])
    def test_radius(self, function, radius, points):
        with pytest.raises(ValueError, match="radius must be a positive finite number, got"):
            function(points, radius)


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

    @examples
    @given(point_sets(dimensions=range(1, 7), most=25))
    def test_against_walking_the_graph(self, points):
        distance = np.linalg.norm(points[:, None] - points[None], axis=2)
        reach = distance <= radius_for(points.shape[1]) * (1 + 1e-9)
        for _ in range(5):  # paths of up to 32 links
            reach = reach @ reach
        labels = regions(points)
        assert labels.dtype == np.int64
        assert ((labels[:, None] == labels[None]) == reach).all()
        sizes = np.bincount(labels)
        firsts = [int(np.flatnonzero(labels == label)[0]) for label in range(len(sizes))]
        order = list(zip(-sizes, firsts, strict=True))
        assert order == sorted(order)


class TestCovered:
    def test_is_within_the_radius_of_a_failure_inclusively(self):
        points = [[0.5, 0.5 + RADIUS], [0.5, 0.5 + 1.001 * RADIUS], [0.9, 0.9]]
        assert covered(points, [[0.5, 0.5], [0.1, 0.1]]).tolist() == [True, False, False]

    def test_of_nothing_and_by_nothing_is_nothing(self):
        assert covered(np.zeros((0, 2)), [[0.5, 0.5]]).tolist() == []
        assert covered([[0.5, 0.5]], np.zeros((0, 2))).tolist() == [False]


class TestANeighbour:
    def test_is_another_point_within_the_radius(self):
        points = [[0.1, 0.1], [0.1, 0.1 + RADIUS], [0.5, 0.5]]
        assert has_neighbour(points).tolist() == [True, True, False]
        assert has_neighbour([[0.1, 0.1]]).tolist() == [False]
        assert has_neighbour([]).tolist() == []


class TestTheBoundOfGrowth:
    def test_is_1_where_no_balls_overlap_and_0_where_all_are_double(self):
        assert growth_bound([[0.1, 0.1], [0.9, 0.9]]) == 1.0
        assert growth_bound([[0.1, 0.1], [0.1, 0.1 + 1e-9]]) == pytest.approx(0.0, abs=1e-3)
        assert growth_bound(np.zeros((0, 2))) == growth_bound([]) == 0.0

    def test_of_two_balls_is_the_share_outside_of_their_lens(self):
        distance = RADIUS
        lens = 2 * RADIUS**2 * math.acos(0.5) - distance / 2 * math.sqrt(3) * RADIUS
        union = 2 * math.pi * RADIUS**2 - lens
        bound = growth_bound([[0.1, 0.1], [0.1, 0.1 + distance]])
        assert bound == pytest.approx(1.0 - lens / union, abs=0.01)

    @pytest.mark.parametrize("dimension", [2, 3, 4])
    def test_is_no_less_than_what_as_many_cases_again_add_on_average(self, dimension):
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


def test_points_far_apart_about_the_middle_are_refused_and_near_ones_far_out_are_not():
    with pytest.raises(ValueError, match="span"):
        fmc(np.array([[-1e6], [1e6]]), radius=1.0)
    assert fmc(np.array([[1e7]]), radius=1.0) == pytest.approx(2.0)
