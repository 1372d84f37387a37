"""A campaign: a sampler proposes cases, they are simulated, the journal keeps them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

from merge_sumo.campaigns.draws import RepeatingSampler
from merge_sumo.campaigns.journal import Journal
from merge_sumo.campaigns.loop import Groups, SearchLoop
from merge_sumo.campaigns.repeats import repeat
from merge_sumo.campaigns.run import AGAINST, FILES, TALLIES, Run, spread_failures
from merge_sumo.campaigns.settings import RECORDED_BY_DEFAULT, CampaignSettings, record_of
from merge_sumo.controllers.process import LOG
from merge_sumo.errors import UserError, notice
from merge_sumo.files import TakenError, check_new, check_own, files_now
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.merge import centre_lines, road_for
from merge_sumo.samplers.base import Predictor, Sampler
from merge_sumo.samplers.controller_model import (
    ControllerModel,
    ControllerModelPair,
    ModelRollout,
)
from merge_sumo.samplers.registry import SAMPLERS
from merge_sumo.scenario.case import Pool
from merge_sumo.simulation.evaluate import open_simulators
from merge_sumo.simulation.plan import SimulationPlan, differences
from merge_sumo.sumo.replay_folder import write_scenario
from merge_sumo.workers import Workers, workers_or_here

EXPORTED_FAILURES = 10
SCENARIOS = "scenarios"
FIRST_BATCH: Final = 5
"""Cases of each level in the first batch where models of two versions predict, which they do from
four cases on. Measured with design2 and design2?x1_m=120 at level 2, seeds 0 to 4: after 40 cases
.81 of what broke is found in the median, and .69 with ten.
"""

Callback = Callable[[Sequence[Outcome]], None]
"""Called with the outcomes of cases when they are stored; may raise to stop the campaign there."""


def run_campaign(
    settings: CampaignSettings,
    plan: SimulationPlan,
    folder: Path,
    callbacks: Sequence[Callback] = (),
    *,
    resumes: bool = False,
    workers: Workers | None = None,
    begin: Callback = lambda _: None,
) -> Run:
    """Run a campaign into a new folder, or one that was stopped to its end; return it.

    Same settings, same versions: same `outcomes.jsonl`, whatever the workers, and as if the
    campaign had never been stopped; also where the settings have more cases than it had, if those
    ended with a whole batch. The worst failures are exported as folders that sumo-gui opens.

    Args:
        settings: what to run; of a campaign that resumes, those of the folder, and those that were
            named again (`settings_of`).
        plan: how its cases run: that of the settings (`resolve`).
        folder: where to.
        callbacks: called in turn with the outcomes of one or more groups when they are stored.
        resumes: whether the folder has a campaign that was stopped, however it was.
        workers: where cases run, by default in this process.
        begin: called before the first case, when nothing is refused any more, with the outcomes of
            the cases that ran before.

    Raises:
        UserError: if the plan cannot be carried out; if the folder of a new campaign exists; if
            something of a stopped one differs that decides outcomes: settings, versions, net,
            policies. The sentence has the name of the field.
    """
    if resumes:
        check_own(folder / SCENARIOS, folder / AGAINST)
    else:
        check_new(folder)
        check_new(folder / SCENARIOS / case_name(settings.cases))
    plan = _sized(settings, plan, folder, workers)
    outcomes: list[Outcome] = []
    with workers_or_here(workers) as available, ExitStack() as opened:
        if resumes:
            journal, history = _resumed(settings, plan, folder, opened, available)
            outcomes += [episode.outcome for episode in history]
        else:
            open_simulators(plan, available)
            journal, history = _created(settings, plan, folder, opened), []
        begin(outcomes)

        def on_groups(groups: Groups) -> None:
            journal.append(*groups)
            stored = [episode.outcome for group in groups for episode in group]
            outcomes.extend(stored)
            for callback in callbacks:
                callback(stored)

        sampler = _sampler(settings, plan)
        young = sampler.uses_predictions and plan.against is not None
        loop = SearchLoop(
            sampler,
            plan,
            settings.cases,
            workers=available,
            batch=settings.batch,
            first=FIRST_BATCH * len(settings.levels) if young else None,
            in_flight=settings.in_flight,
            stop=settings.stopping_rule(),
            history=history,
        )
        loop.run(on_groups)
        done = Run(folder)
        if plan.earlier is not None:
            repeat(Run(folder / AGAINST), settings.earlier, plan.earlier, available)
        repeat(done, settings, replace(plan, against=None), available)
    for outcome in spread_failures(done.cases)[:EXPORTED_FAILURES]:
        with suppress(TakenError):  # whatever it is, the campaign has ended
            export_case(done, outcome.index, folder / SCENARIOS / case_name(outcome.index))
    return done


def _created(
    settings: CampaignSettings, plan: SimulationPlan, folder: Path, opened: ExitStack
) -> Journal:
    """Return the journal of a new folder, which `opened` closes."""
    journal = opened.enter_context(Journal.create(folder, record_of(settings, plan)))
    if plan.earlier is not None:
        record = record_of(settings.earlier, plan.earlier)
        journal.earlier = opened.enter_context(Journal.create(folder / AGAINST, record))
    return journal


def _resumed(
    settings: CampaignSettings,
    plan: SimulationPlan,
    folder: Path,
    opened: ExitStack,
    workers: Workers,
) -> tuple[Journal, list[Episode]]:
    """Return the journal of a folder, which `opened` closes, and the episodes that it has."""
    journal, before = _reopened(folder, opened)
    records = [(journal, _compared(settings, plan, before))]
    motion = SAMPLERS[settings.sampler].uses_predictions
    old: Run | None = None
    if plan.earlier is not None:
        place = folder / AGAINST
        if not before.outcomes:  # it may have been stopped before that folder was whole
            record = record_of(settings.earlier, plan.earlier)
            with suppress(TakenError), Journal.create(place, record):
                pass
        journal.earlier, old = _reopened(place, opened)
        records.append((journal.earlier, _compared(settings.earlier, plan.earlier, old)))
        before.earlier()  # raises where cases are missing; more of them run again
        journal.earlier.keep(old, len(before.outcomes))
    open_simulators(plan, workers)
    for one, rewritten in records:
        if rewritten is not None:
            one.rewrite_settings(rewritten)
    history = before.episodes(motion=motion)
    if old is not None:
        pairs = zip(history, old.episodes(motion=motion), strict=True)
        history = [replace(new, earlier=earlier) for new, earlier in pairs]
    return journal, history


def _sized(
    settings: CampaignSettings, plan: SimulationPlan, folder: Path, workers: Workers | None
) -> SimulationPlan:
    """Return the plan with no more corridors than cases run at a time, and with a log."""
    at_once = settings.batch if SAMPLERS[settings.sampler].learns else settings.cases
    if settings.in_flight is not None:
        at_once = math.ceil(settings.in_flight / (1 if workers is None else workers.count))
    return plan.for_cases(at_once or settings.cases).with_log(folder.resolve() / LOG)


def _reopened(folder: Path, opened: ExitStack) -> tuple[Journal, Run]:
    """Return the journal of a folder, which `opened` closes, and the campaign in it."""
    journal, run, dropped = Journal.reopen(folder)
    opened.enter_context(journal)
    if dropped:
        notice(f"{folder}: dropped {dropped} outcomes of a batch that was stopped; it runs again")
    return journal, run


def _compared(
    settings: CampaignSettings, plan: SimulationPlan, before: Run
) -> dict[str, Any] | None:
    """Return the record of a campaign that continues, where it is to be written again.

    Raises `UserError` where something differs that decides outcomes: cases of two controllers are
    not a campaign.
    """
    recorded = {k: v for k, v in before.record.items() if k not in TALLIES}
    record = record_of(settings, plan)
    # The content of policies decides outcomes, and not their folder.
    moved = (RECORDED_BY_DEFAULT | recorded)["policies"] != record["policies"]
    recorded["policies"] = record["policies"]
    # What was loaded while it ran must be the same, too, although it is not loaded yet.
    for name in FILES:
        known = recorded.get(name) or {}
        record[name] = files_now(known, record[name] or {}) or None
    # Which cases come next does not depend on how many there are to be.
    ended = before.settings.stop_when_converged and not settings.stop_when_converged
    grown = before.settings.cases < settings.cases or ended
    if grown:
        recorded |= {"cases": settings.cases, "stop_when_converged": settings.stop_when_converged}
    changes = differences(RECORDED_BY_DEFAULT | recorded, record)
    if before.criterion != settings.criterion:
        raise UserError(
            f"in {before.folder} a case fails when {before.criterion.text}, and not when "
            f"{settings.criterion.text}: the criterion cannot change on resume; start a new "
            "campaign"
        )
    if changes:
        name, (was, now) = next(iter(changes.items()))
        same = f"give {was} or more" if name == "cases" else "make it the same"
        raise UserError(
            f"{name} differs: {before.folder} was run with {was}, now it is {now}; {same}, or "
            "start a new campaign"
        )
    record |= {k: before.record[k] for k in TALLIES if k in before.record}
    return record if moved or grown else None


def _sampler(settings: CampaignSettings, plan: SimulationPlan) -> Sampler:
    """Return the sampler of a campaign, without outcomes."""
    model = controller_model_of(plan, settings.pool, settings.seed)
    predictor: Predictor = model
    if plan.against is not None:
        earlier = controller_model_of(plan, settings.pool, settings.seed)
        predictor = ControllerModelPair(model, earlier)
    sampler = settings.new_sampler(predictor)
    return sampler if settings.repeat == 1 else RepeatingSampler(sampler, settings.repeat)


def controller_model_of(plan: SimulationPlan, pool: Pool, seed: int) -> ControllerModel:
    """Return an untrained model of the controller of a plan.

    Args:
        plan: how its cases run.
        pool: the cases.
        seed: of the model.
    """
    rollout = ModelRollout(pool, plan.povs, plan.criterion, centre_lines(plan.road))
    return ControllerModel(rollout, seed)


def case_name(index: int) -> str:
    """Return the name of a case's folder."""
    return f"case-{index:05d}"


def export_case(run: Run, index: int, folder: Path, road: Corridor | None = None) -> Path:
    """Write a case of a campaign as a replay folder.

    Args:
        run: the campaign.
        index: index of the case.
        folder: the new folder.
        road: the road of the scenario; read from its net by default.

    Returns:
        The path of the SUMO configuration.
    """
    road = road or road_for(run.scenario)
    return write_scenario(folder, road, run.outcome(index), run.trajectory(index))
