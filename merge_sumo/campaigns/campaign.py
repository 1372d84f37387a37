"""A campaign: a sampler proposes cases, they are simulated, the journal keeps them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from merge_sumo.campaigns.journal import Journal
from merge_sumo.campaigns.loop import Batches, SearchLoop
from merge_sumo.campaigns.recorded import (
    AGAINST,
    FILES,
    TALLIES,
    RecordedCampaign,
    has_converged,
    spread_failures,
)
from merge_sumo.campaigns.repeatability import check_repeatability
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.controllers.process import LOG
from merge_sumo.errors import UserError, notice
from merge_sumo.files import TakenError, check_new, check_own, files_now
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.road.loader import centre_lines, road_for
from merge_sumo.road.road import Road
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
from merge_sumo.sumo.replay_folder import write_replay_folder
from merge_sumo.workers import Workers

EXPORTED_FAILURES = 10
SCENARIOS = "scenarios"

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
) -> RecordedCampaign:
    """Run a campaign into a new folder, or one that was stopped to its end; return it.

    Same settings, same versions: same `outcomes.jsonl`, whatever the workers, and as if the
    campaign had never been stopped. A campaign that is resumed with more cases also gives these
    outcomes, if its earlier number of cases ended with a whole batch. The worst failures are
    exported as folders that sumo-gui opens.

    Args:
        settings: what to run; to resume, the settings of the folder with the controllers that were
            named again (`settings_from_folder`).
        plan: how its cases run (`settings.load_plan()`).
        folder: where to.
        callbacks: called in turn with the outcomes of one or more batches when they are stored.
        resumes: whether the folder has a campaign that was stopped, however it was.
        workers: where cases run, by default in this process.
        begin: called before the first case, when nothing is refused any more, with the outcomes of
            the cases that ran before.

    Raises:
        UserError: if the plan cannot be carried out; if the folder of a new campaign exists; if
            something of a stopped one differs that decides outcomes: settings, versions, net,
            policies. The message names the field.
    """
    if resumes:
        check_own(folder / SCENARIOS, folder / AGAINST)
    else:
        check_new(folder)
        check_new(folder / SCENARIOS / case_name(settings.cases))
    # More corridors than cases that run at a time would stay empty.
    batch = settings.batch if SAMPLERS[settings.sampler].learns else None
    plan = plan.for_cases(settings.in_flight or batch or settings.cases)
    plan = plan.with_log(folder.resolve() / LOG)
    history: list[Episode] = []
    with ExitStack() as opened:
        if workers is None:
            workers = opened.enter_context(Workers())
        if resumes:
            journal, history = _resumed(settings, plan, folder, opened, workers)
        else:
            open_simulators(plan, workers)
            journal = _created(settings, plan, folder, opened)
        begin([episode.outcome for episode in history])

        def on_batches(batches: Batches) -> None:
            journal.append(*batches)
            stored = [episode.outcome for batch in batches for episode in batch]
            for callback in callbacks:
                callback(stored)

        stop = partial(has_converged, tolerated=settings.tolerated)
        loop = SearchLoop(
            _sampler(settings, plan),
            plan,
            settings.cases,
            workers=workers,
            batch=settings.batch,
            repeat=settings.repeat,
            in_flight=settings.in_flight or 0,
            stop=stop if settings.stop_when_converged else None,
            history=history,
        )
        loop.run(on_batches)
        done = RecordedCampaign(folder)
        if plan.earlier is not None:
            check_repeatability(
                RecordedCampaign(folder / AGAINST), settings.earlier, plan.earlier, workers
            )
        check_repeatability(done, settings, replace(plan, against=None), workers)
    for outcome in spread_failures(done.cases)[:EXPORTED_FAILURES]:
        with suppress(TakenError):  # whatever it is, the campaign has ended
            export_case(done, outcome.index, folder / SCENARIOS / case_name(outcome.index))
    return done


def _created(
    settings: CampaignSettings, plan: SimulationPlan, folder: Path, opened: ExitStack
) -> Journal:
    """Return the journal of a new folder, which `opened` closes."""
    journal = opened.enter_context(Journal.create(folder, settings.to_record(plan)))
    if plan.earlier is not None:
        journal.earlier = _created(settings.earlier, plan.earlier, folder / AGAINST, opened)
    return journal


def _resumed(
    settings: CampaignSettings,
    plan: SimulationPlan,
    folder: Path,
    opened: ExitStack,
    workers: Workers,
) -> tuple[Journal, list[Episode]]:
    """Return the journal of a folder, which `opened` closes, and the episodes that it has."""
    journal, run = _reopened(settings, plan, folder, opened)
    if plan.earlier is not None:
        against = folder / AGAINST
        if not run.outcomes:  # it may have been stopped before that folder was whole
            with suppress(TakenError), ExitStack() as created:
                _created(settings.earlier, plan.earlier, against, created)
        journal.earlier, earlier = _reopened(settings.earlier, plan.earlier, against, opened)
        run.read_earlier()  # raises where cases are missing; more of them run again
        journal.earlier.keep(earlier, len(run.outcomes))
    open_simulators(plan, workers)
    journal.write_settings()
    return journal, run.episodes()


def _reopened(
    settings: CampaignSettings, plan: SimulationPlan, folder: Path, opened: ExitStack
) -> tuple[Journal, RecordedCampaign]:
    """Return the journal of a folder, which `opened` closes, and the campaign in it."""
    journal, run, dropped = Journal.reopen(folder)
    opened.enter_context(journal)
    if dropped:
        notice(f"{folder}: dropped {dropped} outcomes of an interrupted batch, which runs again")
    journal.settings = _continued(settings, plan, run)
    return journal, run


def _continued(
    settings: CampaignSettings, plan: SimulationPlan, run: RecordedCampaign
) -> dict[str, Any]:
    """Return the record of a campaign that continues.

    Raises `UserError` where something differs that decides outcomes: cases of two controllers are
    not a campaign.
    """
    recorded, record = dict(run.record), settings.to_record(plan)
    # The content of policies decides outcomes, and not their folder.
    recorded["policies"] = record["policies"]
    # Files that were loaded while it ran must be the same, although they are not loaded yet.
    for name in FILES:
        record[name] = files_now(recorded.get(name) or {}, record[name] or {}) or None
    for name in TALLIES:
        if name in recorded:
            record[name] = recorded[name]
    # Which cases come next does not depend on how many there are to be.
    ended = run.settings.stop_when_converged and not settings.stop_when_converged
    if ended or run.settings.cases < settings.cases:
        recorded |= {"cases": settings.cases, "stop_when_converged": settings.stop_when_converged}
    for name, (was, now) in differences(recorded, record).items():
        same = f"give {was} or more" if name == "cases" else "set it as before"
        raise UserError(
            f"{name} differs: {run.folder} ran with {was}, now it is {now}; {same}, or start a "
            "new campaign"
        )
    return record


def _sampler(settings: CampaignSettings, plan: SimulationPlan) -> Sampler:
    """Return the sampler of a campaign, without outcomes."""
    model = controller_model_of(plan, settings.pool, settings.seed)
    predictor: Predictor = model
    if plan.against is not None:
        earlier = controller_model_of(plan, settings.pool, settings.seed)
        predictor = ControllerModelPair(model, earlier)
    return settings.new_sampler(predictor)


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
    """Return the name of a case's folder.

    Args:
        index: index of the case.
    """
    return f"case-{index:05d}"


def export_case(run: RecordedCampaign, index: int, folder: Path, road: Road | None = None) -> Path:
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
    return write_replay_folder(folder, road, run.outcome(index), run.trajectory(index))
