"""From the config of a verb to the settings of a campaign, and to the plan of its simulation.

A single case, with the same drivers and verdict as in a campaign, is planned here as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from merge_sumo import config as c
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.settings import CampaignSettings, settings_of
from merge_sumo.controllers.in_memory import AnyVut, drivers_of
from merge_sumo.controllers.kinds import load
from merge_sumo.errors import UserError
from merge_sumo.road.loader import road_for
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.imperfection import Actuation, Sensing
from merge_sumo.scenario.scenario import US23, Scenario, level_name
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.simulation.povs import Povs, one_level, own_pov, parse_levels, policies_folder

DEBUG_DEADLINE_S = 86_400.0
"""Deadline of a step while a user debugs."""


def resolve(settings: CampaignSettings, *, debug: bool = False) -> SimulationPlan:
    """Return the plan of what settings name: road, drivers, criterion.

    A verb calls it once: it reads files and loads the controllers.

    Args:
        settings: the settings.
        debug: whether a controller of the user's runs in this process, without a deadline.

    Raises:
        UserError: drivers, policies or a road are missing or cannot be loaded.
    """
    policies = policies_folder(settings.policies, settings.scenario)
    options = settings.vut_options(policies)
    if debug:
        options = replace(options, in_process=True, deadline_s=DEBUG_DEADLINE_S)
    vut = load(settings.vut, options)
    own = None if settings.pov is None else own_pov(settings.pov, options)
    povs = Povs(policies=policies, own=own)
    for level in settings.levels:
        povs.check_level(level)
    return SimulationPlan(
        scenario=settings.scenario,
        road=road_for(settings.scenario),
        vut=vut,
        against=None if settings.against is None else load(settings.against, options),
        povs=povs,
        criterion=settings.criterion,
    )


def changed_scenario(
    scenario: Scenario | Path | str, changes: Mapping[str, Any] | None = None
) -> Scenario:
    """Return the scenario of a config, with changes by the fields of `ScenarioChanges`."""
    named = scenario if isinstance(scenario, Scenario) else named_scenario(str(scenario))
    values = dict(changes or {})
    for name, kind in (("sense", Sensing), ("act", Actuation)):
        if isinstance(text := values.get(name), str):
            values[name] = kind.parsed(text, f"`{name}`")
    return replace(named, **values) if values else named


def explicit(
    config: c.Drivers,
    vut: AnyVut = "",
    pov: AnyVut | None = None,
    scenario: Scenario | None = None,
) -> tuple[dict[str, Any], c.Execution]:
    """Return the settings that a config names, and where its cases run.

    Args:
        config: the config.
        vut: the recorded VUT, where an object drives again.
        pov: the recorded POV.
        scenario: the scenario of a config that names none; None for that of the recorded campaign.

    Raises:
        UserError: for a change of a scenario that is not named.
    """
    named: AnyVut | None = getattr(config, "vut", None)
    where = config if isinstance(config, c.Execution) else c.Execution()
    spec, pov_spec, workers = drivers_of(named or vut, config.pov or pov, where.workers)
    fields = c.changed(config, c.Limits)
    if named is not None:
        fields["vut"] = spec
    if config.pov is not None:
        fields["pov"] = pov_spec
    if config.policies is not None:
        fields["policies"] = str(config.policies)
    if isinstance(config, c.Test):
        fields |= c.changed(config, c.FailureRule)
        changes = c.changed(config, c.ScenarioChanges)
        if base := config.scenario or scenario:
            fields["scenario"] = changed_scenario(base, changes)
        elif changes:
            (name, *_) = changes
            raise UserError(f"`{name}` is of the scenario: name that, too, with `scenario`")
    if isinstance(config, c.CampaignCalls):
        fields |= c.changed(config, c.Search)
        if config.against is not None:
            fields["against"], _, workers = drivers_of(config.against, None, workers)
        if config.cases is not None:
            fields["stop_when_converged"] = config.stop_when_converged
    return fields, c.Execution(workers=workers, progress=where.progress)


def settings_for(
    config: c.Campaign | c.GroundTruth | c.Benchmark, **search: Any
) -> tuple[CampaignSettings, c.Execution]:
    """Return the settings of a campaign, or of a study, and where it runs.

    `search` has settings that the study chooses.
    """
    fields, where = explicit(config, scenario=US23)
    if isinstance(config, c.Campaign) and config.cases is None:
        fields["stop_when_converged"] = True
    folder = policies_folder(config.policies, fields["scenario"])
    fields["levels"] = parse_levels(config.level, folder, own=config.pov is not None)
    return _new_settings(fields | search), where


def _new_settings(fields: dict[str, Any]) -> CampaignSettings:
    """Return settings whose failures are those of the scenario, where nothing else is named."""
    if "require" not in fields:
        fields.setdefault("fail_when", fields["scenario"].criterion)
    return CampaignSettings(**fields)


ONE: dict[str, Any] = {
    "cases": 1,
    "batch": 1,
    "in_flight": None,
    "sampler": "uniform",
    "stop_when_converged": False,
    "repeat": 1,
}
"""Settings of a campaign that is one case."""


def planned_case(config: c.RunCase, run: RecordedCampaign | None) -> tuple[CampaignSettings, Case]:
    """Return a case, and how it is run.

    The coordinates of the config win over those of its row, or of the recorded case.

    Args:
        config: the config.
        run: the campaign, or the cases file, of the recorded case.
    """
    if run is None and not config.vut:
        raise UserError("say with `vut` who drives, or with `recorded` which case of a campaign")
    fields, _ = explicit(config, scenario=US23 if run is None else None)
    if run is None or config.recorded is None:
        scenario, row = fields["scenario"], config.case or {}
    else:
        scenario, row = run.scenario, run.outcome(config.recorded[1]).to_record()
    level = int(row.get("level", 0))
    if config.level is not None:
        folder = policies_folder(config.policies, scenario)
        level = one_level(str(config.level), folder, own=config.pov is not None)
    fields |= {**ONE, "levels": (level,)}
    settings = None if run is None else settings_of(run.folder, run.record, fields)
    settings = settings or _new_settings(fields)
    draw = _number("draw", row.get("draw") or 0)
    values = {}
    for dimension in settings.scenario.dimensions(level):
        values[dimension.field] = row.get(dimension.field)
    for name in c.COORDINATES:
        if getattr(config, name) is not None:
            values[name] = getattr(config, name)
    case = case_of(settings.scenario, level, values | dict(config.at or {}))
    return settings, replace(case, draw=0 if math.isnan(draw) else int(draw))


def case_of(scenario: Scenario, level: int, values: Mapping[str, Any]) -> Case:
    """Return the case of a scenario with values by the names of its fields.

    Args:
        scenario: the scenario.
        level: level of the POV.
        values: coordinates by the names of `outcomes.jsonl`, in m, m/s, s and rad.

    Raises:
        UserError: a coordinate is missing or unknown, or a value is out of range.
    """
    known = {"v_vut0_mps"}
    for dimension in scenario.dimensions(level):
        known.add(dimension.field)
        if values.get(dimension.field) is None:
            raise UserError(
                f"{_option(dimension.field)} is missing: the pool has {dimension.low:g} to "
                f"{dimension.high:g}"
            )
    given: dict[str, Any] = {}
    if isinstance(scenario.v_vut0_mps, float):
        given["v_vut0_mps"] = scenario.v_vut0_mps
    for name, value in values.items():
        if name not in known:
            raise UserError(
                f"{_option(name)} is none of the coordinates of {scenario.name} at level "
                f"{level_name(level)}, which are {', '.join(sorted(known))}: leave it out"
            )
        if value is not None:
            given[name] = _number(name, value)
    return Case(level=level, scenario=scenario, **given)


def _number(name: str, value: Any) -> float:
    """Return a value of a case as a number."""
    try:
        return float(value)
    except (TypeError, ValueError):
        raise UserError(f"{name} is {value!r:.60}: it must be a number") from None


def _option(name: str) -> str:
    """Return how a user gives a coordinate."""
    return f"`{name}`" if name in c.COORDINATES else f"`at` {name}=NUMBER"
