"""Every verb of merge-sumo, once: what the command line calls, and what a notebook calls.

import merge_sumo as ms

run = ms.campaign("design2", cases=400, seed=1)
run.failures        # rows for pandas.DataFrame(run.failures); a table in a notebook
run.report()        # path of the HTML report

A VUT is a spec, as after `--vut`, or a class, a function, or an object with `act` or `act_batch`.
Every verb raises `UserError`, with one sentence, for values and files that do not fit, and where
something stands in the place of what it would write, before it runs anything.
Results print as the command prints them, and `to_record()` is what the command's `--json` prints.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from merge_sumo import options
from merge_sumo.analysis.coordinates import outside_of_the_pool
from merge_sumo.analysis.result import Shown
from merge_sumo.analysis.traffic import named_traffic
from merge_sumo.analysis.verdict import parse_gates
from merge_sumo.api.asked import counter, opened, scenario_of, settings_for, settings_in, stated
from merge_sumo.api.results import (
    CampaignRun,
    CaseRun,
    PolicyChecks,
    TruthResult,
)
from merge_sumo.api.verb import verb
from merge_sumo.campaigns.campaign import (
    SCENARIOS,
    case_name,
    resume_campaign,
    run_campaign,
)
from merge_sumo.campaigns.one_case import ONE, case_of, run_one
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.run import SETTINGS, Run, read_settings
from merge_sumo.campaigns.scenario_suggestion import (
    about,
    kind_of_merge,
    lane_warnings,
    suggested,
    suggested_lane_m,
    unseen,
)
from merge_sumo.campaigns.settings import CampaignSettings, controllers, settings_of
from merge_sumo.drivers.policies import NETWORKS, plays_as, policies_in, policies_of, read_manifest
from merge_sumo.drivers.policies import scenario_of as policies_scenario
from merge_sumo.engine.evaluate import evaluation_workers
from merge_sumo.engine.plan import Engine, SimulationPlan
from merge_sumo.engine.povs import one_level, parse_levels, policies_folder
from merge_sumo.errors import UserError, notice
from merge_sumo.options import AnyPath, AnyRun
from merge_sumo.reports import exports, figures
from merge_sumo.reports.comparison_page import comparison_page
from merge_sumo.reports.export_format import EXPORTS
from merge_sumo.reports.formats import FORMATS
from merge_sumo.reports.junit import check_junit, write_junit, write_junit_of_comparison
from merge_sumo.reports.progress import Bars, CampaignBars
from merge_sumo.reports.repair_page import write_repair
from merge_sumo.reports.report import check_report, write_report
from merge_sumo.reports.reproduction_page import write_reproduction
from merge_sumo.road.drawing import road_svg
from merge_sumo.road.merge import road_for, road_of
from merge_sumo.road.scenario_file import SUFFIX, named_scenario, shipped_scenarios, to_toml
from merge_sumo.samplers.registry import SAMPLERS
from merge_sumo.studies import (
    comparison,
    explanation,
    reproduction,
    vut_check,
)
from merge_sumo.studies import probability as estimates
from merge_sumo.studies import repair as mending
from merge_sumo.studies import stress as ladder
from merge_sumo.studies.comparison import Comparison
from merge_sumo.studies.counterfactuals import avoidance, write_avoidance
from merge_sumo.studies.probability import ProbabilityResult
from merge_sumo.studies.run_study import RunStudy, notice_changes
from merge_sumo.studies.sampler_study import SamplerStudy, Study
from merge_sumo.studies.truth import Repeats
from merge_sumo.studies.vut_check import VutCheck
from merge_sumo.sumo import replay as replayer
from merge_sumo.sumo.binding import scratch_folder
from merge_sumo.sumo.replay import Replay
from merge_sumo.sumo.replay_folder import CONFIG, write_scenario
from merge_sumo.system.folders import (
    check_new,
    check_new_file,
    check_ours,
    check_own,
    dated,
    link_latest,
    make_folder,
    write_new,
)
from merge_sumo.system.interrupt import Stopped, stopping_in_order
from merge_sumo.system.printable import printable, quoted
from merge_sumo.system.records import to_plain
from merge_sumo.system.workers import Workers
from merge_sumo.values.chance import MOST_RUNS
from merge_sumo.values.scenario import LEVELS, US23, MergeScenario, Scenario, level_name
from merge_sumo.values.score import Outcome
from merge_sumo.vuts.base import Car, Seen
from merge_sumo.vuts.built_in import BUILT_IN_VUTS
from merge_sumo.vuts.in_memory import AnyVut, drivers_of, is_here
from merge_sumo.vuts.parameters import Range
from merge_sumo.vuts.python import SeenBatch, installed_vuts
from merge_sumo.vuts.registry import KINDS

if TYPE_CHECKING:
    from merge_sumo.values.case import Case

__all__ = ["AnyRun", "AnyVut", "CampaignRun", "Car", "CaseRun", "Comparison", "Seen", "SeenBatch"]
__all__ += ["benchmark", "campaign", "check_scenario", "check_vut", "compare", "dated", "explain"]
__all__ += ["export", "new_scenario", "open_in_gui", "open_run", "probability", "repair", "replay"]
__all__ += ["report", "reproduce", "rerun", "resume", "run", "scenarios", "stress", "train"]
__all__ += ["truth", "vuts"]

# Campaigns


@verb(options.Campaign)
def campaign(asked: options.Campaign) -> CampaignRun:
    """Test a VUT and return the campaign, also one without failures."""
    settings, where = settings_for(asked)
    folder = dated(settings.vut) if asked.out is None else Path(asked.out)
    plan = resolve(settings)
    _notice_untrained(settings, plan, asked)
    return _concluded(settings, plan, folder, where, asked)


@verb(options.Resume)
def resume(asked: options.Resume) -> CampaignRun:
    """Go on with a campaign that was stopped."""
    folder = _folder_of(asked.run)
    recorded = read_settings(folder)
    fields, where = stated(asked, asked.vut, {name: recorded.get(name) for name in ("vut", "pov")})
    settings = settings_of(folder, recorded, fields, goes_on=True)
    if "level" in asked.given:
        policies = policies_folder(settings.policies, settings.scenario)
        scenario_levels, own = settings.scenario.levels, settings.pov is not None
        levels = parse_levels(str(asked.level), policies, scenario_levels, own=own)
        settings = replace(settings, levels=levels)
    check_report(folder)
    return _concluded(settings, resolve(settings), folder, where, asked, goes_on=True)


def _concluded(
    settings: CampaignSettings,
    plan: SimulationPlan,
    folder: Path,
    where: options.Execution,
    asked: options.SearchOfTest,
    *,
    goes_on: bool = False,
) -> CampaignRun:
    """Run a campaign to its end: cases, counterfactuals, report, JUnit file; return it.

    It begins in a new folder, or goes on in one. An interruption has a note on how to go on.
    """
    gates, junit = list(asked.gates), _path(asked.junit)
    check = asked.check or (lambda: None)
    parse_gates(gates, against=settings.against is not None)
    if junit is not None:
        check_junit(junit, folder)
    if not goes_on:
        check_new(folder)
    bars = CampaignBars(folder, settings.cases, settings.tolerated, shown=where.progress)
    try:
        with opened(where, plan) as workers, bars:

            def begin() -> None:
                bars.begin(_title(settings))

            def case_ended(outcome: Outcome) -> None:
                bars.case_ended(outcome)
                if asked.on_case is not None:
                    asked.on_case(outcome)

            if goes_on:
                done = resume_campaign(
                    *(settings, plan, folder, case_ended),
                    on_before=bars.ran_before,
                    workers=workers,
                    check=check,
                    begin=begin,
                    warn=notice,
                )
            else:
                done = run_campaign(
                    *(settings, plan, folder, case_ended),
                    workers=workers,
                    check=check,
                    begin=begin,
                )
            result = CampaignRun(done, gates)
            _write_findings(result, plan, workers, bars, check, where)
    except (KeyboardInterrupt, Stopped) as stop:
        if folder.exists():
            link_latest(folder)
            again = controllers(asdict(settings)).items()
            named = "".join(f", {name}={spec!r}" for name, spec in again)
            stop.add_note(f"stopped; go on with ms.resume({str(folder)!r}{named})")
        raise
    if junit is not None:
        write_junit(junit, done, result.facts, result.verdict, result.gates)
    return result


def _write_findings(
    result: CampaignRun,
    plan: SimulationPlan,
    workers: Workers,
    bars: CampaignBars,
    check: Callable[[], None],
    where: options.Execution,
) -> None:
    """Write what follows the cases into the folder: counterfactuals and report."""
    done = result.run

    def careful(count: int, total: int) -> None:
        bars.counted("careful drivers", count, total, "failures")

    def page(count: int, total: int) -> None:
        bars.counted("surrogates of the report", count, total, "levels")

    # The careful drivers are models of merges.
    if isinstance(plan.scenario, MergeScenario):
        known = avoidance(done, plan, workers=workers, check=check, on_part=careful)
        if known:
            write_avoidance(done.folder, known)
    explanation.note_explanation(done, plan, workers=workers, check=check)
    link_latest(done.folder)
    write_report(done, result.summary, page)


def _title(settings: CampaignSettings) -> str:
    return f"{settings.vut} v level {'/'.join(map(level_name, settings.levels))}"


def _path(path: AnyPath | None) -> Path | None:
    return None if path is None else Path(path)


def _notice_untrained(
    settings: CampaignSettings, plan: SimulationPlan, asked: options.Campaign
) -> None:
    """Warn with a `Notice` where learned POVs are missing, or were not trained on the scenario."""
    levels = set(LEVELS) & set(settings.scenario.levels)
    if asked.level == "all" and not levels <= set(settings.levels):
        present = ", ".join(map(level_name, settings.levels))
        notice(
            f"`level` all: policies are there for level {present}; `merge-sumo train` makes others"
        )
    learned = {1, 2} & set(settings.levels)
    if learned and unseen(settings.scenario, plan.povs.policies):
        scenario = asked.scenario
        name = scenario.name if isinstance(scenario, Scenario) else str(scenario)
        option = "" if asked.policies is None else f" --policies {quoted(asked.policies)}"
        notice(
            f"note: the POVs of levels 1 and 2 were not trained on {settings.scenario.name}: "
            f"`merge-sumo scenario check {quoted(name)}{option}` says in what it differs"
        )


def open_run(folder: AnyPath) -> CampaignRun:
    """Open the folder of a campaign; `UserError` when it is none."""
    return CampaignRun(folder)


def _opened(run: AnyRun) -> CampaignRun:
    return run if isinstance(run, CampaignRun) else CampaignRun(_folder_of(run))


def _folder_of(run: AnyRun) -> Path:
    return Path(run) if isinstance(run, str | Path) else run.folder


# Cases


@verb(options.Case)
def run(asked: options.Case) -> CaseRun:
    """Run one case and return it."""
    if asked.recorded is not None:
        settings, one = _recorded_case(asked, asked.recorded)
    elif asked.vut is not None:
        settings, one = _given_case(asked, asked.vut, asked.case or {})
    else:
        raise UserError("say with `vut` who drives, or with `recorded` which case of a campaign")
    if asked.out is not None:
        check_new(Path(asked.out))
    if asked.gui:
        replayer.check_display()
    for sentence in outside_of_the_pool(one):
        notice(sentence)
    plan = resolve(settings, debug=asked.debug)
    if asked.recorded is not None:
        notice_changes(_opened(asked.recorded[0]).run, plan)

    result = run_one(plan, one)
    with stopping_in_order(), scratch_folder() as scratch:
        folder = scratch / "case" if asked.out is None else Path(asked.out)
        if asked.gui or asked.out is not None:
            write_scenario(folder, plan.road, result.outcome, result.trajectory)
        if asked.on_end is not None:
            asked.on_end(CaseRun(result))
        if asked.gui:
            replayer.open_gui(folder)
    return CaseRun(result)


def _coordinates(asked: options.Case) -> dict[str, float]:
    """Return the coordinates that are stated."""
    named = {name: getattr(asked, name) for name in options.COORDINATES}
    return {**{n: x for n, x in named.items() if x is not None}, **(asked.at or {})}


def _recorded_case(
    asked: options.Case, recorded: tuple[AnyRun, int]
) -> tuple[CampaignSettings, Case]:
    """Return a case of a campaign with other settings and coordinates, and how it is run."""
    fields, _ = stated(asked, asked.vut, {})
    run = _opened(recorded[0]).run
    before = run.outcome(recorded[1]).case
    number = before.level
    if asked.level is not None:
        policies = policies_folder(asked.policies, run.scenario)
        own = fields.get("pov") is not None
        number = one_level(str(asked.level), policies, run.scenario.levels, own=own)
    settings = settings_of(run.folder, run.settings, {**fields, **ONE, "levels": (number,)})
    names = ("v_vut0_mps", *(d.field for d in settings.scenario.dimensions(number)))
    kept = {name: getattr(before, name) for name in names}
    case = case_of(settings.scenario, number, {**kept, **_coordinates(asked)})
    return settings, replace(case, draw=before.draw)


def _given_case(
    asked: options.Case, vut: AnyVut, row: Mapping[str, Any]
) -> tuple[CampaignSettings, Case]:
    """Return a case by its coordinates, which win over those of a row, and how it is run."""
    spec, pov, _ = drivers_of(vut, asked.pov, 1)
    scenario = scenario_of(asked.scenario, asked.values(options.OfScenario))
    coordinates = {name: row[name] for name in scenario.notation if row.get(name) is not None}
    level = level_name(int(row.get("level", 0))) if asked.level is None else str(asked.level)
    policies = policies_folder(asked.policies, scenario)
    number = one_level(level, policies, scenario.levels, own=pov is not None)
    fields = {"vut": spec, "pov": pov, "levels": (number,), **asked.values(options.Limits), **ONE}
    settings = settings_in(asked, scenario, fields)
    case = case_of(settings.scenario, number, {**coordinates, **_coordinates(asked)})
    return settings, replace(case, draw=_draw_of(row))


def _draw_of(row: Mapping[str, Any]) -> int:
    """Return the draw of a row of a table; an empty field of one with repeats is the first."""
    draw = row.get("draw")
    if draw is None or draw != draw:  # noqa: PLR0124 (NaN of a data frame)
        return 0
    try:
        return int(draw)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"draw is {draw!r:.60}: it must be a whole number") from None


@verb(options.Rerun)
def rerun(asked: options.Rerun) -> Comparison:
    """Run recorded cases again with a changed VUT."""
    before = _opened(asked.run).run
    wanted = _of_level(before, _listed(asked.indices), asked.level)
    total = len(set(wanted) or before.outcomes)
    with _study_of(before, asked, "{vut} again", total) as study:
        return comparison.rerun(study, wanted)


@contextmanager
def _study_of(
    run: Run,
    asked: options.Recorded,
    title: str,
    total: int | Mapping[Engine, int],
    unit: str = "cases",
    *,
    engine: str | None = Engine.SUMO,
) -> Iterator[RunStudy]:
    """Open a campaign for a study that runs cases of it, with a bar that counts `total` of them.

    "{vut}" in the title stands for the VUT; a total may depend on the engine.
    """
    settings, plan, where = _today(run, asked)
    plan = plan.with_engine(engine)
    number = total if isinstance(total, int) else total[plan.engine]
    bar = counter(where, title.format(vut=settings.vut), number, unit)
    with opened(where, plan) as workers, bar:
        yield RunStudy(run, settings, plan, workers, bar.ended)


def _today(
    run: Run, asked: options.Recorded
) -> tuple[CampaignSettings, SimulationPlan, options.Execution]:
    """Return how and where cases of a campaign run today: settings, their plan, and the place."""
    fields, where = stated(asked, asked.vut, {"vut": run.vut})
    settings = settings_of(run.folder, run.settings, fields)
    return settings, resolve(settings), where


def _listed(indices: Iterable[int] | int) -> tuple[int, ...]:
    return tuple(indices) if isinstance(indices, Iterable) else (int(indices),)


def _of_level(run: Run, indices: tuple[int, ...], level: int | str) -> tuple[int, ...]:
    """Return the cases of a level among some, or among all."""
    if str(level) == "all":
        return indices
    by_name = {level_name(number): number for number in run.settings.get("levels", ())}
    if str(level) not in by_name:
        names = ", ".join(by_name)
        raise UserError(f"{run.folder} has no cases at level {level}: it has {names}, or all")
    among = [run.outcome(index) for index in indices] or run.outcomes
    chosen = tuple(o.index for o in among if o.case.level == by_name[str(level)])
    if not chosen:
        raise UserError(f"none of these cases of {run.folder} is of level {level}")
    return chosen


@verb(options.Export)
def export(asked: options.Export) -> list[Path]:
    """Write cases of a campaign for others, and return the paths."""
    loaded = _opened(asked.run).run
    wanted = None if asked.indices is None else list(_listed(asked.indices))
    export_format = FORMATS[asked.file_format]
    if asked.out is None:
        below = dict.fromkeys((SCENARIOS, EXPORTS, export_format.below))
        check_own(*(loaded.folder / name for name in below))
    target = loaded.folder / export_format.below if asked.out is None else Path(asked.out)
    if export_format.write_table is not None:
        wanted = wanted or [outcome.index for outcome in loaded.outcomes]
        return [export_format.write_table(loaded, wanted, target)]
    if not wanted or export_format.write_case is None:
        raise UserError(f"`file_format` {asked.file_format} needs the indices of cases")
    road = road_for(loaded.scenario)
    return list(exports.write_folders(loaded, wanted, target, export_format.write_case, road))


def report(run: AnyRun) -> Shown:
    """Write the report of a campaign again, and return its facts; as `merge-sumo report`."""
    opened = _opened(run)
    path = str(opened.report())
    return Shown({"report": path, "facts": to_plain(opened.facts)}, [path])


def replay(folder: AnyRun, index: int | None = None) -> Replay:
    """Replay a case in SUMO and compare every row with its record; as `merge-sumo replay`.

    Args:
        folder: a scenario folder, or a campaign.
        index: the case of the campaign, which is exported where it is not yet.

    `diverged_at_s` of the result is None where the replay is identical.
    """
    return replayer.replay(_scenario_folder(folder, index))


def open_in_gui(folder: AnyRun, index: int | None = None) -> int:
    """Show a case in sumo-gui until the window is closed; return the exit code of sumo-gui.

    The arguments are those of `replay`. Raises `UserError` without a display.
    """
    return replayer.open_gui(_scenario_folder(folder, index))


def _scenario_folder(folder: AnyRun, index: int | None) -> Path:
    """Return the replay folder of a case, written where it does not exist yet."""
    path = _folder_of(folder)
    if not (path / SETTINGS).is_file():
        if index is not None:
            raise UserError(f"{path} is no campaign, so it has no case {index}: leave that away")
        return path
    if index is None:
        raise UserError(
            f"{path} is a campaign: say which case, as in `merge-sumo replay {quoted(path)} 3`"
        )
    exported = path / SCENARIOS / case_name(index)
    if not (exported / CONFIG).is_file():
        export(folder, index)
    return exported


# Versions of a VUT


@verb(options.Compare)
def compare(asked: options.Compare) -> Comparison:
    """Compare recorded campaigns: what broke, and what was fixed."""
    runs, out, junit = asked.runs, _path(asked.out), _path(asked.junit)
    if isinstance(runs, str | Path | CampaignRun):
        raise UserError("give several campaigns in a list, the oldest first")
    for path in (out, junit):
        if path is not None:
            check_new_file(path)
    versions = [_opened(run).run for run in runs]
    compared = comparison.compare(versions)
    if out is not None:
        write_new(out, comparison_page(compared, versions).encode(errors="backslashreplace"))
    if junit is not None:
        write_junit_of_comparison(junit, compared)
    return compared


# Studies


def _repeats_of(settings: CampaignSettings, repeat: int | None, tolerated: float) -> Repeats | None:
    """Return how often the cases of a truth run; None for once, also where nothing is random."""
    most = repeat if repeat is not None else MOST_RUNS if tolerated else 1
    repeats = Repeats(most, tolerated)
    return repeats if repeats.most > 1 and settings.may_vary else None


@verb(options.Truth)
def truth(asked: options.Truth) -> TruthResult:
    """Find the ground truth of a VUT by uniform cases."""
    settings, where = settings_for(asked)
    with _study(settings, where, asked.engine) as study:
        repeats = _repeats_of(settings, asked.repeat, asked.tolerated)
        by_level = {
            one: study.truth(one, asked.cases, asked.seed, repeats) for one in settings.levels
        }
    if not study.plan.vut.kind.files_are_known and not is_here(settings.vut):
        notice(
            "note: nobody can tell what the program behind this VUT loads; this truth is kept for "
            "its command and the files that are named there"
        )
    return TruthResult(settings.vut, by_level, settings.criterion, asked.tolerated)


@contextmanager
def _study(
    settings: CampaignSettings, where: options.Execution, engine: str | None = None
) -> Iterator[Study]:
    """Open a study; the cache of objects of this process is a passing one.

    Raises `UserError` for an engine that a level does not allow.
    """
    plan = resolve(settings)
    for level in settings.levels:
        plan.at_level(level).with_engine(engine)
    passing = is_here(settings.vut) or is_here(settings.pov or "")
    with (
        opened(where, plan, at_once=True) as workers,
        tempfile.TemporaryDirectory(prefix="merge-sumo-") as folder,
        Bars(shown=where.progress) as bars,
    ):
        cache = Path(folder) if passing else None
        yield Study(plan, workers, cache, bars.counted, engine)


@verb(options.Benchmark)
def benchmark(asked: options.Benchmark) -> SamplerStudy:
    """Compare samplers with each other and with the ground truth."""
    picture = _path(asked.figure)
    if picture is not None:
        figures.check_figure(picture)
    known = SAMPLERS if asked.samplers is None else asked.samplers
    names = list(dict.fromkeys(map(str.strip, known)))
    if not names:
        raise UserError(f"name at least one sampler: {', '.join(SAMPLERS)}")
    settings, where = settings_for(asked, sampler=names[0], cases=asked.cases, batch=asked.batch)
    for name in names[1:]:
        replace(settings, sampler=name)
    if asked.seeds < 1:
        raise UserError(f"`seeds` is {asked.seeds}: it must be 1 or more")
    with _study(settings, where) as study:
        result = study.compare(
            settings.levels,
            names,
            seeds=asked.seeds,
            cases=asked.cases,
            batch=asked.batch,
            truth_cases=asked.truth_cases,
        )
    if picture is None:
        return result
    title = f"{_title(settings)}, {asked.seeds} seeds"
    figures.save(figures.coverage_curves(title, result), picture)
    return replace(result, figure=picture)


@verb(options.Probability)
def probability(asked: options.Probability) -> ProbabilityResult:
    """Estimate how likely the VUT of a campaign is to fail."""
    before = _opened(asked.run).run
    target = before.folder / estimates.RESULT if asked.out is None else Path(asked.out)
    on_road = None if asked.traffic is None else named_traffic(str(asked.traffic))
    total = estimates.DEFAULT_CASES if asked.cases is None else asked.cases
    with _study_of(before, asked, "fresh cases", total, engine=asked.engine) as study:
        found = estimates.failure_probability(
            study,
            target,
            cases=asked.cases,
            distribution=_path(asked.distribution),
            traffic=on_road,
            confidence=asked.confidence,
            seed=asked.seed,
        )
    return ProbabilityResult(found, target, before.criterion)


@verb(options.Stress)
def stress(asked: options.Stress) -> ladder.Stress:
    """Run the cases of a campaign again, each time a little otherwise."""
    before = _opened(asked.run).run
    check_ours(before.folder / ladder.STRESS, ladder.Stress.__struct_fields__)
    total = sum(map(ladder.runs_of, ladder.RUNGS))
    cases = total * sum(outcome.is_tested for outcome in before.outcomes)
    with _study_of(before, asked, "cases again", cases, engine=None) as study:
        return ladder.stress(study)


@verb(options.Repair)
def repair(asked: options.Repair) -> mending.Repair:
    """Search for values of a controller's parameters that repair it."""
    mending.require_optuna()
    if asked.cost not in list(mending.Cost):
        raise UserError(f"`cost` is {asked.cost!r}: choose {' or '.join(mending.Cost)}")
    ranges = tuple(map(Range.parsed, asked.params))
    settings = mending.RepairSettings(
        ranges, mending.Cost(asked.cost), asked.trials, asked.rounds, asked.cases, asked.seed
    )
    before, trials = _opened(asked.run).run, asked.trials
    folder = dated(f"repair-{before.folder.name}") if asked.out is None else Path(asked.out)
    if not asked.resume:
        check_new(folder)
    today, plan, where = _today(before, asked)
    RunStudy(before, today, plan).check_same_system()
    bars: list[Bars] = []

    @contextmanager
    def with_bars() -> Iterator[Workers]:
        with opened(where, plan) as workers, Bars(shown=where.progress) as shown:
            bars[:] = [shown]
            yield workers

    def on_trial(trial: mending.Trial) -> None:
        done = sum(one.round == trial.round for one in search.trials)
        if done <= trials:
            bars[0].counted(f"round {trial.round}", done, trials, "trials")
        else:  # how many the search for the smallest change takes is not known before
            done -= trials
            bars[0].counted(f"round {trial.round}, smallest change", done, done, "trials")

    def fresh(spec: str, number: int) -> Run:
        campaign = folder / mending.CAMPAIGN.format(number)
        of_campaign = mending.fresh_settings(today, settings, spec, number)
        begun = campaign.exists()
        if begun:
            check_report(campaign)
        of_plan = resolve(of_campaign)
        quietly = options.SearchOfTest(check=asked.check)
        return _concluded(of_campaign, of_plan, campaign, where, quietly, goes_on=begun).run

    search = mending.Search(
        *(before, plan.with_engine(None), settings),
        partial(mending.RepairJournal, folder, resume=asked.resume),
        open_workers=with_bars,
        check=asked.check or (lambda: None),
        on_trial=on_trial,
    )
    found = search.repaired(fresh, folder)
    write_repair(found, before)
    return found


@verb(options.Explain)
def explain(asked: options.Explain) -> explanation.ExplanationResult:
    """Find the smallest changes with which a failure passes."""
    before = _opened(asked.run).run
    target = before.folder / explanation.EXPLANATIONS
    check_ours(target, explanation.Explanation.__struct_fields__)
    failure = explanation.failure_of(before, asked.case)
    ranges = tuple(map(Range.parsed, asked.params))
    with _study_of(before, asked, "explained", 1, "failures", engine=None) as study:
        found = explanation.explain(study, failure, ranges)
    return explanation.ExplanationResult(before, found, target)


@verb(options.Reproduce)
def reproduce(asked: options.Reproduce) -> reproduction.Reproduction:
    """Reproduce Table II and the figures of the paper."""
    count = (2 if asked.quick else 10) if asked.seeds is None else asked.seeds
    scale = reproduction.quick(count) if asked.quick else reproduction.Scale(seeds=count)
    trained = policies_folder(asked.policies, US23)
    folder = dated("reproduce") if asked.out is None else Path(asked.out)
    figures.require_matplotlib()
    with evaluation_workers(asked.workers) as workers, Bars(shown=asked.progress) as bars:
        make_folder(folder)
        result = reproduction.reproduce(
            scale, policies=trained, workers=workers, on_part=bars.counted
        )
    return replace(result, page=write_reproduction(result, folder))


# What a person brings: VUTs, scenarios, learned drivers


@verb(options.Vuts)
def vuts(asked: options.Vuts) -> Shown:
    """Return the VUTs that can be tested, and the kinds that a person can bring."""
    policies = asked.policies
    trained = read_manifest(policies_of(US23) if policies is None else policies_in(policies))
    built_in = [name for name, vut in BUILT_IN_VUTS.items() if vut.network in ("", *trained)]
    kinds = [kind for kind in KINDS.values() if kind.form]
    names = {"built in": built_in, "installed": list(installed_vuts())}
    listed = [{"form": kind.form, "what": kind.what, "example": kind.example} for kind in kinds]
    lines = [f"{title}: {', '.join(known)}" for title, known in names.items() if known]
    for kind in kinds:
        lines += [kind.form, f"    {kind.what}", f"    {kind.example}"]
    return Shown({**names, "kinds": listed}, lines)


@verb(options.CheckVut)
def check_vut(asked: options.CheckVut) -> VutCheck:
    """Let a VUT drive a few cases and say what is wrong with it."""
    spec, _, _ = drivers_of(asked.vut, None, 1)
    driven = US23 if asked.scenario is None else scenario_of(asked.scenario)
    policies = None if asked.policies is None else str(asked.policies)
    limits = asked.values(options.Limits)
    settings = CampaignSettings(vut=spec, levels=(0,), scenario=driven, policies=policies, **limits)
    plan = resolve(settings)
    with Bars() as bars:
        bars.say(f"{printable(spec)} drives a few cases: minutes, where a step takes seconds")
        return vut_check.check_vut(plan)


def scenarios() -> Shown:
    """Return the scenarios that the package brings, by name; as `merge-sumo scenario list`."""
    shipped = {name: named_scenario(name) for name in shipped_scenarios()}
    lines = []
    for name, scenario in shipped.items():
        x, v = scenario.dimensions(0)[:2]
        line = f"{name}: POV from {x.low:g} to {x.high:g} m at {v.low:g} to {v.high:g} m/s"
        if isinstance(scenario, MergeScenario) and scenario.lane_m is not None:
            begin_m, end_m = scenario.lane_m
            line += f"; acceleration lane from {begin_m:g} to {end_m:g} m"
        lines.append(line)
    return Shown({name: scenario.to_record() for name, scenario in shipped.items()}, lines)


@verb(options.NewScenario)
def new_scenario(asked: options.NewScenario) -> Shown:
    """Write a scenario for a merge in a net, and a picture of the road."""
    file, net = Path(asked.file), Path(asked.net)
    if file.suffix != SUFFIX:
        raise UserError(f"{file} is to be a scenario: name it NAME{SUFFIX}")
    picture = file.with_suffix(".svg")
    edges = tuple(asked.mainline.split()), tuple(asked.ramp.split())
    for path in (file, picture):
        check_new_file(path, "FILE")
    road = road_of(net, *edges)
    if not asked.point:
        road = road_of(net, *edges, lane_m=suggested_lane_m(road))
    scenario, found = suggested(road, file.stem), [*about(road), *kind_of_merge(road)]
    relative = os.path.relpath(net.resolve(), file.parent.resolve())
    write_new(picture, road_svg(road, scenario), "FILE")
    text = to_toml(replace(scenario, net=relative), found)
    write_new(file, text.encode(), "FILE")
    lines = [*found, f"written: {file}, and its picture {picture}"]
    return Shown({"about": found, "written": [str(file), str(picture)]}, lines)


@verb(options.CheckScenario)
def check_scenario(asked: options.CheckScenario) -> Shown:
    """Say whether a scenario can be hosted, and whether the learned drivers were trained on it."""
    scenario, policies = asked.scenario, asked.policies
    folder = None if policies is None else policies_in(policies)
    checked = scenario_of(scenario)
    name = checked.name if isinstance(scenario, Scenario) else str(scenario)
    found = road_for(checked)
    road, differing = about(found), unseen(checked, folder)
    warnings = lane_warnings(checked, found)
    lines = ["the learned drivers (levels 1 and 2) were trained on such starts, or on like ones"]
    if not isinstance(checked, MergeScenario):
        lines = []
    elif differing:
        made = quoted(f"{checked.name}-policies")
        lines = [
            "the learned drivers (levels 1 and 2) were trained elsewhere; here they extrapolate:",
            *(f"  {sentence}" for sentence in differing),
            f"train them: merge-sumo train --scenario {quoted(name)} --out {made}",
            f"then add to a campaign: --policies {made}",
        ]
    said = [*road, *(f"warning: {sentence}" for sentence in warnings), *lines]
    return Shown({"about": road, "warnings": warnings, "unseen": differing}, said)


@verb(options.Train)
def train(asked: options.Train) -> PolicyChecks:
    """Train the learned drivers in SUMO and return what each loses, by the name of the network."""
    scenario, check = asked.scenario, asked.check
    played = US23 if scenario is None else scenario_of(scenario)
    folder = Path(asked.out) if asked.out is not None else policies_of(played)
    if asked.out is None and not check and not plays_as(played, US23):
        raise UserError(
            f"the shipped policies are for {US23.name}: say with `out` where those for "
            f"{played.name} are to go"
        )
    names = _networks(asked.only)
    for package in ("torch", "gymnasium"):
        if find_spec(package) is None:
            raise UserError(
                f"training needs {package}, which is not installed: run "
                "`pip install 'merge-sumo[train]'`"
            )
    from merge_sumo.training.check import PolicyCheck, check_policy
    from merge_sumo.training.helix import TrainingProgress, train_library

    if not check:
        with Bars(shown=asked.progress) as bars:

            def progressed(now: TrainingProgress) -> None:
                title = f"{now.network} {now.stage}"
                bars.counted(title, now.done, now.total, "updates", now.note)

            train_library(
                *(folder, names, asked.seed),
                scenario=played,
                a_min_mps2=asked.a_min,
                on_progress=progressed,
                on_done=lambda name, check: bars.say(
                    f"{name} is {'there already' if check is None else 'ready'}"
                ),
            )
    manifest = _manifest_for(folder, names, scenario)
    if check:
        checks = {n: check_policy(n, folder, count=asked.cases, scenario=played) for n in names}
        return PolicyChecks(checks)
    return PolicyChecks({n: PolicyCheck(**manifest[n]["check"]) for n in names})


def _networks(only: Iterable[str] | None) -> tuple[str, ...]:
    """Return the names of networks in their order, all for none; `UserError` for an unknown one."""
    wanted = set(only or ()) or set(NETWORKS)
    unknown = wanted - set(NETWORKS)
    if unknown:
        raise UserError(f"there is no network {min(unknown)!r}: choose {', '.join(NETWORKS)}")
    return tuple(name for name in NETWORKS if name in wanted)


def _manifest_for(
    folder: Path, names: Iterable[str], scenario: Scenario | AnyPath | None
) -> Mapping[str, Any]:
    """Return the manifest of a folder of networks; `UserError` for a missing one or scenario."""
    manifest = read_manifest(folder)
    missing = [name for name in names if name not in manifest]
    if missing:
        raise UserError(f"{folder} has no {missing[0]}: run `merge-sumo train` to make it")
    trained_for = policies_scenario(manifest[next(iter(names))])
    if scenario is None and not plays_as(trained_for, US23):
        raise UserError(
            f"{folder} was trained for {trained_for.name}: say with `scenario` in which one to "
            f"check it, or {US23.name}"
        )
    return manifest
