"""Make the folders of scenarios/ again: `python tools/make_scenarios.py`.

Plays each case in SUMO, writes it as a replay folder, and draws positions and speeds of both
vehicles into `motion.png` beside it. Needs matplotlib.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from merge_sumo.campaigns.rollout import rollout
from merge_sumo.drivers.pov import PovLibrary
from merge_sumo.drivers.vut import vut_factory
from merge_sumo.sumo.replay_folder import write_scenario
from merge_sumo.sumo.road import road_of
from merge_sumo.sumo.world import World
from merge_sumo.values.case import Case
from merge_sumo.values.scenario import DT_S
from merge_sumo.values.score import Outcome, measure
from merge_sumo.values.trajectory import Trajectory

SCENARIOS = Path(__file__).resolve().parent.parent / "scenarios"


@dataclass(frozen=True)
class Example:
    """A case, and the VUT that drives in it."""

    vut: str
    case: Case


def _case(level: int, x_pov0_m: float, v_pov0_mps: float, svo_rad: float | None = None) -> Case:
    return Case(level=level, x_pov0_m=x_pov0_m, v_pov0_mps=v_pov0_mps, svo_rad=svo_rad)


EXAMPLES = {
    "pov-yields": Example("level0", _case(1, -273.0, 33.0)),
    "vut-waits": Example("level1", _case(2, -273.0, 33.0, 0.6)),
    "stalemate": Example("design2", _case(2, -294.5, 34.125, 0.6)),
    "no-reaction": Example("design1", _case(0, -269.0, 31.0)),
}


def play(example: Example, world: World) -> Trajectory:
    """Play one example in SUMO."""
    vut = vut_factory(example.vut)(world.corridors)
    ((_, trajectory),) = rollout(world, PovLibrary(world.corridors), vut, [example.case])
    return trajectory


def draw(trajectory: Trajectory, title: str, path: Path) -> None:
    """Draw positions and speeds of both vehicles over time."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    time_s = [step * DT_S for step in range(len(trajectory.motion))]
    for axes, unit, pov, vut in (
        (left, "distance to M in m", trajectory.x_pov_m, trajectory.x_vut_m),
        (right, "speed in m/s", trajectory.v_pov_mps, trajectory.v_vut_mps),
    ):
        axes.plot(time_s, pov, color="#d62728", label="POV")
        axes.plot(time_s, vut, color="#1f77b4", label="VUT")
        axes.set_xlabel("time in s")
        axes.set_ylabel(unit)
        axes.grid(alpha=0.3)
    left.axhline(0.0, color="black", linewidth=0.8)
    left.legend()
    figure.suptitle(title)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main() -> None:
    """Write all examples; older ones are to be removed first."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=SCENARIOS)
    out = parser.parse_args().out
    road = road_of()
    with World(1, road) as world:
        for name, example in EXAMPLES.items():
            trajectory = play(example, world)
            measures = measure(trajectory)
            folder = out / name
            write_scenario(folder, road, Outcome(0, 0, example.case, measures), trajectory)
            case = example.case
            pov = f"POV level {case.level}" + (
                "" if case.svo_rad is None else f" psi {case.svo_rad}"
            )
            dx = "" if measures.dx_m is None else f", dx {measures.dx_m:.1f} m"
            title = f"{pov}, VUT {example.vut}: {measures.end.lower()}{dx}"
            draw(trajectory, title, folder / "motion.png")
            print(
                f"{name}: {title}; hardest braking of the VUT {measures.vut_max_brake_mps2:.1f}, "
                f"of the POV {measures.pov_max_brake_mps2:.1f} m/s2"
            )


if __name__ == "__main__":
    main()
