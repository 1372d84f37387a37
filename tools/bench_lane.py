"""Measure the regret, on an acceleration lane, of a POV that expects a merge at M.

    python tools/bench_lane.py [--cases 300] [--seed 1]

The VUT drives the level-0 profile and merges at a place that the POV does not expect: at the begin
of the lane, at M, half-way from M to the end, or at the end. The POV is of level 1, with the rule
of `merge_sumo/drivers/after_merge.py`. Its return up to the merge is compared with the exact best
response of a driver that is told the place. Regret is a share of the gain of this driver over a
driver that keeps its speed. For M it is the regret of the point merge.

The script also measures how hard cars brake in the 5 s after merges at M that need at most 1 m/s2
of the car behind, at level 0: with ACC, as in campaigns, and with IDM.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from measuring import append_record, benchmark_parser

from merge_sumo.drivers import after_merge
from merge_sumo.drivers.after_merge import PovAfterMerge
from merge_sumo.drivers.base import MERGE, STAY, Driver, Scene
from merge_sumo.drivers.car_following import acc_mps2, idm_mps2
from merge_sumo.drivers.level0 import Level0Pov, Level0Vut
from merge_sumo.drivers.policies import load_driver
from merge_sumo.metrics.merge import brake_after_mps2
from merge_sumo.road.loader import road_for
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case, FloatArray, from_unit
from merge_sumo.scenario.scenario import DT_S, US23, Bounds
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.simulation.kinematic_simulation import KinematicSimulation
from merge_sumo.simulation.rollout import Rollout
from merge_sumo.training.best_response import best_response
from merge_sumo.training.check import returns_of
from merge_sumo.training.game import Game
from merge_sumo.training.reward import Reward


class MergesAt(Level0Vut):
    """The level-0 profile, with a merge request from a place on."""

    def __init__(self, corridors: int, place_m: float) -> None:
        """Take the place."""
        super().__init__(corridors)
        self._place_m = place_m
        self._merge_requests = np.zeros(corridors, dtype=np.int8)

    def act(self, scene: Scene) -> FloatArray:
        """Return the accelerations, (K,)."""
        next_m = scene.x_vut_m + scene.v_vut_mps * DT_S
        self._merge_requests = np.where(next_m >= self._place_m, MERGE, STAY).astype(np.int8)
        return super().act(scene)


def played(cases: Sequence[Case], pov: Driver, vut: Driver) -> list[Trajectory]:
    """Simulate cases of one scenario.

    Args:
        cases: the cases.
        pov: driver of the POV.
        vut: driver of the VUT.

    Returns:
        Trajectories in the order of the cases.
    """
    scenario = cases[0].scenario
    simulation = KinematicSimulation(pov.corridors, road_for(scenario), scenario)
    ended = Rollout(simulation, pov, vut, cases).run()
    return [ended[place] for place in range(len(cases))]


def idm(
    gap_m: FloatArray,
    v: FloatArray,
    v_leader: FloatArray,
    _: FloatArray,
    v_desired: FloatArray | float,
) -> FloatArray:
    """Return accelerations as `acc_mps2` does, by IDM."""
    return idm_mps2(gap_m, v, v_leader, v_desired)


def regrets(cases: Sequence[Case], lane_m: Bounds) -> dict[str, float]:
    """Measure and print the mean regret by the place of the merge.

    Args:
        cases: the cases.
        lane_m: begin and end of the acceleration lane in m.

    Returns:
        Mean regret by the place of the merge in m.
    """
    means = {}
    k, reward = len(cases), Reward.of(US23)
    starts = np.array([[x for start in case.starts() for x in start] for case in cases])
    print(f"POV-1, {k} cases; VUT: level 0, merges at")
    print("place m   mean regret   p99 regret   within 6 m   of the best response")
    for place_m in (lane_m[0], 0.0, 0.5 * lane_m[1], lane_m[1]):
        vut = MergesAt(k, place_m)
        reached, unmoved = (
            returns_of(played(cases, PovAfterMerge(pov), vut), reward)
            for pov in (load_driver("pov1", k), Level0Pov(k))
        )
        shifted = starts - np.array([place_m, 0.0, place_m, 0.0])
        got, kept = (parts.of("pov", np.zeros(k)) for parts in (reached, unmoved))
        best = best_response(Game("pov", None, reward), shifted, got)
        regret = (best - got) / (best - kept).mean()
        means[f"{place_m:.0f}"] = float(regret.mean())
        crash = -reward.weights.crash / 2
        print(
            f"{place_m:7.0f} {regret.mean():12.1%} {np.quantile(regret, 0.99):12.1%}"
            f"{(reached.safe < crash).mean():13.1%} {(best < crash).mean():13.1%}"
        )
    return means


def hard_braking(cases: Sequence[Case]) -> dict[str, int]:
    """Count and print the easy merges after which cars brake hard.

    Args:
        cases: the cases.

    Returns:
        Number of such merges by the car-following model.
    """
    found = {}
    print("followers   merges that need at most 1 m/s2   harder than 3 m/s2 after them")
    for name, follow in (("ACC", acc_mps2), ("IDM", idm)):
        pov = PovAfterMerge(Level0Pov(len(cases)))
        after_merge.acc_mps2 = follow  # type: ignore[attr-defined, assignment]
        merges = played(cases, pov, MergesAt(len(cases), 0.0))
        easy = [one for one in merges if 0.0 < brake_after_mps2(one) <= 1.0]
        hard = [one for one in easy if one.after is not None and one.after[:, 0, 2].min() < -3.0]
        print(f"{name:9} {len(easy):12} {len(hard):12}")
        found[name] = len(hard)
    return found


def main() -> None:
    """Print the regret by the place of the merge, and the braking after it."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--cases", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    scenario = named_scenario("us23-lane")
    assert scenario.lane_m is not None, "a lane"  # noqa: S101
    points = np.random.default_rng(arguments.seed).random((arguments.cases, 2))
    cases = from_unit(points, 1, scenario=scenario)
    regret, hard = regrets(cases, scenario.lane_m), hard_braking(cases)
    append_record(arguments.record, "lane", {"mean_regret": regret, "braked_hard": hard})


if __name__ == "__main__":
    main()
