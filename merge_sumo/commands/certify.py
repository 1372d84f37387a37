"""The command certify."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from merge_sumo.commands.shared import (
    CoresOption,
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
    VutCommandOption,
    VutMemoryOption,
    VutOption,
    app,
    print_result,
    say,
    settings_in,
)
from merge_sumo.errors import UserError
from merge_sumo.system.folders import dated
from merge_sumo.system.printable import quoted
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB


@app.command()
def certify(
    context: typer.Context,
    vut: VutOption,
    radius: Annotated[
        float, typer.Option(help="Radius of the balls, as a share of the axes of the pool.")
    ] = 0.01,
    level: LevelOption = "all",
    scenario: ScenarioOption = "us23",
    policies: PoliciesOption = None,
    pov: PovOption = None,
    fail_when: FailWhenOption = "paper",
    require: RequireOption = None,
    follow_up: FollowUpOption = None,
    vut_command: VutCommandOption = None,
    deadline: DeadlineOption = DEADLINE_S,
    vut_memory: VutMemoryOption = MEMORY_GIB,
    in_process: InProcessOption = False,
    out: Annotated[
        Path | None,
        typer.Option(help="New folder to write.", show_default="runs/certify-VUT-DATE"),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Go on with the certificate in this folder."),
    ] = None,
    net: NetOption = None,
    workers: CoresOption = None,
    dask: DaskOption = None,
    quiet: QuietOption = False,
    as_json: JsonOption = False,
) -> None:
    """Certify that no ball of a radius in the pool fails throughout, or find one that may.

    Tests a lattice that covers the pool: in every ball of that radius, in coordinates of the unit
    cube, there is a case of it. Where none of them fails, no such ball fails throughout: certain,
    as the simulation is deterministic; that the VUT is, some cases that run twice are to show. A
    failing region that is thinner than the balls may be between the cases.
    `tools/check_certificate.py` checks the folder, and shares nothing with it.

    Exit code 0 when it is certain, 1 when a case fails, gives no verdict or ends otherwise the
    second time.

    Example:  merge-sumo certify --vut design2 --radius 0.01
    """
    from merge_sumo import api
    from merge_sumo.system.interrupt import Interrupt, Stopped

    if out is not None and resume is not None:
        raise UserError("--resume names the folder: leave --out away")
    folder = resume or out or dated(f"certify-{vut}")
    try:
        with Interrupt("finishing the running block; once more stops at once") as interrupt:
            done = api.certify(
                **settings_in(context, "radius", "net", "workers", "dask"),
                out=folder,
                resume=resume is not None,
                check=interrupt.check,
                progress=not quiet,
            )
    except Stopped:
        if folder.exists():
            say(f"stopped; go on with the same command and --resume {quoted(folder)}")
        raise
    print_result(done, as_json=as_json)
    raise typer.Exit(0 if done.certain else 1)
