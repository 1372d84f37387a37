"""The reference drivers on the cut-in grid of UN Regulation No. 157, where their models come from.

A car cuts in ahead of a faster one. Behind M a reference driver follows what it sees, so that its
verdict, collision or none, is that of its model. Here the models are worked out a second time, from
the published formulas and parameters, with steps in which a car moves by its new speed, as in the
JRC's own simulations (Mattas et al., 2022); ours moves by eq. (4).
"""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from merge_sumo.drivers.base import Scene
from merge_sumo.drivers.reference import REFERENCES
from merge_sumo.values.case import Case
from merge_sumo.values.scenario import Scenario

DT_S, STEPS, ASIDE_M, G = 0.1, 250, 1.6, 9.81
NEVER_M = 1e5
DELAY_S = {"careful": 0.4 + 0.75, "fsm": 0.75, "reg157": 0.35, "rss": 0.75}
ROAD = Scenario(a_min_mps2=-9.0, level0_v_mps=1.0)
"""Lets everybody brake as the model does; nobody here is slow enough to accelerate."""


def grid():
    """Return cut-ins: speeds of the car behind and of the other, gap, and speed aside, (4, n)."""
    speeds = np.arange(8.0, 36.1, 4.0), np.arange(1.0, 20.1, 1.5)
    cells = product(*speeds, np.arange(2.37, 60.0, 3.0), (0.4, 0.8, 1.2, 1.6))
    return np.array([(v, v - u, gap, aside) for v, u, gap, aside in cells if v - u >= 2.0]).T


def seen(step, aside):
    """Return whether the car that cuts in is in the lane."""
    return ASIDE_M - aside * step * DT_S <= 1e-9


def ours(name, cells, within_m=0.0):
    """Return where a reference driver collides, and not by within so many metres, (n,)."""
    v, v_front, gap, aside = (row.copy() for row in cells)
    case = Case(level=0, x_pov0_m=-200.0, v_pov0_mps=30.0, scenario=ROAD)
    driver = REFERENCES[name](len(v))
    for corridor in range(len(v)):
        driver.begin(corridor, case)
    x = np.full(len(v), 1000.0)  # behind M
    front = x + gap + ROAD.dx_crash_m
    collides = np.zeros(len(v), dtype=bool)
    for step in range(STEPS):
        shown = np.where(seen(step, aside), front, x + NEVER_M)
        everywhere = np.ones(len(v), dtype=bool), np.full(len(v), step)
        a = driver.act(Scene.of_pair(*everywhere, shown, v_front, x, v))
        x, front = x + v * DT_S, front + v_front * DT_S
        v = np.maximum(v + a * DT_S, 0.0)
        collides |= seen(step + 1, aside) & (front - x < ROAD.dx_crash_m - within_m)
    return collides


def published(name, cells):
    """Return where the published model collides, (n,)."""
    v, v_front, gap, aside = (row.copy() for row in cells)
    delay_s, braking = np.full(len(v), DELAY_S[name]), np.zeros(len(v))
    collides = np.zeros(len(v), dtype=bool)
    for step in range(STEPS):
        u = v - v_front
        if name == "careful":  # TTC of 2 s, 0.774 g
            wanted = np.where((u > 0.0) & (gap < 2.0 * u), 0.774 * G, 0.0)
        elif name == "reg157":  # TTC of u / 12 + 0.35 s, and a step
            wanted = np.where((u > 0.0) & (gap <= u * (u / 12.0 + 0.35 + DT_S)), 6.0, 0.0)
        elif name == "rss":  # rho 0.75 s, the scenario's 2 m/s2 and 9 m/s2, 0.774 g
            fast = v + 0.75 * 2.0
            safe = 0.75 * v + 0.75**2 + fast**2 / (2.0 * 0.774 * G) - v_front**2 / 18.0
            wanted = np.where(gap < safe, 0.774 * G, 0.0)
        else:  # tau 0.75 s, 4 m/s2, 6 m/s2, 7 m/s2, d1 2 m
            u = np.maximum(u, 1e-12)
            cfs = (0.75 * u + u**2 / 8.0 - gap) / (u**2 / 8.0 - u**2 / 12.0)
            ahead = 0.75 * v + v**2 / 8.0 - v_front**2 / 14.0 + 2.0 - (gap - 2.0)
            cfs, pfs = (np.clip(x, 0, 1) for x in (cfs, ahead / (v**2 / 8.0 - v**2 / 12.0 + 2.0)))
            wanted = np.where(cfs > 0.0, 2.0 * cfs + 4.0, 4.0 * pfs)
        risk = seen(step, aside) & (gap >= 0.0) & (wanted > 0.0)
        brakes = risk & (delay_s <= 1e-9)
        delay_s = np.where(risk, delay_s - DT_S, delay_s)
        harder = wanted if name == "reg157" else np.minimum(braking + 12.65 * DT_S, wanted)
        braking = np.where(brakes, harder, 0.0)
        v = np.maximum(v - braking * DT_S, 0.0)
        gap = np.where(collides, gap, gap + (v_front - v) * DT_S)
        collides |= seen(step + 1, aside) & (gap < 0.0)
    return collides


@pytest.mark.parametrize("name", REFERENCES)
def test_verdicts_are_those_of_the_published_model(name):
    cells = grid()
    expected = published(name, cells)
    assert 0.2 < expected.mean() < 0.8
    assert (ours(name, cells) == expected).mean() >= 0.999


def test_reg157_avoids_what_the_regulation_asks_systems_to_avoid():
    rng = np.random.default_rng(0)
    u, aside = rng.uniform(1.0, 30.0, 4000), rng.uniform(0.3, 2.0, 4000)
    cuts_in_s = np.ceil(ASIDE_M / aside / DT_S - 1e-6) * DT_S
    over_s = rng.uniform(-1.0, 1.0, 4000)
    ttc_s = u / 12.0 + 0.35 + over_s  # when the other one is in the lane
    cells = np.array([u + 10.0, np.full(4000, 10.0), u * (ttc_s + cuts_in_s), aside])
    # The last step to equal speeds, of less than 0.6 m/s, decides about 7.5 mm.
    collides = ours("reg157", cells, within_m=0.01)
    assert not collides[over_s > 0.0].any()
    assert collides[over_s < -2.0 * DT_S].all()
