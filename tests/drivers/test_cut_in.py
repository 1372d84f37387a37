"""The models of the reference drivers against tables of their published code.

`tests/data/reference/README.md` says where the tables come from. Here the cut-in of the published
comparison is a simulation of its own, as facts: both cars are 4.3 m long and 1.9 m wide, and a car
moves by its new speed. The models and the reaction are those of the package; the lateral
conditions, of which a merge has none, are here.
"""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from merge_sumo.drivers.reference_models import (
    CarefulModel,
    FsmModel,
    Pair,
    Reaction,
    Reg157Model,
    RssModel,
)

TABLES = Path(__file__).parents[1] / "data" / "reference"
DT_S, STEPS, LENGTH_M, WIDTH_M, LANE_M = 0.1, 350, 4.3, 1.9, 3.5


class PublishedReg157Model(Reg157Model):
    """Looks a step ahead, as the published code does."""

    bound_s = 0.45


MODELS = {
    "CC_human_driver": CarefulModel(),
    "FSM": FsmModel(),
    "Reg157": PublishedReg157Model(),
    "RSS": RssModel(),
}


def table(name, **only):
    """Return the columns of a table, each (n,), of the rows with the given values."""
    with (TABLES / name).open(encoding="utf-8", newline="") as file:
        rows = [r for r in csv.DictReader(file) if all(r[k] == v for k, v in only.items())]
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def numbers(rows, *names):
    """Return columns of a table as numbers, (n,) each."""
    return [rows[name].astype(float) for name in names]


def lateral(speeds_mps):
    """Return the gaps to the side and the speeds to the side, (T, n), and steps of run-up, (n,).

    The car that cuts in starts to move by 1.5 m/s2, and moves until it is at ego's centre line.
    """
    gaps, speeds, before = [], [], []
    for speed in speeds_mps.tolist():
        run_up = np.arange(0.0, -speed, -0.15)
        moving = int(10 * LANE_M // speed + 1) if speed else 0
        then = np.concatenate((np.full(moving, -speed), np.zeros(STEPS)))[:STEPS]
        y_m = np.concatenate((LANE_M - np.cumsum(run_up[::-1] / 10)[::-1], [LANE_M]))
        y_m = np.concatenate((y_m, np.cumsum(then) / 10 + LANE_M))[:STEPS]
        gaps.append(np.abs(y_m) - WIDTH_M / 2 - WIDTH_M / 2)
        speeds.append(np.abs(np.concatenate((run_up, [-speed], then))[:STEPS]))
        before.append(len(run_up))
    return np.array(gaps).T, np.array(speeds).T, np.array(before)


class CutIns:
    """Cut-ins ahead of an ego that a model drives.

    Attributes:
        crash_type: 0 none, 1 with ego's centre ahead, 2 with ego behind, (n,).
    """

    def __init__(self, name, ego_kmh, other_kmh, gap_m, lateral_mps):
        self.name, self.model = name, MODELS[name]
        self.v_other = other_kmh / 3.6
        unique, which = np.unique(lateral_mps, return_inverse=True)
        self.y_m, self.u_mps, before = (found[..., which] for found in lateral(unique))
        n, v = len(gap_m), ego_kmh / 3.6
        self.crash_type, self.ended = np.zeros(n, dtype=int), np.zeros(n, dtype=bool)
        reaction, a = Reaction(n, self.model), np.zeros(n)
        d = gap_m + (v - self.v_other) * before * DT_S
        for step in range(STEPS):
            self.touch(step, d)
            unsafe = self.unsafe(step, d, v, a) & (d + LENGTH_M >= 0.0) & ~self.ended
            demand = self.model.demand_mps2(Pair(d, v, self.v_other, a))
            faster = np.maximum(v + reaction.acceleration_mps2(unsafe, demand) * DT_S, 0.0)
            a, v = (faster - v) / DT_S, faster
            d = d + (self.v_other - v) * DT_S

    def touch(self, step, d):
        touch = (self.y_m[step] < 0.0) & (d < 0.0) & (d > -2.0 * LENGTH_M) & ~self.ended
        kind = np.where(d + LENGTH_M < 0.0, 1, 2)
        self.crash_type = np.where(touch & (self.crash_type == 0), kind, self.crash_type)

    def unsafe(self, step, d, v, a):
        """Return where the model is unsafe, and the other car to the side near enough, (n,)."""
        y, u = self.y_m[step], self.u_mps[step]
        # Side by side, the published times to collision are those of |d|.
        gap = np.abs(d) if self.name in ("CC_human_driver", "Reg157") else d
        unsafe = self.model.is_unsafe(Pair(gap, v, self.v_other, a))
        if self.name == "CC_human_driver":
            # Nothing to react to on the lane ends the published case.
            self.ended |= (y <= 0.0) & ~unsafe & (d + LENGTH_M >= 0.0)
            return unsafe & (y <= 0.0)
        if self.name == "Reg157":
            return unsafe & (y <= 0.5)
        if self.name == "RSS":
            return unsafe & (y < 0.3 + (2.0 * u + 0.75) * 0.75 / 2.0 + (u + 0.75) ** 2 / 2.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            in_time = y / u <= (d + 2.0 * LENGTH_M) / (v - self.v_other) + 0.1
        return unsafe & ((y <= 0.0) | ((u > 0.0) & in_time))


def test_pfs_is_that_of_the_published_code():
    rows = table("pfs.csv")
    gap, rear, front, wanted = numbers(rows, "gap_m", "v_rear_mps", "v_front_mps", "pfs")
    assert np.abs(FsmModel().pfs(Pair(gap, rear, front)) - wanted).max() < 1e-9
    assert ((wanted > 0.0) & (wanted < 1.0)).mean() > 0.1


def test_cfs_is_that_of_the_published_code():
    rows = table("cfs.csv")
    gap, rear, front = numbers(rows, "gap_m", "v_rear_mps", "v_front_mps")
    a, wanted = numbers(rows, "a_rear_mps2", "cfs")
    assert np.abs(FsmModel().cfs(Pair(gap, rear, front, a)) - wanted).max() < 1e-9
    assert ((wanted > 0.0) & (wanted < 1.0)).sum() > 50


@pytest.mark.parametrize("name", MODELS)
def test_every_cut_in_ends_as_with_the_published_code(name):
    rows = table("cut_in.csv", model=name)
    columns = numbers(rows, "ego_kmh", "cut_in_kmh", "gap_m", "lat_vel_mps")
    found, wanted = CutIns(name, *columns), rows["crash_type"].astype(int)
    assert len(wanted) == 584
    assert 50 < (wanted > 0).sum() < 500
    assert np.flatnonzero(found.crash_type != wanted).tolist() == []
