"""Measure what a step of each kind of VUT costs: `python tools/bench_vuts.py`.

    python   an object with act(seen), in one corridor and per corridor of 32, in its own process
             and in this process
    traci    a client of the stock `traci` package in its own process: an id list, four getters,
             setSpeed and a step; and a client that subscribes to the same values
    peer     the same client with SUMO's own TraCI server for two clients, where the other client
             moves the POV: the cost of hosting a controller without our server
    fmu      a level-0 FMU of FMI 2.0, compiled here, in one corridor
    onnx     the exported vut1, deciding at every step, in one corridor

Rounds take turns over the kinds. The figures are medians in microseconds, with the range.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import ExitStack, redirect_stdout
from pathlib import Path

import numpy as np
import traci
from build_fmu import build_fmu
from export_policy import export_onnx
from measuring import append_record, benchmark_parser, spread

from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.spec import ControllerOptions
from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.road.loader import road_of
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, US23
from merge_sumo.sumo.binding import SUMO_OPTIONS, sumo_program
from merge_sumo.sumo.sumo_simulation import SumoSimulation

STEPS = 80
"""Of an episode."""
CASE = Case(level=0, x_pov0_m=-300.0, v_pov0_mps=30.0, scenario=US23)
LAW = """
class Vut:
    def act(self, seen):
        return min(max((28.0 - seen.v_vut_mps) / 0.1, 0.0), 1.0)
"""
CLIENT = """
import sys, traci
traci.init(int(sys.argv[1]), numRetries=200)
if len(sys.argv) > 2:
    traci.setOrder(int(sys.argv[2]))
vehicle = traci.vehicle
try:
    while traci.simulation.getMinExpectedNumber() > 0 or len(sys.argv) > 2:
        traci.simulationStep()
        if "vut" in vehicle.getIDList():
            gap = vehicle.getLanePosition("pov") - vehicle.getLanePosition("vut")
            closing = vehicle.getSpeed("pov")
            v = vehicle.getSpeed("vut")
            vehicle.setSpeed("vut", v + 0.1 * min(max((28.0 - v) / 0.1, 0.0), 1.0))
    traci.close()
except traci.FatalTraCIError:
    pass
"""
SUBSCRIBER = """
import sys, traci
import traci.constants as tc
traci.init(int(sys.argv[1]), numRetries=200)
vehicle = traci.vehicle
try:
    while True:
        traci.simulationStep()
        seen = vehicle.getSubscriptionResults("vut")
        if not seen:
            if "vut" in vehicle.getIDList():
                for name in ("pov", "vut"):
                    vehicle.subscribe(name, (tc.VAR_LANEPOSITION, tc.VAR_SPEED))
                seen = vehicle.getSubscriptionResults("vut")
            else:
                continue
        v = seen[tc.VAR_SPEED]
        vehicle.setSpeed("vut", v + 0.1 * min(max((28.0 - v) / 0.1, 0.0), 1.0))
except traci.FatalTraCIError:
    pass
"""


def us_per_step(driver: Driver, episodes: int) -> float:
    """Return microseconds per step and corridor of a driver that moves by its own answers.

    Args:
        driver: the driver.
        episodes: number of episodes.
    """
    k = driver.corridors
    active, spent = np.ones(k, dtype=bool), 0.0
    for _ in range(episodes):
        for corridor in range(k):
            driver.begin(corridor, CASE)
        x_pov, v_pov = np.full(k, CASE.x_pov0_m), np.full(k, CASE.v_pov0_mps)
        x, v = np.full(k, -182.0), np.full(k, CASE.v_vut0_mps)
        for step in range(STEPS):
            x_m, v_mps = np.array([x_pov, x]), np.array([v_pov, v])
            scene = Scene(active, np.full(k, step), x_m, v_mps)
            start = time.perf_counter()
            a = driver.act(scene)
            if step:  # the first step of a client includes its turn to a new episode
                spent += time.perf_counter() - start
            if not np.isfinite(a).all():
                raise RuntimeError(driver.reason(0))
            x_pov, x, v = x_pov + v_pov * DT_S, x + v * DT_S, np.maximum(v + a * DT_S, 0.0)
    return spent / (episodes * (STEPS - 1) * k) * 1e6


def us_of_peer(client: Path, folder: Path, episodes: int) -> float:
    """Return microseconds per step with SUMO's own server for two clients.

    Args:
        client: program of the controller.
        folder: folder for the files of SUMO.
        episodes: number of episodes.
    """
    net_file = folder / "peer.net.xml"
    road = road_of()
    net_file.write_bytes(road.path.read_bytes())
    port = traci.main.getFreeSocketPort()
    options = ["--net-file", str(net_file), "--remote-port", str(port), "--num-clients", "2"]
    server = subprocess.Popen([sumo_program("sumo"), *options, *SUMO_OPTIONS])
    other = subprocess.Popen(
        [sys.executable, str(client), str(port), "2"], stdout=subprocess.DEVNULL
    )
    try:
        with redirect_stdout(sys.stderr):  # it prints every attempt
            host = traci.connect(port, numRetries=200, waitBetweenRetries=0.2)
        host.setOrder(1)
        vehicle, spent = host.vehicle, 0.0
        paths = {"pov": road.mainline, "vut": road.ramp}
        edges = {"pov": road.mainline_edges, "vut": road.ramp_edges}
        for name in paths:
            host.route.add(name, edges[name])
            vehicle.add(name, name, departPos="10", departSpeed="0")
        host.simulationStep()
        for name in paths:
            vehicle.setSpeedMode(name, 32)
        for _ in range(episodes):
            x_and_v = {"pov": (-300.0, 30.0), "vut": (-182.0, 18.0)}
            for name, path in paths.items():
                x_m, v_mps = x_and_v[name]
                at = path.point(x_m)
                vehicle.moveTo(name, at.lane, at.position_m)
                vehicle.setPreviousSpeed(name, v_mps, 0.0)
                vehicle.setSpeed(name, v_mps)
            for _ in range(STEPS - 1):
                start = time.perf_counter()
                host.simulationStep()
                for name in paths:
                    vehicle.getLanePosition(name)
                    vehicle.getSpeed(name)
                vehicle.setSpeed("pov", 30.0)
                spent += time.perf_counter() - start
        return spent / (episodes * (STEPS - 1)) * 1e6
    finally:
        for process in (other, server):
            process.kill()  # SUMO would wait for its clients
            process.wait()


PEERS = {
    "traci": "peer",
    "python": "python, in process",
    "python, 32 corridors": "in process, 32 corridors",
}
"""Kinds that are divided by another one."""


def opened(folder: Path, simulation: SumoSimulation) -> dict[str, Driver]:
    """Write the controllers of all kinds into a folder, and return their drivers by name.

    Args:
        folder: folder of the controllers.
        simulation: a simulation, whose road and scenario a TraCI controller gets.
    """
    (folder / "law.py").write_text(LAW)
    (folder / "client.py").write_text(CLIENT)
    (folder / "subscriber.py").write_text(SUBSCRIBER)
    export_onnx("vut1", folder / "vut1.onnx")
    build_fmu(folder / "level0.fmu")
    law = f"{folder / 'law.py'}:Vut"
    clients = {}
    for name in ("client", "subscriber"):
        command = [sys.executable, str(folder / f"{name}.py"), "{port}"]
        clients[name] = f"traci:{shlex.join(command)}"
    in_process = ControllerOptions(in_process=True)

    def driver(spec: str, corridors: int = 1, options: ControllerOptions | None = None) -> Driver:
        return load(spec, options or ControllerOptions()).open(corridors, simulation)

    return {
        "python": driver(law),
        "python, in process": driver(law, options=in_process),
        "python, 32 corridors": driver(law, 32),
        "in process, 32 corridors": driver(law, 32, in_process),
        "traci": driver(clients["client"]),
        "traci, subscribing": driver(clients["subscriber"]),
        "fmu": driver(f"fmu:{folder / 'level0.fmu'}"),
        "onnx": driver(f"onnx:{folder / 'vut1.onnx'}?decision_period_s=0.1"),
    }


def main() -> None:
    """Print a table."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--episodes", type=int, default=20, help="episodes per round and kind")
    options = parser.parse_args()
    us: dict[str, list[float]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as name, ExitStack() as open_drivers:
        folder = Path(name)
        drivers = opened(folder, open_drivers.enter_context(SumoSimulation(1, scenario=US23)))
        for driver in drivers.values():
            open_drivers.callback(driver.close)
        for _ in range(options.rounds):
            for kind, driver in drivers.items():
                us[kind].append(us_per_step(driver, options.episodes))
            us["peer"].append(us_of_peer(folder / "client.py", folder, options.episodes))
    for kind, values in us.items():
        print(f"{kind:24} {spread(values, 1)} us a step")
    for kind, peer in PEERS.items():
        ratios = [a / b for a, b in zip(us[kind], us[peer], strict=True)]
        print(f"{kind} costs {spread(ratios)} times {peer}")
    append_record(options.record, "vuts", us)


if __name__ == "__main__":
    main()
