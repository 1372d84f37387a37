"""Commands on single cases: run, rerun."""

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
    OneLevelOption,
    PoliciesOption,
    PovOption,
    QuietOption,
    RequireOption,
    RunArgument,
    ScenarioOption,
    ToleranceOption,
    TrustOption,
    VutCommandOption,
    VutMemoryOption,
    WorkersOption,
    app,
    check_tolerance,
    say,
    settings_in,
    show,
    written_settings,
)
from merge_sumo.system.printable import quoted
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB

if TYPE_CHECKING:
    from merge_sumo.api.results import CaseRun
    from merge_sumo.studies.versions import Rerun


@app.command()
def run(
    context: typer.Context,
    vut: Annotated[
        str,
        typer.Option(
            metavar="SPEC",
            help="Vehicle under test.",
            show_default="with --case the campaign's",
            autocompletion=complete.vuts,
        ),
    ] = "",
    level: OneLevelOption = "0",
    x: Annotated[
        float | None, typer.Option("--x", help="Where the POV starts, in m: M is 0.")
    ] = None,
    v: Annotated[float | None, typer.Option("--v", help="How fast it starts, in m/s.")] = None,
    psi: Annotated[
        float | None, typer.Option(help="Its social value orientation in rad, at level 2.")
    ] = None,
    v_vut0: Annotated[
        float | None,
        typer.Option(help="Initial speed of the VUT in m/s.", show_default="the scenario's"),
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
    fail_when: FailWhenOption = "paper",
    require: RequireOption = None,
    follow_up: FollowUpOption = None,
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
    from merge_sumo import api
    from merge_sumo.campaigns.one_case import FIELDS
    from merge_sumo.values.trajectory import End

    def ended(found: CaseRun) -> None:
        if as_json:
            kept = {} if out is None else {"out": str(out)}
            motion = {"motion": found.trajectory.motion.tolist()}
            signals = {} if found.trajectory.signals is None else found.trajectory.signals
            left = {"signals": signals} if signals else {}
            typer.echo(json.dumps({**found.outcome.to_record(), **kept, **motion, **left}))
            return
        for line in found.lines():
            show(line)
        if out is not None:
            show(f"kept: merge-sumo replay {quoted(out)} --gui")
        if gui:
            say("close the window to go on")

    given = settings_in(context) if case is None else written_settings(context)
    given.pop("v_vut0_mps", None)
    values = {
        field: value
        for field, option in FIELDS.items()
        if (value := context.params[option[2:].replace("-", "_")]) is not None
    }
    who = given.pop("vut", None) or None
    found = api.run_case(
        who,
        recorded=case,
        net=net,
        debug=debug,
        gui=gui,
        out=out,
        trust_vut=trust_vut,
        on_end=ended,
        **{**given, **values},
    )
    merged = found.measures.end is End.MERGED
    raise typer.Exit(0 if merged and not found.failed else 1)


@app.command()
def rerun(
    context: typer.Context,
    run: RunArgument,
    case: Annotated[
        list[int] | None,
        typer.Argument(help="Indices of cases in outcomes.jsonl; all if left out."),
    ] = None,
    vut: Annotated[
        str,
        typer.Option(
            metavar="SPEC",
            help="The changed VUT.",
            show_default="the campaign's, as its files are now",
            autocompletion=complete.vuts,
        ),
    ] = "",
    level: LevelOption = "all",
    vut_command: VutCommandOption = None,
    deadline: DeadlineOption = DEADLINE_S,
    vut_memory: VutMemoryOption = MEMORY_GIB,
    in_process: InProcessOption = False,
    policies: PoliciesOption = None,
    net: NetOption = None,
    tolerance: ToleranceOption = 0.0,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
    quiet: QuietOption = False,
    trust_vut: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Run recorded cases again with a changed VUT, and say which verdicts changed.

    Exit code 1 when it is worse than what was recorded, as in compare-runs: at some level the share
    of cases with an error, with an error or a timeout, or the failure mode coverage (FMC) grew by
    more than the tolerance, or it reached the merge point in no case.

    Example:  merge-sumo rerun runs/design2 3 7 --vut design2
    """
    from merge_sumo import api

    check_tolerance(tolerance)
    where: dict[str, Any] = {"workers": workers, "dask": dask, "progress": not quiet}
    where |= {"net": net, "trust_vut": trust_vut, **written_settings(context)}
    found = api.rerun(run, case or (), **where)
    why = found.compared.worse(tolerance)
    if as_json:
        changed = [one.to_record() for one in found.changed]
        judged = {"tolerance": tolerance, "worse": bool(why), "why": why}
        levels = asdict(found.compared)["levels"]
        compared = {"cases": len(found.before), "changed": changed, "levels": levels}
        again = {"unrepeated": found.unrepeated}
        typer.echo(json.dumps({"vut": found.vut, **compared, **judged, **again}))
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
