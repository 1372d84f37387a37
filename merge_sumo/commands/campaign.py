"""The command campaign."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_sumo.commands.shared import (
    DaskOption,
    DeadlineOption,
    JsonOption,
    NetOption,
    VutCommandOption,
    app,
    say,
    show,
)
from merge_sumo.errors import UserError
from merge_sumo.folders import dated
from merge_sumo.printable import quoted
from merge_sumo.samplers import DEFAULT_SAMPLER
from merge_sumo.scenario import DEADLINE_S

if TYPE_CHECKING:
    from merge_sumo.journal import Run
    from merge_sumo.summary import Summary


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
    level: Annotated[str, typer.Option(help="POV level: 0, 1, 2 or all.")] = "all",
    sampler: Annotated[
        str, typer.Option(help="Who chooses: uniform, annealing, subset, gpr or coverage.")
    ] = DEFAULT_SAMPLER,
    cases: Annotated[int, typer.Option(help="Number of test cases.")] = 800,
    batch: Annotated[
        int | None, typer.Option(help="Cases per batch.  [default: 40, or all if fewer]")
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same outcomes.")] = 0,
    v_vut0: Annotated[float, typer.Option(help="Initial speed of the VUT in m/s.")] = 18.0,
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
    out: Annotated[
        Path | None, typer.Option(help="New folder to write.  [default: runs/VUT-DATE]")
    ] = None,
    resume: Annotated[
        Path | None, typer.Option(help="Go on with the campaign in this folder; needs no --vut.")
    ] = None,
    force: Annotated[
        bool, typer.Option(help="Resume although something differs; campaign.json records it.")
    ] = False,
    workers: Annotated[
        int, typer.Option(help="Processes that run cases; the outcomes are the same.")
    ] = 1,
    dask: DaskOption = None,
    net: NetOption = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Show no progress.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Test a VUT: run cases in SUMO, find failures, write a report and replayable scenarios.

    Ctrl-C lets the running batch end and says how to go on; twice stops at once.

    Example:  merge-sumo campaign --vut design1 --level 0 --cases 400 --batch 20 --seed 1
    """
    from merge_sumo import conductor
    from merge_sumo.interrupt import Interrupt, Stopped
    from merge_sumo.journal import read_settings
    from merge_sumo.progress import CampaignPanel
    from merge_sumo.report import check_report, write_report
    from merge_sumo.summary import summarise
    from merge_sumo.sumo.net import Net
    from merge_sumo.workers import open_workers

    if resume is None:
        levels = conductor.parse_levels(level)
        settings = conductor.CampaignSettings(
            vut=vut,
            levels=levels,
            sampler=sampler,
            cases=cases,
            batch=min(conductor.DEFAULT_BATCH, max(cases, 1)) if batch is None else batch,
            seed=seed,
            v_vut0_mps=v_vut0,
            stop_after_converged=stop_after_converged,
            vut_command=vut_command,
            deadline_s=deadline,
        )
        folder = out or dated(vut)
    else:
        given = _given(context)
        settings = conductor.settings_of(resume, {**read_settings(resume), **given})
        folder, levels = resume, settings.levels
        check_report(folder)
    title = f"{settings.vut} v level {'/'.join(map(str, levels))}"
    try:
        with (
            Interrupt("finishing the running batch; once more stops at once") as interrupt,
            open_workers(settings.vut_factory.workers(workers), dask) as there,
            CampaignPanel(title, settings.cases, levels, quiet=quiet) as progress,
        ):
            if resume is None:
                run = conductor.run_campaign(
                    settings,
                    folder,
                    Net(net),
                    progress.case_ended,
                    workers=there,
                    check=interrupt.check,
                )
            else:
                run = conductor.resume_campaign(
                    folder,
                    Net(net),
                    progress.case_ended,
                    given=given,
                    force=force,
                    workers=there,
                    check=interrupt.check,
                    warn=say,
                )
    except Stopped:
        say(_how_to_go_on(folder, net))
        raise
    if resume is None and level == "all" and len(levels) < 3:
        named = ", ".join(map(str, levels))
        say(f"--level all: policies are there for level {named}; `merge-sumo train` makes others")
    report_file = write_report(run)
    summary = summarise(run.outcomes, levels)
    converged = len(run.outcomes) < cases
    if as_json:
        stopped = "converged" if converged else "cases"
        paths = {"run": str(folder), "report": str(report_file)}
        typer.echo(json.dumps({**asdict(summary), "stopped": stopped, **paths}))
    else:
        if converged:
            show(
                f"stopped after {len(run.outcomes)} of {cases} cases: three times in a row the "
                f"next batch was expected to add less than {stop_after_converged:.2%} to the "
                "coverage (this says nothing of regions that no case has come near)"
            )
        _print_summary(run, summary, report_file)


def _given(context: typer.Context) -> dict[str, object]:
    """Return the settings that a person wrote, by their names in `CampaignSettings`."""
    from merge_sumo.conductor import parse_levels

    names = {
        name: name
        for name in (
            "vut",
            "sampler",
            "cases",
            "batch",
            "seed",
            "stop_after_converged",
            "vut_command",
        )
    }
    names |= {"level": "levels", "v_vut0": "v_vut0_mps", "deadline": "deadline_s"}
    given: dict[str, object] = {}
    for option, name in names.items():
        source = context.get_parameter_source(option)
        if source is not None and source.name == "COMMANDLINE":
            value = context.params[option]
            given[name] = parse_levels(value) if option == "level" else value
    if context.params["out"] is not None:
        raise UserError("--resume names the folder: leave --out away")
    return given


def _how_to_go_on(folder: Path, net: Path | None) -> str:
    if not folder.exists():
        return "stopped before the first case; nothing was written"
    command = f"merge-sumo campaign --resume {quoted(folder)}"
    return f"stopped; go on with: {command}" + (f" --net {quoted(net)}" if net is not None else "")


def _print_summary(run: Run, summary: Summary, report_file: Path) -> None:
    from merge_sumo.conductor import SCENARIOS, case_name
    from merge_sumo.journal import failures

    show(f"{summary.failures} failures in {summary.cases} cases")
    for level, found in summary.levels.items():
        show(
            f"  level {level}: {found.failures} failures in {found.cases} cases, "
            f"FMC {found.fmc:.4f}, {found.regions} regions"
        )
    others = {end: n for end, n in summary.ends.items() if end not in ("MERGED", "COLLISION")}
    if others:
        show("  " + ", ".join(f"{n} {end}" for end, n in others.items()))
    show(f"report: {report_file}")
    worst = failures(run.outcomes)
    if worst:
        folder = run.folder / SCENARIOS / case_name(worst[0].index)
        show(f"worst case: merge-sumo replay {quoted(folder)} --gui")
