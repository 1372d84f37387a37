"""Compare the SUMO host with other ways to run SUMO: `python tools/bench_host.py`.

    host     rollouts of the rule-based VUT against the level-0 POV: drivers, commands, positions
             read back from SUMO and checked at every step, refills, trajectories
    bare     the same vehicles with the same motion in a plain libsumo loop: two commands, a step,
             two getters for each; the speeds are computed beforehand, nothing is stored
    step     the same vehicles at constant speeds: only simulation steps
    process  a TraCI server that is started for every case, with the same drivers

Host, bare and step take turns, several rounds for each number of corridors K. For K = 32 they also
run in traffic, with A = 4 vehicles in a corridor. The figures are medians over the rounds, with the
spread in brackets. A step is the step of a corridor with all its vehicles.
"""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import libsumo
import numpy as np
import traci
from measuring import append_record, benchmark_parser, spread

from merge_sumo.controllers.kinds import load
from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.policies import policies_of
from merge_sumo.road.loader import road_of
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case, from_unit
from merge_sumo.scenario.scenario import DT_S, US23, VEHICLES, Scenario
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.simulation.povs import PovLibrary, Povs
from merge_sumo.simulation.rollout import Rollout
from merge_sumo.sumo.binding import NO_COLLISIONS, SPEED_MODE_COMMANDED, SUMO_OPTIONS, sumo_program
from merge_sumo.sumo.net_copies import HostedPath, hosted_net, hosted_paths
from merge_sumo.sumo.sumo_simulation import MAX_SPEED_MPS, SumoSimulation

KS = (1, 8, 32, 64)
STEPS = 80
"""Steps of an episode that the peers play: all last at least that long."""
WAVES = 20
VUT = "design1"


def host_s(simulation: SumoSimulation, cases: list[Case]) -> tuple[float, list[Trajectory]]:
    """Run cases by the host.

    Args:
        simulation: an open simulation.
        cases: the cases.

    Returns:
        Seconds of all cases, and the trajectories.
    """
    pov = PovLibrary(
        simulation.corridors * (simulation.vehicles - 1), Povs(policies=policies_of(US23))
    )
    vut = load(VUT).open(simulation.corridors)
    start = time.perf_counter()
    trajectories = Rollout(simulation, pov, vut, cases).run()
    return time.perf_counter() - start, trajectories


def bare_s_per_step(simulation: SumoSimulation, trajectories: list[Trajectory]) -> float:
    """Return the seconds per step and corridor of a plain loop that moves vehicles as recorded.

    Args:
        simulation: an open simulation.
        trajectories: the recorded motions.
    """
    # The same functions that the host calls: without the Python wrappers around them.
    raw = libsumo._libsumo
    set_speed, set_previous_speed = raw.vehicle_setSpeed, raw.vehicle_setPreviousSpeed
    get_position, get_speed = raw.vehicle_getLanePosition, raw.vehicle_getSpeed
    step = libsumo.simulation.step
    corridors = simulation.corridors
    names = [f"{who}.{k}" for who in VEHICLES[: simulation.vehicles] for k in range(corridors)]
    spent = 0.0
    waves = [
        trajectories[i : i + corridors]
        for i in range(0, len(trajectories) - corridors + 1, corridors)
    ]
    for wave in waves:
        for k, trajectory in enumerate(wave):
            simulation.place(k, trajectory.case.starts())
        # By step, then vehicle by vehicle, each in all corridors.
        motion = np.stack([trajectory.motion[: STEPS + 1] for trajectory in wave], axis=2)
        speeds = motion[..., 1].reshape(STEPS + 1, -1).tolist()
        accelerations = motion[..., 2].reshape(STEPS + 1, -1).tolist()
        start = time.perf_counter()
        for t in range(STEPS):
            for name, v in zip(names, speeds[t], strict=True):
                set_speed(name, v)
            step()
            for name, v, a in zip(names, speeds[t + 1], accelerations[t], strict=True):
                set_previous_speed(name, v, a)
            for name in names:
                get_position(name)
                get_speed(name)
        spent += time.perf_counter() - start
    return spent / (len(waves) * corridors * STEPS)


def step_s_per_step(simulation: SumoSimulation, cases: list[Case]) -> float:
    """Return the seconds per step and corridor of SUMO alone.

    Args:
        simulation: an open simulation.
        cases: the cases whose vehicles are on the road.
    """
    step = libsumo.simulation.step
    spent = 0.0
    for wave in range(WAVES):
        for k in range(simulation.corridors):
            case = cases[(wave * simulation.corridors + k) % len(cases)]
            simulation.place(k, case.starts())
        start = time.perf_counter()
        for _ in range(STEPS):
            step()
        spent += time.perf_counter() - start
    return spent / (WAVES * simulation.corridors * STEPS)


def process_s(cases: list[Case]) -> list[float]:
    """Return the seconds of each case with a TraCI server of its own.

    Args:
        cases: the cases.
    """
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        net_file = Path(folder) / "one.net.xml"
        road = road_of()
        net_file.write_bytes(hosted_net(road, 1))
        command = [sumo_program("sumo"), "--net-file", str(net_file), *SUMO_OPTIONS, *NO_COLLISIONS]
        for case in cases:
            start = time.perf_counter()
            traci.start(command, numRetries=100)
            try:
                _episode_by_traci(
                    case,
                    hosted_paths(road),
                    PovLibrary(1, Povs(policies=policies_of(US23))),
                    load(VUT).open(1),
                )
            finally:
                traci.close()
            seconds.append(time.perf_counter() - start)
    return seconds


def _episode_by_traci(
    case: Case, paths: tuple[HostedPath, HostedPath], pov: Driver, vut: Driver
) -> None:
    vehicle = traci.vehicle
    names = dict(zip(("pov.0", "vut.0"), paths, strict=True))
    begins_m = {
        lane: start_m
        for path in paths
        for lane, start_m in zip(path.lanes(0), path.starts_m, strict=True)
    }
    traci.vehicletype.setMaxSpeed("DEFAULT_VEHTYPE", MAX_SPEED_MPS)
    starts = {
        "pov.0": (case.x_pov0_m, case.v_pov0_mps),
        "vut.0": (US23.x_vut0_m, case.v_vut0_mps),
    }
    for name, path in names.items():
        traci.route.add(f"route.{name}", path.route(0))
        vehicle.add(name, f"route.{name}", departPos="10", departSpeed="0")
    traci.simulationStep()
    for name, path in names.items():
        x_m, speed = starts[name]
        vehicle.setSpeedMode(name, SPEED_MODE_COMMANDED)
        vehicle.moveTo(name, path.lanes(0)[0], x_m - path.starts_m[0])
        vehicle.setPreviousSpeed(name, speed, 0.0)
    pov.begin(0, case)
    vut.begin(0, case)
    for step in range(US23.max_steps):
        x = {
            name: begins_m[vehicle.getLaneID(name)] + vehicle.getLanePosition(name)
            for name in names
        }
        v = {name: vehicle.getSpeed(name) for name in names}
        if x["vut.0"] >= 0.0:
            return
        columns = (x["pov.0"], v["pov.0"], x["vut.0"], v["vut.0"])
        pair = np.array(columns).reshape(2, 2, 1).swapaxes(0, 1)
        scene = Scene(np.array([True]), np.array([step]), *pair)
        a = {"pov.0": float(pov.act(scene)[0]), "vut.0": float(vut.act(scene)[0])}
        for name in names:
            vehicle.setSpeed(name, v[name])
        traci.simulationStep()
        for name in names:
            vehicle.setPreviousSpeed(name, max(v[name] + a[name] * DT_S, 0.0), a[name])


def cases_of(scenario: Scenario, count: int) -> list[Case]:
    """Return random cases at level 0.

    Args:
        scenario: their scenario.
        count: number of cases.
    """
    points = np.random.default_rng(0).random((count, len(scenario.dimensions(0))))
    return from_unit(points, 0, scenario=scenario)


def measured(scenario: Scenario, k: int, count: int, rounds: int) -> dict[str, list[float]]:
    """Measure a simulation with several corridors.

    Args:
        scenario: scenario of the cases.
        k: number of corridors.
        count: number of cases of a round.
        rounds: number of rounds.

    Returns:
        Figures of each round by name.
    """
    row: dict[str, list[float]] = {"us": [], "cases_per_s": [], "to_bare": [], "to_step": []}
    cases = cases_of(scenario, count * min(k, 32) // 32)
    with SumoSimulation(k, scenario=scenario) as simulation:
        host_s(simulation, cases[:k])
        for _ in range(rounds):
            seconds, trajectories = host_s(simulation, cases)
            us = seconds / sum(len(t.whole) - 1 for t in trajectories) * 1e6
            row["us"].append(us)
            row["cases_per_s"].append(len(cases) / seconds)
            row["to_bare"].append(us / bare_s_per_step(simulation, trajectories) / 1e6)
            row["to_step"].append(us / step_s_per_step(simulation, cases) / 1e6)
    return row


def main() -> None:
    """Print a table."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--cases", type=int, default=1280, help="cases per round and K")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--processes", type=int, default=5, help="cases with their own process")
    options = parser.parse_args()
    worlds = [(US23, k) for k in KS] + [(named_scenario("us23-traffic"), 32)]
    print(f"{'A':>2} {'K':>4}  us per step, cases per s, ratio to bare, ratio to step")
    figures: dict[str, Any] = {}
    for scenario, k in worlds:
        row = measured(scenario, k, options.cases, options.rounds)
        figures[f"A = {scenario.vehicles}, K = {k}"] = row
        print(f"{scenario.vehicles:>2} {k:>4}  {', '.join(map(spread, row.values()))}", flush=True)
    process = statistics.median(process_s(cases_of(US23, options.processes)))
    ratio = process * statistics.median(figures["A = 2, K = 32"]["cases_per_s"])
    print(f"a TraCI process per case: {process:.3f} s, {ratio:.0f} times K = 32")
    figures |= {"s_per_traci_process_case": process, "ratio_to_traci_process": ratio}
    append_record(options.record, "host", figures)


if __name__ == "__main__":
    main()
