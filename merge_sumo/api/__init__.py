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
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from merge_sumo.analysis.coordinates import outside_of_the_pool
from merge_sumo.analysis.result import Shown
from merge_sumo.analysis.traffic import named_traffic
from merge_sumo.analysis.verdict import parse_gates
from merge_sumo.api.keywords import (
    CampaignKeywords,
    CaseKeywords,
    Hosting,
    RerunKeywords,
    Runner,
    Running,
    Setup,
    StudyKeywords,
    check_keywords,
    given_again,
    recordable,
    runner_of,
    scenario_of,
    settings_for,
    with_criterion,
)
from merge_sumo.api.results import (
    CampaignRun,
    CaseRun,
    PolicyChecks,
    TruthResult,
)
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
from merge_sumo.errors import Notice, UserError
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
from merge_sumo.road.finder import find_corridor
from merge_sumo.road.merge import road_for, road_of
from merge_sumo.road.netfile import NetFile
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
from merge_sumo.sumo.conversion import command_for, is_map, net_of_map
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
from merge_sumo.system.interrupt import Stopped
from merge_sumo.system.printable import printable, quoted
from merge_sumo.system.records import to_plain
from merge_sumo.system.workers import Workers
from merge_sumo.values.chance import MOST_RUNS
from merge_sumo.values.episode import Episode
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

__all__ = ["AnyRun", "AnyVut", "CampaignRun", "Car", "CaseKeywords", "CaseRun", "Hosting"]
__all__ += ["Comparison", "Seen", "SeenBatch", "Setup", "campaign"]
__all__ += ["check_scenario", "check_vut", "compare", "dated"]
__all__ += ["benchmark", "export"]
__all__ += [
    "explain",
    "new_scenario",
    "open_in_gui",
    "open_run",
]
__all__ += ["probability", "repair", "replay", "report", "reproduce", "rerun", "resume"]
__all__ += ["run", "scenarios", "stress", "train", "truth", "vuts"]

AnyPath = Path | str
AnyRun = CampaignRun | Path | str
"""A campaign, or its folder."""


# Campaigns


def campaign(
    vut: AnyVut,
    *,
    out: AnyPath | None = None,
    **given: Unpack[CampaignKeywords],
) -> CampaignRun:
    """Test a VUT and return the campaign; the same as `merge-sumo campaign`.

    Args:
        vut: vehicle under test: a spec, a class, a function, or an object.
        out: new folder to write; `runs/<vut>-<date>` by default.
        given: which cases are chosen (`level`, `against`, `sampler`, `cases`, `batch`, `in_flight`,
            `seed`, `stop_when_converged`), how a case is run
            and judged (`scenario`, `follow_up_s`, `fail_when`, `require`, `policies`, `pov`,
            `deadline_s`, `vut_memory_gib`), where it runs
            (`workers`), and who is told (`progress`, `on_case`, `check`, `gates`, `junit`);
            see `CampaignKeywords`.

    An interrupted campaign goes on with `resume`.
    """
    check_keywords("campaign", given, CampaignKeywords)
    settings, runner = settings_for(vut, given)
    folder = dated(settings.vut) if out is None else Path(out)
    plan = resolve(settings)
    _notice_untrained(settings, plan, given)
    return _concluded(settings, plan, folder, runner)


def resume(
    run: AnyRun,
    *,
    vut: AnyVut | None = None,
    **given: Unpack[CampaignKeywords],
) -> CampaignRun:
    """Go on with a campaign that was stopped; the same as `merge-sumo campaign --resume`.

    Args:
        run: the campaign, or its folder.
        vut: the VUT again, where it is code of your own: a run folder names no code to run. So
            with `pov` and `against`. Of an object only its name tells that it is the same.
        given: as of `campaign`. The settings must be those of the campaign: `cases` may be more.
    """
    check_keywords("resume", given, CampaignKeywords)
    folder = run.folder if isinstance(run, CampaignRun) else Path(run)
    recorded = read_settings(folder)
    named = {name: one for name, one in given.items() if one is not None or name == "workers"}
    fields, runner = given_again(vut, named, {name: recorded.get(name) for name in ("vut", "pov")})
    settings = settings_of(folder, recorded, fields, goes_on=True)
    if "level" in named:
        policies = policies_folder(settings.policies, settings.scenario)
        scenario_levels, own = settings.scenario.levels, settings.pov is not None
        levels = parse_levels(str(named["level"]), policies, scenario_levels, own=own)
        settings = replace(settings, levels=levels)
    check_report(folder)
    return _concluded(settings, resolve(settings), folder, runner, goes_on=True)


def _concluded(
    settings: CampaignSettings,
    plan: SimulationPlan,
    folder: Path,
    runner: Runner,
    *,
    goes_on: bool = False,
) -> CampaignRun:
    """Run a campaign to its end: cases, counterfactuals, report, JUnit file; return it.

    It begins in a new folder, or goes on in one. An interruption has a note on how to go on.
    """
    gates = list(runner.gates)
    parse_gates(gates, against=settings.against is not None)
    junit = _path(runner.junit)
    if junit is not None:
        check_junit(junit, folder)
    if not goes_on:
        check_new(folder)
    bars = CampaignBars(folder, settings.cases, settings.tolerated, shown=runner.progress)
    try:
        with runner.open(plan) as opened, bars:

            def begin() -> None:
                bars.begin(_title(settings))

            def case_ended(outcome: Outcome) -> None:
                bars.case_ended(outcome)
                if runner.on_case is not None:
                    runner.on_case(outcome)

            if goes_on:
                done = resume_campaign(
                    *(settings, plan, folder, case_ended),
                    on_before=bars.ran_before,
                    workers=opened,
                    check=runner.checks,
                    begin=begin,
                    warn=_notice,
                )
            else:
                done = run_campaign(
                    *(settings, plan, folder, case_ended),
                    workers=opened,
                    check=runner.checks,
                    begin=begin,
                )
            result = CampaignRun(done, gates)
            _write_findings(result, plan, opened, bars, runner)
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
    result: CampaignRun, plan: SimulationPlan, opened: Workers, bars: CampaignBars, runner: Runner
) -> None:
    """Write what follows the cases into the folder: counterfactuals and report."""
    done, checks = result.run, runner.checks

    def careful(count: int, total: int) -> None:
        bars.counted("careful drivers", count, total, "failures")

    def page(count: int, total: int) -> None:
        bars.counted("surrogates of the report", count, total, "levels")

    # The careful drivers are models of merges.
    if isinstance(plan.scenario, MergeScenario):
        known = avoidance(done, plan, workers=opened, check=checks, on_part=careful)
        if known:
            write_avoidance(done.folder, known)
    explanation.note_explanation(done, plan, workers=opened, check=checks)
    link_latest(done.folder)
    write_report(done, result.summary, page)


def _notice(sentence: str) -> None:
    warnings.warn(sentence, Notice, stacklevel=2)


def _title(settings: CampaignSettings) -> str:
    return f"{settings.vut} v level {'/'.join(map(level_name, settings.levels))}"


def _path(path: AnyPath | None) -> Path | None:
    return None if path is None else Path(path)


def _notice_untrained(
    settings: CampaignSettings, plan: SimulationPlan, given: CampaignKeywords
) -> None:
    """Warn with a `Notice` where learned POVs are missing, or were not trained on the scenario."""
    levels = set(LEVELS) & set(settings.scenario.levels)
    if given.get("level", "all") == "all" and not levels <= set(settings.levels):
        present = ", ".join(map(level_name, settings.levels))
        warnings.warn(
            f"--level all: policies are there for level {present}; `merge-sumo train` makes others",
            Notice,
            stacklevel=3,
        )
    learned = {1, 2} & set(settings.levels)
    if learned and unseen(settings.scenario, plan.povs.policies):
        scenario, policies = given.get("scenario", US23), given.get("policies")
        name = scenario.name if isinstance(scenario, Scenario) else str(scenario)
        option = "" if policies is None else f" --policies {quoted(policies)}"
        warnings.warn(
            f"note: the POVs of levels 1 and 2 were not trained on {settings.scenario.name}: "
            f"`merge-sumo scenario check {quoted(name)}{option}` says in what it differs",
            Notice,
            stacklevel=3,
        )


def open_run(folder: AnyPath) -> CampaignRun:
    """Open the folder of a campaign; `UserError` when it is none."""
    return CampaignRun(folder)


def _opened(run: AnyRun) -> CampaignRun:
    return run if isinstance(run, CampaignRun) else CampaignRun(run)


# Cases


def run(
    vut: AnyVut | None = None,
    case: Mapping[str, Any] | None = None,
    *,
    recorded: tuple[AnyRun, int] | None = None,
    level: int | str | None = None,
    debug: bool = False,
    gui: bool = False,
    out: AnyPath | None = None,
    on_end: Callable[[CaseRun], None] | None = None,
    **given: Unpack[CaseKeywords],
) -> CaseRun:
    """Run one case and return it; the same as `merge-sumo run`.

    Args:
        vut: vehicle under test, as of `campaign`; with `recorded`, the campaign's by default, if it
            is of this package or of SUMO.
        case: a row of `run.cases` or `run.failures`: default of level and coordinates.
        recorded: a campaign, or its folder, and the index of its case: default of everything.
        level: POV level 0, 1 or 2, or "own" for a `pov`; by default that of the case, else 0.
        debug: run the VUT in this process without a deadline, so that breakpoints work.
        gui: show it in sumo-gui while it runs; returns when the window is closed.
        out: new folder to keep it in.
        on_end: called with the result when the case has ended, before a window is closed.
        given: coordinates `x_pov0_m`, `v_pov0_mps`, at level 2 `svo_rad`, and others that the
            scenario has: `v_vut0_mps`, `headway_ahead_s`, `headway_behind_s`, those of another
            kind of scenario; and the keywords of `Setup`, as of `campaign`.
    """
    setup = {name: value for name, value in given.items() if name in Setup.__optional_keys__}
    values = {
        name: value for name, value in given.items() if name not in setup and value is not None
    }
    if recorded is not None:
        settings, one = _recorded_case(vut, recorded, level, setup, values)
    elif vut is not None:
        settings, one = _given_case(vut, case or {}, level, setup, values)
    else:
        raise UserError("say with --vut who drives, or with --case which recorded case")
    if out is not None:
        check_new(Path(out))
    for sentence in outside_of_the_pool(one):
        warnings.warn(sentence, Notice, stacklevel=2)
    plan = resolve(settings, debug=debug)
    if recorded is not None:
        notice_changes(_opened(recorded[0]).run, plan)

    def ended(result: Episode) -> None:
        if out is not None:
            write_scenario(Path(out), plan.road, result.outcome, result.trajectory)
        if on_end is not None:
            on_end(CaseRun(result))

    return CaseRun(run_one(plan, one, live=gui, on_end=ended))


def _recorded_case(
    vut: AnyVut | None,
    recorded: tuple[AnyRun, int],
    level: int | str | None,
    setup: Mapping[str, Any],
    values: Mapping[str, Any],
) -> tuple[CampaignSettings, Case]:
    """Return a case of a campaign with other settings and coordinates, and how it is run."""
    fields, _ = given_again(vut, setup, {})
    run = _opened(recorded[0]).run
    before = run.outcome(recorded[1]).case
    number = before.level
    if level is not None:
        policies = policies_folder(setup.get("policies"), run.scenario)
        own = fields.get("pov") is not None
        number = one_level(str(level), policies, run.scenario.levels, own=own)
    settings = settings_of(run.folder, run.settings, {**fields, **ONE, "levels": (number,)})
    names = ("v_vut0_mps", *(d.field for d in settings.scenario.dimensions(number)))
    kept = {name: getattr(before, name) for name in names}
    case = case_of(settings.scenario, number, {**kept, **values})
    return settings, replace(case, draw=before.draw)


def _given_case(
    vut: AnyVut,
    row: Mapping[str, Any],
    level: int | str | None,
    setup: Mapping[str, Any],
    values: Mapping[str, Any],
) -> tuple[CampaignSettings, Case]:
    """Return a case by its coordinates, which win over those of a row, and how it is run."""
    fields, _ = given_again(vut, {"scenario": US23, **setup}, {})
    fields = with_criterion(fields)
    scenario, own = fields["scenario"], fields.get("pov") is not None
    coordinates = {name: row[name] for name in scenario.notation if row.get(name) is not None}
    name = level_name(int(row.get("level", 0))) if level is None else str(level)
    policies = policies_folder(setup.get("policies"), scenario)
    number = one_level(name, policies, scenario.levels, own=own)
    settings = CampaignSettings(**fields, **ONE, levels=(number,))
    case = case_of(settings.scenario, number, {**coordinates, **values})
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


def rerun(
    run: AnyRun,
    indices: Iterable[int] | int = (),
    *,
    level: int | str | None = None,
    **given: Unpack[RerunKeywords],
) -> Comparison:
    """Run recorded cases again with a changed VUT; the same as `merge-sumo rerun`.

    Args:
        run: the campaign, or its folder.
        indices: its cases; all of them by default.
        level: only the cases with a POV of this level; "all" by default.
        given: how the drivers run, where it is to change, and where the cases run: see
            `RerunKeywords`.
    """
    check_keywords("rerun", given, RerunKeywords)
    before = _opened(run).run
    wanted = _of_level(before, _listed(indices), level)
    total = len(set(wanted) or before.outcomes)
    with _study_of(before, given, "{vut} again", total) as study:
        return comparison.rerun(study, wanted)


@contextmanager
def _study_of(
    run: Run,
    given: RerunKeywords,
    title: str,
    total: int | Mapping[Engine, int],
    unit: str = "cases",
    *,
    engine: str | None = Engine.SUMO,
) -> Iterator[RunStudy]:
    """Open a campaign for a study that runs cases of it, with a bar that counts `total` of them.

    "{vut}" in the title stands for the VUT; a total may depend on the engine.
    """
    # Whoever calls the verb: between are the verb, `with`, this function and the two below.
    settings, plan, runner = _today(run, given, stacklevel=7)
    plan = plan.with_engine(engine)
    number = total if isinstance(total, int) else total[plan.engine]
    counter = runner.counter(title.format(vut=settings.vut), number, unit)
    with runner.open(plan) as opened, counter:
        yield RunStudy(run, settings, plan, opened, counter.ended)


def _today(
    run: Run, given: RerunKeywords, stacklevel: int
) -> tuple[CampaignSettings, SimulationPlan, Runner]:
    """Return how and where cases of a campaign run today: settings, their plan, and the runner."""
    others = {name: one for name, one in given.items() if name != "vut"}
    fields, runner = given_again(given.get("vut"), others, {"vut": run.vut}, stacklevel)
    settings = settings_of(run.folder, run.settings, fields)
    return settings, resolve(settings), runner


def _listed(indices: Iterable[int] | int) -> tuple[int, ...]:
    return tuple(indices) if isinstance(indices, Iterable) else (int(indices),)


def _of_level(run: Run, indices: tuple[int, ...], level: int | str | None) -> tuple[int, ...]:
    """Return the cases of a level among some, or among all."""
    if level is None or str(level) == "all":
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


def export(
    run: AnyRun,
    indices: Iterable[int] | int | None = None,
    *,
    file_format: str = "sumo",
    out: AnyPath | None = None,
) -> list[Path]:
    """Write cases of a campaign for others, and return the paths; as `merge-sumo export`.

    Args:
        run: the campaign, or its folder.
        indices: its cases; of a table all of them when left out.
        file_format: "sumo" or "openscenario" for folders, "csv" for one
            table, or the name of a format that an installed package brings.
        out: folder; `scenarios` or `exports` in that of the campaign when left out.
    """
    loaded = _opened(run).run
    wanted = None if indices is None else list(_listed(indices))
    export_format = FORMATS[file_format]
    if out is None:
        below = dict.fromkeys((SCENARIOS, EXPORTS, export_format.below))
        check_own(*(loaded.folder / name for name in below))
    target = Path(out) if out is not None else loaded.folder / export_format.below
    if export_format.write_table is not None:
        wanted = wanted or [outcome.index for outcome in loaded.outcomes]
        return [export_format.write_table(loaded, wanted, target)]
    if not wanted or export_format.write_case is None:
        raise UserError(f"--format {file_format} needs the indices of cases")
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
    path = folder.folder if isinstance(folder, CampaignRun) else Path(folder)
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


def compare(
    runs: Iterable[AnyRun], *, out: AnyPath | None = None, junit: AnyPath | None = None
) -> Comparison:
    """Compare recorded campaigns: what broke, and what was fixed; as `merge-sumo compare`.

    Everything is read from the records: no case runs, and no VUT.

    Args:
        runs: the campaigns, or their folders, the oldest first.
        out: page to write; nothing may be there. None is written when left out.
        junit: JUnit file to write, in the same way.
    """
    if isinstance(runs, str | Path | CampaignRun):
        raise UserError("give several campaigns in a list, the oldest first")
    for path in (out, junit):
        if path is not None:
            check_new_file(Path(path))
    opened = [_opened(run).run for run in runs]
    compared = comparison.compare(opened)
    if out is not None:
        html = comparison_page(compared, opened)
        write_new(Path(out), html.encode(errors="backslashreplace"))
    if junit is not None:
        write_junit_of_comparison(Path(junit), compared)
    return compared


# Studies


def _repeats_of(settings: CampaignSettings, repeat: int | None, tolerated: float) -> Repeats | None:
    """Return how often the cases of a truth run; None for once, also where nothing is random."""
    most = repeat if repeat is not None else MOST_RUNS if tolerated else 1
    repeats = Repeats(most, tolerated)
    return repeats if repeats.most > 1 and settings.may_vary else None


def truth(
    vut: AnyVut,
    level: int | str = "all",
    *,
    cases: int | None = None,
    seed: int = 0,
    engine: str | None = None,
    repeat: int | None = None,
    tolerated: float = 0.0,
    **given: Unpack[StudyKeywords],
) -> TruthResult:
    """Find the ground truth of a VUT by uniform cases; the same as `merge-sumo truth`.

    Args:
        vut: as of `campaign`.
        level: POV level 0, 1 or 2, "own" for a `pov`, or "all".
        cases: uniform cases of a level; by default 10,000, and 20,000 at level 2.
        seed: same seed, same cases.
        engine: "sumo", or "kinematic" for the equations of motion alone, with SUMO for at least one
            case of a hundred; by default "kinematic" where VUT and POV are of this package.
        repeat: runs of a case, at most, each with another draw of what is random: it runs until it
            is decided whether it fails. By default 1, or 20 where a share of the runs is tolerated.
        tolerated: share of its runs in which a case may fail: it fails where more do.
        given: how a case is run and judged, and where: see `StudyKeywords`.

    A cached truth is used again. The truth of an object of this process is not kept: its name does
    not tell it from another object.
    """
    check_keywords("truth", given, StudyKeywords)
    settings, runner = settings_for(vut, {**given, "level": level})
    with _study(settings, runner, engine) as study:
        repeats = _repeats_of(settings, repeat, tolerated)
        by_level = {one: study.truth(one, cases, seed, repeats) for one in settings.levels}
    if not study.plan.vut.kind.files_are_known and not is_here(settings.vut):
        warnings.warn(
            "note: nobody can tell what the program behind this VUT loads; this truth is kept for "
            "its command and the files that are named there",
            Notice,
            stacklevel=2,
        )
    return TruthResult(settings.vut, by_level, settings.criterion, tolerated)


@contextmanager
def _study(
    settings: CampaignSettings, runner: Runner, engine: str | None = None
) -> Iterator[Study]:
    """Open a study; the cache of objects of this process is a passing one.

    Raises `UserError` for an engine that a level does not allow.
    """
    plan = resolve(settings)
    for level in settings.levels:
        plan.at_level(level).with_engine(engine)
    passing = is_here(settings.vut) or is_here(settings.pov or "")
    with (
        runner.open(plan, at_once=True) as opened,
        tempfile.TemporaryDirectory(prefix="merge-sumo-") as folder,
        Bars(shown=runner.progress) as bars,
    ):
        cache = Path(folder) if passing else None
        yield Study(plan, opened, cache, bars.counted, engine)


def benchmark(
    vut: AnyVut,
    level: int | str = "all",
    *,
    samplers: Iterable[str] | None = None,
    seeds: int = 10,
    cases: int = 400,
    batch: int | None = None,
    truth_cases: int | None = None,
    figure: AnyPath | None = None,
    **given: Unpack[StudyKeywords],
) -> SamplerStudy:
    """Compare samplers with each other and with the ground truth; as `merge-sumo benchmark`.

    Args:
        vut: as of `campaign`.
        level: POV level 0, 1 or 2, "own" for a `pov`, or "all", over which coverage is summed.
        samplers: their names; all by default.
        seeds: runs of each sampler.
        cases: cases of each run.
        batch: cases per batch; by default 20, and for `coverage` as many as it wants.
        truth_cases: cases of the truth at a level; by default 10,000, and 20,000 at level 2.
        figure: new file for FMC against cases: .png, .svg or .html.
        given: how a case is run and judged, and where: see `StudyKeywords`.
    """
    check_keywords("benchmark", given, StudyKeywords)
    picture = _path(figure)
    if picture is not None:
        figures.check_figure(picture)
    names = list(dict.fromkeys(map(str.strip, SAMPLERS if samplers is None else samplers)))
    if not names:
        raise UserError(f"name at least one sampler: {', '.join(SAMPLERS)}")
    search = {"level": level, "sampler": names[0], "cases": cases, "batch": batch}
    settings, runner = settings_for(vut, {**given, **search})
    for name in names[1:]:
        replace(settings, sampler=name)
    if seeds < 1:
        raise UserError(f"--seeds is {seeds}: it must be 1 or more")
    with _study(settings, runner) as study:
        result = study.compare(
            settings.levels,
            names,
            seeds=seeds,
            cases=cases,
            batch=batch,
            truth_cases=truth_cases,
        )
    if picture is None:
        return result
    figures.save(figures.coverage_curves(f"{_title(settings)}, {seeds} seeds", result), picture)
    return replace(result, figure=picture)


def probability(
    run: AnyRun,
    *,
    cases: int | None = None,
    traffic: AnyPath | None = None,
    distribution: AnyPath | None = None,
    confidence: float = 0.95,
    seed: int = 0,
    out: AnyPath | None = None,
    engine: str | None = None,
    **given: Unpack[RerunKeywords],
) -> ProbabilityResult:
    """Estimate how likely the VUT of a campaign is to fail; as `merge-sumo probability`.

    Args:
        run: the campaign, or its folder.
        cases: fresh cases to run; by default 100,000 by the kinematic engine, and 4,000 in SUMO.
        traffic: traffic on the mainline, a shipped one by name, or its TOML file: how many cars a
            merge fails with in it.
        distribution: JSON file that says how often cases occur; uniform by default.
        confidence: chance that the interval holds the probability.
        seed: same seed, same cases.
        out: new file to write; `probability.json` in the folder of the campaign by default.
        engine: "sumo", or "kinematic": see `truth`.
        given: how the drivers run, where it is to change, and where the cases run: see
            `RerunKeywords`.
    """
    check_keywords("probability", given, RerunKeywords)
    before = _opened(run).run
    target = before.folder / estimates.RESULT if out is None else Path(out)
    on_road = None if traffic is None else named_traffic(str(traffic))
    total = estimates.DEFAULT_CASES if cases is None else cases
    with _study_of(before, given, "fresh cases", total, engine=engine) as study:
        found = estimates.failure_probability(
            study,
            target,
            cases=cases,
            distribution=_path(distribution),
            traffic=on_road,
            confidence=confidence,
            seed=seed,
        )
    return ProbabilityResult(found, target, before.criterion)


def stress(run: AnyRun, **given: Unpack[RerunKeywords]) -> ladder.Stress:
    """Run the cases of a campaign again, each time a little otherwise: `merge-sumo rerun --stress`.

    Args:
        run: the campaign, or its folder, into which `stress.json` is written.
        given: how the drivers run, where it is to change, and where the cases run: see
            `RerunKeywords`.

    `robust` of the result has the failures that fail every time, the worst first.
    """
    check_keywords("stress", given, RerunKeywords)
    before = _opened(run).run
    check_ours(before.folder / ladder.STRESS, ladder.Stress.__struct_fields__)
    total = sum(map(ladder.runs_of, ladder.RUNGS))
    cases = total * sum(outcome.is_tested for outcome in before.outcomes)
    with _study_of(before, given, "cases again", cases, engine=None) as study:
        return ladder.stress(study)


def repair(
    run: AnyRun,
    params: Iterable[str],
    *,
    cost: str = mending.Cost.TIME,
    trials: int = mending.DEFAULT_TRIALS,
    rounds: int = mending.DEFAULT_ROUNDS,
    cases: int | None = None,
    seed: int = 0,
    out: AnyPath | None = None,
    resume: bool = False,
    check: Callable[[], None] | None = None,
    **given: Unpack[RerunKeywords],
) -> mending.Repair:
    """Search for values of a controller's parameters that repair it; as `merge-sumo repair`.

    Args:
        run: the campaign, or its folder.
        params: parameters that may change, with their ranges: "headway_s=0.5..3".
        cost: "time" to the merge, or "braking": of what the repair is to cost least.
        trials: trials of a round.
        rounds: most rounds of search and fresh campaign.
        cases: cases of a fresh campaign; by default as many as the campaign has.
        seed: same seed, same result.
        out: new folder to write; `runs/repair-<campaign>-<date>` by default.
        resume: go on in the folder `out`.
        check: called after every trial and every batch; may raise to stop there.
        given: how the drivers run, where it is to change, and where the cases run: see
            `RerunKeywords`.
    """
    check_keywords("repair", given, RerunKeywords)
    mending.require_optuna()
    if cost not in list(mending.Cost):
        raise UserError(f"--cost is {cost!r}: choose {' or '.join(mending.Cost)}")
    ranges = tuple(map(Range.parsed, params))
    asked = mending.RepairSettings(ranges, mending.Cost(cost), trials, rounds, cases, seed)
    before = _opened(run).run
    folder = dated(f"repair-{before.folder.name}") if out is None else Path(out)
    if not resume:
        check_new(folder)
    today, plan, runner = _today(before, given, stacklevel=5)
    runner = replace(runner, check=check)
    RunStudy(before, today, plan).check_same_system()
    bars: list[Bars] = []

    @contextmanager
    def opened() -> Iterator[Workers]:
        with runner.open(plan) as workers, Bars(shown=runner.progress) as shown:
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
        return _fresh_campaign(mending.fresh_settings(today, asked, spec, number), campaign, runner)

    search = mending.Search(
        *(before, plan.with_engine(None), asked),
        partial(mending.RepairJournal, folder, resume=resume),
        open_workers=opened,
        check=runner.checks,
        on_trial=on_trial,
    )
    found = search.repaired(fresh, folder)
    write_repair(found, before)
    return found


def _fresh_campaign(settings: CampaignSettings, folder: Path, runner: Runner) -> Run:
    """Run a campaign into a folder, or go on with it where it has begun."""
    plan = resolve(settings)
    begun = folder.exists()
    if begun:
        check_report(folder)
    return _concluded(settings, plan, folder, runner, goes_on=begun).run


def explain(
    run: AnyRun,
    case: int | None = None,
    *,
    params: Iterable[str] = (),
    **given: Unpack[RerunKeywords],
) -> explanation.ExplanationResult:
    """Find the smallest changes with which a failure passes; the same as `merge-sumo explain`.

    Args:
        run: the campaign, or its folder, into which `explanations.jsonl` is written.
        case: index of the failure; the worst by default.
        params: parameters of the controller with the ranges that are searched, "headway_s=0.5..3".
        given: how the drivers run, where it is to change, and where the cases run: see
            `RerunKeywords`.
    """
    check_keywords("explain", given, RerunKeywords)
    before = _opened(run).run
    target = before.folder / explanation.EXPLANATIONS
    check_own(target)
    failure, ranges = explanation.failure_of(before, case), tuple(map(Range.parsed, params))
    with _study_of(before, given, "explained", 1, "failures", engine=None) as study:
        found = explanation.explain(study, failure, ranges)
    return explanation.ExplanationResult(before, found, target)


def reproduce(
    *,
    seeds: int | None = None,
    out: AnyPath | None = None,
    quick: bool = False,
    policies: AnyPath | None = None,
    **given: Unpack[Running],
) -> reproduction.Reproduction:
    """Reproduce Table II and the figures of the paper; the same as `merge-sumo reproduce`.

    Args:
        seeds: runs of each sampler; by default 10, with `quick` 2.
        out: new folder to write; `runs/reproduce-<date>` by default.
        quick: few and short runs and a small truth: a first look.
        policies: folder of learned drivers instead of the shipped ones.
        given: where the cases run: see `Running`.
    """
    check_keywords("reproduce", given, Running)
    runner, _ = runner_of(given)
    count = (2 if quick else 10) if seeds is None else seeds
    scale = reproduction.quick(count) if quick else reproduction.Scale(seeds=count)
    trained = policies_folder(policies, US23)
    folder = dated("reproduce") if out is None else Path(out)
    figures.require_matplotlib()
    with (
        evaluation_workers(runner.workers) as opened,
        Bars(shown=runner.progress) as bars,
    ):
        make_folder(folder)
        result = reproduction.reproduce(
            scale, policies=trained, workers=opened, on_part=bars.counted
        )
    return replace(result, page=write_reproduction(result, folder))


# What a person brings: VUTs, scenarios, learned drivers


def vuts(policies: AnyPath | None = None) -> Shown:
    """Return the VUTs that can be tested, and the kinds that a person can bring.

    `policies` is the folder of learned drivers instead of the shipped ones.
    """
    trained = read_manifest(policies_of(US23) if policies is None else policies_in(policies))
    built_in = [name for name, vut in BUILT_IN_VUTS.items() if vut.network in ("", *trained)]
    kinds = [kind for kind in KINDS.values() if kind.form]
    names = {"built in": built_in, "installed": list(installed_vuts())}
    listed = [{"form": kind.form, "what": kind.what, "example": kind.example} for kind in kinds]
    lines = [f"{title}: {', '.join(known)}" for title, known in names.items() if known]
    for kind in kinds:
        lines += [kind.form, f"    {kind.what}", f"    {kind.example}"]
    return Shown({**names, "kinds": listed}, lines)


def check_vut(
    vut: AnyVut, *, scenario: Scenario | AnyPath | None = None, **hosting: Unpack[Hosting]
) -> VutCheck:
    """Let a VUT drive a few cases and say what is wrong with it; as `merge-sumo check-vut`.

    Args:
        vut: as of `campaign`.
        scenario: a `Scenario`, its name, or its TOML file; "us23" by default.
        hosting: `policies`, `deadline_s`, `vut_memory_gib`; see
            `Hosting`.
    """
    check_keywords("check_vut", hosting, Hosting)
    spec, _, _ = drivers_of(vut, None, 1)
    fields = recordable({name: value for name, value in hosting.items() if name != "pov"})
    driven = US23 if scenario is None else scenario_of(scenario)
    settings = CampaignSettings(vut=spec, levels=(0,), scenario=driven, **fields)
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


def new_scenario(
    file: AnyPath, *, net: AnyPath, mainline: str, ramp: str, point: bool = False
) -> Shown:
    """Write a scenario for a merge in a net, and a picture of the road; as `scenario new`.

    On a ramp with an acceleration lane the VUT chooses on it where to merge.

    Args:
        file: new TOML file to write.
        net: SUMO net, or a map of which netconvert makes one beside `file`: .osm, .xodr.
        mainline: edges of the mainline, past M: "e1 e2".
        ramp: edges of the ramp, past M.
        point: make M a point, also where the ramp has an acceleration lane.
    """
    file, net = Path(file), Path(net)
    if file.suffix != SUFFIX:
        raise UserError(f"{file} is to be a scenario: name it NAME{SUFFIX}")
    picture = file.with_suffix(".svg")
    edges = tuple(mainline.split()), tuple(ramp.split())
    written, map_file = [file, picture], net if is_map(net) else None
    if map_file is not None:
        net = file.with_suffix(".net.xml")
        written.append(net)
    for path in written:
        check_new_file(path, "FILE")
    if map_file is not None:
        converted = net_of_map(map_file)
        try:
            find_corridor(NetFile(map_file, converted), *edges)
        except UserError as error:
            raise UserError(f"{error}; to look at its edges: `{command_for(map_file)}`") from error
        write_new(net, converted, "FILE")
    road = road_of(net, *edges)
    if not point:
        road = road_of(net, *edges, lane_m=suggested_lane_m(road))
    scenario, found = suggested(road, file.stem), [*about(road), *kind_of_merge(road)]
    relative = os.path.relpath(net.resolve(), file.parent.resolve())
    write_new(picture, road_svg(road, scenario), "FILE")
    text = to_toml(replace(scenario, net=relative), found)
    write_new(file, text.encode(), "FILE")
    made_of = "" if map_file is None else f", and its net {net}, made of {map_file}"
    lines = [*found, f"written: {file}, and its picture {picture}{made_of}"]
    return Shown({"about": found, "written": list(map(str, written))}, lines)


def check_scenario(scenario: Scenario | AnyPath, policies: AnyPath | None = None) -> Shown:
    """Say whether a scenario can be hosted, and whether the learned drivers were trained on it.

    Args:
        scenario: a `Scenario`, its name, or its TOML file.
        policies: folder of learned drivers instead of the shipped ones.
    """
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


def train(
    only: Iterable[str] | None = None,
    *,
    seed: int = 0,
    scenario: Scenario | AnyPath | None = None,
    out: AnyPath | None = None,
    a_min: float | None = None,
    check: bool = False,
    cases: int = 300,
    progress: bool | None = None,
) -> PolicyChecks:
    """Train the learned drivers in SUMO and return what each loses; as `merge-sumo train`.

    Args:
        only: names of the networks: "pov1", "vut1", "pov2", "vut2"; all by default.
        seed: same seed, same weights on one machine.
        scenario: a `Scenario`, its name, or its TOML file; "us23" by default.
        out: folder; by default that of the shipped policies, for "us23" only.
        a_min: hardest braking of the POVs in m/s2, below 0; by default that of the scenario, which
            is always that of the VUTs.
        check: train nothing, and measure the regret of the networks in the folder.
        cases: random cases of such a check.
        progress: show progress; by default in a notebook and on a terminal.

    Returns:
        A `PolicyCheck` by the name of the network.

    An interrupted training goes on with what is not finished.
    """
    played = US23 if scenario is None else scenario_of(scenario)
    folder = Path(out) if out is not None else policies_of(played)
    if out is None and not check and not plays_as(played, US23):
        raise UserError(
            f"the shipped policies are for {US23.name}: say with --out where those for "
            f"{played.name} are to go"
        )
    names = _networks(only)
    for package in ("torch", "gymnasium"):
        if find_spec(package) is None:
            raise UserError(
                f"training needs {package}, which is not installed: run "
                "`pip install 'merge-sumo[train]'`"
            )
    from merge_sumo.training.check import PolicyCheck, check_policy
    from merge_sumo.training.helix import TrainingProgress, train_library

    if not check:
        with Bars(shown=progress) as bars:

            def progressed(now: TrainingProgress) -> None:
                title = f"{now.network} {now.stage}"
                bars.counted(title, now.done, now.total, "updates", now.note)

            train_library(
                *(folder, names, seed),
                scenario=played,
                a_min_mps2=a_min,
                on_progress=progressed,
                on_done=lambda name, check: bars.say(
                    f"{name} is {'there already' if check is None else 'ready'}"
                ),
            )
    manifest = _manifest_for(folder, names, scenario)
    if check:
        checks = {n: check_policy(n, folder, count=cases, scenario=played) for n in names}
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
            f"{folder} was trained for {trained_for.name}: say with --scenario in which one to "
            f"check it, or --scenario {US23.name}"
        )
    return manifest
