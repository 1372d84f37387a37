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
from pathlib import Path
from typing import TYPE_CHECKING

from merge_sumo import config as c
from merge_sumo.analysis import (
    comparison,
    explanation,
    own_scenario,
    reproduction,
    sampler_study,
    vut_check,
)
from merge_sumo.analysis import probability as estimates
from merge_sumo.analysis import rerun as rerunning
from merge_sumo.analysis import stress as ladder
from merge_sumo.analysis.cases_file import CasesFile
from merge_sumo.analysis.comparison import Comparison
from merge_sumo.analysis.explanation import EXPLANATIONS, ExplanationResult
from merge_sumo.analysis.probability import PROBABILITY, ProbabilityResult
from merge_sumo.analysis.reproduction import Reproduction
from merge_sumo.analysis.run_study import notice_changes
from merge_sumo.analysis.sampler_study import SamplerStudy
from merge_sumo.analysis.stress import STRESS, StressResult
from merge_sumo.analysis.truth import TruthResult
from merge_sumo.analysis.vut_check import VutCheck
from merge_sumo.api.campaigns import notice_povs, run_and_report
from merge_sumo.api.results import CampaignRun, CaseRun, campaign_of, folder_of, recorded
from merge_sumo.api.settings import (
    case_in,
    explicit,
    opened_study,
    opened_truths,
    path_of,
    recorded_case,
    scenario_of,
    settings_for,
)
from merge_sumo.api.verb import verb
from merge_sumo.campaigns.campaign import SCENARIOS, case_name
from merge_sumo.campaigns.one_case import run_one
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.run import SETTINGS, read_settings
from merge_sumo.campaigns.settings import CampaignSettings, settings_of
from merge_sumo.controllers.controller import Car, Seen
from merge_sumo.controllers.in_memory import AnyVut, drivers_of
from merge_sumo.controllers.parameters import Range
from merge_sumo.controllers.python import SeenBatch
from merge_sumo.drivers.policies import policies_in
from merge_sumo.errors import UserError, notice
from merge_sumo.files import (
    check_new,
    dated,
    make_folder,
    write_new,
)
from merge_sumo.metrics.merge import check_from
from merge_sumo.printable import printable, quoted
from merge_sumo.records import check_toml_size, to_plain
from merge_sumo.reports import figures
from merge_sumo.reports.cases_toml import with_file
from merge_sumo.reports.comparison_page import PAGE, comparison_page
from merge_sumo.reports.exports import export_cases
from merge_sumo.reports.junit import JUNIT, write_junit_of_comparison
from merge_sumo.reports.progress import Bars
from merge_sumo.reports.reproduction_page import write_reproduction
from merge_sumo.result import Shown
from merge_sumo.road.scenario_file import SUFFIX
from merge_sumo.scenario.coordinates import outside_of_the_pool
from merge_sumo.scenario.scenario import US23, Scenario
from merge_sumo.simulation.plan import Engine
from merge_sumo.simulation.povs import parse_levels, policies_folder
from merge_sumo.sumo import replay as replayer
from merge_sumo.sumo.binding import scratch_folder
from merge_sumo.sumo.replay import Replay, check_display
from merge_sumo.sumo.replay_folder import CONFIG, write_scenario
from merge_sumo.workers import open_workers

if TYPE_CHECKING:
    from merge_sumo.training.library import PolicyChecks

__all__ = ["AnyVut", "CampaignRun", "Car", "CaseRun", "Comparison", "Seen", "SeenBatch", "dated"]

# Campaigns


@verb(c.Campaign)
def campaign(config: c.Campaign) -> CampaignRun:
    """Test a VUT and return the campaign, also one without failures."""
    settings, where = settings_for(config)
    folder = dated(settings.vut) if config.out is None else Path(config.out)
    plan = resolve(settings)
    notice_povs(settings, plan, config)
    return run_and_report(settings, plan, folder, where, config)


@verb(c.Resume)
def resume(config: c.Resume) -> CampaignRun:
    """Go on with a campaign that was stopped."""
    folder = folder_of(config.run)
    recorded = read_settings(folder)
    fields, where = explicit(config, recorded.get("vut") or "", recorded.get("pov"))
    settings = settings_of(folder, recorded, fields, resumes=True)
    if config.level != "all":
        policies = policies_folder(settings.policies, settings.scenario)
        own = settings.pov is not None
        levels = parse_levels(config.level, policies, settings.scenario.levels, own=own)
        settings = replace(settings, levels=levels)
    return run_and_report(settings, resolve(settings), folder, where, config, resumes=True)


def open_run(folder: c.AnyPath) -> CampaignRun:
    """Open the folder of a campaign; `UserError` when it is none."""
    return CampaignRun(folder)


# Cases


@verb(c.RunCase)
def run(config: c.RunCase) -> CaseRun:
    """Run one case and return it."""
    check_from(config.from_s)
    settings, case = case_in(config) if config.recorded is None else recorded_case(config)
    if config.out is not None:
        check_new(Path(config.out))
    for sentence in outside_of_the_pool(case):
        notice(sentence)
    plan = resolve(settings, debug=config.debug)
    if config.recorded is not None:
        notice_changes(recorded(config.recorded[0]), plan)
    if config.gui:
        check_display()
    episode = run_one(plan, case)
    result = CaseRun(episode, config.from_s)
    with ExitStack() as opened:
        folder = path_of(config.out)
        if folder is None and config.gui:
            folder = opened.enter_context(scratch_folder()) / "case"
        if folder is not None:
            write_scenario(folder, plan.road, episode.outcome, episode.trajectory)
        if config.on_end is not None:
            config.on_end(result)
        if folder is not None and config.gui:
            replayer.open_gui(folder, config.from_s, silent=True)
    return result


@verb(c.Rerun)
def rerun(config: c.Rerun) -> Comparison:
    """Run recorded cases again with a changed VUT."""
    before = recorded(config.run)
    indices = (config.indices,) if isinstance(config.indices, int) else tuple(config.indices)
    chosen = rerunning.chosen(before, indices, config.level)
    out, junit = _new_files(config, SUFFIX if isinstance(before, CasesFile) else PAGE)
    some = len(chosen) < len(before.outcomes)
    if isinstance(before, CasesFile) and out is not None and some:
        raise UserError("`out` of a cases file has all cases: name none of them, and no level")
    with opened_study(before, config, "{vut} again", len(chosen), engine=Engine.SUMO) as study:
        compared = rerunning.rerun(study, chosen)
    if isinstance(before, CasesFile):
        compared = with_file(compared, before, out or before.folder)
    return _written(compared, out, junit)


def _new_files(config: c.Rerun | c.Compare, ending: str = PAGE) -> tuple[Path | None, Path | None]:
    """Return the new files of a comparison, whose `out` has an ending.

    Raises `UserError` where one cannot be.
    """
    out, junit = path_of(config.out), path_of(config.junit)
    if out is not None:
        check_new(out, endings=(ending,))
    if junit is not None:
        check_new(junit, "`junit`", JUNIT)
    return out, junit


def _written(compared: Comparison, out: Path | None, junit: Path | None) -> Comparison:
    """Write the page, or the cases file of now, and JUnit, where they are wanted."""
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


@verb(c.Export)
def export(config: c.Export) -> list[Path]:
    """Write cases of a campaign for others, and return the paths."""
    indices = config.indices
    wanted = [indices] if isinstance(indices, int) else list(indices or ())
    loaded = campaign_of(config.run).run
    return export_cases(loaded, wanted, config.file_format, path_of(config.out))


def report(run: c.AnyRun) -> Shown:
    """Write the report of a campaign again, and return its facts; as `merge-sumo report`."""
    opened_run = campaign_of(run)
    path = str(opened_run.report())
    return Shown({"report": path, "facts": to_plain(opened_run.facts)}, [path])


def replay(folder: c.AnyRun, index: int | None = None, *, from_s: float | None = None) -> Replay:
    """Replay a case in SUMO and compare every row with its record; as `merge-sumo replay`.

    Args:
        folder: a scenario folder, or a campaign.
        index: the case of the campaign, which is exported where it is not yet.
        from_s: begin so long before the first conflict, as in -3.

    `diverged_at_s` of the result is None where the replay is identical.
    """
    check_from(from_s)
    return replayer.replay(_scenario_folder(folder, index), from_s)


def open_in_gui(folder: c.AnyRun, index: int | None = None, *, from_s: float | None = None) -> int:
    """Show a case in sumo-gui until the window is closed; return the exit code of sumo-gui.

    The arguments are those of `replay`. Raises `UserError` without a display.
    """
    check_from(from_s)
    return replayer.open_gui(_scenario_folder(folder, index), from_s)


def _scenario_folder(folder: c.AnyRun, index: int | None) -> Path:
    """Return the replay folder of a case, written where it does not exist yet."""
    path = folder_of(folder)
    if not (path / SETTINGS).is_file():
        if index is not None:
            raise UserError(
                f"{path} is no campaign, so it has no case {index}: leave the index away"
            )
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


@verb(c.Compare)
def compare(config: c.Compare) -> Comparison:
    """Compare recorded campaigns: what broke, and what was fixed."""
    if isinstance(config.runs, str | Path | CampaignRun):
        raise UserError("give several campaigns in a list, the oldest first")
    out, junit = _new_files(config)
    versions = [campaign_of(run).run for run in config.runs]
    return _written(comparison.compare(versions), out, junit)


@verb(c.GroundTruth)
def truth(config: c.GroundTruth) -> TruthResult:
    """Find the ground truth of a VUT by uniform cases."""
    settings, where = settings_for(config)
    with opened_truths(settings, where, config.engine) as study:
        return study.truths(settings, config)


@verb(c.Benchmark)
def benchmark(config: c.Benchmark) -> SamplerStudy:
    """Compare samplers with each other and with the ground truth."""
    picture = path_of(config.figure)
    if picture is not None:
        figures.check_figure(picture)
    names = sampler_study.names_of(config)
    settings, where = settings_for(config, sampler=names[0], cases=config.cases, batch=config.batch)
    for name in names[1:]:
        replace(settings, sampler=name)
    with opened_truths(settings, where) as study:
        result = study.compare(settings.levels, names, config)
    if picture is None:
        return result
    title = f"{sampler_study.title(settings.vut, settings.levels)}, {config.seeds} seeds"
    figures.save(figures.coverage_curves(title, result), picture)
    return replace(result, figure=picture)


@verb(c.Probability)
def probability(config: c.Probability) -> ProbabilityResult:
    """Estimate how likely the VUT of a campaign is to fail."""
    before = campaign_of(config.run).run
    target = path_of(config.out) or before.folder / PROBABILITY.name
    total = estimates.DEFAULT_CASES if config.cases is None else config.cases
    with opened_study(before, config, "fresh cases", total, engine=config.engine) as study:
        return estimates.failure_probability(study, config, target)


@verb(c.Stress)
def stress(config: c.Stress) -> StressResult:
    """Run the cases of a campaign again, each time a little otherwise."""
    before = campaign_of(config.run).run
    STRESS.check(before.folder)
    cases = ladder.RUNS * sum(outcome.is_tested for outcome in before.outcomes)
    with opened_study(before, config, "cases again", cases) as study:
        return ladder.stress(study)


@verb(c.Explain)
def explain(config: c.Explain) -> ExplanationResult:
    """Find the smallest changes with which a failure passes."""
    before = campaign_of(config.run).run
    EXPLANATIONS.check(before.folder)
    explanation.failure_of(before, config.case)
    ranges = tuple(map(Range.parsed, config.params))
    with opened_study(before, config, "explained", 1, "failures") as study:
        return explanation.explain(study, config.case, ranges)


@verb(c.Reproduce)
def reproduce(config: c.Reproduce) -> Reproduction:
    """Reproduce Table II and the figures of the paper."""
    scale = reproduction.scale_of(config)
    policies, folder = policies_folder(config.policies, US23), path_of(config.out)
    figures.require_matplotlib()
    folder = folder or dated("reproduce")
    with open_workers(config.workers) as workers, Bars(shown=config.progress) as bars:
        make_folder(folder)
        result = reproduction.reproduce(
            scale, policies=policies, workers=workers, on_part=bars.counted
        )
    return replace(result, page=write_reproduction(result, folder))


# Bring your own: VUTs, scenarios, learned drivers


@verb(c.Vuts)
def vuts(config: c.Vuts) -> Shown:
    """Return the VUTs that can be tested, and the kinds that a user can bring."""
    return vut_check.known_vuts(config.policies)


@verb(c.CheckVut)
def check_vut(config: c.CheckVut) -> VutCheck:
    """Let a VUT drive a few cases and say what is wrong with it."""
    spec, _, _ = drivers_of(config.vut, None, 1)
    policies = None if config.policies is None else str(config.policies)
    fields = {"vut": spec, "levels": (0,), "policies": policies, **c.changed(config, c.Limits)}
    plan = resolve(CampaignSettings(scenario=scenario_of(config.scenario), **fields))
    with Bars() as bars:
        bars.say(f"{printable(spec)} drives a few cases: minutes, where a step takes seconds")
        return vut_check.check_vut(plan)


def scenarios() -> Shown:
    """Return the scenarios that the package brings, by name; as `merge-sumo scenario list`."""
    return own_scenario.shipped()


@verb(c.NewScenario)
def new_scenario(config: c.NewScenario) -> Shown:
    """Write a scenario for a merge in a net, and a picture of the road."""
    return own_scenario.write_scenario(config)


@verb(c.CheckScenario)
def check_scenario(config: c.CheckScenario) -> Shown:
    """Say whether a scenario can be hosted, and whether the learned drivers were trained on it."""
    folder = None if config.policies is None else policies_in(config.policies)
    scenario = scenario_of(config.scenario)
    name = scenario.name if isinstance(config.scenario, Scenario) else str(config.scenario)
    return own_scenario.check_scenario(scenario, name, folder)


@verb(c.Train)
def train(config: c.Train) -> PolicyChecks:
    """Train the learned drivers and return what each loses in SUMO, by the name of the network."""
    for package in ("torch", "gymnasium"):
        if find_spec(package) is None:
            raise UserError(
                f"training needs {package}, which is not installed: run "
                "`pip install 'merge-sumo[train]'`"
            )
    from merge_sumo.training.library import checks_of

    scenario = None if config.scenario is None else scenario_of(config.scenario)
    with Bars(shown=config.progress) as bars:
        return checks_of(config, scenario, bars.counted, bars.say)
