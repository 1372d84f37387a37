"""A campaign from its settings to its report: what `campaign` and `resume` share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter

from merge_sumo import config as c
from merge_sumo.analysis.counterfactuals import AVOIDANCE, avoidance
from merge_sumo.analysis.explanation import note_explanation
from merge_sumo.analysis.share import note_shares
from merge_sumo.api.results import CampaignRun
from merge_sumo.api.settings import opened
from merge_sumo.campaigns.again import call_again
from merge_sumo.campaigns.campaign import run_campaign
from merge_sumo.campaigns.scenario_suggestion import unseen
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.errors import WorkersLostError, notice
from merge_sumo.files import check_new, link_latest
from merge_sumo.interrupt import Stopped
from merge_sumo.metrics.score import Outcome
from merge_sumo.metrics.summary import parse_gates
from merge_sumo.printable import quoted
from merge_sumo.reports.junit import check_junit, write_junit
from merge_sumo.reports.progress import CampaignBars
from merge_sumo.reports.report import RunningReport, check_report, write_report
from merge_sumo.road.scenario_file import spoken_name
from merge_sumo.scenario.scenario import (
    LEVELS,
    OWN,
    US23,
    MergeScenario,
    Scenario,
    lane_of,
    level_name,
)
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import Workers, workers_or_here


def run_and_report(
    settings: CampaignSettings,
    plan: SimulationPlan,
    folder: Path,
    where: c.Execution,
    config: c.CampaignCalls,
    *,
    resumes: bool = False,
) -> CampaignRun:
    """Run a campaign to its end: cases, counterfactuals, report, JUnit file; return it.

    An interruption has a note on how to continue.

    Args:
        settings: the settings of the campaign.
        plan: how its cases run.
        folder: a new folder, or that of the campaign.
        where: where its cases run.
        config: gates, JUnit file, and functions that are called.
        resumes: whether the campaign continues in the folder.
    """
    junit = None if config.junit is None else Path(config.junit)
    parse_gates(config.gates, against=settings.against is not None)
    if junit is not None:
        check_junit(junit, folder)
    if resumes:
        check_report(folder)
    else:
        check_new(folder)
    check = config.check or (lambda: None)
    bars = CampaignBars(folder, settings.cases, settings.tolerated, shown=where.progress)
    title = f"{settings.vut} v level {'/'.join(map(level_name, settings.levels))}"

    report = RunningReport(folder)

    def on_cases(outcomes: Sequence[Outcome]) -> None:
        if config.on_case is not None:
            for outcome in outcomes:
                config.on_case(outcome)
        check()

    try:
        with opened(where, plan) as workers, bars, report:
            begun_s = perf_counter()
            done = run_campaign(
                settings,
                plan,
                folder,
                (bars.ended, report.rewrite, on_cases),
                resumes=resumes,
                on_before=bars.ran_before,
                workers=workers,
                begin=lambda: bars.begin(title),
                warn=notice,
            )
            result = CampaignRun(done, config.gates)
            took_s = perf_counter() - begun_s
            _write_findings(result, replace(plan, against=None), workers, took_s, bars, check)
    except (KeyboardInterrupt, Stopped, WorkersLostError) as stop:
        if folder.exists():
            link_latest(folder)
            address = {"workers": where.workers} if isinstance(where.workers, str) else {}
            goes_on_by = call_again("resume", folder, asdict(settings), **address)
            stop.add_note(f"stopped; go on with {goes_on_by}")
        raise
    if junit is not None:
        write_junit(junit, done, result.facts, result.verdict, result.gates)
    return result


def _write_findings(
    result: CampaignRun,
    plan: SimulationPlan,
    workers: Workers,
    took_s: float,
    bars: CampaignBars,
    check: Callable[[], None],
) -> None:
    """Write what follows the cases into the folder: counterfactuals, shares and report."""

    def counted(title: str, unit: str) -> Callable[[int, int], None]:
        return lambda count, total: bars.counted(title, count, total, unit)

    done, careful = result.run, counted("careful drivers", "failures")
    # The careful drivers are models of merges.
    if isinstance(plan.scenario, MergeScenario) and (
        known := avoidance(done, plan, workers=workers, check=check, on_part=careful)
    ):
        AVOIDANCE.write_lines(done.folder, known)
    uniform = counted("uniform starts", "cases")
    note_shares(done, plan, workers, took_s, check, uniform)
    with workers_or_here(None) as here:  # worker processes take longer to start than these cases
        note_explanation(done, plan, here, check)
    link_latest(done.folder)
    write_report(done, result.summary, counted("surrogates of the report", "levels"))


def notice_povs(settings: CampaignSettings, plan: SimulationPlan, config: c.Campaign) -> None:
    """Warn with a `Notice` of POVs that are missing, not trained on the scenario, or see no VUT."""
    levels = set(LEVELS) & set(settings.scenario.levels)
    if config.level == "all" and not levels <= set(settings.levels):
        present = ", ".join(map(level_name, settings.levels))
        notice(
            f"`level` all: policies are there for level {present}; `merge-sumo train` makes others"
        )
    if {1, 2} & set(settings.levels) and unseen(settings.scenario, plan.povs.policies):
        scenario = config.scenario or US23
        name = spoken_name(scenario) if isinstance(scenario, Scenario) else str(scenario)
        option = "" if config.policies is None else f" --policies {quoted(config.policies)}"
        check = f"`merge-sumo scenario check {quoted(name or '')}{option}`"
        notice(
            f"note: the POVs of levels 1 and 2 were not trained on {settings.scenario.name}"
            f"{f': {check} says in what it differs' if name else ''}"
        )
    own, by_sumo = plan.povs.own, plan.vut.vut_type is not None
    on_lane = OWN in settings.levels and lane_of(settings.scenario) is not None
    if on_lane and own is not None and own.vut_type is not None and not by_sumo:
        # SUMO's drivers make room for a car next to them where its lane-change model asks them to.
        notice(
            f"note: until the VUT has merged, the POV {own.spec} keeps its speed: on an "
            "acceleration lane SUMO's drivers see only a VUT that SUMO drives, too (sumo:MODEL)"
        )
