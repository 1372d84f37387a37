"""The conductor: a sampler proposes, the world runs, the journal remembers."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from merge_sumo.campaigns.journal import Journal
from merge_sumo.campaigns.ownership import FILES
from merge_sumo.campaigns.plan import plan_of
from merge_sumo.campaigns.prefetch import Ahead, proposals
from merge_sumo.campaigns.repeats import repeat, write_repeats
from merge_sumo.campaigns.run import RAN_AGAIN, SETTINGS, Run, spread_failures
from merge_sumo.campaigns.settings import (
    RECORDED_BY_DEFAULT,
    CampaignSettings,
    record_of,
    settings_of,
)
from merge_sumo.campaigns.transfer import lessons
from merge_sumo.engine.simulator import (
    CaseResult,
    OnWorkers,
    RunCases,
    SimulationPlan,
    road_for,
    runs_on,
)
from merge_sumo.engine.versions import differences
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.road.corridor import Corridor
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.sumo.replay_folder import write_scenario
from merge_sumo.system.folders import check_new, check_own
from merge_sumo.system.hashing import sha256_of
from merge_sumo.system.workers import Workers, open_workers
from merge_sumo.twin.twin import Twin
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import Trajectory
from merge_sumo.vuts.files import Files
from merge_sumo.vuts.output import LOG

EXPORTED_FAILURES: Final = 10
SCENARIOS: Final = "scenarios"
FORCED: Final = "forced"
"""Key of `campaign.json`: what differed where a campaign went on with --force."""
SEAL: Final = "seal"
"""Key of `campaign.json` in folders of version 0.1; it means nothing any more."""

OnCase = Callable[[Outcome], None]
"""Told of every case as it ends, in the order in which cases end."""


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
    """Ask, run, tell, batch by batch; yield what each batch gave, in order of the cases.

    Without a `batch`, the sampler says how many cases it wants. It ends after `cases`, or earlier
    where `stop` says so of the outcomes so far. A campaign goes on after `history`, whole batches
    of its own outcomes: the sampler is told them, and as it is pure in what it was told, it
    proposes what it would have proposed then. One that uses_predictions is told the `motions`,
    (T + 1, A, 3), of the history by index, too.
    """
    sampler.tell(history, motions)
    number, first = (history[-1].batch + 1 if history else 0), len(history)
    while first < cases and not (stop is not None and stop(sampler.observed())):
        ran: list[tuple[Outcome, Trajectory]] = []
        for place, done in run(sampler.ask(min(batch or sampler.batch_size(), cases - first))):
            case, prediction = done.trajectory.case, sampler.prediction(place)
            index, margin = first + place, done.margin
            outcome = Outcome(index, number, case, done.measures, prediction, margin)
            ran.append((outcome, done.trajectory))
            if on_case is not None:
                on_case(outcome)
        ran.sort(key=lambda pair: pair[0].index)
        sampler.tell([o for o, _ in ran], {o.index: t.motion for o, t in ran})
        yield ran
        number, first = number + 1, first + len(ran)


def run_campaign(
    settings: CampaignSettings,
    folder: Path,
    net: Corridor | None = None,
    on_case: OnCase | None = None,
    *,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
) -> Run:
    """Run a campaign into a new folder and return it.

    Same settings, same versions: same `outcomes.jsonl`, whatever the workers. The worst failures
    are exported as folders that sumo-gui opens. Raises `UserError` when the folder exists.

    Args:
        settings: what to run.
        folder: where to.
        net: the road, by default the shipped one.
        on_case: told of every case.
        workers: where cases run, by default in this process.
        check: called after every batch; may raise to stop there, and `resume_campaign` goes on.
    """
    check_new(folder)
    check_new(folder / SCENARIOS / case_name(settings.cases))
    net = net or road_for(settings.scenario)
    with workers_or_here(workers) as there:
        run = runs_on(there, _plan(settings, net, folder))
        record = record_of(settings, net)
        with Journal.create(folder, record) as journal:
            return _go_on(settings, record, net, journal, run, None, on_case, check)


def resume_campaign(
    folder: Path,
    net: Corridor | None = None,
    on_case: OnCase | None = None,
    *,
    on_before: OnCase | None = None,
    given: Mapping[str, object] | None = None,
    force: bool = False,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
    warn: Callable[[str], None] = lambda _: None,
    trust: bool = False,
) -> Run:
    """Go on with a campaign that was stopped, however it was; return it as `run_campaign` does.

    The result is the same to the last byte as if it had never been stopped; also where more cases
    are `given` than it had, if those ended with a whole batch. Raises `UserError` with the name of
    the field where something differs that decides outcomes: settings that are `given`, versions,
    net, policies. With `force` it goes on and records that they did.

    Args:
        folder: where the campaign is.
        net: the net with which it was started, by default the shipped one.
        on_case: told of every case, also of those that ran before, unless there is an
        on_before: told of those.
        given: settings that a person named again, by their names in `CampaignSettings`.
        force: go on although something differs.
        workers: where cases run, by default in this process.
        check: called after every batch; may raise to stop there.
        warn: told in a sentence what was dropped.
        trust: run the controller that the folder names although the folder may be a stranger's.
    """
    check_own(folder / SCENARIOS)
    journal, before, dropped = Journal.reopen(folder)
    net = net or road_for(before.scenario)
    with journal, workers_or_here(workers) as there:
        recorded = {k: v for k, v in before.settings.items() if k not in (FORCED, RAN_AGAIN, SEAL)}
        settings = settings_of(folder, before.settings, given, trust=trust)
        record = record_of(settings, net)
        # Where policies are decides nothing: what is in them does.
        moved = recorded.get("policies") != record["policies"]
        recorded["policies"] = record["policies"]
        # What was loaded while it ran must be the same, too, although it is not loaded yet.
        for name in FILES:
            record[name] = _files_again(recorded, name, record[name] or {}) or None
        was = recorded.get("cases")
        grown = isinstance(was, int) and was < settings.cases
        if grown:  # which cases come next does not depend on how many there are to be
            recorded["cases"] = settings.cases
        changes = differences(RECORDED_BY_DEFAULT | recorded, record)
        if before.criterion != settings.criterion:
            raise UserError(
                f"in {folder} a case fails when {before.criterion.text}, and not when "
                f"{settings.criterion.text}: a campaign has one criterion; begin another one"
            )
        if changes and not force:
            name, (was, now) = next(iter(changes.items()))
            raise UserError(
                f"{name} differs: {folder} was run with {was}, now it is {now}; make it the same, "
                "or go on with --force, which is recorded"
            )
        if dropped:
            warn(f"{folder}: dropped {dropped} outcomes of a batch that was stopped; it runs again")
        run = runs_on(there, _plan(settings, net, folder))
        if before.settings.get(FORCED) or changes:
            forced = {"from_case": len(before.outcomes), "differs": changes}
            record[FORCED] = [*_forced(before), *([forced] if changes else [])]
        if before.ran_again:
            record[RAN_AGAIN] = before.ran_again
        if changes or moved or grown:
            journal.rewrite_settings(record)
        else:
            journal.note_own(record)
        told = on_before or on_case
        if told is not None:
            for outcome in before.outcomes:
                told(outcome)
        return _go_on(settings, record, net, journal, run, before, on_case, check)


def _files_again(recorded: Mapping[str, Any], name: str, known: Files) -> Files:
    """Return the files that a record names as they are now, and those that are known by now.

    A name in the record is relative to where the campaign was begun, which may be elsewhere.
    """
    files = recorded.get(name)
    again: Files = {}
    for file in files if isinstance(files, dict) else {}:
        try:
            now = sha256_of(Path(file))
        except ValueError as error:
            raise UserError(f"{SETTINGS} has a file that no file can be named: {error}") from error
        same = [other for other in known if other.endswith(f"/{file}")]
        if now is None and same:
            now, known = known[same[0]], {k: v for k, v in known.items() if k != same[0]}
        again[file] = now
    return again | known


def _go_on(
    settings: CampaignSettings,
    record: dict[str, Any],
    net: Corridor,
    journal: Journal,
    run: OnWorkers,
    before: Run | None,
    on_case: OnCase | None,
    check: Callable[[], None],
) -> Run:
    taught = lessons(settings.learn_from, settings.scenario)
    others = [motion for motions in taught.values() for motion in motions]
    games = Twin(
        settings.pool,
        settings.povs,
        settings.seed,
        others,
        settings.criterion,
        centre_lines(net),
    )
    sampler = make_sampler(settings.sampler, settings.pool, settings.seed, games)
    stop = settings.stopping_rule()
    files: dict[str, Files] = {name: dict(record[name] or {}) for name in FILES}
    again = record.get(RAN_AGAIN, 0)

    def noting_files(cases: Sequence[Case]) -> Iterator[tuple[int, CaseResult]]:
        nonlocal again
        for place, done in ahead(cases):
            again += done.again
            for name, loaded in zip(FILES, (done.files, done.pov_files), strict=True):
                files[name] = loaded | files[name]  # what was known stays
            yield place, done

    history = [] if before is None else before.outcomes
    ended: list[Outcome] = []
    motions = None
    if before is not None and sampler.uses_predictions:
        motions = {o.index: before.trajectory(o.index).motion for o in history}
    scout = make_sampler(settings.sampler, settings.pool, settings.seed)
    proposed = proposals(scout, history, settings.cases, settings.batch)
    with Ahead(run, proposed, settings.cases - len(history)) as ahead:
        batches = conduct(
            sampler,
            noting_files,
            settings.cases,
            settings.batch,
            on_case,
            history,
            motions,
            stop,
        )
        for ran in ahead.together(batches):
            journal.append(*ran)
            ended += [outcome for batch in ran for outcome, _ in batch]
            noted: dict[str, object] = {name: known or None for name, known in files.items()}
            if again:
                noted[RAN_AGAIN] = again
            if noted != {name: record.get(name) for name in noted}:
                record |= noted
                journal.rewrite_settings(record)
            check()
    done = Run(journal.folder, [*history, *ended])
    repeats = repeat(done, settings, run)
    if repeats:
        write_repeats(done, repeats)
    for outcome in spread_failures(done.outcomes)[:EXPORTED_FAILURES]:
        folder = journal.folder / SCENARIOS / case_name(outcome.index)
        if not os.path.lexists(folder):  # written whole, before the campaign was stopped
            export_case(done, outcome.index, folder, net)
    return done


@contextmanager
def workers_or_here(workers: Workers | None) -> Iterator[Workers]:
    """Give the workers, which stay open, or this process as the only one."""
    if workers is not None:
        yield workers
        return
    with open_workers(1) as here:
        yield here


def _plan(settings: CampaignSettings, net: Corridor, folder: Path) -> SimulationPlan:
    log = folder.resolve() / LOG
    at_once = settings.batch if SAMPLERS[settings.sampler].learns else settings.cases
    return plan_of(settings, net, cases=at_once or settings.cases, log=log)


def _forced(run: Run) -> list[Any]:
    forced = run.settings.get(FORCED, [])
    return forced if isinstance(forced, list) else [forced]


def case_name(index: int) -> str:
    """Return the name of a case's folder."""
    return f"case-{index:05d}"


def export_case(run: Run, index: int, folder: Path, net: Corridor | None = None) -> Path:
    """Write a case of a run as a replay folder; return the path of its SUMO configuration."""
    road = net or road_for(run.scenario)
    return write_scenario(folder, road, run.outcome(index), run.trajectory(index))
