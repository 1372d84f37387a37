"""The reference drivers: reactions by hand, and a table of merges of another implementation."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from support.plans import POVS
from support.scenes import scene_of

from merge_sumo.drivers.reference_drivers import (
    REFERENCE_DRIVERS,
    CarefulPov,
    CarefulVut,
    FsmVut,
    Reg157Vut,
)
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, US23, Scenario
from merge_sumo.simulation.povs import PovLibrary

TABLES = Path(__file__).parents[1] / "data" / "reference"
OF_TABLE = {"CC": "careful", "FSM": "fsm", "Reg157": "reg157", "RSS": "rss"}


def started(driver, scenario=US23):
    made = driver(1)
    made.begin(0, Case(level=0, x_pov0_m=-200.0, v_pov0_mps=30.0, scenario=scenario))
    return made


def at_m(dx_m, v_pov_mps=30.0, x_vut_m=-140.0):
    """Return a scene with a VUT at 28 m/s, at M in 5 s, and the POV dx ahead of it then."""
    return scene_of(dx_m + v_pov_mps * x_vut_m / 28.0, v_pov_mps, x_vut_m, 28.0)


def answers(driver, seen, steps):
    return [round(float(driver.act(seen)[0]), 4) for _ in range(steps)]


class TestRampDrivers:
    def test_the_careful_driver_waits_until_a_collision_is_less_than_2_s_away(self):
        assert answers(started(CarefulVut), at_m(0.0), 13) == [0.0] * 13
        # Perceived for the first time: 0.4 s and 0.75 s, with the pedal released.
        near = scene_of(-36.0, 20.0, -55.9, 28.0)
        found = answers(started(CarefulVut, Scenario(a_min_mps2=-9.0)), near, 15)
        assert found == [-0.4] * 12 + [-1.665, -2.93, -4.195]

    def test_an_episode_begins_with_the_delay(self):
        fsm = started(FsmVut)
        answers(fsm, at_m(0.0), 10)
        fsm.begin(0, Case(level=0, x_pov0_m=-200.0, v_pov0_mps=30.0, scenario=US23))
        assert answers(fsm, at_m(0.0), 9) == [0.0] * 8 + [-1.265]

    def test_fsm_brakes_by_6_where_4_is_too_late(self):
        hard = Scenario(a_min_mps2=-9.0)
        # 0.5 s before M braking by 4 m/s2 costs 0.02 s and by 6 m/s2 0.03 s: 0.6 m and 0.9 m.
        late = answers(started(FsmVut, hard), at_m(5.25, x_vut_m=-14.0), 14)[-1]
        early = answers(started(FsmVut, hard), at_m(5.25, x_vut_m=-80.0), 14)[-1]
        assert (late, early) == (-6.0, -4.0)

    def test_one_that_cannot_fall_behind_any_more_accelerates(self):
        # 0.5 s before M full braking gains half a metre.
        assert answers(started(Reg157Vut), at_m(-1.0, x_vut_m=-14.0), 6) == [0.0] * 6

    @pytest.mark.parametrize(
        ("driver", "dx_m", "brakes"),
        [
            # Ahead of a POV that comes nearer by 2 m/s, the gap 4 m and 8 m.
            (FsmVut, -10.0, False),
            (FsmVut, -6.9, True),
            # Behind one that draws away, but might brake.
            (FsmVut, 10.0, True),
            (FsmVut, 70.0, False),
        ],
    )
    def test_one_ahead_at_m_must_not_endanger_the_one_behind(self, driver, dx_m, brakes):
        found = answers(started(driver), at_m(dx_m, x_vut_m=-112.0), 14)[-1]
        assert (found < 0.0) == brakes


class TestCarefulPov:
    def test_brakes_for_a_vut_that_cuts_in(self):
        # The VUT is at M in 1 s, 11 m ahead and slower by 10 m/s: 5 m in 0.5 s more.
        found = answers(started(CarefulPov), scene_of(-41.0, 30.0, -20.0, 20.0), 12)
        assert found == [-0.4] * 8 + [-1.665, -2.93, -4.0, -4.0]


class TestTables:
    @pytest.mark.parametrize("name", OF_TABLE)
    def test_the_ramp_drivers_are_those_of_another_implementation(self, name):
        with (TABLES / "ramp.csv").open(encoding="utf-8", newline="") as file:
            rows = [row for row in csv.DictReader(file) if row["driver"] == name]
        assert len(rows) == 240
        cases = []
        for row in rows:
            case = Case(
                level=int(row["level"]),
                x_pov0_m=float(row["x_pov0_m"]),
                v_pov0_mps=float(row["v_pov0_mps"]),
                svo_rad=float(row["svo_rad"]) if row["svo_rad"] else None,
                scenario=US23,
            )
            cases.append(case)
        t_s, dx_m, v_mps = driven(OF_TABLE[name], cases)
        for found, column, within in (
            (t_s, "t_end_s", 1e-9),
            (dx_m, "dx_m", 1e-3),
            (v_mps, "v_vut_mps", 1e-3),
        ):
            assert np.abs(found - [float(row[column]) for row in rows]).max() < within
        collides = [row["end"] == "COLLISION" for row in rows]
        assert (np.abs(dx_m) < 6.0).tolist() == collides
        assert sum(collides) == (10 if name == "CC" else 0)


def driven(name, cases):
    """Return when merges by eq. (4) end, dx at M, and the VUT's speed there, (n,) each."""
    n = len(cases)
    vut, pov = REFERENCE_DRIVERS[name](n), PovLibrary(n, POVS)
    for corridor, case in enumerate(cases):
        vut.begin(corridor, case)
        pov.begin(corridor, case)
    starts = [case.starts() for case in cases]
    (x_pov, v_pov), (x, v) = (np.array(state).T for state in zip(*starts, strict=True))
    found = np.full((3, n), np.nan)
    for step in range(300):
        runs = np.isnan(found[0])
        seen = scene_of(x_pov, v_pov, x, v, step=step, active=runs)
        a_pov, a = (np.clip(driver.act(seen), -4.0, 2.0) for driver in (pov, vut))
        x_pov, x = x_pov + v_pov * DT_S, x + v * DT_S
        v_pov, v = (np.maximum(w + b * DT_S, 0.0) for w, b in ((v_pov, a_pov), (v, a)))
        ends = runs & (x >= 0.0)
        state = np.array((np.full(n, (step + 1) * DT_S), x_pov - x, v))
        found[:, ends] = state[:, ends]
    return found
