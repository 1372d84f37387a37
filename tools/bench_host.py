"""Measure the SUMO host beside its peers, all in one run: `python tools/bench_host.py`.

    host     rollouts of the rule-based VUT against the level-0 POV: drivers, commands, state read
             back from SUMO at every step, refills, trajectories
    bare     the same vehicles through the same motion in a plain libsumo loop: two commands, a
             step, two getters for each; the speeds are known beforehand, nothing is kept
    step     the same vehicles at constant speeds, and nothing at all but simulation steps
    process  a TraCI server started for every case, with the same drivers

Host, bare and step take turns, several rounds for each number of corridors K; the figures are
medians over the rounds, with the spread in brackets.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path

import libsumo
import numpy as np
import traci

from merge_sumo.campaigns.rollout import rollout
from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.pov import PovLibrary
from merge_sumo.drivers.vut import vut_factory
from merge_sumo.sumo.binding import sumo_program
from merge_sumo.sumo.hosting import HostedPath, hosted_net, hosted_paths
from merge_sumo.sumo.road import road_of
from merge_sumo.sumo.world import MAX_SPEED_MPS, SPEED_MODE_COMMANDED, SUMO_OPTIONS, World
from merge_sumo.values.case import Case, from_unit
from merge_sumo.values.scenario import DT_S, MAX_STEPS, X_VUT0_M
from merge_sumo.values.trajectory import Trajectory

KS = (1, 8, 32, 64)
STEPS = 80
"""Steps of an episode that the peers play: all last at least that long."""
WAVES = 20
VUT = "design1"


def host_s(world: World, cases: list[Case]) -> tuple[float, list[Trajectory]]:
    """Return the seconds that the host takes for cases, and the trajectories."""
    pov, vut = PovLibrary(world.corridors), vut_factory(VUT)(world.corridors)
    start = time.perf_counter()
    trajectories = [trajectory for _, trajectory in rollout(world, pov, vut, cases)]
    return time.perf_counter() - start, trajectories


def bare_s_per_pair_step(world: World, trajectories: list[Trajectory]) -> float:
    """Return the seconds per pair-step of a plain loop that moves vehicles as recorded."""
    # The same functions that the host calls: without the Python wrappers around them.
    raw = libsumo._libsumo
    set_speed, set_previous_speed = raw.vehicle_setSpeed, raw.vehicle_setPreviousSpeed
    get_position, get_speed = raw.vehicle_getLanePosition, raw.vehicle_getSpeed
    step = libsumo.simulation.step
    corridors = world.corridors
    names = [f"{who}.{k}" for who in ("pov", "vut") for k in range(corridors)]
    spent = 0.0
    waves = [
        trajectories[i : i + corridors]
        for i in range(0, len(trajectories) - corridors + 1, corridors)
    ]
    for wave in waves:
        for k, trajectory in enumerate(wave):
            (x_pov, v_pov, _), (x_vut, v_vut, _) = trajectory.motion[0].tolist()
            world.place(k, [(x_pov, v_pov), (x_vut, v_vut)])
        motion = np.stack([trajectory.motion[: STEPS + 1] for trajectory in wave])
        speeds = np.concatenate([motion[:, :, 0, 1], motion[:, :, 1, 1]]).T.tolist()
        accelerations = np.concatenate([motion[:, :, 0, 2], motion[:, :, 1, 2]]).T.tolist()
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


def step_s_per_pair_step(world: World, cases: list[Case]) -> float:
    """Return the seconds per pair-step of SUMO alone."""
    step = libsumo.simulation.step
    spent = 0.0
    for wave in range(WAVES):
        for k in range(world.corridors):
            case = cases[(wave * world.corridors + k) % len(cases)]
            world.place(k, case.starts())
        start = time.perf_counter()
        for _ in range(STEPS):
            step()
        spent += time.perf_counter() - start
    return spent / (WAVES * world.corridors * STEPS)


def process_s(cases: list[Case]) -> list[float]:
    """Return the seconds of each case with a TraCI server of its own."""
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        net_file = Path(folder) / "one.net.xml"
        road = road_of()
        net_file.write_bytes(hosted_net(road, 1))
        command = [sumo_program("sumo"), "--net-file", str(net_file), *SUMO_OPTIONS]
        for case in cases:
            start = time.perf_counter()
            traci.start(command, numRetries=100)
            try:
                _episode_by_traci(case, hosted_paths(road), PovLibrary(1), vut_factory(VUT)(1))
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
        "vut.0": (X_VUT0_M, case.v_vut0_mps),
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
    for step in range(MAX_STEPS):
        x = {
            name: begins_m[vehicle.getLaneID(name)] + vehicle.getLanePosition(name)
            for name in names
        }
        v = {name: vehicle.getSpeed(name) for name in names}
        if x["vut.0"] >= 0.0:
            return
        columns = (x["pov.0"], v["pov.0"], x["vut.0"], v["vut.0"])
        scene = Scene.of_pair(np.array([True]), np.array([step]), *(np.array([c]) for c in columns))
        a = {"pov.0": float(pov.act(scene)[0]), "vut.0": float(vut.act(scene)[0])}
        for name in names:
            vehicle.setSpeed(name, v[name])
        traci.simulationStep()
        for name in names:
            vehicle.setPreviousSpeed(name, max(v[name] + a[name] * DT_S, 0.0), a[name])


def main() -> None:
    """Print a table, or with --json one object."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--cases", type=int, default=1280, help="cases per round and K")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--processes", type=int, default=5, help="cases with a process each")
    options = parser.parse_args()

    rng = np.random.default_rng(0)
    cases = from_unit(rng.random((options.cases, 2)), level=0)
    rows: dict[int, dict[str, list[float]]] = {}
    for k in KS:
        rows[k] = {"us": [], "cases_per_s": [], "to_bare": [], "to_step": []}
        some = cases[: options.cases * min(k, 32) // 32]
        with World(k) as world:
            host_s(world, some[:k])
            for _ in range(options.rounds):
                seconds, trajectories = host_s(world, some)
                us = seconds / sum(len(t.motion) - 1 for t in trajectories) * 1e6
                rows[k]["us"].append(us)
                rows[k]["cases_per_s"].append(len(some) / seconds)
                rows[k]["to_bare"].append(us / bare_s_per_pair_step(world, trajectories) / 1e6)
                rows[k]["to_step"].append(us / step_s_per_pair_step(world, some) / 1e6)
    process = statistics.median(process_s(cases[: options.processes]))
    medians = {
        k: {name: statistics.median(x) for name, x in row.items()} for k, row in rows.items()
    }
    ratio_to_process = process * medians[32]["cases_per_s"]
    if options.json:
        result = {
            "us_per_pair_step": {k: row["us"] for k, row in medians.items()},
            "cases_per_s": {k: row["cases_per_s"] for k, row in medians.items()},
            "ratio_to_bare": medians[32]["to_bare"],
            "ratio_to_bare_by_k": {k: row["to_bare"] for k, row in medians.items()},
            "ratio_to_step_by_k": {k: row["to_step"] for k, row in medians.items()},
            "ratio_to_traci_process": ratio_to_process,
            "s_per_traci_process_case": process,
        }
        print(json.dumps(result))
        return
    print(
        f"{'K':>4} {'us per pair-step':>24} {'cases per s':>24} "
        f"{'ratio to bare':>20} {'to step':>20}"
    )
    for k, row in rows.items():
        cells = [f"{statistics.median(x):.2f} [{min(x):.2f}, {max(x):.2f}]" for x in row.values()]
        print(f"{k:>4} {cells[0]:>24} {cells[1]:>24} {cells[2]:>20} {cells[3]:>20}")
    print(f"a TraCI process per case: {process:.3f} s, {ratio_to_process:.0f} times K = 32")


if __name__ == "__main__":
    main()
