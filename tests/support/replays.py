"""Replay folders of any motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.road.road import Road
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.sumo.replay import replay
from merge_sumo.sumo.replay_folder import HOLD_STEPS, write_replay_folder


def commanded(
    case: Case, a_mps2: np.ndarray, x_m: list[float] | None = None, end: End = End.TIMEOUT
) -> Trajectory:
    """Return the motion of eq. (4) under accelerations, (steps, 2); no speed falls below 0."""
    starts = np.array(case.starts())
    x, v = starts[:, 0] if x_m is None else np.array(x_m), starts[:, 1]
    rows = []
    for wanted in a_mps2:
        a = np.maximum(wanted, -v / DT_S)
        rows.append(np.stack((x, v, a), axis=1))
        x, v = x + v * DT_S, np.maximum(v + a * DT_S, 0.0)
    rows.append(np.stack((x, v, np.zeros(2)), axis=1))
    return Trajectory(case, np.array(rows), end)


def write_replay(folder: Path, road: Road, trajectory: Trajectory) -> Path:
    outcome = Outcome(0, 0, trajectory.case, Measures.of(trajectory))
    write_replay_folder(folder, road, outcome, trajectory)
    return folder


def assert_identical(folder: Path, rows: int | None = None) -> None:
    """Replay a folder; `rows` is that of its motion."""
    result = replay(folder)
    assert (result.diverged_at_s, result.detail) == (None, "")
    assert result.rows > 0 if rows is None else result.rows == 2 * (rows + HOLD_STEPS)
