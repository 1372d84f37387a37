"""The one case that `run` is asked for: of a campaign, or by its coordinates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from merge_sumo import options, verbs
from merge_sumo.api.asked import scenario_of, settings_in, stated_again
from merge_sumo.api.results import recorded
from merge_sumo.campaigns.one_case import ONE, case_of
from merge_sumo.campaigns.settings import CampaignSettings, settings_of
from merge_sumo.engine.povs import one_level, policies_folder
from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import level_name
from merge_sumo.vuts.in_memory import drivers_of

if TYPE_CHECKING:
    from merge_sumo.scenario.case import Case


def recorded_case(asked: verbs.RunCase) -> tuple[CampaignSettings, Case]:
    """Return a case of a campaign with other settings and coordinates, and how it is run."""
    assert asked.recorded is not None, "one of a campaign"  # noqa: S101
    fields, _ = stated_again(asked, asked.vut, {})
    run = recorded(asked.recorded[0])
    before = run.outcome(asked.recorded[1]).case
    level = before.level
    if asked.level is not None:
        policies, own = policies_folder(asked.policies, run.scenario), bool(fields.get("pov"))
        level = one_level(str(asked.level), policies, run.scenario.levels, own=own)
    settings = settings_of(run.folder, run.record, {**fields, **ONE, "levels": (level,)})
    names = ("v_vut0_mps", *(d.field for d in settings.scenario.dimensions(level)))
    kept = {name: getattr(before, name) for name in names}
    case = case_of(settings.scenario, level, {**kept, **_coordinates(asked)})
    return settings, replace(case, draw=before.draw)


def given_case(asked: verbs.RunCase) -> tuple[CampaignSettings, Case]:
    """Return a case by its coordinates, which win over those of a row, and how it is run."""
    if asked.vut is None:
        raise UserError("say with `vut` who drives, or with `recorded` which case of a campaign")
    spec, pov, _ = drivers_of(asked.vut, asked.pov, 1)
    row: Mapping[str, Any] = asked.case or {}
    scenario = scenario_of(asked.scenario, asked.values(options.OfScenario))
    of_row = {name: row[name] for name in scenario.notation if row.get(name) is not None}
    name = level_name(int(row.get("level", 0))) if asked.level is None else str(asked.level)
    policies = policies_folder(asked.policies, scenario)
    level = one_level(name, policies, scenario.levels, own=pov is not None)
    fields = {"vut": spec, "pov": pov, "levels": (level,), **asked.values(options.Limits), **ONE}
    settings = settings_in(asked, scenario, fields)
    case = case_of(settings.scenario, level, {**of_row, **_coordinates(asked)})
    draw = row.get("draw")
    if draw is None or draw != draw:  # noqa: PLR0124 (NaN of a data frame: the first)
        return settings, case
    try:
        return settings, replace(case, draw=int(draw))
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"draw is {draw!r:.60}: it must be a whole number") from None


def _coordinates(asked: verbs.RunCase) -> dict[str, float]:
    """Return the coordinates that are stated."""
    named = {name: getattr(asked, name) for name in verbs.COORDINATES}
    return {**{n: x for n, x in named.items() if x is not None}, **(asked.at or {})}
