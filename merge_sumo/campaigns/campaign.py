"""A campaign: a sampler proposes cases, the engine runs them, the journal keeps them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from merge_sumo.campaigns.against import FIRST_BATCH, evaluate_both, tell_both
from merge_sumo.campaigns.journal import Journal
from merge_sumo.campaigns.plan import resolve_earlier
from merge_sumo.campaigns.repeats import repeat
from merge_sumo.campaigns.run import AGAINST, FILES, TALLIES, Run, spread_failures
from merge_sumo.campaigns.scheduler import OnCase, Scheduler
from merge_sumo.campaigns.settings import RECORDED_BY_DEFAULT, CampaignSettings, record_of
from merge_sumo.engine.evaluate import evaluate_chunks, open_simulators, workers_or_here
from merge_sumo.engine.plan import SimulationPlan, differences
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.merge import road_for
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.registry import SAMPLERS
from merge_sumo.sumo.replay_folder import write_scenario
from merge_sumo.system.folders import TakenError, check_new, check_own
from merge_sumo.system.hashing import files_now
from merge_sumo.system.workers import Workers
from merge_sumo.twin.pair import TwinPair
from merge_sumo.twin.twin import Twin
from merge_sumo.verdict.episode import Episode
from merge_sumo.verdict.score import Outcome
from merge_sumo.vuts.process import LOG

EXPORTED_FAILURES: Final = 10
SCENARIOS: Final = "scenarios"


@dataclass(slots=True)
class _Version:
    """A version of the VUT in a campaign: what runs, and the folder that keeps it.

    Attributes:
        folder: the folder.
        settings: what to run.
        plan: how its cases run.
        journal: writes the folder, once that is open.
        before: what the folder had; None for a new one.
        outcomes: of all cases that have run.
    """

    folder: Path
    settings: CampaignSettings
    plan: SimulationPlan
    journal: Journal = field(init=False)
    before: Run | None = None
    outcomes: list[Outcome] = field(default_factory=list)

    def history(self, *, motion: bool) -> list[Episode]:
        """Return the cases that ran before; see `Run.episodes`."""
        return [] if self.before is None else self.before.episodes(motion=motion)

    def append(self, groups: Sequence[Sequence[Episode]]) -> None:
        """Write groups."""
        self.journal.append(*groups)
        self.outcomes += [episode.outcome for group in groups for episode in group]

    def ended(self, workers: Workers) -> Run:
        """Run some of all cases a second time; return the campaign."""
        done = Run(self.folder, self.outcomes)
        repeat(done, self.settings, self.plan, workers)
        return done


def run_campaign(
    settings: CampaignSettings,
    plan: SimulationPlan,
    folder: Path,
    on_case: OnCase = lambda _: None,
    *,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
    begin: Callable[[], None] = lambda: None,
) -> Run:
    """Run a campaign into a new folder and return it.

    Same settings, same versions: same `outcomes.jsonl`, whatever the workers. The worst failures
    are exported as folders that sumo-gui opens. Raises `UserError` when the folder exists.

    Args:
        settings: what to run.
        plan: how its cases run: that of the settings (`resolve`).
        folder: where to.
        on_case: called with every outcome.
        workers: where cases run, by default in this process.
        check: called after every batch; may raise to stop there, and `resume_campaign` goes on.
        begin: called before the first case, when nothing is refused any more.
    """
    check_new(folder)
    check_new(folder / SCENARIOS / case_name(settings.cases))
    versions = _versions(folder, settings, plan, workers)
    with workers_or_here(workers) as available, ExitStack() as opened:
        sampler = _new_sampler(versions)
        for one in versions:
            open_simulators(one.plan, available, first=settings.in_flight is not None)
        for one in versions:
            journal = Journal.create(one.folder, record_of(one.settings, one.plan))
            one.journal = opened.enter_context(journal)
        return _run(sampler, versions, available, on_case, check, begin)


def resume_campaign(
    settings: CampaignSettings,
    plan: SimulationPlan,
    folder: Path,
    on_case: OnCase = lambda _: None,
    *,
    on_before: OnCase = lambda _: None,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
    begin: Callable[[], None] = lambda: None,
    warn: Callable[[str], None] = lambda _: None,
) -> Run:
    """Go on with a campaign that was stopped, however it was; return it as `run_campaign` does.

    The result is the same to the last byte as if it had never been stopped; also where the settings
    have more cases than it had, if those ended with a whole batch. Raises `UserError` with the name
    of the field where something differs that decides outcomes: settings, versions, net, policies.

    `settings` are those of the folder, and what a person named again (`settings_of`). `on_before`
    is called with the outcomes of cases that ran before, `warn` with a sentence on what was
    dropped. The other arguments are those of `run_campaign`.
    """
    check_own(folder / SCENARIOS, folder / AGAINST)
    versions = _versions(folder, settings, plan, workers)
    campaign, before = versions[0], list[Run]()
    with workers_or_here(workers) as available, ExitStack() as opened:
        for one in versions:
            if one is not campaign and not campaign.outcomes:
                # It may have been stopped before its second folder was whole.
                record = record_of(one.settings, one.plan)
                with suppress(TakenError), Journal.create(one.folder, record):
                    pass
            journal, run, dropped = Journal.reopen(one.folder)
            one.journal, one.before = opened.enter_context(journal), run
            one.outcomes = run.outcomes
            before.append(run)
            if dropped:
                warn(
                    f"{one.folder}: dropped {dropped} outcomes of a batch that was stopped; it "
                    "runs again"
                )
        records = [_compared(one, run) for one, run in zip(versions, before, strict=True)]
        for one, run in zip(versions[1:], before[1:], strict=True):
            before[0].earlier()  # raises where cases are missing; more of them run again
            one.journal.keep(run, len(campaign.outcomes))
        for one, rewritten in zip(versions, records, strict=True):
            open_simulators(one.plan, available, first=settings.in_flight is not None)
            if rewritten is not None:
                one.journal.rewrite_settings(rewritten)
        for outcome in campaign.outcomes:
            on_before(outcome)
        sampler = _new_sampler(versions)
        return _run(sampler, versions, available, on_case, check, begin)


def _versions(
    folder: Path, settings: CampaignSettings, plan: SimulationPlan, workers: Workers | None
) -> list[_Version]:
    """Return the version of a campaign, then the one that it is against, if any."""
    versions = [_Version(folder, settings, plan)]
    earlier = resolve_earlier(settings, plan)
    if earlier is not None:
        versions.append(_Version(folder / AGAINST, settings.earlier, earlier))
    at_once = settings.batch if SAMPLERS[settings.sampler].learns else settings.cases
    if settings.in_flight is not None:
        at_once = math.ceil(settings.in_flight / (1 if workers is None else workers.count))
    for one in versions:
        few = one.plan.for_cases(at_once or settings.cases)
        one.plan = few.with_log(one.folder.resolve() / LOG)
    return versions


def _compared(version: _Version, before: Run) -> dict[str, Any] | None:
    """Return the record of a campaign that goes on, where it is to be written anew.

    Raises `UserError` where something differs that decides outcomes: cases of two controllers make
    no campaign.
    """
    settings = version.settings
    recorded = {k: v for k, v in before.record.items() if k not in TALLIES}
    record = record_of(settings, version.plan)
    # Where policies are decides nothing: what is in them does.
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
            f"{settings.criterion.text}: a campaign has one criterion; begin another one"
        )
    if changes:
        name, (was, now) = next(iter(changes.items()))
        same = f"give {was} or more" if name == "cases" else "make it the same"
        raise UserError(
            f"{name} differs: {before.folder} was run with {was}, now it is {now}; {same}, or "
            "begin a new campaign"
        )
    record |= {k: before.record[k] for k in TALLIES if k in before.record}
    return record if moved or grown else None


def _run(
    sampler: Sampler,
    versions: Sequence[_Version],
    workers: Workers,
    on_case: OnCase,
    check: Callable[[], None],
    begin: Callable[[], None],
) -> Run:
    """Run what is missing of a campaign, then some cases a second time; export the worst."""
    campaign, earlier = versions[0], versions[1] if len(versions) > 1 else None
    scheduler = _scheduler(sampler, campaign, earlier, on_case)
    if earlier is None:
        run = scheduler.run(partial(evaluate_chunks, campaign.plan, workers=workers), workers)
    else:
        both = partial(evaluate_both, campaign.plan, earlier.plan, workers)
        run = scheduler.run(both, workers, whole=True)
    with closing(run):
        begin()
        for groups in run:
            if earlier is not None:
                earlier.append([[e.earlier for e in group if e.earlier] for group in groups])
            campaign.append(groups)
            check()
    if earlier is not None:
        earlier.ended(workers)
    done = campaign.ended(workers)
    for outcome in spread_failures(done.cases)[:EXPORTED_FAILURES]:
        folder = done.folder / SCENARIOS / case_name(outcome.index)
        with suppress(TakenError):  # whatever it is, the campaign has ended
            export_case(done, outcome.index, folder, campaign.plan.road)
    return done


def _new_sampler(versions: Sequence[_Version]) -> Sampler:
    """Return the sampler of a campaign, which was told nothing."""
    settings = versions[0].settings
    twins = [twin_of(settings, one.plan) for one in versions]
    predictor = twins[0] if len(twins) == 1 else TwinPair(*twins)
    return settings.with_repeats(settings.new_sampler(predictor))


def _scheduler(
    sampler: Sampler, campaign: _Version, earlier: _Version | None, on_case: OnCase
) -> Scheduler:
    """Return the scheduler of a campaign, which knows what ran before."""
    settings, motion = campaign.settings, sampler.uses_predictions
    history = campaign.history(motion=motion)
    if earlier is not None:
        old = earlier.history(motion=motion)
        pairs = zip(history, old, strict=True)
        history = [replace(new, earlier=before) for new, before in pairs]
    young = FIRST_BATCH * len(settings.levels) if motion and earlier is not None else None
    return Scheduler(
        sampler,
        settings.cases,
        batch=settings.batch,
        first=young,
        in_flight=settings.in_flight,
        stop=settings.stopping_rule(),
        tell=None if earlier is None else partial(tell_both, sampler),
        on_case=on_case,
        history=history,
    )


def twin_of(settings: CampaignSettings, plan: SimulationPlan) -> Twin:
    """Return the twin of the VUT."""
    lines = centre_lines(plan.road)
    return Twin(settings.pool, plan.povs, settings.seed, plan.criterion, lines)


def case_name(index: int) -> str:
    """Return the name of a case's folder."""
    return f"case-{index:05d}"


def export_case(run: Run, index: int, folder: Path, road: Corridor | None = None) -> Path:
    """Write a case of a run as a replay folder; return the path of its SUMO configuration."""
    road = road or road_for(run.scenario)
    return write_scenario(folder, road, run.outcome(index), run.trajectory(index))
