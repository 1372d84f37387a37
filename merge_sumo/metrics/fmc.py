"""Failure mode coverage (FMC): the volume of the union of balls around failing cases.

Source: Wang, Zhang, Lee, Peng, "An Interaction-aware Evaluation Method for Highly Automated
Vehicles", section "Problem formulation for adaptive testing": M(s, rho, lambda) is the integral of
1 dv over the union of the balls B(rho, s_i) around the cases s_i with P(s_i) < lambda. The caller
chooses the failing cases; they are points in coordinates normalised to [0, 1] per dimension, and
the balls are not clipped to the unit cube.

In one and two dimensions the volume is exact up to rounding. In more it is sampled.

The paper has two and three dimensions, with one radius. Failures are a thin layer next to a
hypersurface of the pool, where the order of merging changes, and a ball covers a disc of it with
one dimension less. In more dimensions a disc of the paper's radius would be next to nothing, so
there the radius is the one for which the disc is as large as in three (`radius_for`): to cover as
much of such a layer takes about the same number of balls.
"""

from __future__ import annotations

import math
from functools import cache, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import ndtri

RADIUS = 0.05
"""Ball radius rho of the paper, in normalised coordinates (no unit)."""

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

SAMPLES = 1 << 17
"""Places at which the balls are counted."""
SLACK = 1e-9
"""Relative rounding of distances (0.2 - 0.15 > 0.05): else a grid with the spacing of the radius
would fall apart into regions at random."""
PAIRS_AT_ONCE = 1 << 14
"""Pairs of a disc and a neighbour that are computed together: they fit into the cache."""


def ball_volume(dimension: int) -> float:
    """Return the volume of a ball of radius 1.

    Args:
        dimension: number of coordinates, d.
    """
    return math.exp(dimension / 2.0 * math.log(math.pi) - math.lgamma(dimension / 2.0 + 1.0))


def radius_for(dimension: int) -> float:
    """Return the radius of the balls: the paper's up to 3-D, then that of as large a disc.

    The disc is the cut of a ball through its centre, with one dimension less.

    Args:
        dimension: number of coordinates, d.

    Returns:
        The radius in normalised coordinates, without a unit.
    """
    if dimension <= 3:
        return RADIUS
    disc = dimension - 1
    return float((RADIUS**2 * ball_volume(2) / ball_volume(disc)) ** (1.0 / disc))


def fmc(points: ArrayLike) -> float:
    """Return the volume of the union of balls: M(s, rho, lambda) of Wang et al.

    Args:
        points: centres of the balls, shape (n, d) with d from 1 to 6, in normalised coordinates:
            the cases with a score below lambda. Shape (0,) also means no points. Not modified;
            order and repeated points do not matter.

    Returns:
        Length (d = 1), area (d = 2) or volume of the union of balls of radius `radius_for(d)`, not
        clipped to the unit cube; 0.0 for no points. Exact up to rounding for d = 1 and 2. Sampled
        for d > 2: the error is about 5e-4 of the volume for 50 to 5,000 points of a band, up to
        4e-3 for 20,000, and 2e-2 for dense heaps. The same points have the same figure.

    Raises:
        ValueError: points of another shape or dimension, or points that are not finite.

    Example:
        >>> fmc([[0.5, 0.5]])  # pi * 0.05**2
        0.007853981633974483
    """
    cases = _checked(points)
    return _volume(cases.tobytes(), cases.shape[1]) if len(cases) else 0.0


@lru_cache(maxsize=256)
def _volume(cases: bytes, dimension: int) -> float:
    """Return the volume of the union of balls around cases, (n, d), given as bytes.

    A search that continues needs the volume of the same cases again, and bytes can be a key of the
    cache.
    """
    radius = radius_for(dimension)
    centres = _in_radii(np.frombuffer(cases).reshape(-1, dimension), radius)
    if dimension == 1:
        volume = 2.0 + float(np.minimum(np.diff(centres[:, 0]), 2.0).sum())
    elif dimension == 2:
        volume = _union_area(centres)
    else:
        # A place is drawn as often as it is in balls (Karp and Luby, 1983).
        volume = len(centres) * ball_volume(dimension) * float((1.0 / _balls_at(centres)).mean())
    return float(volume * radius**dimension)


def fmc_growth(points: ArrayLike) -> FloatArray:
    """Return the FMC of the first 1, 2, ... n of some points, sampled to within 3 %, for charts.

    Args:
        points: failures in the order in which they were found, (n, d), as those of `fmc`.

    Returns:
        Shape (n,), rising.
    """
    cases = _checked(points)
    n, dimension = cases.shape
    if n == 0:
        return np.zeros(0)
    radius = radius_for(dimension)
    centres = cases / radius
    samples = 1 << 13
    first, share = np.empty(samples, dtype=np.int64), np.empty(samples)
    balls_at = cKDTree(centres).query_ball_point(_places(centres, samples), 1.0 + SLACK)
    for place, balls in enumerate(balls_at):
        first[place], share[place] = min(balls), 1.0 / len(balls)
    volume = n * ball_volume(dimension) * radius**dimension
    found = np.bincount(first, share, minlength=n)
    growth: FloatArray = volume / samples * np.cumsum(found)
    return growth


def covered(points: ArrayLike, failures: ArrayLike) -> BoolArray:
    """Return which of some points the balls around failures contain.

    The mean over failing points that were drawn uniformly, whatever was searched, is the *covered
    share*: the share of the failing volume that lies within a radius of a failure found. It is a
    share of independent points, so its error is that of a binomial share, in any dimension.

    Args:
        points: places, (m, d), as those of `fmc`.
        failures: centres of the balls, (n, d).

    Returns:
        Shape (m,).
    """
    places, centres = _checked(points), _checked(failures)
    if len(places) == 0 or len(centres) == 0:
        return np.zeros(len(places), dtype=np.bool_)
    limit = radius_for(places.shape[1]) * (1.0 + SLACK)
    distance, _ = cKDTree(centres).query(places, distance_upper_bound=2.0 * limit)
    within: BoolArray = distance <= limit
    return within


def growth_bound(points: ArrayLike) -> float:
    """Return a bound on the FMC that the same number of uniform cases again adds, as a share of it.

    Of N uniform cases, the failures within a radius of a place x are Poisson distributed with mean
    N m(x), where m is the failing share of the pool in the ball around x. The expected volume in
    one ball alone is then the integral of N m exp(-N m), and the expected growth from N to 2N cases
    that of exp(-N m) (1 - exp(-N m)), which is nowhere more (Good and Toulmin, 1956). So the bound
    is the share of the union that lies in one ball alone, up to the randomness of the cases.

    Args:
        points: failures among uniform cases, shape (n, d).

    Returns:
        0 to 1; 1 where no two balls overlap, 0 for no points. Sampled, to within 0.01. The order
        of the points does not matter; a repeated point counts twice.
    """
    cases = _checked(points)
    if len(cases) == 0:
        return 0.0
    in_order = cases[np.lexsort(cases.T)]
    balls = _balls_at(in_order / radius_for(cases.shape[1]))
    return float((balls == 1).sum() / (1.0 / balls).sum())


def regions(points: ArrayLike, radius: float | None = None) -> IntArray:
    """Return the connected region of each failure: points within a radius are linked.

    Args:
        points: cases, shape (n, d) with d from 1 to 6, in normalised coordinates. Shape (0,) also
            means no points. Not modified.
        radius: largest distance of two linked points; None for `radius_for(d)`.

    Returns:
        Shape (n,): the region of each point. Region 0 has the most points, then 1 and so on;
        regions of equal size are in the order of their first point.

    Raises:
        ValueError: points of another shape or dimension, or points that are not finite.
    """
    cases = _checked(points)
    limit = (radius_for(cases.shape[1]) if radius is None else radius) * (1.0 + SLACK)
    pairs = cKDTree(cases).query_pairs(limit, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(cases), len(cases)))
    # Numbered in the order of their first point.
    _, region = connected_components(links, directed=False)
    size = np.bincount(region)
    rank = np.empty(len(size), dtype=np.int64)
    rank[np.argsort(-size, kind="stable")] = np.arange(len(size))
    ranked: IntArray = rank[region]
    return ranked


def _balls_at(centres: FloatArray) -> IntArray:
    """Return in how many unit balls around centres, (n, d), places in them lie, (SAMPLES,)."""
    places = _places(centres, SAMPLES)
    balls = cKDTree(centres).query_ball_point(places, 1.0, workers=-1, return_length=True)
    return np.maximum(np.asarray(balls, dtype=np.int64), 1)


def _places(centres: FloatArray, samples: int) -> FloatArray:
    """Return places in unit balls, (samples, d); each ball has the same number of them."""
    own = centres[np.arange(samples) * len(centres) // samples]
    return own + _places_in_ball(centres.shape[1])[:samples]


@cache
def _places_in_ball(dimension: int) -> FloatArray:
    """Return places in the unit ball, (SAMPLES, d).

    They are of a rank-1 sequence (Roberts, 2018), which fills a ball more evenly than random
    numbers: the error of a volume is a quarter.
    """
    ratio = 2.0
    for _ in range(50):  # the root of ratio ** (d + 2) = ratio + 1
        ratio = (1.0 + ratio) ** (1.0 / (dimension + 2))
    steps = ratio ** -np.arange(1.0, dimension + 2.0)
    uniform = (0.5 + np.arange(1, SAMPLES + 1)[:, None] * steps) % 1.0
    places: FloatArray = ndtri(np.maximum(uniform[:, :dimension], 1e-12))
    places *= uniform[:, dimension:] ** (1.0 / dimension) / np.linalg.norm(
        places, axis=1, keepdims=True
    )
    return places


def _checked(points: ArrayLike) -> FloatArray:
    """Return points as an array (n, d), or raise a ValueError."""
    cases = np.asarray(points, dtype=np.float64)
    if cases.shape == (0,):
        return np.zeros((0, 1))
    if cases.ndim != 2 or not 1 <= cases.shape[1] <= 6:
        raise ValueError(f"points must have shape (n, d) with d from 1 to 6, got {cases.shape}")
    if not np.isfinite(cases).all():
        raise ValueError("points must be finite")
    return cases


def _in_radii(cases: FloatArray, radius: float) -> FloatArray:
    """Return the distinct points, sorted, in radii from the middle of their bounding box."""
    low, high = cases.min(axis=0), cases.max(axis=0)
    # Snapped to a grid, which moves a boundary by 1e-12 at most: a case written with another
    # rounding is the same case. Sorting makes the result equal to the last bit for every order.
    grid = 2.0**-40
    return np.unique(np.round((cases - (low + high) / 2.0) / radius / grid) * grid, axis=0)


def _union_area(centres: FloatArray) -> float:
    """Return the area of the union of unit discs around distinct centres, (n, 2).

    Each circle is first compared with its nearest discs. A circle that some of them cover is not
    part of the boundary; the others, few where discs are dense, are compared with more and more.
    """
    tree = cKDTree(centres)
    area, neighbours = 0.0, 9
    discs = np.arange(len(centres))
    while len(discs):
        neighbours = min(neighbours, len(centres))
        undecided = []
        rows = max(1, PAIRS_AT_ONCE // neighbours)
        for start in range(0, len(discs), rows):
            part = discs[start : start + rows]
            known, left = _boundary_integral(tree, part, neighbours)
            area += known
            undecided.append(left)
        discs = np.concatenate(undecided)
        neighbours *= 4
    return area


def _boundary_integral(tree: cKDTree, discs: IntArray, neighbours: int) -> tuple[float, IntArray]:
    """Integrate (x dy - y dx) / 2 over the uncovered arcs of some discs (Green's theorem).

    Args:
        tree: centres of all unit discs, (n, 2).
        discs: the discs to integrate over, (m,), as indices of centres.
        neighbours: number of the nearest discs that may cover a circle, the disc itself included.

    Returns:
        The integral over the discs that have no more neighbours than that, and the discs with an
        uncovered arc that have more and so are undecided.
    """
    centres = tree.data[discs]
    # Discs 2 apart touch at most. Missing neighbours get the index n and an infinite distance.
    distance, near = tree.query(centres, k=np.arange(1, neighbours + 1), distance_upper_bound=2.0)
    has_all = np.isinf(distance[:, -1]) | (neighbours == tree.n)
    absent = np.isinf(distance) | (distance == 0.0)
    away = tree.data[np.where(absent, discs[:, None], near)] - centres[:, None]

    # A neighbour covers the angles within `half` of its direction, an absent one none.
    turn = 2.0 * np.pi
    half = np.arccos(np.where(absent, 2.0, distance) / 2.0)
    begin = np.arctan2(away[..., 1], away[..., 0]) - half
    begin[begin < 0.0] += turn
    end = begin + 2.0 * half

    # Cut the circle at angle 0: one more interval covers the part beyond the cut. With begins and
    # ends sorted separately, a gap follows the k-th end if that comes before begin k + 1: all k
    # intervals that have begun have ended there.
    over = np.maximum(end.max(axis=1) - turn, 0.0)
    ends = np.sort(np.column_stack([over, np.minimum(end, turn)]), axis=1)
    begins = np.sort(np.column_stack([begin, np.full(len(discs), turn)]), axis=1)
    # A shorter arc is the rounding of two angles below 2 pi.
    uncovered = begins - ends > 1e-14
    undecided = discs[uncovered.any(axis=1) & ~has_all]

    disc, gap = np.nonzero(uncovered & has_all[:, None])
    low, high = ends[disc, gap], begins[disc, gap]
    x_part = centres[disc, 0] * (np.sin(high) - np.sin(low))
    y_part = centres[disc, 1] * (np.cos(high) - np.cos(low))
    return float(np.sum(high - low + x_part - y_part)) / 2.0, undecided
