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

from contextlib import ExitStack
from dataclasses import replace
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

from merge_sumo import options, verbs
from merge_sumo.api.asked import (
    opened,
    opened_study,
    opened_truths,
    path_of,
    scenario_of,
    settings_for,
    stated_again,
    today,
)
from merge_sumo.api.campaigns import concluded, notice_povs
from merge_sumo.api.cases import given_case, recorded_case
from merge_sumo.api.results import CampaignRun, CaseRun, campaign_of, folder_of, recorded
from merge_sumo.api.verb import verb
from merge_sumo.campaigns.campaign import SCENARIOS, case_name
from merge_sumo.campaigns.one_case import run_one
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.run import SETTINGS, Run, read_settings
from merge_sumo.campaigns.settings import CampaignSettings, settings_of
from merge_sumo.drivers.policies import policies_in
from merge_sumo.engine.evaluate import evaluation_workers
from merge_sumo.engine.plan import Engine
from merge_sumo.engine.povs import parse_levels, policies_folder
from merge_sumo.errors import UserError, notice
from merge_sumo.options import AnyPath, AnyRun
from merge_sumo.reports import exports, figures
from merge_sumo.reports.comparison_page import PAGE, comparison_page
from merge_sumo.reports.export_format import EXPORTS
from merge_sumo.reports.formats import FORMATS
from merge_sumo.reports.junit import JUNIT, write_junit_of_comparison
from merge_sumo.reports.progress import Bars
from merge_sumo.reports.repair_page import write_repair
from merge_sumo.reports.reproduction_page import write_reproduction
from merge_sumo.road.merge import road_for
from merge_sumo.road.scenario_file import SUFFIX
from merge_sumo.scenario.coordinates import outside_of_the_pool
from merge_sumo.scenario.scenario import US23, Scenario
from merge_sumo.studies import (
    comparison,
    explanation,
    own_scenario,
    reproduction,
    sampler_study,
    vut_check,
)
from merge_sumo.studies import probability as estimates
from merge_sumo.studies import repair as mending
from merge_sumo.studies import rerun as rerunning
from merge_sumo.studies import stress as ladder
from merge_sumo.studies.cases_file import CasesFile
from merge_sumo.studies.comparison import Comparison
from merge_sumo.studies.explanation import EXPLANATIONS, ExplanationResult
from merge_sumo.studies.probability import PROBABILITY, ProbabilityResult
from merge_sumo.studies.repair import RepairResult
from merge_sumo.studies.reproduction import Reproduction
from merge_sumo.studies.run_study import RunStudy, notice_changes
from merge_sumo.studies.sampler_study import SamplerStudy
from merge_sumo.studies.stress import STRESS, StressResult
from merge_sumo.studies.truth import TruthResult
from merge_sumo.studies.vut_check import VutCheck
from merge_sumo.sumo import replay as replayer
from merge_sumo.sumo.binding import scratch_folder
from merge_sumo.sumo.replay import Replay, check_display
from merge_sumo.sumo.replay_folder import CONFIG, write_scenario
from merge_sumo.system.folders import (
    check_new,
    check_new_file,
    check_own,
    dated,
    make_folder,
    write_new,
)
from merge_sumo.system.printable import printable, quoted
from merge_sumo.system.records import check_toml_size, to_plain
from merge_sumo.system.result import Shown
from merge_sumo.verdict.conflict import check_from
from merge_sumo.vuts.base import Car, Seen
from merge_sumo.vuts.in_memory import AnyVut, drivers_of
from merge_sumo.vuts.parameters import Range
from merge_sumo.vuts.python import SeenBatch

if TYPE_CHECKING:
    from merge_sumo.training.library import PolicyChecks

__all__ = ["AnyRun", "AnyVut", "CampaignRun", "Car", "CaseRun", "Comparison", "Seen", "SeenBatch"]
__all__ += ["benchmark", "campaign", "check_scenario", "check_vut", "compare", "dated", "explain"]
__all__ += ["export", "new_scenario", "open_in_gui", "open_run", "probability", "repair", "replay"]
__all__ += ["report", "reproduce", "rerun", "resume", "run", "scenarios", "stress", "train"]
__all__ += ["truth", "vuts"]

# Campaigns


@verb(verbs.Campaign)
def campaign(asked: verbs.Campaign) -> CampaignRun:
    """Test a VUT and return the campaign, also one without failures."""
    settings, where = settings_for(asked)
    folder = dated(settings.vut) if asked.out is None else Path(asked.out)
    plan = resolve(settings)
    notice_povs(settings, plan, asked)
    return concluded(settings, plan, folder, where, asked)


@verb(verbs.Resume)
def resume(asked: verbs.Resume) -> CampaignRun:
    """Go on with a campaign that was stopped."""
    folder = folder_of(asked.run)
    recorded = read_settings(folder)
    fields, where = stated_again(
        asked, asked.vut, {name: recorded.get(name) for name in ("vut", "pov")}
    )
    settings = settings_of(folder, recorded, fields, goes_on=True)
    if "level" in asked.given:
        policies = policies_folder(settings.policies, settings.scenario)
        own = settings.pov is not None
        levels = parse_levels(asked.level, policies, settings.scenario.levels, own=own)
        settings = replace(settings, levels=levels)
    return concluded(settings, resolve(settings), folder, where, asked, goes_on=True)


def open_run(folder: AnyPath) -> CampaignRun:
    """Open the folder of a campaign; `UserError` when it is none."""
    return CampaignRun(folder)


# Cases


@verb(verbs.RunCase)
def run(asked: verbs.RunCase) -> CaseRun:
    """Run one case and return it."""
    check_from(asked.from_s)
    settings, case = given_case(asked) if asked.recorded is None else recorded_case(asked)
    if asked.out is not None:
        check_new(Path(asked.out))
    for sentence in outside_of_the_pool(case):
        notice(sentence)
    plan = resolve(settings, debug=asked.debug)
    if asked.recorded is not None:
        notice_changes(recorded(asked.recorded[0]), plan)
    if asked.gui:
        check_display()
    episode = run_one(plan, case)
    result = CaseRun(episode, asked.from_s)
    with ExitStack() as opened:
        folder = path_of(asked.out)
        if folder is None and asked.gui:
            folder = opened.enter_context(scratch_folder()) / "case"
        if folder is not None:
            write_scenario(folder, plan.road, episode.outcome, episode.trajectory)
        if asked.on_end is not None:
            asked.on_end(result)
        if folder is not None and asked.gui:
            replayer.open_gui(folder, asked.from_s)
    return result


@verb(verbs.Rerun)
def rerun(asked: verbs.Rerun) -> Comparison:
    """Run recorded cases again with a changed VUT."""
    before = recorded(asked.run)
    indices = (asked.indices,) if isinstance(asked.indices, int) else tuple(asked.indices)
    chosen = rerunning.chosen(before, indices, asked.level)
    out, junit = _new_files(asked, SUFFIX if isinstance(before, CasesFile) else PAGE)
    some = len(chosen) < len(before.outcomes)
    if isinstance(before, CasesFile) and out is not None and some:
        raise UserError("`out` of a cases file has all cases: name none of them, and no level")
    with opened_study(before, asked, "{vut} again", len(chosen), engine=Engine.SUMO) as study:
        compared = rerunning.rerun(study, chosen)
    if isinstance(before, CasesFile):
        compared = before.compared(compared, out or before.folder)
    return _written(compared, out, junit)


def _new_files(
    asked: verbs.Rerun | verbs.Compare, ending: str = PAGE
) -> tuple[Path | None, Path | None]:
    """Return the new files of a comparison, whose `out` has an ending.

    Raises `UserError` where one cannot be.
    """
    out, junit = path_of(asked.out), path_of(asked.junit)
    if out is not None:
        check_new_file(out, endings=(ending,))
    if junit is not None:
        check_new_file(junit, "`junit`", JUNIT)
    return out, junit


def _written(compared: Comparison, out: Path | None, junit: Path | None) -> Comparison:
    """Write the page, or the cases file of now, and JUnit, where they are asked for."""
    text = compared.text
    if out is not None and text is not None:
        check_toml_size(text.encode(errors="backslashreplace"), out)
    if junit is not None:
        write_junit_of_comparison(junit, compared)
    if out is None:
        return compared
    page = comparison_page(compared) if text is None else text
    write_new(out, page.encode(errors="backslashreplace"))
    return replace(compared, page_command="")


@verb(verbs.Export)
def export(asked: verbs.Export) -> list[Path]:
    """Write cases of a campaign for others, and return the paths."""
    loaded, export_format = campaign_of(asked.run).run, FORMATS[asked.file_format]
    given = asked.indices
    wanted = [given] if isinstance(given, int) else list(given or ())
    if asked.out is None:
        below = dict.fromkeys((SCENARIOS, EXPORTS, export_format.below))
        check_own(*(loaded.folder / name for name in below))
    target = loaded.folder / export_format.below if asked.out is None else Path(asked.out)
    if export_format.write_table is not None:
        return [export_format.write_table(loaded, wanted, target)]
    if not wanted or export_format.write_case is None:
        raise UserError(f"`file_format` {asked.file_format} needs the indices of cases")
    road = road_for(loaded.scenario)
    return list(exports.write_folders(loaded, wanted, target, export_format.write_case, road))


def report(run: AnyRun) -> Shown:
    """Write the report of a campaign again, and return its facts; as `merge-sumo report`."""
    opened_run = campaign_of(run)
    path = str(opened_run.report())
    return Shown({"report": path, "facts": to_plain(opened_run.facts)}, [path])


def replay(folder: AnyRun, index: int | None = None, *, from_s: float | None = None) -> Replay:
    """Replay a case in SUMO and compare every row with its record; as `merge-sumo replay`.

    Args:
        folder: a scenario folder, or a campaign.
        index: the case of the campaign, which is exported where it is not yet.
        from_s: begin so long before the first conflict, as in -3.

    `diverged_at_s` of the result is None where the replay is identical.
    """
    check_from(from_s)
    return replayer.replay(_scenario_folder(folder, index), from_s)


def open_in_gui(folder: AnyRun, index: int | None = None, *, from_s: float | None = None) -> int:
    """Show a case in sumo-gui until the window is closed; return the exit code of sumo-gui.

    The arguments are those of `replay`. Raises `UserError` without a display.
    """
    check_from(from_s)
    return replayer.open_gui(_scenario_folder(folder, index), from_s)


def _scenario_folder(folder: AnyRun, index: int | None) -> Path:
    """Return the replay folder of a case, written where it does not exist yet."""
    path = folder_of(folder)
    if not (path / SETTINGS).is_file():
        if index is not None:
            raise UserError(f"{path} is no campaign, so it has no case {index}: leave that away")
        return path
    if index is None:
        raise UserError(
            f"{path} is a campaign: say which case, as in `merge-sumo replay {quoted(path)} 0`"
        )
    exported = path / SCENARIOS / case_name(index)
    if not (exported / CONFIG).is_file():
        export(folder, index)
    return exported


# Studies


@verb(verbs.Compare)
def compare(asked: verbs.Compare) -> Comparison:
    """Compare recorded campaigns: what broke, and what was fixed."""
    if isinstance(asked.runs, str | Path | CampaignRun):
        raise UserError("give several campaigns in a list, the oldest first")
    out, junit = _new_files(asked)
    versions = [campaign_of(run).run for run in asked.runs]
    return _written(comparison.compare(versions), out, junit)


@verb(verbs.GroundTruth)
def truth(asked: verbs.GroundTruth) -> TruthResult:
    """Find the ground truth of a VUT by uniform cases."""
    settings, where = settings_for(asked)
    with opened_truths(settings, where, asked.engine) as study:
        return study.truths(settings, asked)


@verb(verbs.Benchmark)
def benchmark(asked: verbs.Benchmark) -> SamplerStudy:
    """Compare samplers with each other and with the ground truth."""
    picture = path_of(asked.figure)
    if picture is not None:
        figures.check_figure(picture)
    names = sampler_study.names_of(asked)
    settings, where = settings_for(asked, sampler=names[0], cases=asked.cases, batch=asked.batch)
    for name in names[1:]:
        replace(settings, sampler=name)
    with opened_truths(settings, where) as study:
        result = study.compare(settings.levels, names, asked)
    if picture is None:
        return result
    title = f"{sampler_study.title(settings.vut, settings.levels)}, {asked.seeds} seeds"
    figures.save(figures.coverage_curves(title, result), picture)
    return replace(result, figure=picture)


@verb(verbs.Probability)
def probability(asked: verbs.Probability) -> ProbabilityResult:
    """Estimate how likely the VUT of a campaign is to fail."""
    before = campaign_of(asked.run).run
    target = path_of(asked.out) or before.folder / PROBABILITY.name
    total = estimates.DEFAULT_CASES if asked.cases is None else asked.cases
    with opened_study(before, asked, "fresh cases", total, engine=asked.engine) as study:
        return estimates.failure_probability(study, asked, target)


@verb(verbs.Stress)
def stress(asked: verbs.Stress) -> StressResult:
    """Run the cases of a campaign again, each time a little otherwise."""
    before = campaign_of(asked.run).run
    STRESS.check(before.folder)
    cases = ladder.RUNS * sum(outcome.is_tested for outcome in before.outcomes)
    with opened_study(before, asked, "cases again", cases) as study:
        return ladder.stress(study)


@verb(verbs.Repair)
def repair(asked: verbs.Repair) -> RepairResult:
    """Search for values of a controller's parameters that repair it."""
    mending.ranges_of(asked)
    before = campaign_of(asked.run).run
    folder = path_of(asked.out) or dated(f"repair-{before.folder.name}")
    check_new(folder)
    settings, plan, where = today(before, asked)
    study = RunStudy(before, settings, plan.with_engine(None))
    study.check_same_system()
    with opened(where, plan) as workers, Bars(shown=where.progress) as bars:

        def fresh(spec: str, number: int) -> Run:
            of_round = mending.fresh_settings(settings, before, asked, spec, number)
            to, total, number_of = (
                folder / mending.CAMPAIGN.format(number),
                of_round.cases,
                count(1),
            )

            def on_case(_: object) -> None:
                bars.counted(f"fresh campaign {number}", next(number_of), total, "cases")

            of_plan, listening = resolve(of_round), verbs.SearchOfTest(on_case=on_case)
            quietly = replace(where, progress=False)
            return concluded(of_round, of_plan, to, quietly, listening, workers=workers).run

        study = replace(study, workers=workers)
        found = mending.repair(study, asked, folder, fresh, bars.counted)
    write_repair(found, before)
    return found


@verb(verbs.Explain)
def explain(asked: verbs.Explain) -> ExplanationResult:
    """Find the smallest changes with which a failure passes."""
    before = campaign_of(asked.run).run
    EXPLANATIONS.check(before.folder)
    explanation.failure_of(before, asked.case)
    ranges = tuple(map(Range.parsed, asked.params))
    with opened_study(before, asked, "explained", 1, "failures") as study:
        return explanation.explain(study, asked.case, ranges)


@verb(verbs.Reproduce)
def reproduce(asked: verbs.Reproduce) -> Reproduction:
    """Reproduce Table II and the figures of the paper."""
    scale = reproduction.scale_of(asked)
    policies, folder = policies_folder(asked.policies, US23), path_of(asked.out)
    figures.require_matplotlib()
    folder = folder or dated("reproduce")
    with evaluation_workers(asked.workers) as workers, Bars(shown=asked.progress) as bars:
        make_folder(folder)
        result = reproduction.reproduce(
            scale, policies=policies, workers=workers, on_part=bars.counted
        )
    return replace(result, page=write_reproduction(result, folder))


# What a person brings: VUTs, scenarios, learned drivers


@verb(verbs.Vuts)
def vuts(asked: verbs.Vuts) -> Shown:
    """Return the VUTs that can be tested, and the kinds that a person can bring."""
    return vut_check.known_vuts(asked.policies)


@verb(verbs.CheckVut)
def check_vut(asked: verbs.CheckVut) -> VutCheck:
    """Let a VUT drive a few cases and say what is wrong with it."""
    spec, _, _ = drivers_of(asked.vut, None, 1)
    scenario = US23 if asked.scenario is None else scenario_of(asked.scenario)
    policies = None if asked.policies is None else str(asked.policies)
    fields = {"vut": spec, "levels": (0,), "policies": policies, **asked.values(options.Limits)}
    plan = resolve(CampaignSettings(scenario=scenario, **fields))
    with Bars() as bars:
        bars.say(f"{printable(spec)} drives a few cases: minutes, where a step takes seconds")
        return vut_check.check_vut(plan)


def scenarios() -> Shown:
    """Return the scenarios that the package brings, by name; as `merge-sumo scenario list`."""
    return own_scenario.shipped()


@verb(verbs.NewScenario)
def new_scenario(asked: verbs.NewScenario) -> Shown:
    """Write a scenario for a merge in a net, and a picture of the road."""
    return own_scenario.write_scenario(asked)


@verb(verbs.CheckScenario)
def check_scenario(asked: verbs.CheckScenario) -> Shown:
    """Say whether a scenario can be hosted, and whether the learned drivers were trained on it."""
    folder = None if asked.policies is None else policies_in(asked.policies)
    scenario = scenario_of(asked.scenario)
    name = scenario.name if isinstance(asked.scenario, Scenario) else str(asked.scenario)
    return own_scenario.check_scenario(scenario, name, folder)


@verb(verbs.Train)
def train(asked: verbs.Train) -> PolicyChecks:
    """Train the learned drivers and return what each loses in SUMO, by the name of the network."""
    for package in ("torch", "gymnasium"):
        if find_spec(package) is None:
            raise UserError(
                f"training needs {package}, which is not installed: run "
                "`pip install 'merge-sumo[train]'`"
            )
    from merge_sumo.training.library import checks_of

    scenario = None if asked.scenario is None else scenario_of(asked.scenario)
    with Bars(shown=asked.progress) as bars:
        return checks_of(asked, scenario, bars.counted, bars.say)
