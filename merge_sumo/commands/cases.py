"""Commands on single cases: run, rerun."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from merge_sumo.commands.shared import (
    DeadlineOption,
    InProcessOption,
    JsonOption,
    NetOption,
    PoliciesOption,
    PovOption,
    RunArgument,
    ScenarioOption,
    ToleranceOption,
    TrustOption,
    VutCommandOption,
    VutMemoryOption,
    app,
    check_tolerance,
    say,
    show,
    written,
    written_settings,
)
from merge_sumo.errors import UserError
from merge_sumo.system.printable import quoted
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB

if TYPE_CHECKING:
    from merge_sumo.campaigns.settings import CampaignSettings
    from merge_sumo.campaigns.single import Ended
    from merge_sumo.reports.rerun import Rerun
    from merge_sumo.values.case import Case


@app.command()
def run(
    context: typer.Context,
    vut: Annotated[
        str, typer.Option(help="Vehicle under test.  [with --case default: the campaign's]")
    ] = "",
    level: Annotated[str, typer.Option(help="POV level: 0, 1, 2 or own.")] = "0",
    x: Annotated[
        float | None, typer.Option("--x", help="Where the POV starts, in m: M is 0.")
    ] = None,
    v: Annotated[float | None, typer.Option("--v", help="How fast it starts, in m/s.")] = None,
    psi: Annotated[
        float | None, typer.Option(help="Its social value orientation in rad, at level 2.")
    ] = None,
    v_vut0: Annotated[
        float | None,
        typer.Option(help="Initial speed of the VUT in m/s.  [default: the scenario's]"),
    ] = None,
    headway_ahead: Annotated[
        float | None, typer.Option(help="Headway to the car ahead in s, in traffic.")
    ] = None,
    headway_behind: Annotated[
        float | None, typer.Option(help="Headway of the car behind in s, in traffic.")
    ] = None,
    case: Annotated[
        tuple[Path, int] | None,
        typer.Option(
            metavar="RUN INDEX", help="A case of a campaign instead; options given beside it win."
        ),
    ] = None,
    scenario: ScenarioOption = "us23",
    pov: PovOption = None,
    policies: PoliciesOption = None,
    net: NetOption = None,
    vut_command: VutCommandOption = None,
    deadline: DeadlineOption = DEADLINE_S,
    vut_memory: VutMemoryOption = MEMORY_GIB,
    gui: Annotated[
        bool, typer.Option("--gui", help="Show it in sumo-gui while it runs, in real time.")
    ] = False,
    debug: Annotated[
        bool,
        typer.Option(
            "--debug", help="Run the VUT in this process without a deadline: breakpoints work."
        ),
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="New folder to keep it in, for `replay` and sumo-gui.")
    ] = None,
    trust_vut: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run one case and show what happens: verdict, measures, and the motion second by second.

    Exit code 0 when the case passes, 1 when it fails, errs or times out, 2 for bad use.

    Example:  merge-sumo run --vut design2 --level 2 --x -298.6 --v 34.5 --psi 0.62
    """
    from merge_sumo.campaigns.ground import road_for
    from merge_sumo.campaigns.plan import plan_of
    from merge_sumo.campaigns.single import run_one
    from merge_sumo.system.folders import check_new
    from merge_sumo.values.trajectory import End

    settings, one = _case_and_settings(context)
    if out is not None:
        check_new(out)
    for outside in _outside(one):
        say(f"note: {outside}")
    road = road_for(settings.scenario, net)

    def ended(found: Ended) -> None:
        from merge_sumo.reports.motion import lines_of
        from merge_sumo.sumo.replay_folder import write_scenario

        if out is not None:
            write_scenario(out, road, found.outcome, found.trajectory)
        if as_json:
            kept = {} if out is None else {"out": str(out)}
            motion = {"motion": found.trajectory.motion.tolist()}
            typer.echo(json.dumps({**found.outcome.to_record(), **kept, **motion}))
            return
        for line in lines_of(found.outcome, found.trajectory):
            show(line)
        if out is not None:
            show(f"kept: merge-sumo replay {quoted(out)} --gui")
        if gui:
            say("close the window to go on")

    plan = plan_of(settings, road, cases=1)
    found = run_one(plan, one, live=gui, on_end=ended).outcome
    raise typer.Exit(0 if found.measures.end is End.MERGED and not found.failed else 1)


def _outside(case: Case) -> list[str]:
    """Return in sentences which coordinates of a case are outside of the pool."""
    from merge_sumo.reports.coordinates import coordinates

    return [
        f"{c.name} {c.text(case)} {c.unit} is outside of the pool, {c.dimension.low:g} to "
        f"{c.dimension.high:g} {c.unit}: no campaign runs such a case"
        for c in coordinates(case.scenario, (case.level,))
        if (value := c.of(case)) is not None and not c.dimension.low <= value <= c.dimension.high
    ]


@app.command()
def rerun(
    context: typer.Context,
    run: RunArgument,
    case: Annotated[
        list[int] | None,
        typer.Argument(help="Indices of cases in outcomes.jsonl; all if left out."),
    ] = None,
    vut: Annotated[
        str, typer.Option(help="The changed VUT.  [default: the campaign's, as its files are now]")
    ] = "",
    vut_command: VutCommandOption = None,
    deadline: DeadlineOption = DEADLINE_S,
    vut_memory: VutMemoryOption = MEMORY_GIB,
    in_process: InProcessOption = False,
    policies: PoliciesOption = None,
    net: NetOption = None,
    tolerance: ToleranceOption = 0.0,
    workers: Annotated[int, typer.Option(help="Processes that run cases.")] = 1,
    trust_vut: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run recorded cases again with a changed VUT, and say which verdicts changed.

    Exit code 1 when it is worse than what was recorded, as in compare-runs: at some level the share
    of cases with an error, with an error or a timeout, or the failure mode coverage (FMC) grew by
    more than the tolerance, or it reached the merge point in no case.

    Example:  merge-sumo rerun runs/design2 3 7 --vut design2
    """
    from merge_sumo.campaigns.run import Run
    from merge_sumo.reports import rerun as again
    from merge_sumo.reports.progress import Counter
    from merge_sumo.system.workers import open_workers

    check_tolerance(tolerance)
    recorded = Run(run)
    total = len(set(case or ()) or recorded.outcomes)
    settings = again.settings_today(recorded, written_settings(context), trust=trust_vut)
    with (
        open_workers(settings.workers(workers)) as there,
        Counter(f"{settings.vut} again", total, "cases") as counter,
    ):
        found = again.rerun(
            recorded,
            settings,
            case or (),
            net=net,
            workers=there,
            on_case=counter.ended,
        )
    why = found.compared.worse(tolerance)
    if as_json:
        changed = [one.to_record() for one in found.changed]
        judged = {"tolerance": tolerance, "worse": bool(why), "why": why}
        compared = {"cases": total, "changed": changed, "levels": asdict(found.compared)["levels"]}
        typer.echo(json.dumps({"vut": found.vut, **compared, **judged}))
    else:
        _print_rerun(found, run)
        show(f"it is {'worse' if why else 'not worse'}, with a tolerance of {tolerance:g}")
        for sentence in why:
            show(f"  {sentence} (A is what was recorded, B is now)")
    raise typer.Exit(1 if why else 0)


def _print_rerun(found: Rerun, folder: Path) -> None:
    for line in found.lines():
        show(line)
    if found.changed:
        show(
            f"look at one: merge-sumo run --case {quoted(folder)} {found.changed[0].before.index} "
            f"--vut {quoted(found.vut)} --gui"
        )


def _case_and_settings(context: typer.Context) -> tuple[CampaignSettings, Case]:
    """Return the case that is asked for, and how it is to be run."""
    from merge_sumo.campaigns.run import Run
    from merge_sumo.campaigns.settings import one_level, povs_of
    from merge_sumo.campaigns.single import DEBUG_DEADLINE_S, FIELDS, settings_and_case
    from merge_sumo.drivers.vuts.base import VutOptions
    from merge_sumo.scenarios.scenario_file import named_scenario

    options = context.params
    given = written_settings(context)
    if options["debug"]:
        given |= {"in_process": True, "deadline_s": DEBUG_DEADLINE_S}
    values = {
        field: options[option[2:].replace("-", "_")]
        for field, option in FIELDS.items()
        if options[option[2:].replace("-", "_")] is not None
    }
    if options["case"] is None:
        if not options["vut"]:
            raise UserError("say with --vut who drives, or with --case which recorded case")
        where = named_scenario(options["scenario"])
        hosted = VutOptions(memory_gib=options["vut_memory"])
        povs = povs_of(options["policies"], where, options["pov"], hosted)
        given["scenario"] = where
        return settings_and_case(None, one_level(options["level"], povs), values, given)
    folder, index = options["case"]
    recorded = Run(folder)
    level = recorded.outcome(index).case.level
    if "level" in written(context):
        level = one_level(options["level"], povs_of(options["policies"], recorded.scenario))
    of = recorded, index
    return settings_and_case(of, level, values, given, trust=options["trust_vut"])
