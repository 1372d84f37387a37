"""Repeat a campaign in another simulator, HighwayEnv: `python tools/crosscheck.py RUN`.

- Motion: HighwayEnv's vehicles get the recorded accelerations, from the recorded starts.
- Verdicts: POVs and VUT drive HighwayEnv's vehicles, on the recorded cases and on fresh uniform
  cases, up to `--cases`. The failure criterion of the campaign judges them next to SUMO.

The script works for campaigns of a VUT of this package, and needs the extra `peers`. Its exit code
is 1 if vehicles with the same commands move differently in HighwayEnv.
docs/how-to/other-simulators.md has the results.

HighwayEnv (Leurent, 2018) moves a vehicle that does not steer by x + v dt and v + a dt, which is
eq. (4). Each vehicle of an episode has its own straight lane there, along which it drives its lane
coordinate. Bodies do not meet, as they do not where SUMO moves them by command.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

import merge_sumo as ms
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.settings import CampaignSettings, settings_from_folder
from merge_sumo.errors import UserError
from merge_sumo.road.loader import centre_lines
from merge_sumo.road.road import Road
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, VEHICLES, VUT, Scenario
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.simulation.evaluate import simulate
from merge_sumo.simulation.kinematic_simulation import KinematicSimulation
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.simulation.simulator import Simulator, corridors_of
from merge_sumo.sumo.sumo_simulation import MAX_SPEED_MPS

AGREED: Final = 1e-6
"""Positions and speeds this near to each other, in m and m/s, are the same. Measured: 5e-12."""
LANE_WIDTH_M: Final = 4.0
"""That of HighwayEnv."""
CHUNK: Final = 64
"""Recorded motions that HighwayEnv moves at a time."""
MOVES_OTHERWISE: Final = "its vehicles move otherwise"
"""The reason that is a difference of the simulators."""


class HighwayEnvWorld(KinematicSimulation):
    """The state of the vehicles in `corridors` independent corridors, moved by HighwayEnv.

    `x_m` and `v_mps` have shape (A, corridors), as in a `SumoSimulation`, and are read from its
    vehicles.
    """

    def __init__(self, corridors: int, road: Road, scenario: Scenario) -> None:
        """Make a road of HighwayEnv for each corridor."""
        super().__init__(corridors, road, scenario)
        lengths_m = [scenario.pov_length_m] * self.vehicles
        lengths_m[VUT] = scenario.vut_length_m
        base = import_module("highway_env.vehicle.kinematics").Vehicle
        limits = {"MAX_SPEED": MAX_SPEED_MPS, "MIN_SPEED": -MAX_SPEED_MPS}
        self._types = [type("Car", (base,), {"LENGTH": one, **limits}) for one in lengths_m]
        self._half_m: FloatArray = np.array(lengths_m)[:, None] / 2.0
        """From the front bumper back to the centre, which is the position in HighwayEnv."""
        self._roads = [self._road() for _ in range(corridors)]

    def _road(self) -> Any:
        """Return a road of HighwayEnv with a straight lane for each vehicle of an episode."""
        road, lane = (import_module(f"highway_env.road.{name}") for name in ("road", "lane"))
        network = road.RoadNetwork()
        for row in range(self.vehicles):
            ends_m = (-self.scenario.reach_m, self.scenario.room_after_m)
            ends = [(x_m, row * LANE_WIDTH_M) for x_m in ends_m]
            network.add_lane("begin", "end", lane.StraightLane(*ends, LANE_WIDTH_M))
        return road.Road(network)

    def restart(self) -> None:
        """Park all vehicles."""
        for corridor in range(self.corridors):
            self.park(corridor)

    def place(
        self, corridor: int, starts: Sequence[tuple[float, float]], *, own: bool = False
    ) -> None:
        """Put new vehicles where an episode starts: (x in m, v in m/s) in the order of rows."""
        road, half_m = self._roads[corridor], self._half_m[:, 0].tolist()
        road.vehicles = [
            make(road, (x_m - half_m[row], row * LANE_WIDTH_M), 0.0, v_mps)
            for row, (make, (x_m, v_mps)) in enumerate(zip(self._types, starts, strict=True))
        ]
        self._read([corridor])

    def park(self, corridor: int) -> None:
        """Take the vehicles of a corridor from its road.

        Args:
            corridor: the corridor.
        """
        self._roads[corridor].vehicles = []
        super().park(corridor)

    def command(self, a_mps2: FloatArray, merged: NDArray[np.bool_] | None = None) -> None:
        """Let HighwayEnv make a step; no vehicle drives backwards.

        Args:
            a_mps2: accelerations, (A, K).
            merged: whether the VUT is on the mainline, (K,); None without an acceleration lane.
        """
        actions = np.maximum(a_mps2, self.v_mps / -DT_S).T.tolist()
        occupied = [k for k, road in enumerate(self._roads) if road.vehicles]
        for corridor in occupied:
            road = self._roads[corridor]
            for vehicle, a in zip(road.vehicles, actions[corridor], strict=True):
                vehicle.act({"steering": 0.0, "acceleration": a})
            road.step(DT_S)
        self.x_m, self.v_mps = self.x_m.copy(), self.v_mps.copy()
        self._read(occupied)

    def _read(self, corridors: Sequence[int]) -> None:
        """Read the state of corridors from their vehicles."""
        for corridor in corridors:
            vehicles = self._roads[corridor].vehicles
            self.x_m[:, corridor] = [vehicle.position[0] for vehicle in vehicles]
            self.v_mps[:, corridor] = [vehicle.speed for vehicle in vehicles]
        self.x_m[:, corridors] += self._half_m


class HighwayEnvSimulator(Simulator):
    """A VUT and the POVs in HighwayEnv, without SUMO."""

    def __init__(self, plan: SimulationPlan) -> None:
        with ExitStack() as opened:
            simulation = HighwayEnvWorld(
                corridors_of(plan, plan.corridors), plan.road, plan.scenario
            )
            self._open_drivers(plan, simulation, opened)


@dataclass(frozen=True, slots=True)
class Crosscheck:
    """The differences between both simulators.

    Attributes:
        cases: cases whose verdicts were compared.
        failures: those among them that fail in SUMO.
        largest_m: largest difference of a position where accelerations are the same.
        largest_mps: largest difference of a speed there.
        differences: sentences on the cases with another verdict.
    """

    cases: int
    failures: int
    largest_m: float
    largest_mps: float
    differences: tuple[str, ...]

    @property
    def agrees(self) -> bool:
        """Whether both simulators move vehicles alike under the same commands."""
        moves = any(MOVES_OTHERWISE in one for one in self.differences)
        return max(self.largest_m, self.largest_mps) <= AGREED and not moves


def crosscheck(run: RecordedCampaign, cases: int, seed: int) -> Crosscheck:
    """Let HighwayEnv repeat cases of a campaign, and run fresh uniform ones.

    Args:
        run: the campaign.
        cases: number of cases of both kinds.
        seed: seed of the fresh cases.
    """
    settings = settings_from_folder(run.folder, run.record)
    plan = settings.load_plan()
    if plan.needs_sumo is not None:
        raise UserError(f"{plan.needs_sumo}: name a campaign of a VUT of this package")
    known = run.trajectories(outcome.index for outcome in run.outcomes)
    in_sumo = [*known.values()]
    fresh = uniform(settings, cases - len(in_sumo), seed)
    in_sumo += [result.trajectory for result in simulate(plan, fresh)] if fresh else []
    largest_m, largest_mps = largest_deviations(plan, in_sumo)
    with HighwayEnvSimulator(plan) as simulator:
        ran = simulator.run([trajectory.case for trajectory in in_sumo])
    differences, failures = [], 0
    for place, trajectory in enumerate(in_sumo):
        here, there = (failed(plan, one) for one in (trajectory, ran[place]))
        failures += here
        if here != there:
            reason = reason_of(trajectory, ran[place])
            differences.append(f"case {place}: {here=}, {there=}: {reason}")
    return Crosscheck(len(in_sumo), failures, largest_m, largest_mps, tuple(differences))


def uniform(settings: CampaignSettings, count: int, seed: int) -> list[Case]:
    """Return uniform cases, equally shared by the levels.

    Args:
        settings: settings of the campaign.
        count: number of cases.
        seed: seed of the cases.
    """
    fresh: list[Case] = []
    for level, share in zip(
        settings.levels,
        np.array_split(np.arange(max(count, 0)), len(settings.levels)),
        strict=True,
    ):
        dims = len(settings.scenario.dimensions(level))
        points = np.random.default_rng([seed, level]).random((len(share), dims))
        fresh += settings.pool.cases(points, level)
    return fresh


def failed(plan: SimulationPlan, trajectory: Trajectory) -> bool:
    """Return whether a case fails by the criterion of the campaign.

    Args:
        plan: plan of the campaign.
        trajectory: motion of the case.
    """
    return plan.criterion.outcome(trajectory, centre_lines(plan.road)).failed


def largest_deviations(plan: SimulationPlan, known: Sequence[Trajectory]) -> tuple[float, float]:
    """Compare motions with HighwayEnv's.

    Args:
        plan: plan of the campaign.
        known: motions of merge-sumo.

    Returns:
        Largest differences in m and in m/s.
    """
    off = np.zeros(2)
    for first in range(0, len(known), CHUNK):
        motions = [one.motion for one in known[first : first + CHUNK]]
        simulation = HighwayEnvWorld(len(motions), plan.road, plan.scenario)
        for corridor, motion in enumerate(motions):
            simulation.place(corridor, motion[0, :, :2].tolist())
        for step in range(1, max(map(len, motions))):
            a_mps2 = np.zeros_like(simulation.x_m)
            running = [k for k, motion in enumerate(motions) if step < len(motion)]
            for k in running:
                a_mps2[:, k] = motions[k][step - 1, :, 2]
            simulation.command(a_mps2)
            for k in running:
                state = np.array((simulation.x_m[:, k], simulation.v_mps[:, k])).T
                off = np.maximum(off, np.abs(state - motions[k][step, :, :2]).max(axis=0))
                if step == len(motions[k]) - 1:
                    simulation.park(k)
    return float(off[0]), float(off[1])


def reason_of(sumo: Trajectory, there: Trajectory) -> str:
    """Return the reason for another verdict, in a clause.

    Args:
        sumo: motion in merge-sumo.
        there: motion in HighwayEnv.
    """
    rows = min(len(sumo.motion), len(there.motion))
    apart = np.abs(sumo.motion[:rows] - there.motion[:rows])
    differs = np.flatnonzero((apart[..., :2] > AGREED).any(axis=(1, 2)))
    if not len(differs):
        return "a rounding error decides at the limit of the criterion"
    step = int(differs[0])
    answers = apart[step - 1, :, 2] > AGREED / DT_S if step else np.zeros(len(VEHICLES), np.bool_)
    if not answers.any():
        return MOVES_OTHERWISE
    names = " and ".join(VEHICLES[row].upper() for row in np.flatnonzero(answers))
    return f"the {names} answers otherwise to a state that is the same but for rounding"


def main() -> int:
    """Print the differences; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path, help="folder of a campaign")
    parser.add_argument("--cases", type=int, default=0, help="total of recorded and fresh cases")
    parser.add_argument("--seed", type=int, default=0, help="seed of the fresh cases")
    options = parser.parse_args()
    try:
        peer = f"HighwayEnv {version('highway-env')}"
        found = crosscheck(ms.open_run(options.run).recorded, options.cases, options.seed)
    except ImportError:
        print("this needs highway-env: run `pip install 'merge-sumo[peers]'`", file=sys.stderr)
        return 2
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    same = found.cases - len(found.differences)
    print(f"{peer}: positions within {found.largest_m:.0e} m, speeds {found.largest_mps:.0e} m/s")
    print(f"verdicts: {same} of {found.cases} the same, {found.failures} failures in SUMO")
    print("\n".join(found.differences))
    return 0 if found.agrees else 1


if __name__ == "__main__":
    sys.exit(main())
