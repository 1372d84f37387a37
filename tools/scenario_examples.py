"""The episodes of scenarios/, which `tools/make_pictures.py` writes and draws."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from matplotlib.figure import Figure

from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.reports.pages import X_AXIS
from merge_sumo.road.loader import centre_lines, road_for
from merge_sumo.road.road import Road
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import COLOURS, DT_S, US23, Scenario
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.simulation.simulator import Simulator

STYLES: dict[str, dict[str, Any]] = {
    "POV": {"color": COLOURS["pov"]},
    "VUT": {"color": COLOURS["vut"]},
    "car ahead": {"color": COLOURS["ahead"], "linestyle": "--"},
    "car behind": {"color": COLOURS["behind"], "linestyle": ":"},
}
"""Lines of the vehicles, in the order of their rows."""


@dataclass(frozen=True)
class Example:
    """A case, and the VUT that drives in it."""

    vut: str
    case: Case


US23_TRAFFIC, ROUNDABOUT = map(named_scenario, ("us23-traffic", "roundabout"))


def _case(
    level: int,
    x_pov0_m: float,
    v_pov0_mps: float,
    svo_rad: float | None = None,
    scenario: Scenario = US23,
    **headways_s: Any,
) -> Case:
    """Return a case with the VUT's own speed in its scenario."""
    return Case(
        level=level,
        x_pov0_m=x_pov0_m,
        v_pov0_mps=v_pov0_mps,
        svo_rad=svo_rad,
        v_vut0_mps=scenario.bounds("v_vut0_mps")[0],
        scenario=scenario,
        **headways_s,
    )


QUEUE = {"headway_ahead_s": 1.2, "headway_behind_s": 1.3}
EXAMPLES = {
    "pov-yields": Example("level0", _case(1, -273.0, 33.0)),
    "vut-waits": Example("level1", _case(2, -273.0, 33.0, 0.6)),
    "stalemate": Example("design2", _case(2, -294.5, 34.125, 0.6)),
    "no-reaction": Example("design1", _case(0, -269.0, 31.0)),
    "queue": Example("design2", _case(0, -204.0, 26.4, scenario=US23_TRAFFIC, **QUEUE)),
    "roundabout-yields": Example("level0", _case(1, -66.5, 10.625, scenario=ROUNDABOUT)),
    "roundabout-stalemate": Example("roundabout", _case(1, -66.5, 10.625, scenario=ROUNDABOUT)),
}


@dataclass(frozen=True)
class Played:
    """An example that SUMO has played.

    Attributes:
        example: the example.
        trajectory: its motion.
        road: its road.
    """

    example: Example
    trajectory: Trajectory
    road: Road

    @property
    def outcome(self) -> Outcome:
        """The outcome of the case."""
        measures = Measures.of(self.trajectory, centre_lines(self.road))
        return Outcome(0, 0, self.example.case, measures)

    @property
    def title(self) -> str:
        """Both drivers and the result in a line."""
        case, measures = self.example.case, self.outcome.measures
        pov = f"POV level {case.level}" + ("" if case.svo_rad is None else f" psi {case.svo_rad}")
        dx = "" if measures.dx_m is None else f", dx {measures.dx_m:.1f} m"
        if case.scenario.vehicles > 2:
            dx += f" to the car {measures.nearest}" if measures.nearest != "pov" else " to the POV"
        return f"{pov}, VUT {self.example.vut}: {measures.result.lower()}{dx}"


@cache
def play(name: str) -> Played:
    """Play one example in SUMO.

    Args:
        name: name of the example.
    """
    example = EXAMPLES[name]
    case = example.case
    settings = CampaignSettings(vut=example.vut, levels=(case.level,), scenario=case.scenario)
    with Simulator(settings.load_plan().for_cases(1)) as ground:
        (trajectory,) = ground.run([case])
    return Played(example, trajectory, road_for(case.scenario))


def motion_figure(played: Played) -> Figure:
    """Return positions and speeds of all vehicles over time as a figure.

    Args:
        played: the example.
    """
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    motion = played.trajectory.motion
    time_s = [step * DT_S for step in range(len(motion))]
    for axes, column, unit in ((left, 0, X_AXIS), (right, 1, "speed, m/s")):
        for row, (label, style) in enumerate(STYLES.items()):
            if row < motion.shape[1]:
                axes.plot(time_s, motion[:, row, column], label=label, **style)
        axes.set_xlabel("time, s")
        axes.set_ylabel(unit)
        axes.grid(alpha=0.3)
    left.axhline(0.0, color="black", linewidth=0.8)
    left.legend()
    figure.suptitle(played.title)
    return figure
