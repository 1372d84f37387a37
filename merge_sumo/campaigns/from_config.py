"""From the config of a verb to the settings of a campaign, or of a single case."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from merge_sumo import config as c
from merge_sumo.campaigns.printed_commands import CONTROLLERS
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.settings import CampaignSettings, settings_from_folder
from merge_sumo.controllers.in_memory import spec_of_driver
from merge_sumo.errors import UserError
from merge_sumo.printable import either
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.imperfection import Actuation, Sensing
from merge_sumo.scenario.scenario import US23, Scenario, level_name
from merge_sumo.simulation.povs import one_level, parse_levels, policies_folder


def scenario_from(
    scenario: Scenario | Path | str, changes: Mapping[str, Any] | None = None
) -> Scenario:
    """Return the scenario of a config.

    Args:
        scenario: the scenario, its name, or its file.
        changes: other values, by the fields of `ScenarioChanges`.

    Raises:
        UserError: an unknown name, or a wrong file or value.
    """
    named = scenario if isinstance(scenario, Scenario) else named_scenario(str(scenario))
    values = dict(changes or {})
    for name, kind in (("sense", Sensing), ("act", Actuation)):
        if isinstance(text := values.get(name), str):
            values[name] = kind.parsed(text, f"`{name}`")
    return replace(named, **values) if values else named


def named_settings(
    config: c.Drivers | c.CheckVut, scenario: Scenario | None = None
) -> dict[str, Any]:
    """Return the settings whose values differ from the defaults, by fields of `CampaignSettings`.

    A default that the user wrote counts as not given: the value of a recorded campaign stays.

    Args:
        config: the config.
        scenario: the scenario of a config that names none; None for that of a recorded campaign.

    Raises:
        UserError: for a change of a scenario that is not named.
    """
    named = c.non_defaults(config, c.Limits)
    for name in CONTROLLERS:
        if (controller := getattr(config, name, None)) is not None:
            named[name] = spec_of_driver(controller)
    if config.policies is not None:
        named["policies"] = str(config.policies)
    if isinstance(config, c.Test):
        named |= c.non_defaults(config, c.FailureRule)
        changes = c.non_defaults(config, c.ScenarioChanges)
        if base := config.scenario or scenario:
            named["scenario"] = scenario_from(base, changes)
        elif changes:
            (name, *_) = changes
            raise UserError(f"`{name}` changes a scenario: set `scenario`, too")
    if isinstance(config, c.CampaignCalls):
        named |= c.non_defaults(config, c.Search)
        if config.cases is not None:
            named["stop_when_converged"] = config.stop_when_converged
    return named


def settings_from_config(
    config: c.Campaign | c.GroundTruth | c.Benchmark, **search: Any
) -> CampaignSettings:
    """Return the settings of a campaign, or of a study.

    Args:
        config: the config.
        search: settings that the study chooses.
    """
    named = named_settings(config, US23)
    if isinstance(config, c.Campaign) and config.cases is None:
        named["stop_when_converged"] = True
    folder = policies_folder(config.policies, named["scenario"])
    named["levels"] = parse_levels(config.level, folder, own=config.pov is not None)
    return _new_settings(named | search)


def _new_settings(named: dict[str, Any]) -> CampaignSettings:
    """Return settings, by default with the criterion of the scenario."""
    if "require" not in named:
        named.setdefault("fail_when", named["scenario"].criterion)
    return CampaignSettings(**{"vut": ""} | named)  # which says that a VUT is missing


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

    Returns:
        Settings of a campaign of this case alone, and the case.

    Raises:
        UserError: no VUT is named, or the case is not one of the scenario.
    """
    if run is None and not config.vut:
        raise UserError("no VUT is named: set `vut`, or choose a recorded case with `recorded`")
    named = named_settings(config, US23 if run is None else None)
    if run is None or config.recorded is None:
        scenario, row = named["scenario"], config.case or {}
    else:
        scenario, row = run.scenario, run.outcome(config.recorded[1]).to_record()
    level = int(row.get("level", 0))
    if config.level is not None:
        folder = policies_folder(config.policies, scenario)
        level = one_level(str(config.level), folder, own=config.pov is not None)
    named |= {**ONE, "levels": (level,)}
    settings = None if run is None else settings_from_folder(run.folder, run.record, named)
    settings = settings or _new_settings(named)
    draw = _number("draw", row.get("draw") or 0)
    values = {}
    for dimension in settings.scenario.dimensions(level):
        values[dimension.field] = row.get(dimension.field)
    for name in c.COORDINATE_OPTIONS:
        if getattr(config, name) is not None:
            values[name] = getattr(config, name)
    case = _case(settings.scenario, level, values | dict(config.at or {}))
    return settings, replace(case, draw=0 if math.isnan(draw) else int(draw))


def _case(scenario: Scenario, level: int, values: Mapping[str, Any]) -> Case:
    """Return the case of a scenario with values by the names of its coordinates."""
    known = {"v_vut0_mps"}
    for dimension in scenario.dimensions(level):
        known.add(dimension.field)
        if values.get(dimension.field) is None:
            raise UserError(
                f"`{dimension.field}` is missing: set it, or give it in `at`; the pool ranges "
                f"from {dimension.low:g} to {dimension.high:g}"
            )
    numbers: dict[str, Any] = {}
    if isinstance(scenario.v_vut0_mps, float):
        numbers["v_vut0_mps"] = scenario.v_vut0_mps
    for name, value in values.items():
        if name not in known:
            raise UserError(
                f"`{name}` is not a coordinate of {scenario.name} at level {level_name(level)}: "
                f"remove it, or use {either(sorted(known))}"
            )
        if value is not None:
            numbers[name] = _number(name, value)
    return Case(level=level, scenario=scenario, **numbers)


def _number(name: str, value: Any) -> float:
    """Return a value of a case as a number."""
    try:
        return float(value)
    except (TypeError, ValueError):
        raise UserError(f"{name} is {value!r:.60}: it must be a number") from None
