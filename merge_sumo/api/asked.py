"""From what a verb is asked to the settings of a campaign, and to where its cases run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.run import Run
from merge_sumo.campaigns.settings import CampaignSettings, settings_of
from merge_sumo.engine.evaluate import evaluation_workers
from merge_sumo.engine.plan import Engine, SimulationPlan
from merge_sumo.engine.povs import parse_levels, policies_folder
from merge_sumo.errors import UserError
from merge_sumo.options import (
    DEFAULT_CASES,
    AnyPath,
    Asked,
    Execution,
    Hosting,
    Judged,
    Limits,
    OfScenario,
    Recorded,
    Search,
    Test,
)
from merge_sumo.reports.progress import Bars, Counter
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.imperfection import Actuation, Sensing
from merge_sumo.scenario.scenario import Scenario
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.studies.sampler_study import Study
from merge_sumo.system.scratch import ScratchFolder
from merge_sumo.system.workers import HERE_S, AnyWorkers, Workers
from merge_sumo.verbs import Benchmark, Campaign, GroundTruth, SearchOfTest
from merge_sumo.vuts.in_memory import AnyVut, drivers_of, is_here


def opened(where: Execution, plan: SimulationPlan, *, at_once: bool = False) -> Workers:
    """Return the workers that run the cases of a plan, to be used in `with`.

    Where nobody says how many, processes are started `at_once`, or as soon as they pay.
    """
    here_s = HERE_S if where.workers is None and not at_once else None
    return evaluation_workers(plan.workers(where.workers), here_s)


@contextmanager
def opened_study(
    run: Run,
    asked: Recorded,
    title: str,
    total: int | Mapping[Engine, int],
    unit: str = "cases",
    *,
    engine: str | None = None,
) -> Iterator[RunStudy]:
    """Open a campaign for a study that runs cases of it, with a bar that counts `total` of them.

    "{vut}" in the title stands for the VUT; a total may depend on the engine.
    """
    settings, plan, where = today(run, asked)
    plan = plan.with_engine(engine)
    number = total if isinstance(total, int) else total[plan.engine]
    bar = Counter(title.format(vut=settings.vut), number, unit, shown=where.progress)
    with opened(where, plan) as workers, bar:
        yield RunStudy(run, settings, plan, workers, bar.ended)


def today(run: Run, asked: Recorded) -> tuple[CampaignSettings, SimulationPlan, Execution]:
    """Return how and where cases of a campaign run today: settings, their plan, and the place."""
    fields, where = stated_again(asked, asked.vut, {"vut": run.vut})
    settings = settings_of(run.folder, run.record, fields)
    return settings, resolve(settings), where


@contextmanager
def opened_truths(
    settings: CampaignSettings, where: Execution, engine: str | None = None
) -> Iterator[Study]:
    """Open a study of truths; the cache of objects of this process is a passing one.

    Raises `UserError` for an engine that a level does not allow.
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


def path_of(path: AnyPath | None) -> Path | None:
    """Return what a person names as a path."""
    return None if path is None else Path(path)


def scenario_of(
    scenario: Scenario | Path | str, changes: Mapping[str, Any] | None = None
) -> Scenario:
    """Return the scenario that a person names, with changes by the fields of `OfScenario`."""
    named = scenario if isinstance(scenario, Scenario) else named_scenario(str(scenario))
    values = {name: value for name, value in (changes or {}).items() if value is not None}
    for name, kind in (("sense", Sensing), ("act", Actuation)):
        if isinstance(text := values.get(name), str):
            values[name] = kind.parsed(text, f"`{name}`")
    return replace(named, **values) if values else named


def settings_for(
    asked: Campaign | GroundTruth | Benchmark, **search: Any
) -> tuple[CampaignSettings, Execution]:
    """Return the settings of a campaign that is asked for, or of a study, and where it runs.

    `search` has settings that the study chooses.
    """
    spec, pov, workers = drivers_of(asked.vut, asked.pov, asked.workers)
    fields = asked.values(Limits)
    if isinstance(asked, Campaign):
        against, workers = _earlier(asked, workers)
        fields |= asked.values(Search) | against
        if asked.cases is None:
            fields |= {"cases": DEFAULT_CASES, "stop_when_converged": True}
    scenario = scenario_of(asked.scenario, asked.values(OfScenario))
    folder = policies_folder(asked.policies, scenario)
    levels = parse_levels(asked.level, folder, scenario.levels, own=pov is not None)
    fields |= {"vut": spec, "pov": pov, "levels": levels, **search}
    return settings_in(asked, scenario, fields), _where(asked, workers)


def settings_in(asked: Test, scenario: Scenario, fields: Mapping[str, Any]) -> CampaignSettings:
    """Return the settings of a scenario, with others by name."""
    folder = None if asked.policies is None else str(asked.policies)
    judged = criterion_of(asked, scenario)
    return CampaignSettings(scenario=scenario, policies=folder, **judged, **fields)


def criterion_of(asked: Judged, scenario: Scenario) -> dict[str, Any]:
    """Return what counts as a failure, by default what the scenario says."""
    if asked.require is not None and asked.fail_when is None:
        return {"require": asked.require}
    fail_when = scenario.criterion if asked.fail_when is None else asked.fail_when
    return {"fail_when": fail_when, "require": asked.require}


def stated_again(
    asked: Hosting, vut: AnyVut | None, recorded: Mapping[str, Any]
) -> tuple[dict[str, Any], Execution]:
    """Return what a person states anew of a recorded campaign, and where its cases run.

    `recorded` has VUT and POV for where they are not stated. Raises `UserError` for a change of a
    scenario that is not named.
    """
    fields = asked.stated(Limits)
    if asked.policies is not None:
        fields["policies"] = str(asked.policies)
    drivers = {**recorded, **({} if vut is None else {"vut": vut})}
    drivers |= {} if asked.pov is None else {"pov": asked.pov}
    workers = asked.workers if isinstance(asked, Execution) else 1
    spec, pov, workers = drivers_of(drivers.get("vut") or "", drivers.get("pov"), workers)
    fields |= {} if vut is None else {"vut": spec}
    fields |= {} if asked.pov is None else {"pov": pov}
    if isinstance(asked, Test):
        fields |= asked.stated(Judged) | _scenario_again(asked)
    if isinstance(asked, SearchOfTest):
        against, workers = _earlier(asked, workers)
        fields |= asked.stated(Search) | against
        if asked.cases is not None:
            fields["stop_when_converged"] = asked.stop_when_converged
    return fields, _where(asked, workers)


def _scenario_again(asked: Test) -> dict[str, Any]:
    changes = asked.stated(OfScenario)
    if "scenario" not in asked.given:
        for name in changes:
            raise UserError(f"`{name}` is of the scenario: name that, too, with `scenario`")
        return {}
    return {"scenario": scenario_of(asked.scenario, changes)}


def _earlier(asked: SearchOfTest, workers: AnyWorkers) -> tuple[dict[str, str], AnyWorkers]:
    """Return the spec of an earlier version that is given, and how many workers."""
    if asked.against is None:
        return {}, workers
    spec, _, workers = drivers_of(asked.against, None, workers)
    return {"against": spec}, workers


def _where(asked: Asked, workers: AnyWorkers) -> Execution:
    progress = asked.progress if isinstance(asked, Execution) else None
    return Execution(workers=workers, progress=progress)
