"""From the config of a verb to the settings of a campaign, and to where its cases run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from merge_sumo import config as c
from merge_sumo.analysis.run_study import RunStudy
from merge_sumo.analysis.sampler_study import Study
from merge_sumo.api.results import recorded
from merge_sumo.campaigns.one_case import ONE, case_of
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.run import Run
from merge_sumo.campaigns.settings import CampaignSettings, settings_of
from merge_sumo.controllers.in_memory import AnyVut, drivers_of, is_here
from merge_sumo.errors import UserError
from merge_sumo.reports.progress import Bars, Counter
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.imperfection import Actuation, Sensing
from merge_sumo.scenario.scenario import US23, Scenario
from merge_sumo.scratch import ScratchFolder
from merge_sumo.simulation.plan import Engine, SimulationPlan
from merge_sumo.simulation.povs import one_level, parse_levels, policies_folder
from merge_sumo.workers import HERE_S, Workers, open_workers


def opened(where: c.Execution, plan: SimulationPlan, *, at_once: bool = False) -> Workers:
    """Return the workers that run the cases of a plan, to be used in `with`.

    Where their number is open, processes are started `at_once`, or as soon as they pay.
    """
    here_s = HERE_S if where.workers is None and not at_once else 0.0
    return open_workers(plan.workers(where.workers), here_s=here_s)


@contextmanager
def opened_study(
    run: Run,
    config: c.Recorded,
    title: str,
    total: int | Mapping[Engine, int],
    unit: str = "cases",
    *,
    engine: str | None = None,
) -> Iterator[RunStudy]:
    """Open a campaign for a study that runs cases of it, with a progress bar.

    Args:
        run: the campaign.
        config: how and where cases of it run.
        title: of the bar; "{vut}" in it stands for the VUT.
        total: number of cases, which may depend on the engine.
        unit: what the bar counts.
        engine: what moves the vehicles.
    """
    settings, plan, where = current(run, config)
    plan = plan.with_engine(engine)
    number = total if isinstance(total, int) else total[plan.engine]
    bar = Counter(title.format(vut=settings.vut), number, unit, shown=where.progress)
    with opened(where, plan) as workers, bar:
        yield RunStudy(run, settings, plan, workers, bar.ended)


def current(run: Run, config: c.Recorded) -> tuple[CampaignSettings, SimulationPlan, c.Execution]:
    """Return how cases of a campaign run: settings with overrides, their plan, and where."""
    fields, where = explicit(config, run.vut)
    settings = settings_of(run.folder, run.record, fields)
    return settings, resolve(settings), where


@contextmanager
def opened_truths(
    settings: CampaignSettings, where: c.Execution, engine: str | None = None
) -> Iterator[Study]:
    """Open a study of truths; the cache of objects of this process is a passing one.

    Raises:
        UserError: for an engine that a level does not allow.
    """
    plan = resolve(settings)
    for level in settings.levels:
        plan.at_level(level).with_engine(engine)
    passing = is_here(settings.vut) or is_here(settings.pov or "")
    with (
        opened(where, plan, at_once=True) as workers,
        ScratchFolder() as folder,
        Bars(shown=where.progress) as bars,
    ):
        yield Study(plan, workers, Path(folder) if passing else None, bars.counted, engine)


def path_of(path: Path | str | None) -> Path | None:
    """Return a path of a user as one of `pathlib`."""
    return None if path is None else Path(path)


def scenario_of(
    scenario: Scenario | Path | str | None, changes: Mapping[str, Any] | None = None
) -> Scenario:
    """Return the scenario of a config, with changes by the fields of `ScenarioChanges`."""
    scenario = scenario or US23
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
    fields |= {} if named is None else {"vut": spec}
    fields |= {} if config.pov is None else {"pov": pov_spec}
    fields |= {} if config.policies is None else {"policies": str(config.policies)}
    if isinstance(config, c.Test):
        fields |= c.changed(config, c.FailureRule)
        changes = c.changed(config, c.ScenarioChanges)
        if base := config.scenario or scenario:
            fields["scenario"] = scenario_of(base, changes)
        elif changes:
            raise UserError(
                f"`{next(iter(changes))}` is of the scenario: name that, too, with `scenario`"
            )
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
        search = {"stop_when_converged": True}
    scenario, own = fields["scenario"], config.pov is not None
    folder = policies_folder(config.policies, scenario)
    levels = parse_levels(config.level, folder, scenario.levels, own=own)
    return _new_settings(fields | {"levels": levels} | search), where


def _new_settings(fields: dict[str, Any]) -> CampaignSettings:
    """Return settings whose failures are those of the scenario, where nothing else is named."""
    if "require" not in fields:
        fields.setdefault("fail_when", fields["scenario"].criterion)
    return CampaignSettings(**fields)


def recorded_case(config: c.RunCase) -> tuple[CampaignSettings, Case]:
    """Return a case of a campaign with other settings and coordinates, and how it is run."""
    assert config.recorded is not None, "one of a campaign"  # noqa: S101
    fields, _ = explicit(config)
    run = recorded(config.recorded[0])
    before = run.outcome(config.recorded[1]).case
    level = _level(config, before.level, run.scenario)
    settings = settings_of(run.folder, run.record, {**fields, **ONE, "levels": (level,)})
    names = ("v_vut0_mps", *(d.field for d in settings.scenario.dimensions(level)))
    kept = {name: getattr(before, name) for name in names}
    case = case_of(settings.scenario, level, {**kept, **_coordinates(config)})
    return settings, replace(case, draw=before.draw)


def case_in(config: c.RunCase) -> tuple[CampaignSettings, Case]:
    """Return a case by its coordinates, which win over those of a row, and how it is run."""
    if not config.vut:
        raise UserError("say with `vut` who drives, or with `recorded` which case of a campaign")
    fields, _ = explicit(config, scenario=US23)
    scenario, row = fields["scenario"], config.case or {}
    of_row = {name: row[name] for name in scenario.notation if row.get(name) is not None}
    level = _level(config, int(row.get("level", 0)), scenario)
    settings = _new_settings({**fields, **ONE, "levels": (level,)})
    case = case_of(settings.scenario, level, {**of_row, **_coordinates(config)})
    draw = row.get("draw")
    if draw is None or draw != draw:  # noqa: PLR0124 (NaN of a data frame: the first)
        return settings, case
    try:
        return settings, replace(case, draw=int(draw))
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"draw is {draw!r:.60}: it must be a whole number") from None


def _level(config: c.RunCase, default: int, scenario: Scenario) -> int:
    """Return the level of a case."""
    if config.level is None:
        return default
    folder = policies_folder(config.policies, scenario)
    return one_level(str(config.level), folder, scenario.levels, own=config.pov is not None)


def _coordinates(config: c.RunCase) -> dict[str, float]:
    """Return the coordinates of a config."""
    named = {name: getattr(config, name) for name in c.COORDINATES}
    return {**{n: x for n, x in named.items() if x is not None}, **(config.at or {})}
