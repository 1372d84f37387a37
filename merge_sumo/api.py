"""The functions of merge-sumo, which the command line, scripts and notebooks call.

import merge_sumo as ms

run = ms.campaign("design2", cases=400, seed=1)
run.to_dataframe()  # of pandas
run.report()        # path of the HTML report

A VUT is a spec, as for `--vut`, or a class, a function, or an object with `act` or `act_batch`.
Each function checks values and files before it runs anything. It raises `UserError` with one
sentence if one of them is wrong, or if an output exists.
A result prints as on the command line, and its `to_record()` returns the object of `--json`.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, fields, replace
from functools import cache, partial, update_wrapper, wraps
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

from threadpoolctl import threadpool_limits

from merge_sumo import config as c
from merge_sumo.analysis import (
    cases_file,
    comparison,
    counterfactuals,
    explanation,
    own_scenario,
    reproduction,
    run_study,
    sampler_study,
    share,
    vut_check,
)
from merge_sumo.analysis import probability as estimates
from merge_sumo.analysis import rerun as rerunning
from merge_sumo.analysis import stress as ladder
from merge_sumo.analysis.truth import TruthResult
from merge_sumo.campaign_run import CampaignRun, CaseRun, campaign_of, folder_of, open_recorded
from merge_sumo.campaigns.campaign import SCENARIOS, case_name, run_campaign
from merge_sumo.campaigns.from_config import (
    named_settings,
    planned_case,
    scenario_from,
    settings_from_config,
)
from merge_sumo.campaigns.printed_commands import campaign_command
from merge_sumo.campaigns.recorded import SETTINGS, RecordedCampaign, read_settings
from merge_sumo.campaigns.scenario_suggestion import unseen
from merge_sumo.campaigns.settings import CampaignSettings, settings_from_folder
from merge_sumo.controllers.controller import Car, Seen
from merge_sumo.controllers.in_memory import AnyVut, is_in_process
from merge_sumo.controllers.parameters import Range
from merge_sumo.controllers.python import SeenBatch
from merge_sumo.drivers.policies import policies_in
from merge_sumo.errors import UserError, WorkersLostError, notice
from merge_sumo.files import (
    ScratchFolder,
    check_new,
    dated,
    link_latest,
    make_folder,
    write_new,
)
from merge_sumo.interrupt import Stopped
from merge_sumo.metrics.merge import check_from
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import parse_gates
from merge_sumo.printable import either, meant, printable, quoted
from merge_sumo.records import to_plain
from merge_sumo.reports import figures
from merge_sumo.reports.cases_toml import with_file
from merge_sumo.reports.comparison_page import PAGE, comparison_page
from merge_sumo.reports.exports import export_cases
from merge_sumo.reports.junit import JUNIT, write_junit, write_junit_of_comparison
from merge_sumo.reports.progress import Bars, CampaignBars
from merge_sumo.reports.report import RunningReport, check_report, write_report
from merge_sumo.result import Shown
from merge_sumo.road.scenario_file import SUFFIX
from merge_sumo.scenario.scenario import US23, Scenario, level_name
from merge_sumo.simulation.evaluate import simulate
from merge_sumo.simulation.plan import Engine, SimulationPlan
from merge_sumo.simulation.povs import parse_levels, policies_folder
from merge_sumo.sumo import replay as replayer
from merge_sumo.sumo.binding import scratch_folder
from merge_sumo.sumo.replay import Replay
from merge_sumo.sumo.replay_folder import CONFIG, write_replay_folder
from merge_sumo.workers import open_workers

if TYPE_CHECKING:
    from merge_sumo.training.helix import PolicyChecks

__all__ = ["AnyVut", "CampaignRun", "Car", "CaseRun", "Seen", "SeenBatch", "dated"]

P = ParamSpec("P")
C = TypeVar("C")
R = TypeVar("R")
KEYWORDS: dict[str, Sequence[str]] = {}
"""Keywords of each function, by its name."""


def checked(function: Callable[P, R], name: str = "") -> Callable[P, R]:
    """Decorate a function so that it raises `UserError` for an unknown keyword.

    Args:
        function: the function.
        name: what users call it; by default its name.
    """
    name = name or function.__name__
    own = KEYWORDS[name] = list(inspect.signature(function).parameters)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        for keyword in kwargs:
            if keyword not in own:
                choice = f"{meant(keyword, own)}choose one of {', '.join(own) or 'none'}"
                others = [other for other, known in KEYWORDS.items() if keyword in known]
                where = f", which {either(others)} has" if others else ""
                raise UserError(f"{name} has no keyword `{keyword}`{where}: {choice}")
        return function(*args, **kwargs)

    return call


def verb(config: Callable[P, C]) -> Callable[[Callable[[C], R]], Callable[P, R]]:
    """Decorate a function of one config, so that callers pass the fields of the config instead.

    Args:
        config: dataclass of the fields.

    Returns:
        The decorator. `help` of the decorated function shows the docstring of the config, the
        fields under `Args:`, and the docstring of the function without its first line.
    """

    def decorated(work: Callable[[C], R]) -> Callable[P, R]:
        made = checked(config, work.__name__)

        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            # One thread: products are small, and the cores are for workers.
            with threadpool_limits(1):
                return work(made(*args, **kwargs))

        update_wrapper(call, work)
        # What `help` shows.
        vars(call)["__signature__"] = inspect.signature(config).replace(
            return_annotation=work.__annotations__["return"]
        )
        call.__doc__ = (
            f"{inspect.getdoc(config)}\n\nArgs:{_arguments(config)}\n"
            + str(inspect.getdoc(work)).partition("\n")[2]
        )
        return call

    return decorated


def _arguments(config: Any) -> str:
    """Return the fields of a config and their docstrings, as lines under `Args:`."""
    text = ""
    for field in fields(config):
        owner = next(kind for kind in config.__mro__ if field.name in kind.__annotations__)
        text += f"\n    {field.name}: {_docstrings()[owner.__name__, field.name]}"
    return text


@cache
def _docstrings() -> dict[tuple[str, str], str]:
    """Return the docstrings under the fields, by the names of the class and of the field."""
    found = {}
    for kind in ast.parse(inspect.getsource(c)).body:
        if not isinstance(kind, ast.ClassDef):
            continue
        for field, text in pairwise(kind.body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                found[kind.name, ast.unparse(field.target)] = inspect.cleandoc(
                    ast.literal_eval(text.value)
                ).replace("\n", "\n        ")
    return found


# Campaigns


@verb(c.Campaign)
def campaign(config: c.Campaign) -> CampaignRun:
    """Test a VUT and return the campaign, whether or not cases fail.

    Returns:
        The campaign: `failures` lists the failing cases, and `report()` writes the report again.

    Raises:
        UserError: a value or a file is wrong, or the folder `out` exists.

    Example:
        run = ms.campaign("design2", cases=400, seed=1)
        for case in run.failures:
            print(case["index"], case["x_pov0_m"])
    """
    settings = settings_from_config(config)
    folder = dated(settings.vut) if config.out is None else Path(config.out)
    plan = settings.load_plan()
    if {1, 2} & set(settings.levels) and unseen(settings.scenario, plan.povs.policies):
        notice(
            f"the POVs of levels 1 and 2 were not trained on {settings.scenario.name}: "
            "`merge-sumo scenario check SCENARIO` lists the differences"
        )
    check_new(folder)
    return run_and_report(settings, plan, folder, config)


@verb(c.Resume)
def resume(config: c.Resume) -> CampaignRun:
    """Continue a campaign that was stopped.

    Returns:
        The campaign, with its old and its new cases.

    Raises:
        UserError: the folder is not a campaign, or a setting differs from the recorded one.

    Example:
        run = ms.resume("runs/design2", cases=800)
    """
    folder = folder_of(config.run)
    named = named_settings(config)
    settings = settings_from_folder(folder, read_settings(folder), named, resumes=True)
    if config.level != "all":
        policies = policies_folder(settings.policies, settings.scenario)
        own = settings.pov is not None
        levels = parse_levels(config.level, policies, own=own)
        settings = replace(settings, levels=levels)
    check_report(folder)
    return run_and_report(settings, settings.load_plan(), folder, config, resumes=True)


@checked
def open_run(folder: c.AnyPath) -> CampaignRun:
    """Open the folder of a campaign without running anything.

    Args:
        folder: the folder.

    Returns:
        The campaign.

    Raises:
        UserError: the folder is not a campaign.

    Example:
        run = ms.open_run("runs/design2")
        print(run.summary)
    """
    return CampaignRun(folder)


# Cases


@verb(c.RunCase)
def run(config: c.RunCase) -> CaseRun:
    """Run one case and return it.

    Returns:
        The case: its verdict, its measures and its motion.

    Raises:
        UserError: a value or a file is wrong, or the folder `out` exists.

    Example:
        result = ms.run("design2", level=2, x_pov0_m=-298.6, v_pov0_mps=34.5, svo_rad=0.62)
        print(result)
    """
    check_from(config.from_s)
    before = None if config.recorded is None else open_recorded(config.recorded[0])
    settings, case = planned_case(config, before)
    if config.out is not None:
        check_new(Path(config.out))
    plan = settings.load_plan(debug=config.debug)
    if before is not None:
        run_study.notice_changes(before, plan)
    with open_workers(1):  # which closes the simulator
        (episode,) = simulate(plan.for_cases(1), [case])
    result = CaseRun(episode, config.from_s)
    with ExitStack() as opened:
        folder = path_of(config.out)
        if folder is None and config.gui:
            folder = opened.enter_context(scratch_folder()) / "case"
        if folder is not None:
            write_replay_folder(folder, plan.road, episode.outcome, episode.trajectory)
        if config.on_end is not None:
            config.on_end(result)
        if folder is not None and config.gui:
            replayer.open_gui(folder, config.from_s, silent=True)
    return result


@verb(c.Rerun)
def rerun(config: c.Rerun) -> comparison.Comparison:
    """Run recorded cases again with a changed VUT.

    Returns:
        The comparison of the recorded and the new results: which cases broke, and which are fixed.

    Raises:
        UserError: a value or a file is wrong, an index has no case, or an output exists.

    Example:
        compared = ms.rerun("runs/design2", vut="design2", out="changes.html")
        print(compared)
    """
    before = open_recorded(config.run)
    indices = (config.indices,) if isinstance(config.indices, int) else tuple(config.indices)
    chosen = rerunning.chosen(before, indices, config.level)
    file = before if isinstance(before, cases_file.CasesFile) else None
    out, junit = _new_files(config, SUFFIX if file else PAGE)
    some = len(chosen) < len(before.outcomes)
    if file and out is not None and some:
        raise UserError("`out` writes all cases of a cases file: omit indices and `level`")
    with opened_study(before, config, "cases again", len(chosen), engine=Engine.SUMO) as study:
        compared = rerunning.rerun(study, chosen)
    if file:
        compared = with_file(compared, file, out or file.folder)
    return _written(compared, out, junit)


def _new_files(config: c.Rerun | c.Compare, ending: str = PAGE) -> tuple[Path | None, Path | None]:
    """Return the new files of a comparison: `out`, with its ending, and `junit`.

    Raises:
        UserError: one of them exists or has another ending.
    """
    out, junit = path_of(config.out), path_of(config.junit)
    if out is not None:
        check_new(out, endings=(ending,))
    if junit is not None:
        check_new(junit, "`junit`", JUNIT)
    return out, junit


def _written(
    compared: comparison.Comparison, out: Path | None, junit: Path | None
) -> comparison.Comparison:
    """Write the page or the updated cases file, and the JUnit file, if the user names them."""
    if out is not None:
        page = compared.text or comparison_page(compared)
        write_new(out, page.encode(errors="backslashreplace"))
    if junit is not None:
        write_junit_of_comparison(junit, compared)
    return compared


@verb(c.Export)
def export(config: c.Export) -> list[Path]:
    """Write cases of a campaign as scenarios, as a table, or as a cases file.

    Returns:
        The paths of the written files.

    Raises:
        UserError: an index has no case, the format is unknown, or an output exists.

    Example:
        paths = ms.export("runs/design2", [17, 42])
    """
    indices = config.indices
    wanted = [indices] if isinstance(indices, int) else list(indices or ())
    run = campaign_of(config.run).recorded
    return export_cases(run, wanted, config.file_format, path_of(config.out))


@checked
def report(run: c.AnyRun) -> Shown:
    """Write the report of a campaign again, as `merge-sumo report` does.

    Args:
        run: the campaign, or its folder.

    Returns:
        The path of the report and its facts. `to_record()` returns both as a dictionary.

    Raises:
        UserError: the folder is not a campaign.
    """
    opened_run = campaign_of(run)
    path = str(opened_run.report())
    return Shown({"report": path, "facts": to_plain(opened_run.facts)}, [path])


@checked
def replay(folder: c.AnyRun, index: int | None = None, *, from_s: float | None = None) -> Replay:
    """Replay a case in SUMO and compare its motion with the record, as `merge-sumo replay` does.

    Args:
        folder: a scenario folder, or a campaign.
        index: index of the case of the campaign. It is exported first, if necessary.
        from_s: start relative to the first conflict, such as -3.

    Returns:
        The comparison. Its `diverged_at_s` is None if the replay is identical.

    Raises:
        UserError: the folder is neither a scenario nor a campaign, or the index has no case.

    Example:
        assert ms.replay("scenarios/stalemate").diverged_at_s is None
    """
    check_from(from_s)
    return replayer.replay(_scenario_folder(folder, index), from_s)


@checked
def open_in_gui(folder: c.AnyRun, index: int | None = None, *, from_s: float | None = None) -> None:
    """Show a case in sumo-gui until the user closes the window.

    Args:
        folder: a scenario folder, or a campaign.
        index: index of the case of the campaign. It is exported first, if necessary.
        from_s: start relative to the first conflict, such as -3.

    Raises:
        UserError: sumo-gui failed, for example without a display.
    """
    check_from(from_s)
    replayer.open_gui(_scenario_folder(folder, index), from_s)


def _scenario_folder(folder: c.AnyRun, index: int | None) -> Path:
    """Return the replay folder of a case, and write it if it does not exist."""
    path = folder_of(folder)
    if index is None:
        if (path / SETTINGS).is_file():
            raise UserError(
                f"{path} is a campaign: name a case, as in `merge-sumo replay {quoted(path)} 0`"
            )
        return path
    exported = path / SCENARIOS / case_name(index)
    if not (exported / CONFIG).is_file():
        export(folder, index)
    return exported


# Studies


@verb(c.Compare)
def compare(config: c.Compare) -> comparison.Comparison:
    """Compare recorded campaigns: broken and fixed cases.

    Returns:
        The comparison of each campaign with the one before it.

    Raises:
        UserError: the campaigns cannot be compared, or an output exists.

    Example:
        print(ms.compare(["runs/design1", "runs/design2"]))
    """
    if isinstance(config.runs, str | Path | CampaignRun):
        raise UserError("give several campaigns in a list, the oldest first")
    out, junit = _new_files(config)
    versions = [campaign_of(run).recorded for run in config.runs]
    return _written(comparison.compare(versions), out, junit)


@verb(c.GroundTruth)
def truth(config: c.GroundTruth) -> TruthResult:
    """Find the ground truth of a VUT from uniform cases.

    Returns:
        The ground truth of each level.

    Raises:
        UserError: a value or a file is wrong, or a level does not allow the engine.
    """
    settings = settings_from_config(config)
    with opened_truths(settings, config, config.engine) as study:
        return study.truths(settings, config)


@verb(c.Benchmark)
def benchmark(config: c.Benchmark) -> sampler_study.SamplerStudy:
    """Compare samplers with each other and with the ground truth.

    Returns:
        The results of all samplers.

    Raises:
        UserError: a value is wrong, a sampler is unknown, or the figure exists.
    """
    picture = path_of(config.figure)
    if picture is not None:
        check_new(picture, "`figure`", figures.KINDS)
        figures.require("matplotlib")
    names = sampler_study.names_of(config)
    settings = settings_from_config(
        config, sampler=names[0], cases=config.cases, batch=config.batch
    )
    for name in names[1:]:
        replace(settings, sampler=name)
    with opened_truths(settings, config) as study:
        result = study.compare(settings.levels, names, config)
    if picture is None:
        return result
    title = f"{sampler_study.title(settings.vut, settings.levels)}, {config.seeds} seeds"
    figures.save(figures.coverage_curves(title, result), picture)
    return replace(result, figure=picture)


@verb(c.Probability)
def probability(config: c.Probability) -> estimates.ProbabilityResult:
    """Estimate the failure probability of the VUT of a campaign.

    Returns:
        The estimate and its confidence interval.

    Raises:
        UserError: a value or a file is wrong, or the output exists.

    Example:
        found = ms.probability("runs/design2", cases=100_000)
        print(found)
    """
    before = campaign_of(config.run).recorded
    target = path_of(config.out) or before.folder / estimates.PROBABILITY.name
    total = estimates.DEFAULT_CASES if config.cases is None else config.cases
    with opened_study(before, config, "fresh cases", total, engine=config.engine) as study:
        return estimates.failure_probability(study, config, target)


@verb(c.Stress)
def stress(config: c.Stress) -> ladder.StressResult:
    """Run the cases of a campaign again, with small changes of the simulation.

    Returns:
        The failures that fail every time, and the results of each change.

    Raises:
        UserError: the VUT is code and was not given, or a value is wrong.
    """
    before = campaign_of(config.run).recorded
    ladder.STRESS.check(before.folder)
    cases = ladder.RUNS * sum(outcome.is_tested for outcome in before.outcomes)
    with opened_study(before, config, "cases again", cases) as study:
        return ladder.stress(study)


@verb(c.Explain)
def explain(config: c.Explain) -> explanation.ExplanationResult:
    """Find the smallest changes with which a failure passes.

    Returns:
        The explanation: for each coordinate and parameter the nearest value with which it passes.

    Raises:
        UserError: the case is not a failure, or the controller does not have a parameter.

    Example:
        print(ms.explain("runs/design1"))
    """
    before = campaign_of(config.run).recorded
    explanation.EXPLANATIONS.check(before.folder)
    explanation.failure_of(before, config.case)
    ranges = tuple(map(Range.parsed, config.params))
    with opened_study(before, config, "explained", 1, "failures") as study:
        return explanation.explain(study, config.case, ranges)


@verb(c.Reproduce)
def reproduce(config: c.Reproduce) -> reproduction.Reproduction:
    """Reproduce Table II and the figures of the paper.

    Returns:
        The table, and the path of the page with all figures.

    Raises:
        UserError: a value is wrong, or matplotlib is missing.
    """
    scale = reproduction.scale_of(config)
    policies, folder = policies_folder(config.policies, US23), path_of(config.out)
    figures.require("matplotlib")
    folder = folder or dated("reproduce")
    with open_workers(config.workers) as workers, Bars(shown=config.progress) as bars:
        make_folder(folder)
        result = reproduction.reproduce(
            scale, policies=policies, workers=workers, on_part=bars.counted
        )
    return replace(result, page=figures.write_reproduction(result, folder))


# Bring your own: VUTs, scenarios, learned drivers


@verb(c.Vuts)
def vuts(config: c.Vuts) -> Shown:
    """List the vehicles that can be tested, and the kinds that users can bring.

    Returns:
        The built-in and the installed VUTs, and the forms of all kinds.
    """
    return vut_check.known_vuts(config.policies)


@verb(c.CheckVut)
def check_vut(config: c.CheckVut) -> vut_check.VutCheck:
    """Check a VUT in a few cases.

    Returns:
        The errors of the VUT and the time of a step. `ok` is true if there are no errors.

    Raises:
        UserError: the VUT or the scenario does not exist.

    Example:
        found = ms.check_vut("my_vut.py:MyVut")
        assert found.ok, found.problems
    """
    scenario = scenario_from(config.scenario or US23)
    settings = CampaignSettings(scenario=scenario, levels=(0,), **named_settings(config))
    with Bars() as bars:
        bars.say(f"{printable(settings.vut)} drives a few cases, which may take minutes")
        return vut_check.check_vut(settings)


@checked
def scenarios() -> Shown:
    """List the shipped scenarios by name, as `merge-sumo scenario list` does.

    Returns:
        The scenarios. `to_record()` returns all their numbers.
    """
    return own_scenario.shipped()


@verb(c.NewScenario)
def new_scenario(config: c.NewScenario) -> Shown:
    """Write a scenario for a merge in a net, and a picture of the road.

    Returns:
        The paths of the file and of the picture, and remarks on the road.

    Raises:
        UserError: the net has no such merge, or the file exists.
    """
    return own_scenario.write_scenario(config)


@verb(c.CheckScenario)
def check_scenario(config: c.CheckScenario) -> Shown:
    """Check that a scenario can run, and whether the learned drivers were trained on it.

    Returns:
        The road, and the differences between the scenario and the training.

    Raises:
        UserError: the scenario or its road is wrong.
    """
    folder = None if config.policies is None else policies_in(config.policies)
    scenario = scenario_from(config.scenario)
    name = scenario.name if isinstance(config.scenario, Scenario) else str(config.scenario)
    return own_scenario.check_scenario(scenario, name, folder)


@verb(c.Train)
def train(config: c.Train) -> PolicyChecks:
    """Train the learned drivers and measure their regret in SUMO.

    Returns:
        The regret of each network, by name.

    Raises:
        UserError: a value is wrong, or an extra that training needs is not installed.
    """
    from merge_sumo.training.helix import train_and_check

    scenario = None if config.scenario is None else scenario_from(config.scenario)
    with Bars(shown=config.progress) as bars:
        return train_and_check(config, scenario, bars.counted, bars.say)


# Shared by the verbs


@contextmanager
def opened_study(
    run: RecordedCampaign,
    config: c.StudyOptions,
    title: str,
    total: int | Mapping[Engine, int],
    unit: str = "cases",
    *,
    engine: str | None = None,
) -> Iterator[run_study.RunStudy]:
    """Open a campaign for a study that runs cases of the campaign, with a progress bar.

    Args:
        run: the campaign.
        config: how and where the cases run.
        title: title of the bar.
        total: number of cases, or the numbers by engine.
        unit: name of the counted things.
        engine: engine that moves the vehicles.
    """
    settings = settings_from_folder(run.folder, run.record, named_settings(config))
    plan = settings.load_plan().with_engine(engine)
    number = total if isinstance(total, int) else total[plan.engine]
    bars = Bars(shown=config.progress)
    with open_workers(plan.workers(config.workers)) as workers, bars:
        ended = bars.counter(title, number, unit)
        yield run_study.RunStudy(run, settings, plan, workers, ended)


@contextmanager
def opened_truths(
    settings: CampaignSettings, config: c.Execution, engine: str | None = None
) -> Iterator[sampler_study.Study]:
    """Open a study of ground truths. It does not keep truths of objects of this process.

    Args:
        settings: the settings of the study.
        config: where its cases run.
        engine: engine that moves the vehicles; by default the kinematic one, if possible.

    Raises:
        UserError: a level does not allow the engine.
    """
    plan = settings.load_plan()
    for level in settings.levels:
        plan.at_level(level).with_engine(engine)
    passing = is_in_process(settings.vut) or is_in_process(settings.pov or "")
    with (
        open_workers(plan.workers(config.workers)) as workers,
        ScratchFolder() as folder,
        Bars(shown=config.progress) as bars,
    ):
        yield sampler_study.Study(
            plan, workers, Path(folder) if passing else None, bars.counted, engine
        )


def path_of(path: Path | str | None) -> Path | None:
    """Return a path of a user as a `Path`.

    Args:
        path: the path; None stands for no path.
    """
    return None if path is None else Path(path)


def run_and_report(
    settings: CampaignSettings,
    plan: SimulationPlan,
    folder: Path,
    config: c.CampaignCalls,
    *,
    resumes: bool = False,
) -> CampaignRun:
    """Run a campaign to its end and return it: cases, counterfactuals, report and JUnit file.

    The exception of an interruption has a note that says how to continue.

    Args:
        settings: the settings of the campaign.
        plan: how its cases run.
        folder: a new folder, or the folder of the campaign.
        config: gates, JUnit file, workers, and functions to call.
        resumes: whether the campaign continues in the folder.
    """
    junit = path_of(config.junit)
    parse_gates(config.gates, against=settings.against is not None)
    if junit is not None:
        check_new(junit, "`junit`", JUNIT)
    bars = CampaignBars(folder, settings.cases, settings.tolerated, shown=config.progress)
    title = f"{settings.vut} v level {'/'.join(map(level_name, settings.levels))}"

    def on_cases(outcomes: Sequence[Outcome]) -> None:
        if config.on_case is not None:
            for outcome in outcomes:
                config.on_case(outcome)
        if config.check is not None:
            config.check()

    def _on_part(title: str, unit: str, done: int, total: int) -> None:
        bars.counted(title, done, total, unit)
        on_cases(())

    workers = plan.workers(config.workers, settings.cases)
    try:
        with open_workers(workers) as available, bars, RunningReport(folder) as report:
            callbacks = bars.ended, report.rewrite, on_cases
            begin = partial(bars.begin, title)
            done = run_campaign(
                settings, plan, folder, callbacks, resumes=resumes, workers=available, begin=begin
            )
            result = CampaignRun(done, config.gates)
            study = run_study.RunStudy(done, settings, replace(plan, against=None), available)
            counterfactuals.write_avoidance(
                study, partial(_on_part, "reference drivers", "failures")
            )
            share.write_shares(study, partial(_on_part, "uniform starts", "cases"))
            explanation.write_worst_explanation(study)
            link_latest(folder)
            write_report(done)
    except (KeyboardInterrupt, Stopped, WorkersLostError) as stop:
        if folder.exists():
            link_latest(folder)
            # Gates, files and the address of a cluster are not among the settings.
            gates = list(config.gates) or None
            cluster = workers if isinstance(workers, str) else None
            more = {"gates": gates, "junit": junit, "workers": cluster}
            command = campaign_command("resume", folder, asdict(settings), **more)
            stop.add_note(f"continue with: {command}")
        raise
    if junit is not None:
        write_junit(junit, result)
    return result
