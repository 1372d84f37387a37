"""From what a person asked for to the plan of a simulation, which says all that decides a case.

Whatever runs cases takes its plan from here, so that no command tests another road, other drivers
or another criterion than the others.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from merge_sumo.drivers.policies import policies_of
from merge_sumo.engine.povs import Povs
from merge_sumo.engine.simulator import MAX_CORRIDORS, SimulationPlan, road_for
from merge_sumo.vuts.base import VutOptions
from merge_sumo.vuts.registry import VutFactory, vut_factory

if TYPE_CHECKING:
    from merge_sumo.campaigns.settings import CampaignSettings
    from merge_sumo.road.corridor import Corridor
    from merge_sumo.values.criterion import Criterion
    from merge_sumo.values.scenario import Scenario


def resolve(
    vut: str | VutFactory,
    *,
    scenario: Scenario,
    criterion: Criterion,
    povs: Povs | None = None,
    corridors: int = MAX_CORRIDORS,
) -> SimulationPlan:
    """Return the plan for a VUT on the road of a scenario.

    Args:
        vut: the VUT, or its spec; a learned one that is only named comes from where the POVs do.
        scenario: the scenario.
        criterion: what counts as a failure.
        povs: drivers of the POV, by default those that were trained for the scenario.
        corridors: the most episodes at a time.

    Raises:
        UserError: for a VUT that is none, a road that is missing, and a criterion over measures
            that no episode of the scenario has.
    """
    povs = povs or Povs(policies=policies_of(scenario))
    criterion.check(scenario)
    if not isinstance(vut, VutFactory):
        vut = vut_factory(vut, VutOptions(policies=povs.policies))
    return SimulationPlan(
        vut=vut,
        corridors=corridors,
        net=road_for(scenario),
        scenario=scenario,
        povs=povs,
        criterion=criterion,
    )


def plan_of(
    settings: CampaignSettings,
    net: Corridor,
    *,
    cases: int = MAX_CORRIDORS,
    log: Path | None = None,
    vut: VutFactory | None = None,
) -> SimulationPlan:
    """Return the plan of a campaign.

    Args:
        settings: those of the campaign.
        net: its road.
        cases: the number of cases that are there to run at a time.
        log: file to which is added what the drivers of a user print.
        vut: the driver in the place of the campaign's VUT.
    """
    vut, povs = vut or settings.vut_factory, settings.povs
    return SimulationPlan(
        vut=vut if log is None else vut.with_log(log),
        corridors=min(MAX_CORRIDORS, cases),
        net=net,
        scenario=settings.scenario,
        povs=povs if log is None else povs.with_log(log),
        criterion=settings.criterion,
    )
