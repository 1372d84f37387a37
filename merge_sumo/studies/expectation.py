"""Where the twin of a campaign's VUT expects failures, over the whole pool.

expected.json           in the folder of a campaign that made predictions: by level, how near the
                        gap is expected to be at the nodes of a grid, from 0 to 255

The file of a folder which somebody sent is data as everything in it.
"""

from __future__ import annotations

import json
import math
from typing import Annotated, Final

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from merge_sumo.analysis.predictions import has_predictions
from merge_sumo.analysis.surface import Grid, nodes
from merge_sumo.campaigns.store import Run
from merge_sumo.drivers.policies import policies_of
from merge_sumo.engine.povs import Povs
from merge_sumo.engine.simulator import road_for
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.samplers.prediction_skill import Query
from merge_sumo.system.arrays import regular
from merge_sumo.system.folders import replace_own
from merge_sumo.system.records import Record, decode
from merge_sumo.twin.twin import Twin
from merge_sumo.values.case import FloatArray, Pool
from merge_sumo.values.scenario import DX_CRASH_M, level_name

EXPECTED: Final = "expected.json"
GRID: Final[dict[int, Grid]] = {2: (41, 41, 1), 3: (25, 25, 9)}
"""Nodes in each coordinate, by their number."""
MOST_CASES: Final = 1000
"""Cases, the last ones, that the twin learns from."""
MOST_NODES: Final = 4000
"""Nodes that the twin is asked at a time."""
HIGHEST: Final = 255
"""What stands for a gap of 0 in the file."""


class _Expectation(Record, frozen=True):
    levels: dict[str, tuple[Annotated[int, Meta(ge=0, le=HIGHEST)], ...]]


def note_expectation(run: Run) -> None:
    """Write where the twin of a campaign expects failures, in the place of an older file.

    Nothing is written for a campaign without predictions, nor where its motions or its policies
    are gone.
    """
    if not has_predictions(run.outcomes):
        return
    try:
        levels = _levels(run)
    except UserError:
        return
    replace_own(run.folder / EXPECTED, (json.dumps({"levels": levels}) + "\n").encode())


def _levels(run: Run) -> dict[str, list[int]]:
    """Return how near gaps are expected, by name of level, in the order of `nodes`."""
    from threadpoolctl import threadpool_limits

    levels = run.levels
    limit_m = run.scenario.dx_crash_m if run.criterion.is_papers else DX_CRASH_M
    twin = learned_twin(run, levels)
    result = {}
    for level in levels:
        grid = GRID.get(len(run.scenario.dimensions(level)))
        if grid is not None and twin.can_predict(level):
            with threadpool_limits(1):
                near = nearness(twin, level, nodes(grid), limit_m)
            result[level_name(level)] = [round(HIGHEST * share) for share in near.tolist()]
    return result


def learned_twin(run: Run, levels: list[int]) -> Twin:
    """Return a twin that learned from the motions of a run; `UserError` where something is gone."""
    povs = Povs(policies=policies_of(run.scenario))
    if povs.sha256() != run.settings.get("policies_sha256"):
        raise UserError("the run had other drivers than those that are here")
    pool = Pool(levels=tuple(levels), scenario=run.scenario)
    lines = centre_lines(road_for(run.scenario))
    twin = Twin(pool, povs, 0, criterion=run.criterion, lines=lines)
    last = run.outcomes[-MOST_CASES:]
    twin.tell(last, {o.index: run.trajectory(o.index).motion for o in last})
    return twin


def nearness(twin: Twin, level: int, points: FloatArray, limit_m: float) -> FloatArray:
    """Return how near gaps are expected at points, (n, d), as (n,).

    1 where the gap is 0, 0.5 at the limit of a failure, 0 from twice the limit on, as a mean over
    the experts of the twin. Their members take turns, from point to point.
    """
    parts = np.array_split(points, len(points) // MOST_NODES + 1)
    by_turns = [Query(level, part, held_out=range(len(part))) for part in parts]
    gaps_m = np.concatenate([twin.predict([query])[0] for query in by_turns], axis=-1)
    far = np.nan_to_num(np.abs(gaps_m), nan=np.inf) / (2.0 * limit_m)
    return np.asarray(np.clip(1.0 - far, 0.0, 1.0).mean(axis=0), dtype=np.float64)


def read_expectation(run: Run) -> dict[int, tuple[Grid, NDArray[np.uint8]]]:
    """Return by level the grid, and how near gaps are expected at its nodes, (n,), 255 at 0.

    Empty where the folder says nothing. Raises `UserError` for a file that is not as we write it.
    """
    path = run.folder / EXPECTED
    try:
        levels = decode(regular(path).read_bytes(), _Expectation).levels
        return dict(_row(run, name, row) for name, row in levels.items())
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    except UserError as error:
        raise UserError(f"{path} is not as it was written: {error}") from error


def _row(run: Run, name: str, row: tuple[int, ...]) -> tuple[int, tuple[Grid, NDArray[np.uint8]]]:
    for level in run.levels:
        grid = GRID.get(len(run.scenario.dimensions(level)))
        if level_name(level) == name and grid is not None and len(row) == math.prod(grid):
            return level, (grid, np.array(row, dtype=np.uint8))
    raise UserError(f"the campaign has no level {name!r} of {len(row)} nodes")
