"""Failure mode coverage in four dimensions and more: closed forms, and Monte Carlo of its error."""

from __future__ import annotations

import math

import numpy as np
import pytest
from conftest import some
from scipy.spatial import cKDTree
from scipy.special import betainc

from merge_sumo.values import ball_union
from merge_sumo.values.ball_union import ball_volume, cell_volume, star_volume
from merge_sumo.values.fmc import RADIUS, fmc, fmc_and_error, radius_for, regions

FloatArray = np.ndarray
DIMENSIONS = pytest.mark.parametrize("dimension", some([4, 5, 6], 4))


def ball(dimension: int) -> float:
    """Volume of one ball."""
    return ball_volume(dimension) * radius_for(dimension) ** dimension


def lens(distance: float, dimension: int) -> float:
    """Volume common to two balls: two caps, each a share of a ball (Li, 2011)."""
    half = distance / 2.0 / radius_for(dimension)
    return ball(dimension) * float(betainc((dimension + 1) / 2.0, 0.5, 1.0 - half**2))


def row(count: int, distance: float, dimension: int) -> FloatArray:
    """Centres in a row that is along no axis."""
    direction = np.random.default_rng(dimension).normal(size=dimension)
    return 0.4 + np.outer(np.arange(count) * distance, direction / np.linalg.norm(direction))


def monte_carlo(points: FloatArray, samples: int = 200_000) -> tuple[float, float]:
    """The definition: share of a box within the radius of a point. Returns it and its error."""
    radius = radius_for(points.shape[1])
    low, high = points.min(axis=0) - radius, points.max(axis=0) + radius
    box = float(np.prod(high - low))
    x = np.random.default_rng(7).uniform(low, high, size=(samples, points.shape[1]))
    covered = cKDTree(points).query(x, distance_upper_bound=radius)[0] <= radius
    share = float(np.mean(covered))
    return box * share, box * math.sqrt(share * (1 - share) / samples)


def test_the_radius_is_that_of_a_ball_whose_disc_is_as_large_as_the_one_of_three_dimensions():
    assert [radius_for(d) for d in (1, 2, 3)] == [RADIUS] * 3
    disc = math.pi * RADIUS**2
    assert 4 / 3 * math.pi * radius_for(4) ** 3 == pytest.approx(disc, rel=1e-12)
    assert math.pi**2 / 2 * radius_for(5) ** 4 == pytest.approx(disc, rel=1e-12)
    assert 8 * math.pi**2 / 15 * radius_for(6) ** 5 == pytest.approx(disc, rel=1e-12)
    assert [round(radius_for(d), 3) for d in (4, 5, 6)] == [0.123, 0.2, 0.272]


class TestClosedForms:
    @DIMENSIONS
    def test_one_ball_is_exact(self, dimension):
        volume, error = fmc_and_error(np.full((1, dimension), 0.4))
        assert volume == pytest.approx(ball(dimension), rel=1e-12)
        assert error == 0.0

    @DIMENSIONS
    @pytest.mark.parametrize("times", [2.0, 2.0 + 1e-9, 3.0, 50.0])
    def test_touching_and_distant_balls_add_up(self, dimension, times):
        volume, error = fmc_and_error(row(5, times * radius_for(dimension), dimension))
        assert volume == pytest.approx(5 * ball(dimension), rel=1e-9)
        assert error < 1e-9

    @DIMENSIONS
    @pytest.mark.parametrize("times", [1e-3, 0.1, 0.5, 1.0, 1.5, 1.9])
    def test_two_overlapping_balls(self, dimension, times):
        distance = times * radius_for(dimension)
        volume, error = fmc_and_error(row(2, distance, dimension))
        expected = 2 * ball(dimension) - lens(distance, dimension)
        assert error < 2e-3 * expected
        assert abs(volume - expected) < 5 * error + 1e-9 * expected

    @DIMENSIONS
    @pytest.mark.parametrize("times", [0.3, 1.2])
    def test_a_row_of_balls(self, dimension, times):
        distance = times * radius_for(dimension)
        volume, error = fmc_and_error(row(30, distance, dimension))
        expected = 30 * ball(dimension) - 29 * lens(distance, dimension)
        assert error < 1e-3 * expected
        assert abs(volume - expected) < 5 * error


class TestTheDefinition:
    @DIMENSIONS
    @pytest.mark.parametrize(("count", "width"), [(3, 0.15), (60, 0.5), (400, 0.3), (1500, 1.0)])
    def test_by_monte_carlo(self, dimension, count, width):
        points = np.random.default_rng(count).random((count, dimension)) * width
        expected, its_error = monte_carlo(points)
        volume, error = fmc_and_error(points)
        assert error < its_error < 0.02 * expected
        assert abs(volume - expected) < 4 * math.hypot(its_error, error)

    @pytest.mark.parametrize(
        ("dimension", "bound"),
        [(4, 2e-3), (5, 4e-3), pytest.param(6, 1e-2, marks=pytest.mark.long)],
    )
    def test_by_monte_carlo_where_there_are_many(self, dimension, bound):
        points = np.random.default_rng(3).random((ball_union.MOST_STARS + 1, dimension))
        points[:, 0] *= 0.2
        expected, its_error = monte_carlo(points)
        volume, error = fmc_and_error(points)
        assert 0.0 < error < bound * volume
        assert abs(volume - expected) < 4 * math.hypot(its_error, error)

    @DIMENSIONS
    def test_by_directions_and_by_cells_is_the_same(self, dimension):
        points = np.random.default_rng(4).random((500, dimension)) / radius_for(dimension)
        points[:, 0] *= 0.3
        stars, cells = star_volume(points), cell_volume(points)
        errors = [volumes.std(ddof=1) / math.sqrt(len(volumes)) for volumes in (stars, cells)]
        assert abs(stars.mean() - cells.mean()) < 5 * math.hypot(*errors)

    def test_the_error_is_what_other_scramblings_differ_by(self, monkeypatch):
        points = np.random.default_rng(6).random((100, 4)) * 0.4
        volumes, errors = [], []
        for seed in range(12):
            monkeypatch.setattr(ball_union, "SEED", seed)
            volume, error = fmc_and_error(points)
            volumes.append(volume)
            errors.append(error)
        assert 0.4 < np.std(volumes, ddof=1) / np.mean(errors) < 2.5


class TestWhatMustNotMatter:
    @DIMENSIONS
    @pytest.mark.parametrize("count", [50, 5000])
    def test_order_and_repetition(self, dimension, count):
        rng = np.random.default_rng(8)
        points = rng.random((count, dimension)) * 0.6
        twice = rng.permutation(np.vstack([points, points]))
        assert fmc(twice) == fmc(points)

    @DIMENSIONS
    def test_scale_and_place(self, dimension):
        points = np.random.default_rng(9).random((80, dimension)) * 0.5
        radius = radius_for(dimension)
        scaled = fmc(points * 8.0 + 3.0, radius * 8.0) / 8.0**dimension
        assert scaled == pytest.approx(fmc(points), rel=1e-9)

    @DIMENSIONS
    def test_one_more_point_covers_more_and_no_more_than_its_ball(self, dimension):
        points = np.random.default_rng(11).random((8, dimension)) * 0.3
        figures = [fmc_and_error(points[:n]) for n in range(9)]
        gains = np.diff([volume for volume, _ in figures])
        slack = 6 * max(error for _, error in figures)
        assert gains.min() > -slack
        assert gains.max() < ball(dimension) + slack


class TestRegions:
    @DIMENSIONS
    def test_are_linked_at_the_radius_of_their_dimension(self, dimension):
        step = np.eye(dimension)[0] * radius_for(dimension)
        points = 0.3 + np.array([0.0 * step, 0.99 * step, 3.0 * step, 1.98 * step])
        assert regions(points).tolist() == [0, 0, 1, 0]
