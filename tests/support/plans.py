"""Plans for tests, on the paper's road and by its criterion where a test does not say otherwise."""

from __future__ import annotations

from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions
from merge_sumo.drivers.policies import policies_of
from merge_sumo.metrics.criterion import PAPER_CRITERION, Criterion
from merge_sumo.road.loader import road_for
from merge_sumo.scenario.scenario import US23, Scenario
from merge_sumo.simulation.plan import MAX_CORRIDORS, SimulationPlan
from merge_sumo.simulation.povs import Povs

POVS = Povs(policies=policies_of(US23))


def plan_for(
    vut: str | ControllerKind,
    *,
    scenario: Scenario = US23,
    criterion: Criterion = PAPER_CRITERION,
    povs: Povs | None = None,
    corridors: int = MAX_CORRIDORS,
) -> SimulationPlan:
    povs = povs or Povs(policies=policies_of(scenario))
    options = ControllerOptions(policies=povs.policies)
    return SimulationPlan(
        scenario=scenario,
        road=road_for(scenario),
        vut=vut if isinstance(vut, ControllerKind) else load(vut, options),
        povs=povs,
        criterion=criterion,
        corridors=corridors,
    )
