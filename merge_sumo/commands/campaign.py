"""The command campaign."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from merge_sumo.commands import complete
from merge_sumo.commands.shared import (
    DaskOption,
    DeadlineOption,
    FailWhenOption,
    FollowUpOption,
    InProcessOption,
    JsonOption,
    LevelOption,
    NetOption,
    PoliciesOption,
    PovOption,
    QuietOption,
    RequireOption,
    ScenarioOption,
    TrustOption,
    VutCommandOption,
    VutMemoryOption,
    VutOption,
    WorkersOption,
    app,
    print_troubles,
    print_unrepeatable,
    say,
    settings_in,
    show,
    written_settings,
)
from merge_sumo.errors import UserError
from merge_sumo.samplers import DEFAULT_SAMPLER
from merge_sumo.system.folders import dated, link_latest
from merge_sumo.system.printable import quoted
from merge_sumo.values.scenario import DEADLINE_S, LEVELS, MEMORY_GIB, level_name

if TYPE_CHECKING:
    from merge_sumo.analysis.summary import Summary
    from merge_sumo.analysis.verdict import Gate, Verdict
    from merge_sumo.api.results import CampaignRun
    from merge_sumo.campaigns.run import Run


@app.command()
def campaign(
    context: typer.Context,
    vut: VutOption = "",
    level: LevelOption = "all",
    pov: PovOption = None,
    sampler: Annotated[
        str,
        typer.Option(
            help="What chooses the cases: {samplers}.",
            autocompletion=complete.samplers,
        ),
    ] = DEFAULT_SAMPLER,
    cases: Annotated[int, typer.Option(help="Number of test cases.")] = 800,
    batch: Annotated[
        int | None,
        typer.Option(
            help="Cases per batch.", show_default="few, later more, for coverage; 40 for others"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(help="Same seed, same outcomes.")] = 0,
    learn_from: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="RUN",
            help="An earlier campaign, of another version or at other levels, to learn the VUT "
            "from. May be given several times.",
            autocompletion=complete.runs,
        ),
    ] = None,
    scenario: ScenarioOption = "us23",
    policies: PoliciesOption = None,
    fail_when: FailWhenOption = "paper",
    require: RequireOption = None,
    follow_up: FollowUpOption = None,
    v_vut0: Annotated[
        float | None,
        typer.Option(
            help="Initial speed of the VUT in m/s.", show_default="the scenario's, 18 in us23"
        ),
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
        Path | None, typer.Option(help="New folder to write.", show_default="runs/VUT-DATE")
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="Go on with the campaign in this folder; --cases may be more.",
            autocompletion=complete.runs,
        ),
    ] = None,
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="Resume although something differs; campaign.json records it."
        ),
    ] = False,
    trust_vut: TrustOption = False,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
    net: NetOption = None,
    gate: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GATE",
            help='Exit with 1 if there are failures, errors, timeouts, or "fmc>X": an FMC above X '
            "at some level. May be given several times.",
            autocompletion=complete.gates,
        ),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(metavar="FILE", help="New file to write for CI: JUnit XML.")
    ] = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Test a VUT: run cases in SUMO, find failures, write a report and replayable scenarios.

    Ctrl-C lets the running batch end and says how to go on; twice stops at once.

    Exit code 1 when a --gate is met, and always when the VUT reached the merge point in no case:
    then nothing was tested. 2 for bad use, 130 or 143 when it was stopped, else 0.

    Example:  merge-sumo campaign --vut design1 --level 0 --cases 400 --batch 20 --seed 1
    """
    from merge_sumo import api
    from merge_sumo.analysis.verdict import parse_gates
    from merge_sumo.reports.junit import check_junit
    from merge_sumo.system.interrupt import Interrupt, Stopped

    if resume is not None and out is not None:
        raise UserError("--resume names the folder: leave --out away")
    gates = parse_gates(gate or ())
    folder = resume or out or dated(vut)
    if junit is not None:
        check_junit(junit, folder)
    try:
        with Interrupt("finishing the running batch; once more stops at once") as interrupt:
            where: dict[str, Any] = {"net": net, "workers": workers, "dask": dask}
            where |= {"check": interrupt.check, "progress": not quiet}
            if resume is None:
                run = api.campaign(**settings_in(context), out=folder, **where)
            else:
                where |= {"force": force, "trust_vut": trust_vut, **written_settings(context)}
                run = api.resume(folder, **where)
    except Stopped:
        say(_how_to_go_on(folder, net, [gate.name for gate in gates], junit))
        raise
    levels = run.settings["levels"]
    if resume is None and level == "all" and not set(levels) >= set(LEVELS):
        named = ", ".join(map(level_name, levels))
        say(f"--level all: policies are there for level {named}; `merge-sumo train` makes others")
    raise typer.Exit(0 if _conclude(run, gates, junit, as_json=as_json) else 1)


def _conclude(found: CampaignRun, gates: list[Gate], junit: Path | None, *, as_json: bool) -> bool:
    """Print what a campaign found; return whether it passed."""
    from merge_sumo.analysis.plausibility import notes_on
    from merge_sumo.analysis.verdict import NOTHING_TESTED
    from merge_sumo.reports.junit import write_junit

    run, summary, verdict, careful = found.run, found.summary, found.verdict, found.careful
    results = [gate.check(verdict, summary) for gate in gates]
    passed = verdict.tested > 0 and not any(result.met for result in results)
    converged = len(run.outcomes) < found.settings["cases"]
    if as_json:
        judged = {
            **asdict(summary),
            **verdict.to_record(),
            "gates": {result.name: result.met for result in results},
            "passed": passed,
            "stopped": "converged" if converged else "cases",
            "careful": careful,
            "fail_when": run.criterion.text,
            "notes": notes_on(run.outcomes, run.criterion),
            "repeats": [one.to_record() for one in found.repeats],
        }
        paths = {"run": str(run.folder), "report": str(found.report_file)}
        typer.echo(json.dumps({**judged, **paths}))
    else:
        if converged:
            asked, share = (found.settings[name] for name in ("cases", "stop_after_converged"))
            show(
                f"stopped after {len(run.outcomes)} of {asked} cases: three times in a row the "
                f"next batch was expected to add less than {share:.2%} to the coverage (this says "
                "nothing of regions that no case has come near)"
            )
        _print_summary(run, summary, verdict, careful, found.report_file)
    if junit is not None:
        write_junit(junit, run, summary.levels, verdict, results)
    for result in results:
        say(result.sentence)
    if not verdict.tested:
        say(NOTHING_TESTED)
    return passed


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
    from merge_sumo.analysis.plausibility import doubts
    from merge_sumo.analysis.verdict import counted
    from merge_sumo.campaigns.campaign import SCENARIOS, case_name
    from merge_sumo.campaigns.run import failures

    print_unrepeatable(run)
    show(verdict.counts)
    if not run.criterion.is_papers:
        show(f"  a case fails when {run.criterion.words}")
    if summary.severities:
        counts = ", ".join(f"{number} {name}" for name, number in summary.severities.items())
        show(f"  severity of all cases: {counts}")
    print_troubles(verdict)
    if run.ran_again:
        show(f"  {run.ran_again_in_words}")
    for note in doubts(run.outcomes, run.criterion):
        show(f"  note: {note}")
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
