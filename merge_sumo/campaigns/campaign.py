"""A campaign: a sampler proposes cases, the simulator runs them, the journal keeps them."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from functools import partial
from pathlib import Path
from typing import Any, Final

from merge_sumo.campaigns.against import AGAINST, PairedSearch, by_batch
from merge_sumo.campaigns.in_flight import Flight, by_rounds, conduct_in_flight
from merge_sumo.campaigns.plan import resolve_earlier
from merge_sumo.campaigns.prefetch import ChunkResults, Prefetch, RunChunks, proposals
from merge_sumo.campaigns.repeats import repeat, write_repeats
from merge_sumo.campaigns.settings import RECORDED_BY_DEFAULT, CampaignSettings, record_of
from merge_sumo.campaigns.store import FILES, RAN_AGAIN, Batch, Journal, Run, spread_failures
from merge_sumo.engine.evaluate import (
    CaseResult,
    evaluate,
    evaluate_anew,
    evaluate_chunks,
    open_simulators,
    workers_or_here,
)
from merge_sumo.engine.plan import SimulationPlan, differences
from merge_sumo.engine.simulator import road_for
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.road.corridor import Corridor
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.registry import SAMPLERS
from merge_sumo.sumo.replay_folder import write_scenario
from merge_sumo.system.folders import TakenError, check_new, check_own
from merge_sumo.system.hashing import Files, files_now
from merge_sumo.system.workers import Workers
from merge_sumo.twin.pair import TwinPair
from merge_sumo.twin.twin import Twin
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import Trajectory
from merge_sumo.vuts.output import LOG

EXPORTED_FAILURES: Final = 10
SCENARIOS: Final = "scenarios"

OnCase = Callable[[Outcome], None]
"""Called with every case as it ends, in the order in which cases end."""
RunCases = Callable[[Sequence[Case]], Iterable[tuple[int, CaseResult]]]
"""Runs cases; gives (place, result) in any order."""


def conduct(
    sampler: Sampler,
    run: RunCases,
    cases: int,
    batch: int | None,
    on_case: OnCase | None = None,
    history: Sequence[Outcome] = (),
    motions: Mapping[int, FloatArray] | None = None,
    stop: Callable[[Sequence[Outcome]], bool] | None = None,
) -> Iterator[list[tuple[Outcome, Trajectory]]]:
    """Ask, run and tell, batch by batch; yield the cases of each batch in order.

    Args:
        sampler: proposes the cases, and is told the outcomes.
        run: runs them.
        cases: number of cases after which the search ends.
        batch: cases of a batch; by default as many as the sampler wants.
        on_case: called with every outcome.
        history: outcomes of whole batches that ran before; as a sampler is pure in what it was
            told, it goes on as if it had just run them.
        motions: their motions, (T + 1, A, 3), by index, for a sampler that uses predictions.
        stop: says of the outcomes so far whether the search is over.
    """
    sampler.tell(history, motions)
    number, first = (history[-1].batch + 1 if history else 0), len(history)
    while first < cases and not (stop is not None and stop(sampler.observed())):
        ran: list[tuple[Outcome, Trajectory]] = []
        for place, result in run(sampler.ask(min(batch or sampler.batch_size(), cases - first))):
            outcome = result.outcome(first + place, number, sampler.prediction(place))
            ran.append((outcome, result.trajectory))
            if on_case is not None:
                on_case(outcome)
        ran.sort(key=lambda pair: pair[0].index)
        sampler.tell([o for o, _ in ran], {o.index: t.motion for o, t in ran})
        yield ran
        number, first = number + 1, first + len(ran)


def run_campaign(
    settings: CampaignSettings,
    plan: SimulationPlan,
    folder: Path,
    on_case: OnCase | None = None,
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
    both = _with_earlier(folder, settings, plan, workers)
    with workers_or_here(workers) as available, ExitStack() as journals:
        for _, of_version, planned in both:
            open_simulators(planned, available, first=of_version.in_flight is not None)
        opened = []
        for at, of_version, planned in both:
            record = record_of(of_version, planned)
            journal = journals.enter_context(Journal.create(at, record))
            opened.append(_Open(of_version, planned, record, journal))
        return _run(*opened, workers=available, on_case=on_case, check=check, begin=begin)


def resume_campaign(
    settings: CampaignSettings,
    plan: SimulationPlan,
    folder: Path,
    on_case: OnCase | None = None,
    *,
    on_before: OnCase | None = None,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
    begin: Callable[[], None] = lambda: None,
    warn: Callable[[str], None] = lambda _: None,
) -> Run:
    """Go on with a campaign that was stopped, however it was; return it as `run_campaign` does.

    The result is the same to the last byte as if it had never been stopped; also where the settings
    have more cases than it had, if those ended with a whole batch. Raises `UserError` with the name
    of the field where something differs that decides outcomes: settings, versions, net, policies.

    Args:
        settings: those of the folder, and what a person named again (`settings_of`).
        plan: as of `run_campaign`, and so are `on_case`, `workers` and `check`.
        folder: where the campaign is.
        on_case: called with the cases that ran before, too, without `on_before`.
        on_before: called with the outcomes of cases that ran before.
        workers: where cases run.
        check: called after every batch.
        begin: called before the first case.
        warn: called with a sentence on what was dropped.
    """
    check_own(folder / SCENARIOS, folder / AGAINST)
    with workers_or_here(workers) as available, ExitStack() as journals:
        opened: list[_Open] = []
        rewrites = []
        for at, of_version, planned in _with_earlier(folder, settings, plan, workers):
            if opened and not opened[0].history:
                # It may have been stopped before its second folder was whole.
                with suppress(TakenError), Journal.create(at, record_of(of_version, planned)):
                    pass
            journal, before, dropped = Journal.reopen(at)
            journals.enter_context(journal)
            record, rewrite = _compared(before, of_version, planned)
            opened.append(_Open(of_version, planned, record, journal, before))
            rewrites.append(rewrite)
            if dropped:
                warn(f"{at}: dropped {dropped} outcomes of a batch that was stopped; it runs again")
        for earlier in opened[1:]:
            earlier.keep_cases_of(opened[0])
        for one, rewrite in zip(opened, rewrites, strict=True):
            open_simulators(one.plan, available, first=one.settings.in_flight is not None)
            one.go_on(rewrite=rewrite)
        if (on_outcome := on_before or on_case) is not None:
            for outcome in opened[0].history:
                on_outcome(outcome)
        return _run(*opened, workers=available, on_case=on_case, check=check, begin=begin)


def _with_earlier(
    folder: Path, settings: CampaignSettings, plan: SimulationPlan, workers: Workers | None
) -> list[tuple[Path, CampaignSettings, SimulationPlan]]:
    """Return folder, settings and plan of a campaign, then of the version that it is against."""
    both = [(folder, settings, plan)]
    earlier = resolve_earlier(settings, plan)
    if earlier is not None:
        both.append((folder / AGAINST, settings.earlier, earlier))
    return [(at, of, _plan_in(at, of, planned, workers)) for at, of, planned in both]


def _compared(
    before: Run, settings: CampaignSettings, plan: SimulationPlan
) -> tuple[dict[str, Any], bool]:
    """Return the record of a campaign that goes on, and whether to write it.

    Raises `UserError` where something differs that decides outcomes: cases of two controllers make
    no campaign.
    """
    recorded = {k: v for k, v in before.settings.items() if k != RAN_AGAIN}
    record = record_of(settings, plan)
    # Where policies are decides nothing: what is in them does.
    moved = (RECORDED_BY_DEFAULT | recorded)["policies"] != record["policies"]
    recorded["policies"] = record["policies"]
    # What was loaded while it ran must be the same, too, although it is not loaded yet.
    for name in FILES:
        known = recorded.get(name) or {}
        record[name] = files_now(known, record[name] or {}) or None
    # Which cases come next does not depend on how many there are to be.
    cases = recorded.get("cases")
    grown = isinstance(cases, int) and cases < settings.cases
    if grown:
        recorded["cases"] = settings.cases
    changes = differences(RECORDED_BY_DEFAULT | recorded, record)
    if before.criterion != settings.criterion:
        raise UserError(
            f"in {before.folder} a case fails when {before.criterion.text}, and not when "
            f"{settings.criterion.text}: a campaign has one criterion; begin another one"
        )
    if changes:
        name, (was, now) = next(iter(changes.items()))
        raise UserError(
            f"{name} differs: {before.folder} was run with {was}, now it is {now}; make it the "
            "same, or begin a new campaign"
        )
    return record, moved or grown


class _Open:
    """A campaign whose folder is open: what runs, and what the folder has.

    Attributes:
        settings: what to run.
        plan: how its cases run.
        journal: writes the folder.
        before: what the folder had; None for a new one.
        history: the outcomes of that.
    """

    def __init__(
        self,
        settings: CampaignSettings,
        plan: SimulationPlan,
        record: dict[str, Any],
        journal: Journal,
        before: Run | None = None,
    ) -> None:
        """Take settings, plan, what `campaign.json` holds, and the folder."""
        self.settings, self.plan, self.journal, self.before = settings, plan, journal, before
        self.history: list[Outcome] = [] if before is None else before.outcomes
        self._record, self._noted = record, _Noted(record)

    def go_on(self, *, rewrite: bool) -> None:
        """Write the record of a campaign that goes on, where it is another; see `_compared`."""
        before, record = self.before, self._record
        assert before is not None, "it goes on"  # noqa: S101
        if before.ran_again:
            record[RAN_AGAIN] = before.ran_again
        if rewrite:
            self.journal.rewrite_settings(record)
        self._noted = _Noted(record)

    def run_chunks(self, workers: Workers) -> RunChunks:
        """Return what runs chunks of cases, and notes what the results say."""
        return self._noted.noting(partial(evaluate_chunks, self.plan, workers=workers))

    def append(self, *batches: Batch) -> None:
        """Write batches, and what their results said."""
        self.journal.append(*batches)
        if self._noted.update(self._record):
            self.journal.rewrite_settings(self._record)

    def recorded(self) -> Batch:
        """Return the outcomes before with their trajectories."""
        before = self.before
        return [] if before is None else [(o, before.trajectory(o.index)) for o in self.history]

    def keep_cases_of(self, other: _Open) -> None:
        """Drop the cases that another campaign of the same cases does not have.

        Raises `UserError` where cases are missing.
        """
        count = len(other.history)
        if self.before is None or [o.case for o in self.history[:count]] != [
            o.case for o in other.history
        ]:
            raise UserError(
                f"{self.journal.folder} has other cases than {other.journal.folder}: take both "
                "from a copy"
            )
        if len(self.history) > count:
            self.journal.keep(self.before, count)

    def ended(self, outcomes: list[Outcome], workers: Workers) -> Run:
        """Run some of all cases a second time; return the campaign."""
        done = Run(self.journal.folder, outcomes)
        run_cases = partial(evaluate, self.plan, workers=workers)
        repeats = repeat(done, self.settings, run_cases, partial(evaluate_anew, self.plan))
        if repeats:
            write_repeats(done, repeats)
        return done


def _run(
    campaign: _Open,
    against: _Open | None = None,
    *,
    workers: Workers,
    on_case: OnCase | None,
    check: Callable[[], None],
    begin: Callable[[], None],
) -> Run:
    """Run what is missing of a campaign, then some cases a second time; export the worst."""
    ended = list(campaign.history)
    with closing(_search(campaign, against, workers, on_case)) as search:
        begin()
        for together in search:
            campaign.append(*together)
            ended += [outcome for batch in together for outcome, _ in batch]
            check()
    done = campaign.ended(ended, workers)
    for outcome in spread_failures(done.cases)[:EXPORTED_FAILURES]:
        folder = done.folder / SCENARIOS / case_name(outcome.index)
        with suppress(TakenError):  # whatever it is, the campaign has ended
            export_case(done, outcome.index, folder, campaign.plan.road)
    return done


def _search(
    campaign: _Open, against: _Open | None, workers: Workers, on_case: OnCase | None
) -> Generator[list[Batch], None, None]:
    """Return what runs the missing cases; it yields batches that ended together."""
    if against is not None:
        return _against(campaign, against, workers, on_case)
    settings, plan, history = campaign.settings, campaign.plan, campaign.history
    sampler = settings.with_repeats(settings.new_sampler(twin_of(settings, plan)))
    motions = None
    if campaign.before is not None and sampler.uses_predictions:
        motions = {o.index: t.motion for o, t in campaign.recorded()}
    run_all = campaign.run_chunks(workers)
    if settings.in_flight is None:
        return _in_batches(settings, sampler, workers, run_all, on_case, history, motions)
    flight = Flight(
        *(sampler, settings.cases, settings.in_flight, history, motions),
        by_rounds(settings.stopping_rule(), settings.in_flight),
    )
    return conduct_in_flight(flight, run_all, workers.chunk_size, on_case)


def _against(
    campaign: _Open, against: _Open, workers: Workers, on_case: OnCase | None
) -> Generator[list[Batch], None, None]:
    """Run the missing cases with both versions; yield the batches of the new one.

    A batch of the earlier version is written before.
    """
    settings = campaign.settings
    twins = twins_of(settings, campaign.plan, against.plan)
    sampler = settings.new_sampler(twins)
    search = PairedSearch(
        sampler, twins if sampler.uses_predictions else None, settings.stopping_rule()
    )
    search.tell(campaign.recorded(), against.recorded())
    both = search.batches(
        *(by_batch(one.run_chunks(workers), workers.chunk_size) for one in (campaign, against)),
        cases=settings.cases,
        batch=settings.batch,
        last=campaign.history[-1] if campaign.history else None,
        on_case=on_case,
    )
    ran = list(against.history)
    for of_new, of_old in both:
        against.append(of_old)
        ran += [outcome for outcome, _ in of_old]
        yield [of_new]
    against.ended(ran, workers)


def _in_batches(
    settings: CampaignSettings,
    sampler: Sampler,
    workers: Workers,
    run_chunks: RunChunks,
    on_case: OnCase | None,
    history: Sequence[Outcome],
    motions: Mapping[int, FloatArray] | None,
) -> Generator[list[Batch], None, None]:
    """Run batch by batch what is missing of a campaign; yield batches that ended together."""
    proposed = proposals(
        settings.with_repeats(settings.new_sampler()),
        *(history, settings.cases, settings.batch),
    )
    missing = settings.cases - len(history)
    with Prefetch(run_chunks, workers.count, proposed, missing, workers.chunk_size) as prefetch:
        batches = conduct(
            *(sampler, prefetch.run, settings.cases, settings.batch),
            *(on_case, history, motions, settings.stopping_rule()),
        )
        yield from prefetch.together(batches)


class _Noted:
    """What the record of a campaign says of its cases: files that were loaded, runs again."""

    def __init__(self, record: Mapping[str, Any]) -> None:
        self._files: dict[str, Files] = {name: dict(record[name] or {}) for name in FILES}
        self._ran_again = record.get(RAN_AGAIN, 0)

    def noting(self, run_chunks: RunChunks) -> RunChunks:
        """Return what runs chunks as `run_chunks` does, and notes what the results say."""

        def run(chunks: Iterable[Sequence[Case]]) -> ChunkResults:
            with closing(run_chunks(chunks)) as ran:
                for first, results in ran:
                    for result in results:
                        self._note(result)
                    yield first, results

        return run

    def _note(self, result: CaseResult) -> None:
        self._ran_again += result.again
        for name, loaded in zip(FILES, (result.files, result.pov_files), strict=True):
            self._files[name] = loaded | self._files[name]  # what was known stays

    def update(self, record: dict[str, Any]) -> bool:
        """Bring a record up to date; return whether it was not."""
        noted: dict[str, object] = {name: known or None for name, known in self._files.items()}
        if self._ran_again:
            noted[RAN_AGAIN] = self._ran_again
        if noted == {name: record.get(name) for name in noted}:
            return False
        record |= noted
        return True


def twin_of(settings: CampaignSettings, plan: SimulationPlan) -> Twin:
    """Return the twin of the VUT."""
    lines = centre_lines(plan.road)
    return Twin(settings.pool, plan.povs, settings.seed, plan.criterion, lines)


def twins_of(settings: CampaignSettings, new: SimulationPlan, old: SimulationPlan) -> TwinPair:
    """Return the twins of both versions of a campaign against an earlier one."""
    return TwinPair(twin_of(settings, new), twin_of(settings, old))


def _plan_in(
    folder: Path, settings: CampaignSettings, plan: SimulationPlan, workers: Workers | None
) -> SimulationPlan:
    """Return the plan of a campaign in its folder, where the log of its drivers is."""
    at_once = settings.batch if SAMPLERS[settings.sampler].learns else settings.cases
    if settings.in_flight is not None:
        at_once = math.ceil(settings.in_flight / (1 if workers is None else workers.count))
    return plan.for_cases(at_once or settings.cases).with_log(folder.resolve() / LOG)


def case_name(index: int) -> str:
    """Return the name of a case's folder."""
    return f"case-{index:05d}"


def export_case(run: Run, index: int, folder: Path, road: Corridor | None = None) -> Path:
    """Write a case of a run as a replay folder; return the path of its SUMO configuration."""
    road = road or road_for(run.scenario)
    return write_scenario(folder, road, run.outcome(index), run.trajectory(index))
