"""The largest ball that no case has entered: by hand, and against the checker's Voronoi cells."""

# mypy: no-strict-optional

from __future__ import annotations

import math

import check_certificate
import numpy as np
import pytest
from scipy.spatial import cKDTree

from merge_sumo.analysis.summary import summarise
from merge_sumo.values.empty_ball import EXACT, largest_empty_ball


@pytest.mark.parametrize(
    ("points", "radius", "centre"),
    [
        ([[0.5, 0.5]], math.sqrt(0.5), None),
        ([[0.0, 0.0]], math.sqrt(2.0), (1.0, 1.0)),
        ([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], math.sqrt(1.25), None),
        ([[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]], math.sqrt(0.5), (0.5, 0.5)),
        ([[0.0, 0.0, 0.0, 0.0]], 2.0, (1.0, 1.0, 1.0, 1.0)),
    ],
)
def test_is_known_by_hand(points, radius, centre):
    found = largest_empty_ball(np.array(points))
    assert radius * (1.0 - 2.0 * EXACT) <= found.radius <= radius <= found.at_most + 1e-12
    if centre is not None:
        assert found.centre == pytest.approx(centre, abs=0.01)


@pytest.mark.parametrize("dims", [2, 3])
def test_is_that_of_voronoi_cells(dims):
    points = np.random.default_rng(1).random((60, dims))
    radius = check_certificate.farthest(points, 0.5)
    found = largest_empty_ball(points)
    assert radius * (1.0 - EXACT) <= found.radius <= radius <= found.at_most
    assert cKDTree(points).query(found.centre)[0] == found.radius


def test_is_bounded_where_there_are_too_many_boxes():
    points = np.random.default_rng(2).random((100, 5))
    found = largest_empty_ball(points)
    assert cKDTree(points).query(found.centre)[0] == found.radius < found.at_most
    assert largest_empty_ball(points) == found


def test_there_is_none_without_points():
    assert largest_empty_ball(np.empty((0, 2))) is None


def test_is_in_the_summary_of_a_campaign(run):
    found = summarise(run.outcomes, (0, 2)).levels
    assert 0.05 < found[0].unseen.radius < 0.3
    assert found[2].unseen is None
