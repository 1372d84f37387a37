"""Failure mode coverage (FMC): the volume of the union of balls around failing cases.

Source: Wang, Zhang, Lee, Peng, "An Interaction-aware Evaluation Method for Highly Automated
Vehicles", section "Problem formulation for adaptive testing": M(s, rho, lambda) is the integral of
1 dv over the union of the balls B(rho, s_i) around the cases s_i with P(s_i) < lambda. The caller
picks the failing cases; here they are points in coordinates normalised to [0, 1] per dimension, and
the balls are not clipped to the unit cube.

One dimension is a sum of gaps and two dimensions follow from the boundary arcs of the union; both
are exact up to rounding. Three dimensions integrate the exact two-dimensional union over parallel
slices, to within about 1e-4 of the volume. More dimensions are sampled.

The paper has two and three dimensions, with one radius. Failures are a thin layer beside a
hypersurface of the pool, where the order of merging changes, and a ball covers a disc of it with
one dimension less. In more dimensions a disc of the paper's radius would be next to nothing, so
there the radius is the one for which the disc is as large as in three (`radius_for`): to cover as
much of such a layer takes about as many balls.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

RADIUS: Final = 0.05
"""Ball radius rho of the paper, in normalised coordinates (no unit)."""
MOST_DIMENSIONS: Final = 6

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

_SAMPLES: Final = 1 << 17
"""Places of the union at which balls are counted."""
_SEED: Final = 20210909

_TURN: Final = 2.0 * np.pi
# Inside this module lengths are in radii: every ball has radius 1.
_MAX_SPAN: Final = 1e6  # the boundary integral loses span * 1e-16 of a disc to rounding
_MERGE: Final = 2.0**-40  # points are snapped to this grid: moves a boundary by 1e-12 at most
_MIN_ARC_RAD: Final = 1e-14  # a shorter arc is the rounding of two angles below 2 pi
_FIRST_NEIGHBOURS: Final = 8
_MORE_NEIGHBOURS: Final = 4  # factor from one round to the next
_CHUNK: Final = 1 << 14  # disc-neighbour pairs at once: fits the cache, bounds the memory
_COINCIDENT: Final = 1e-100  # stands for a distance of 0 that has to have a direction
_TURNED_RAD: Final = (1.0, 0.7, 0.3)  # about x, y, z; any angles with nothing special to them
# Slices per ball diameter. What is left of the errors of single balls averages out, so many spread
# balls need the fewest (measured: 24 slices keep 400 of them within 8e-5). Few balls can afford
# more, up to a budget of discs, and a heap not much larger than one ball needs more in all.
_SLICES: Final = 24
_SLICES_IN_ALL: Final = 64
_MAX_SLICES: Final = 250
_DISC_BUDGET: Final = 10_000
# Distances are rounded (0.2 - 0.15 > 0.05): without this slack a grid with the spacing of the
# radius would fall apart into regions at random.
_LINK_SLACK: Final = 1e-9


def ball_volume(dimension: int) -> float:
    """Return the volume of a ball of radius 1."""
    return math.exp(dimension / 2.0 * math.log(math.pi) - math.lgamma(dimension / 2.0 + 1.0))


def radius_for(dimension: int) -> float:
    """Return the radius of the balls: the paper's up to 3-D, then that of as large a disc.

    The disc is the cut of a ball through its centre, with one dimension less.
    """
    if dimension <= 3:
        return RADIUS
    disc = dimension - 1
    return float((RADIUS**2 * ball_volume(2) / ball_volume(disc)) ** (1.0 / disc))


def fmc(points: ArrayLike, radius: float | None = None) -> float:
    """Volume of the union of equal balls: M(s, rho, lambda) of Wang et al.

    Args:
        points: centres of the balls, shape (n, d) with d from 1 to 6, in normalised coordinates:
            the cases with a score below lambda. Shape (0,) also means no points. Not modified;
            order and repeated points do not matter.
        radius: radius rho of the balls, in the same coordinates; by default `radius_for(d)`.

    Returns:
        Length (d = 1), area (d = 2) or volume of the union, not clipped to the unit cube; 0.0 for
        no points. Exact up to rounding for d = 1 and 2. For d = 3 within about 1e-4 of the volume
        (measured on clusters, bands, plates and lattices: mostly 3e-5, 1.3e-4 at worst), so that
        one more point may lower the figure by as much. For d > 3 with a standard error of at most
        1e-3 of the volume for clouds and bands of 1,000 points (measured for d = 4 to 6), 4e-3 for
        20,000, and 2e-2 for heaps. The same points have the same figure.

    Raises:
        ValueError: points of another shape or dimension, points that are not finite, a radius that
            is not a positive finite number, or points more than a million radii apart.
    """
    cases = _checked(points, radius)
    dimension = cases.shape[1]
    unit = radius_for(dimension) if radius is None else radius
    return _volume(cases.tobytes(), dimension, float(unit)) if len(cases) else 0.0


@lru_cache(maxsize=256)
def _volume(cases: bytes, dimension: int, unit: float) -> float:
    """Return the volume of the union: a search that goes on asks for that of its beginning."""
    centres = _in_radii(np.frombuffer(cases).reshape(-1, dimension), unit)
    if dimension == 1:
        volume = 2.0 + float(np.minimum(np.diff(centres[:, 0]), 2.0).sum())
    elif dimension == 2:
        # The one slice of balls.
        flat = np.column_stack([centres, np.zeros(len(centres))])
        volume = _sliced_area(flat, cKDTree(flat), np.arange(len(flat)), np.zeros(len(flat)))
    elif dimension == 3:
        volume = _union_volume(centres)
    else:
        # A place is drawn as often as it is in balls (Karp and Luby, 1983).
        volume = len(centres) * ball_volume(dimension) * float((1.0 / _balls_at(centres)).mean())
    return float(volume * unit**dimension)


def covered(points: ArrayLike, failures: ArrayLike, radius: float | None = None) -> BoolArray:
    """Return which of some points, (m, d), the balls around failures, (n, d), contain: (m,).

    The mean over failing points that were drawn uniformly, whatever was searched, is the *covered
    share*: the share of the failing volume that lies within a radius of a failure found. It is a
    share of independent points, so its error is that of a binomial share of m, in any dimension.
    Raises as `fmc` does.
    """
    return _near(points, failures, radius, nth=1)


def has_neighbour(points: ArrayLike, radius: float | None = None) -> BoolArray:
    """Return which of some points, (n, d), have another one within the radius: (n,).

    Raises as `fmc` does.
    """
    return _near(points, points, radius, nth=2)


def _near(points: ArrayLike, others: ArrayLike, radius: float | None, nth: int) -> BoolArray:
    """Return for which points, (m, d), the nth nearest of others is within the radius, (m,)."""
    drawn, found = _checked(points, radius), _checked(others, radius)
    if not (len(drawn) and len(found)):
        return np.zeros(len(drawn), dtype=np.bool_)
    limit = (radius_for(drawn.shape[1]) if radius is None else radius) * (1.0 + _LINK_SLACK)
    distance, _ = cKDTree(found).query(drawn, k=[nth], distance_upper_bound=2.0 * limit)
    within: BoolArray = distance[:, 0] <= limit
    return within


def growth_bound(points: ArrayLike, radius: float | None = None) -> float:
    """Return the most that as many uniform cases again add to the FMC, as a share of it.

    Of N uniform cases, the failures within a radius of a place x are Poisson distributed with mean
    N m(x), where m is the failing share of the pool in the ball around x. The expected volume in
    one ball alone is then the integral of N m exp(-N m), and the expected growth from N to 2N cases
    that of exp(-N m) (1 - exp(-N m)), which is nowhere more (Good and Toulmin, 1956). So the bound
    is the share of the union that lies in one ball alone, up to the randomness of the cases.

    Args:
        points: failing ones of uniform cases, shape (n, d).
        radius: as of `fmc`.

    Returns:
        0 to 1; 1 where no two balls overlap, 0 for no points. Sampled, to within 0.01. The order
        of the points does not matter; a point given twice counts twice. Raises as `fmc` does.
    """
    cases = _checked(points, radius)
    if len(cases) == 0:
        return 0.0
    unit = radius_for(cases.shape[1]) if radius is None else radius
    balls = _balls_at(cases[np.lexsort(cases.T)] / unit)
    return float((balls == 1).sum() / (1.0 / balls).sum())


def regions(points: ArrayLike, radius: float | None = None) -> IntArray:
    """Connected regions of failures: components of the graph that links points within a radius.

    Args:
        points: cases, shape (n, d) with d from 1 to 6, in normalised coordinates. Shape (0,) also
            means no points. Not modified.
        radius: two points at this distance or less (to within 1e-9 of it) are in one region; by
            default `radius_for(d)`.

    Returns:
        Shape (n,): the region of each point. Region 0 has the most points, then 1 and so on;
        regions of equal size are in the order of their first point. Empty for no points. Memory
        grows with the number of points, however dense they are.

    Raises:
        ValueError: points of another shape or dimension, points that are not finite, or a radius
            that is not a positive finite number.
    """
    cases = _checked(points, radius)
    if len(cases) == 0:
        return np.zeros(0, dtype=np.int64)
    # Pairs grow with the square of the number of copies of a point, so link each place once.
    places, place = np.unique(cases, axis=0, return_inverse=True)
    place = place.reshape(-1)  # a column in NumPy 2.0.0
    limit = radius_for(cases.shape[1]) if radius is None else radius
    component = _linked(places, limit * (1.0 + _LINK_SLACK))[place]
    _, first, size = np.unique(component, return_index=True, return_counts=True)
    rank = np.empty(len(size), dtype=np.int64)
    rank[np.lexsort((first, -size))] = np.arange(len(size))
    ranked: IntArray = rank[component]
    return ranked


def _linked(places: FloatArray, limit: float) -> IntArray:
    """Return the component of each of n distinct points, (n,), linked at `limit` or less.

    Dense points have too many links to list. Their nearest neighbours link most of them; points in
    one cell of a grid with a diagonal of `limit` are linked anyhow. What these leave apart is
    looked at part by part, among the points that have more neighbours than were looked at.
    """
    n, dimension = places.shape
    near = min(_FIRST_NEIGHBOURS + 1, n)
    distance, neighbour = cKDTree(places).query(places, k=np.arange(1, near + 1))
    point, column = np.nonzero(distance <= limit)
    all_looked_at = (distance[:, -1] > limit) | (near == n)
    grid = np.floor(places / (limit / np.sqrt(dimension))).astype(np.int64)
    _, first, cell = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    cell = cell.reshape(-1)
    links = [
        np.column_stack([point, neighbour[point, column]]),
        np.column_stack([np.arange(n), first[cell]]),
    ]
    component = _components(links, n)
    crowded = np.flatnonzero(~all_looked_at)
    labels = component[crowded]
    for label in np.unique(labels)[:-1].tolist():
        own, later = crowded[labels == label], crowded[labels > label]
        low, high = places[own].min(axis=0) - limit, places[own].max(axis=0) + limit
        later = later[((places[later] >= low) & (places[later] <= high)).all(axis=1)]
        if not len(later):
            continue
        distance, nearest = cKDTree(places[own]).query(places[later])
        near_enough = distance <= limit
        links.append(np.column_stack([own[nearest[near_enough]], later[near_enough]]))
    return _components(links, n)


def _components(links: list[IntArray], n: int) -> IntArray:
    """Return the component of each of n points, (n,), from arrays of linked pairs, (m, 2)."""
    pairs = np.concatenate(links)
    graph = coo_array((np.ones(len(pairs), dtype=np.bool_), pairs.T), shape=(n, n))
    component: IntArray = connected_components(graph, directed=False)[1]
    return component


def _balls_at(centres: FloatArray) -> IntArray:
    """Return in how many unit balls around centres, (n, d), places drawn in them lie."""
    rng, dimension = np.random.default_rng(_SEED), centres.shape[1]
    direction = rng.standard_normal((_SAMPLES, dimension))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    reach = rng.random((_SAMPLES, 1)) ** (1.0 / dimension)
    places = centres[rng.integers(len(centres), size=_SAMPLES)] + reach * direction
    balls = cKDTree(centres).query_ball_point(places, 1.0, return_length=True)
    return np.maximum(np.asarray(balls, dtype=np.int64), 1)


def _checked(points: ArrayLike, radius: float | None) -> FloatArray:
    """The points as an array (n, d), d = 1 to 6, or a ValueError that says what is wrong."""
    if radius is not None and not (np.isfinite(radius) and radius > 0.0):
        raise ValueError(f"radius must be a positive finite number, got {radius}")
    cases = np.asarray(points, dtype=np.float64)
    if cases.shape == (0,):
        return np.zeros((0, 1))
    if cases.ndim != 2 or not 1 <= cases.shape[1] <= MOST_DIMENSIONS:
        raise ValueError(f"points must have shape (n, d) with d from 1 to 6, got {cases.shape}")
    bad = np.flatnonzero(~np.isfinite(cases).all(axis=1))
    if len(bad):
        raise ValueError(f"points must be finite, but point {bad[0]} is {cases[bad[0]].tolist()}")
    return cases


def _in_radii(cases: FloatArray, radius: float) -> FloatArray:
    """The distinct points, sorted, in radii from the middle of their bounding box."""
    if len(cases) == 0:
        return cases
    low, high = cases.min(axis=0), cases.max(axis=0)
    with np.errstate(over="ignore"):
        span = float(((high - low) / radius).max())
    if span > _MAX_SPAN:
        raise ValueError(
            f"points span {span:.3g} radii, more than {_MAX_SPAN:.0e}: normalise them to [0, 1]"
        )
    # The same case written with another rounding is the same case. Sorting makes the result equal
    # to the last bit for every order of the points.
    return np.unique(np.round((cases - (low + high) / 2.0) / radius / _MERGE) * _MERGE, axis=0)


def _union_volume(centres: FloatArray) -> float:
    """Volume of the union of unit balls around distinct centres (n, 3).

    Midpoint rule over the area A(z) of slices, with the error of its worst kinks taken off: where
    a ball begins or ends at z0, A changes by pi (2 t - t^2), t = |z - z0|, unless another ball
    hides that pole. A lone ball is exact that way. What is left are the heights where boundaries
    meet, and A is smoother (t^1.5): with m slices per diameter about m^-2.5, of either sign.
    """
    n = len(centres)
    # Cases on a grid or in a plane would have all their kinks at the same heights, where errors add
    # up; turned by no special angle, they cancel out. The volume does not change.
    balls: FloatArray = Rotation.from_euler("xyz", _TURNED_RAD).apply(centres)
    tree = cKDTree(balls)
    bottom, top = float(balls[:, 2].min()) - 1.0, float(balls[:, 2].max()) + 1.0
    per_diameter = max(_SLICES, _DISC_BUDGET // n, int(_SLICES_IN_ALL * 2.0 / (top - bottom)))
    per_diameter = min(per_diameter, _MAX_SLICES)
    step = 2.0 / per_diameter
    first = np.floor((balls[:, 2] - 1.0 - bottom) / step).astype(np.int64)
    nth = first[:, None] + np.arange(per_diameter + 2)
    heights = bottom + step * (nth.astype(np.float64) + 0.5)
    ball, column = np.nonzero(np.abs(heights - balls[:, 2:]) < 1.0)
    volume = step * _sliced_area(balls, tree, ball, heights[ball, column])
    for side in (-1.0, 1.0):
        poles = balls[:, 2] + side
        bare = poles[_bare_poles(balls, tree, side, depth=step / 4.0)]
        phase = np.mod((bare - bottom) / step - 0.5, 1.0)
        # Euler-Maclaurin: where A' jumps by 2 pi, the sum exceeds the integral by this.
        excess = -(step**2) / 2.0 * _TURN * (phase**2 - phase + 1.0 / 6.0)
        volume -= float(excess.sum())
    return volume


def _bare_poles(balls: FloatArray, tree: cKDTree, side: float, depth: float) -> NDArray[np.bool_]:
    """Which unit balls (n, 3) show a pole, the lower (side -1) or the upper one (side 1).

    A pole is hidden if a ball that reaches further contains the point `depth` inside it. Asking for
    that point and not for the pole itself makes two poles that are closer than the slices can tell
    one kink (measured: an eighth to a half of the distance of the slices does equally well).
    """
    inside = balls + np.array([0.0, 0.0, side * (1.0 - depth)])
    # The balls that reach furthest past a point within the cap are the nearest to it.
    _, near = tree.query(inside, k=np.arange(1, min(_FIRST_NEIGHBOURS, len(balls)) + 1))
    further = side * (balls[near, 2] - balls[:, 2:]) > 0.0
    contains = np.linalg.norm(balls[near] - inside[:, None], axis=2) < 1.0
    bare: NDArray[np.bool_] = ~(further & contains).any(axis=1)
    return bare


def _sliced_area(balls: FloatArray, tree: cKDTree, ball: IntArray, height: FloatArray) -> float:
    """Area of the union of discs in each slice, summed over the slices.

    A disc is the cut of unit ball `ball[i]` of the distinct `balls` (n, 3) at z = `height[i]`; all
    discs of a slice must be given. Each disc's circle is first compared with its nearest balls: a
    circle that some of them cover is no part of the boundary, whatever the others do. Only the
    circles left over, few where balls are dense, are compared with more, at last with all.
    """
    n = len(balls)
    area = 0.0
    neighbours = _FIRST_NEIGHBOURS + 1  # a ball is its own nearest
    while len(ball):
        neighbours = min(neighbours, n)
        undecided: list[IntArray] = []
        rows = max(1, _CHUNK // neighbours)
        for start in range(0, len(ball), rows):
            part = slice(start, start + rows)
            known, left = _boundary_integral(balls, tree, ball[part], height[part], neighbours)
            area += known
            undecided.append(start + left)
        again = np.concatenate(undecided)
        ball, height = ball[again], height[again]
        neighbours *= _MORE_NEIGHBOURS
    return area


def _boundary_integral(
    balls: FloatArray, tree: cKDTree, ball: IntArray, height: FloatArray, neighbours: int
) -> tuple[float, IntArray]:
    """Integral of (x dy - y dx) / 2 over the uncovered arcs of some discs (Green's theorem).

    Returns the integral over the discs that have no more than the given number of neighbours, and
    the indices of the discs with an uncovered arc that have more and so are undecided.
    """
    n = len(balls)
    used, row = np.unique(ball, return_inverse=True)
    # Balls 2 apart touch at most. Missing neighbours get the index n.
    _, near = tree.query(balls[used], k=np.arange(1, neighbours + 1), distance_upper_bound=2.0)
    complete = (near[:, -1] == n) | (neighbours == n)
    absent = (near == n) | (near == used[:, None])
    near = np.where(absent, 0, near)

    # What concerns a pair of balls and not the slice: direction and distance in the plane.
    dx, dy, dz = (balls[near, axis] - balls[used, axis][:, None] for axis in range(3))
    # Of two balls above each other, each must see the other one on the opposite side.
    above = (dx == 0.0) & (dy == 0.0)
    dx = np.where(above, np.copysign(_COINCIDENT, near - used[:, None]), dx)
    distance = np.where(absent, 4.0, np.hypot(dx, dy))
    direction = np.where(absent, 0.0, np.arctan2(dy, dx))
    slope = np.where(absent, 0.0, dz / distance)
    z_sum = balls[near, 2] + balls[used, 2][:, None]

    # A neighbour covers the angles within `half` of its direction, from the cosine rule
    # (d^2 + r^2 - r'^2) / 2dr; beyond +-1 it covers nothing or all. r^2 - r'^2 is written as a
    # product so that it is exactly opposite for the two discs, which then agree on who covers whom.
    # An absent one gets no width.
    own = balls[ball]
    size = np.sqrt(1.0 - (height - own[:, 2]) ** 2)
    cosine = distance[row] + slope[row] * (z_sum[row] - 2.0 * height[:, None])
    half = np.arccos(np.clip(cosine / (2.0 * size[:, None]), -1.0, 1.0))
    begin = direction[row] - half
    begin[begin < 0.0] += _TURN
    end = begin + 2.0 * half

    # Cut the circle at angle 0: one more interval holds what reaches over the cut. With begins and
    # ends sorted apart, the k-th end is followed by a gap if it comes before begin k + 1, for then
    # as many intervals have ended there as have begun.
    over = np.maximum(end.max(axis=1) - _TURN, 0.0)
    ends = np.sort(np.column_stack([over, np.minimum(end, _TURN)]), axis=1)
    begins = np.sort(np.column_stack([begin, np.full(len(ball), _TURN)]), axis=1)
    uncovered = begins - ends > _MIN_ARC_RAD
    undecided = np.flatnonzero(uncovered.any(axis=1) & ~complete[row])

    disc, gap = np.nonzero(uncovered & complete[row][:, None])
    low, high, r = ends[disc, gap], begins[disc, gap], size[disc]
    x_part = own[disc, 0] * (np.sin(high) - np.sin(low))
    y_part = own[disc, 1] * (np.cos(high) - np.cos(low))
    return float(np.sum(r * (r * (high - low) + x_part - y_part))) / 2.0, undecided
