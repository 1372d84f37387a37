"""The lane by a second simulation: one case at a time, from the definitions, without our drivers.

It shares with the package the numbers of a scenario and the trained networks (their inputs, action
values and accelerations); the rest is written again with `math`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pytest
from support.plans import plan_for

from merge_sumo.drivers.levelk import actions_mps2, features
from merge_sumo.drivers.policies import load_network
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case, from_unit
from merge_sumo.scenario.trajectory import End
from merge_sumo.simulation import evaluate

ROAD = named_scenario("us23-lane")
BEGIN_M, END_M = -70.0, 130.0
DT_S, LENGTH_M, A_MIN, A_MAX = 0.1, 5.0, -4.0, 2.0
CRUISE_MPS = 28.0
IDM_A, IDM_B, IDM_T_S, IDM_S0_M, COOLNESS = 1.5, 2.0, 1.0, 2.0, 0.99
NETWORKS = {1: load_network("pov1"), 2: load_network("pov2")}

GAP_FILE = """
class Gap:
    "Takes a gap of half a second, from the gore on."

    def act(self, seen):
        ahead_m = seen.x_pov_m - seen.x_vut_m
        if seen.merged:
            return -2.0 if 0.0 < ahead_m < 5.0 + seen.v_vut_mps else 0.5
        rear_mps = seen.v_vut_mps if ahead_m > 0.0 else seen.v_pov_mps
        return (1.0 if seen.v_vut_mps < 26.0 else 0.0), abs(ahead_m) - 5.0 >= 0.5 * rear_mps
"""

Vut = Callable[[SimpleNamespace], tuple[float, bool | None]]
"""Gives the acceleration and the wish of a VUT; None for a VUT that only accelerates."""


def level0_mps2(v_mps: float) -> float:
    """Return the acceleration of the level-0 profile: 1 m/s2 up to 28 m/s."""
    return min(max((CRUISE_MPS - v_mps) / DT_S, 0.0), 1.0)


def level0() -> Vut:
    return lambda now: (level0_mps2(now.v_vut), None)


def gap() -> Vut:
    def act(now: SimpleNamespace) -> tuple[float, bool]:
        if now.merged:
            follows = now.x_pov > now.x_vut and now.x_pov - LENGTH_M < now.x_vut + now.v_vut
            return (-2.0 if follows else 0.5), True
        dx = now.x_pov - now.x_vut
        enough = abs(dx) - LENGTH_M >= 0.5 * (now.v_vut if dx > 0.0 else now.v_pov)
        return (1.0 if now.v_vut < 26.0 else 0.0), enough

    return act


VUTS: dict[str, Callable[[], Vut]] = {"level0": level0, "gap": gap}


def idm_mps2(gap_m: float, v: float, v_leader: float, v_wanted: float) -> float:
    if gap_m <= 0.0:
        return -math.inf
    wanted_m = IDM_S0_M + max(v * IDM_T_S + v * (v - v_leader) / (2 * math.sqrt(IDM_A * IDM_B)), 0)
    return IDM_A * (1.0 - (v / v_wanted) ** 4 - (wanted_m / gap_m) ** 2)


def acc_mps2(gap_m: float, v: float, v_leader: float, a_leader: float, v_wanted: float) -> float:
    """Return the acceleration of Kesting, Treiber and Helbing (2010)."""
    idm = idm_mps2(gap_m, v, v_leader, v_wanted)
    if gap_m <= 0.0:
        return idm
    a = min(a_leader, IDM_A)
    if v_leader * (v - v_leader) <= -2.0 * gap_m * a:
        below = v_leader**2 - 2.0 * gap_m * a
        constant = v**2 * a / below if below > 0.0 else a
    else:
        constant = a - max(v - v_leader, 0.0) ** 2 / (2.0 * gap_m)
    if idm >= constant:
        return idm
    calm = constant + IDM_B * math.tanh((idm - constant) / IDM_B)
    return (1.0 - COOLNESS) * idm + COOLNESS * calm


class Pov:
    """Plays its level before the merge, with M at 0 and then at the lane's end; follows after."""

    def __init__(self, case: Case) -> None:
        self.case, self.held = case, 0.0

    def policy_mps2(self, now: SimpleNamespace) -> float:
        if self.case.level and now.step % 5 == 0:
            m = END_M if now.x_vut >= 0.0 else 0.0
            state = (now.x_pov - m, now.v_pov, now.x_vut - m, now.v_vut)
            svo = np.array([self.case.svo_rad]) if self.case.level == 2 else None
            inputs = features(np.array([state]).T, svo, scenario=ROAD)
            values = NETWORKS[self.case.level].values(inputs)[0]
            self.held = float(actions_mps2(ROAD)[int(values.argmax())])
        return self.held

    def act(self, now: SimpleNamespace) -> float:
        policy, first = self.policy_mps2(now), self.case.v_pov0_mps
        recovery = min(max((first - now.v_pov) / DT_S, 0.0), 1.0)
        if now.merged and now.x_pov < now.x_vut:
            gap_m = now.x_vut - LENGTH_M - now.x_pov
            return min(recovery, acc_mps2(gap_m, now.v_pov, now.v_vut, now.a_vut, first))
        past = now.x_pov - LENGTH_M > now.x_vut >= 0.0
        return recovery if now.merged or past else policy


def simulate(case: Case, vut: Vut) -> tuple[float | None, float, float]:
    """Return the place of the merge, the least bumper gap within 5 s, and the needed braking."""
    now = SimpleNamespace(x_pov=case.x_pov0_m, v_pov=case.v_pov0_mps, x_vut=-182.0, a_vut=0.0)
    now.v_vut, now.merged, now.step, pov = case.v_vut0_mps, False, 0, Pov(case)
    place, least_m, braking, left = None, math.inf, 0.0, 50
    while left and (now.merged or now.step < 300):
        (a_vut, wish), a_pov = vut(now), pov.act(now)
        if wish is None:
            granted = now.x_vut + now.v_vut * DT_S >= 0.0
            if now.merged:
                ahead_m = now.x_pov - LENGTH_M - now.x_vut
                free = now.x_pov < now.x_vut
                a_vut = idm_mps2(math.inf if free else ahead_m, now.v_vut, now.v_pov, CRUISE_MPS)
        else:
            granted = wish and now.x_vut + now.v_vut * DT_S >= BEGIN_M
        left -= now.merged
        for name, a in (("pov", a_pov), ("vut", a_vut)):
            x, v = getattr(now, f"x_{name}"), getattr(now, f"v_{name}")
            setattr(now, f"x_{name}", x + v * DT_S)
            setattr(now, f"v_{name}", max(v + min(max(a, A_MIN), A_MAX) * DT_S, 0.0))
            now.a_vut = (now.v_vut - v) / DT_S if name == "vut" else 0.0
        now.step += 1
        gap_m = abs(now.x_pov - now.x_vut) - LENGTH_M
        if not now.merged and (granted or now.x_vut >= END_M):
            now.merged, place = True, now.x_vut
            closing = (now.v_pov - now.v_vut) * (1.0 if now.x_pov < now.x_vut else -1.0)
            room_m = gap_m - 0.75 * max(closing, 0.0)
            needed = max(closing, 0.0) ** 2 / (2.0 * room_m) if room_m > 0.0 else math.inf
            braking = math.inf if gap_m <= 0.0 else needed
        least_m = min(least_m, gap_m) if now.merged else least_m
    return place, least_m, braking


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("name", VUTS)
def test_an_episode_is_that_of_the_definition(name, level, tmp_path):
    (tmp_path / "gap.py").write_text(GAP_FILE)
    spec = f"{tmp_path / 'gap.py'}:Gap" if name == "gap" else name
    points = np.random.default_rng([24, level]).random((150, len(ROAD.dimensions(level))))
    cases: list[Case] = from_unit(points, level, scenario=ROAD)
    results = evaluate.simulate(plan_for(spec, scenario=ROAD, criterion=Criterion("unsafe")), cases)
    for case, result in zip(cases, results, strict=True):
        verdict = result.outcome
        assert isinstance(case, Case)
        place, least_m, braking = simulate(case, VUTS[name]())
        measures = result.outcome.measures
        assert (result.trajectory.end is End.MERGED) == (place is not None)
        assert measures.x_merge_m == pytest.approx(place, abs=1e-6)
        assert measures.clearance_m == pytest.approx(least_m, abs=1e-6)
        assert verdict.failed == (least_m <= 0.0 or braking > 3.0)
