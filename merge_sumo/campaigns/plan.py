"""From settings to the plan of a simulation."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.controllers.kinds import load
from merge_sumo.road.merge import road_for
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.simulation.povs import Povs, own_pov, policies_folder

DEBUG_DEADLINE_S: Final = 86_400.0
"""A person at a breakpoint takes their time."""


def resolve(settings: CampaignSettings, *, debug: bool = False) -> SimulationPlan:
    """Return the plan of what settings name: road, drivers, criterion.

    With `debug` a controller of the user's runs in this process, without a deadline.

    A verb calls it once: it reads files, and loads a VUT of the user's to ask what it is. Raises
    `UserError` for drivers, policies or a road that are missing or cannot be loaded.
    """
    policies = policies_folder(settings.policies, settings.scenario)
    options = settings.vut_options(policies)
    if debug:
        options = replace(options, in_process=True, deadline_s=DEBUG_DEADLINE_S)
    vut = load(settings.vut, options)
    own = None if settings.pov is None else own_pov(settings.pov, options)
    povs = Povs(policies=policies, own=own, scenario_levels=settings.scenario.levels)
    for level in settings.levels:
        povs.check_level(level)
    against = None
    if settings.against is not None:
        against = load(settings.against, settings.earlier.vut_options(policies))
    return SimulationPlan(
        scenario=settings.scenario,
        road=road_for(settings.scenario),
        vut=vut,
        against=against,
        povs=povs,
        criterion=settings.criterion,
    )
