"""The command campaign."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from merge_sumo.commands.shared import (
    DaskOption,
    DeadlineOption,
    FailWhenOption,
    FollowUpOption,
    InProcessOption,
    JsonOption,
    NetOption,
    PoliciesOption,
    PovOption,
    RequireOption,
    ScenarioOption,
    TrustOption,
    VutCommandOption,
    VutMemoryOption,
    app,
    followed_up,
    print_troubles,
    say,
    show,
    written,
    written_settings,
)
from merge_sumo.errors import UserError
from merge_sumo.samplers import DEFAULT_SAMPLER
from merge_sumo.system.folders import dated, link_latest
from merge_sumo.system.printable import quoted
from merge_sumo.values.scenario import DEADLINE_S, LEVELS, MEMORY_GIB, level_name

if TYPE_CHECKING:
    from merge_sumo.campaigns.run import Run
    from merge_sumo.campaigns.settings import CampaignSettings
    from merge_sumo.reports.campaign_panel import CampaignPanel
    from merge_sumo.reports.summary import Summary
    from merge_sumo.reports.verdict import Gate, Verdict
    from merge_sumo.sumo.corridor import Corridor
    from merge_sumo.system.interrupt import Interrupt
    from merge_sumo.system.workers import Workers


@app.command()
def campaign(
    context: typer.Context,
    vut: Annotated[
        str,
        typer.Option(
            help="Vehicle under test: level0, level1, level2, design1 or design2, or your own: "
            "`merge-sumo vuts` lists the kinds."
        ),
    ] = "",
    level: Annotated[str, typer.Option(help="POV level: 0, 1, 2, own or all.")] = "all",
    pov: PovOption = None,
    sampler: Annotated[
        str, typer.Option(help="Who chooses: uniform, annealing, subset, gpr or coverage.")
    ] = DEFAULT_SAMPLER,
    cases: Annotated[int, typer.Option(help="Number of test cases.")] = 800,
    batch: Annotated[
        int | None,
        typer.Option(
            help="Cases per batch.  [default: few, later more, for coverage; 40 for the others]"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same outcomes.")] = 0,
    learn_from: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RUN",
            help="An earlier campaign, of another version or at other levels, to learn the VUT "
            "from. May be given several times.",
        ),
    ] = None,
    scenario: ScenarioOption = "us23",
    policies: PoliciesOption = None,
    fail_when: FailWhenOption = "paper",
    require: RequireOption = None,
    follow_up: FollowUpOption = None,
    v_vut0: Annotated[
        float | None,
        typer.Option(help="Initial speed of the VUT in m/s.  [default: the scenario's, 18]"),
    ] = None,
    stop_after_converged: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="Stop early when, three batches in a row, the next batch is expected to add less "
            "than this share to the coverage. Needs a sampler that can tell: coverage.",
        ),
    ] = None,
    vut_command: VutCommandOption = None,
    deadline: DeadlineOption = DEADLINE_S,
    vut_memory: VutMemoryOption = MEMORY_GIB,
    in_process: InProcessOption = False,
    out: Annotated[
        Path | None, typer.Option(help="New folder to write.  [default: runs/VUT-DATE]")
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(help="Go on with the campaign in this folder; --cases may be more."),
    ] = None,
    force: Annotated[
        bool, typer.Option(help="Resume although something differs; campaign.json records it.")
    ] = False,
    trust_vut: TrustOption = False,
    workers: Annotated[
        int, typer.Option(help="Processes that run cases; the outcomes are the same.")
    ] = 1,
    dask: DaskOption = None,
    net: NetOption = None,
    gate: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GATE",
            help='Exit with 1 if there are failures, errors, timeouts, or "fmc>X": an FMC above X '
            "at some level. May be given several times.",
        ),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(metavar="FILE", help="New file to write for CI: JUnit XML.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Test a VUT: run cases in SUMO, find failures, write a report and replayable scenarios.

    Ctrl-C lets the running batch end and says how to go on; twice stops at once.

    Exit code 1 when a --gate is met, and always when the VUT reached the merge point in no case:
    then nothing was tested. 2 for bad use, 130 or 143 when it was stopped, else 0.

    Example:  merge-sumo campaign --vut design1 --level 0 --cases 400 --batch 20 --seed 1
    """
    from merge_sumo.campaigns import conductor
    from merge_sumo.campaigns.ground import road_for
    from merge_sumo.campaigns.run import read_settings
    from merge_sumo.campaigns.settings import (
        CampaignSettings,
        parse_levels,
        povs_of,
        settings_of,
    )
    from merge_sumo.drivers.vuts.base import VutOptions
    from merge_sumo.reports.campaign_panel import panel_of
    from merge_sumo.reports.junit import check_junit
    from merge_sumo.reports.report import check_report
    from merge_sumo.reports.verdict import parse_gates
    from merge_sumo.scenarios.scenario_file import named_scenario
    from merge_sumo.system.interrupt import Interrupt, Stopped
    from merge_sumo.system.workers import open_workers

    gates = parse_gates(gate or ())
    if resume is None:
        where = followed_up(named_scenario(scenario), follow_up)
        options = VutOptions(deadline_s=deadline, memory_gib=vut_memory, in_process=in_process)
        levels = parse_levels(level, povs_of(policies, where, pov, options))
        settings = CampaignSettings(
            vut=vut,
            levels=levels,
            sampler=sampler,
            cases=cases,
            batch=batch,
            seed=seed,
            v_vut0_mps=v_vut0,
            stop_after_converged=stop_after_converged,
            vut_command=vut_command,
            deadline_s=deadline,
            vut_memory_gib=vut_memory,
            in_process=in_process,
            policies=None if policies is None else str(policies),
            pov=pov,
            learn_from=tuple(map(str, learn_from or ())),
            scenario=where,
            fail_when=fail_when,
            require=require,
        )
        folder = out or dated(vut)
    else:
        given = _given(context)
        settings = settings_of(resume, read_settings(resume), given, trust=trust_vut)
        if "level" in written(context):
            settings = replace(settings, levels=parse_levels(level, settings.povs))
            given["levels"] = settings.levels
        folder, levels = resume, settings.levels
        check_report(folder)
    if junit is not None:
        check_junit(junit, folder)
    road = road_for(settings.scenario, net)
    if resume is None:
        _say_unseen(settings, scenario, policies)
    title = f"{settings.vut} v level {'/'.join(map(level_name, levels))}"
    try:
        with (
            Interrupt("finishing the running batch; once more stops at once") as interrupt,
            open_workers(settings.workers(workers), dask) as there,
            panel_of(
                title, settings.cases, levels, folder, workers=there.count, quiet=quiet
            ) as progress,
        ):
            if resume is None:
                run = conductor.run_campaign(
                    settings,
                    folder,
                    road,
                    progress.case_ended,
                    workers=there,
                    check=interrupt.check,
                )
            else:
                run = conductor.resume_campaign(
                    folder,
                    road,
                    progress.case_ended,
                    on_before=progress.ran_before,
                    given=given,
                    force=force,
                    workers=there,
                    check=interrupt.check,
                    warn=say,
                    trust=trust_vut,
                )
            found = _looked_back(
                run, settings, road, there, interrupt, progress, local=dask is None
            )
    except Stopped:
        say(_how_to_go_on(folder, net, [gate.name for gate in gates], junit))
        raise
    if resume is None and level == "all" and not set(levels) >= set(LEVELS):
        named = ", ".join(map(level_name, levels))
        say(f"--level all: policies are there for level {named}; `merge-sumo train` makes others")
    raise typer.Exit(0 if _conclude(found, settings, gates, junit, as_json=as_json) else 1)


class _Found(NamedTuple):
    """What a campaign found, and where it is told."""

    run: Run
    summary: Summary
    careful: str | None
    report_file: Path


def _looked_back(
    run: Run,
    settings: CampaignSettings,
    road: Corridor,
    workers: Workers,
    interrupt: Interrupt,
    progress: CampaignPanel,
    *,
    local: bool,
) -> _Found:
    """Drive the failures of a campaign again, and write its report."""
    from merge_sumo.campaigns.avoidance import note_avoidance
    from merge_sumo.reports.report import write_report
    from merge_sumo.reports.summary import summarise

    careful = note_avoidance(
        run,
        settings,
        road,
        workers=workers,
        check=interrupt.check,
        on_part=progress.driven_again,
    )
    link_latest(run.folder)
    summary = summarise(run.outcomes, settings.levels)
    # Learned on another machine, surrogates may differ in a last bit.
    report_file = write_report(run, summary, workers if local else None, progress.report_part)
    return _Found(run, summary, careful, report_file)


def _conclude(
    found: _Found,
    settings: CampaignSettings,
    gates: list[Gate],
    junit: Path | None,
    *,
    as_json: bool,
) -> bool:
    """Print what a campaign found; return whether it passed."""
    from merge_sumo.reports.junit import write_junit
    from merge_sumo.reports.verdict import NOTHING_TESTED, judge

    run, summary, careful, report_file = found
    verdict = judge(run.outcomes)
    results = [gate.check(verdict, summary) for gate in gates]
    passed = verdict.tested > 0 and not any(result.met for result in results)
    converged = len(run.outcomes) < settings.cases
    if as_json:
        judged = {
            **asdict(summary),
            **verdict.to_record(),
            "gates": {result.name: result.met for result in results},
            "passed": passed,
            "stopped": "converged" if converged else "cases",
            "careful": careful,
            "fail_when": run.criterion.text,
        }
        paths = {"run": str(run.folder), "report": str(report_file)}
        typer.echo(json.dumps({**judged, **paths}))
    else:
        if converged:
            show(
                f"stopped after {len(run.outcomes)} of {settings.cases} cases: three times in a "
                "row the next batch was expected to add less than "
                f"{settings.stop_after_converged:.2%} to the coverage (this says nothing of "
                "regions that no case has come near)"
            )
        _print_summary(run, summary, verdict, careful, report_file)
    if junit is not None:
        write_junit(junit, run, summary.levels, verdict, results)
    for result in results:
        say(result.sentence)
    if not verdict.tested:
        say(NOTHING_TESTED)
    return passed


def _say_unseen(settings: CampaignSettings, scenario: str, policies: Path | None) -> None:
    """Say where the POVs were not trained on the scenario."""
    from merge_sumo.scenarios.suggestion import unseen

    learned = {1, 2} & set(settings.levels)
    if learned and unseen(settings.scenario, settings.povs.policies):
        named = "" if policies is None else f" --policies {quoted(policies)}"
        say(
            f"note: the POVs of levels 1 and 2 were not trained on {settings.scenario.name}: "
            f"`merge-sumo scenario check {quoted(scenario)}{named}` says in what it differs"
        )


def _given(context: typer.Context) -> dict[str, object]:
    """Return the settings that a person wrote beside --resume."""
    if context.params["out"] is not None:
        raise UserError("--resume names the folder: leave --out away")
    return written_settings(context)


def _how_to_go_on(folder: Path, net: Path | None, gates: list[str], junit: Path | None) -> str:
    if not folder.exists():
        return "stopped before the first case; nothing was written"
    link_latest(folder)
    command = f"merge-sumo campaign --resume {quoted(folder)}"
    command += f" --net {quoted(net)}" if net is not None else ""
    # Neither is a setting of the campaign, which its folder would remember.
    command += "".join(f" --gate {quoted(gate)}" for gate in gates)
    command += f" --junit {quoted(junit)}" if junit is not None else ""
    return f"stopped; go on with: {command}"


def _print_summary(
    run: Run, summary: Summary, verdict: Verdict, careful: str | None, report_file: Path
) -> None:
    from merge_sumo.campaigns.conductor import SCENARIOS, case_name
    from merge_sumo.campaigns.run import failures
    from merge_sumo.reports.verdict import counted

    show(verdict.counts)
    if not run.criterion.is_papers:
        show(f"  a case fails when {run.criterion.words}")
    if summary.severities:
        counts = ", ".join(f"{number} {name}" for name, number in summary.severities.items())
        show(f"  severity: {counts}")
    print_troubles(verdict)
    for level, found in summary.levels.items():
        if found.cases and not found.tested:
            show(f"  level {level_name(level)}: nothing was tested in {found.cases} cases")
            continue
        unseen = found.unseen
        empty = (
            ""
            if unseen is None
            else f"; largest ball without a case: {unseen.radius:.0%} of the axes"
        )
        show(
            f"  level {level_name(level)}: {counted(found.failures, 'failure')} in "
            f"{counted(found.cases, 'case')}, FMC {found.fmc:.4f}, "
            f"{counted(found.regions, 'region')}{empty}"
        )
    if careful is not None:
        show(careful)
    show(f"report: {report_file}")
    worst = failures(run.outcomes)
    if worst:
        folder = run.folder / SCENARIOS / case_name(worst[0].index)
        show(f"worst case: merge-sumo replay {quoted(folder)} --gui")
