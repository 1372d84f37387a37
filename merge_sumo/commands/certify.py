"""The command certify."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from merge_sumo.commands.shared import (
    DaskOption,
    DeadlineOption,
    FailWhenOption,
    FollowUpOption,
    JsonOption,
    NetOption,
    PoliciesOption,
    PovOption,
    RequireOption,
    ScenarioOption,
    VutCommandOption,
    VutMemoryOption,
    app,
    followed_up,
    say,
    show,
)
from merge_sumo.errors import UserError
from merge_sumo.system.folders import check_new, dated
from merge_sumo.system.printable import quoted
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB, level_name

NAMED: int = 5
"""Failures of a level that are printed; the certificate names more."""


@app.command()
def certify(
    vut: Annotated[str, typer.Option(help="Vehicle under test.")],
    radius: Annotated[
        float, typer.Option(help="Radius of the balls, as a share of the axes of the pool.")
    ] = 0.01,
    level: Annotated[str, typer.Option(help="POV level: 0, 1, 2, own or all.")] = "all",
    scenario: ScenarioOption = "us23",
    policies: PoliciesOption = None,
    pov: PovOption = None,
    fail_when: FailWhenOption = "paper",
    require: RequireOption = None,
    follow_up: FollowUpOption = None,
    vut_command: VutCommandOption = None,
    deadline: DeadlineOption = DEADLINE_S,
    vut_memory: VutMemoryOption = MEMORY_GIB,
    out: Annotated[
        Path | None, typer.Option(help="New folder to write.  [default: runs/certify-VUT-DATE]")
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Go on with the certificate in this folder."),
    ] = None,
    net: NetOption = None,
    workers: Annotated[int | None, typer.Option(help="Processes.  [default: one a core]")] = None,
    dask: DaskOption = None,
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
    from merge_sumo.campaigns import certificate
    from merge_sumo.campaigns.certificate_runs import runs_points_on
    from merge_sumo.campaigns.ground import road_for
    from merge_sumo.campaigns.settings import CampaignSettings, parse_levels, povs_of
    from merge_sumo.drivers.vuts.base import VutOptions
    from merge_sumo.reports.progress import Counter
    from merge_sumo.scenarios.scenario_file import named_scenario
    from merge_sumo.system.interrupt import Interrupt, Stopped
    from merge_sumo.system.workers import open_workers

    if out is not None and resume is not None:
        raise UserError("--resume names the folder: leave --out away")
    where = followed_up(named_scenario(scenario), follow_up)
    options = VutOptions(deadline_s=deadline, memory_gib=vut_memory)
    settings = CampaignSettings(
        vut=vut,
        levels=parse_levels(level, povs_of(policies, where, pov, options)),
        vut_command=vut_command,
        deadline_s=deadline,
        vut_memory_gib=vut_memory,
        policies=None if policies is None else str(policies),
        pov=pov,
        scenario=where,
        fail_when=fail_when,
        require=require,
    )
    lattices = certificate.lattices_of(settings, radius)
    folder = resume or out or dated(f"certify-{vut}")
    if resume is None:
        check_new(folder)
    road = road_for(where, net)
    title = f"{vut} v level {'/'.join(map(level_name, settings.levels))}"
    try:
        with (
            Interrupt("finishing the running block; once more stops at once") as interrupt,
            open_workers(settings.workers(workers), dask) as there,
            Counter(title, sum(map(len, lattices.values())), "cases") as counter,
        ):
            done = certificate.certify(
                settings,
                radius,
                folder,
                road,
                runs_points_on(there, settings, road, folder),
                resume=resume is not None,
                on_cases=counter.ended,
                check=interrupt.check,
            )
    except Stopped:
        if folder.exists():
            say(f"stopped; go on with the same command and --resume {quoted(folder)}")
        raise
    file = folder / certificate.CERTIFICATE
    if as_json:
        found = {level: asdict(of_level) for level, of_level in done.levels.items()}
        result = {"certain": done.certain, "sentence": done.sentence, "radius": done.radius}
        typer.echo(json.dumps({**result, "levels": found, "file": str(file)}, allow_nan=False))
    else:
        show(done.sentence)
        for of_level, found_there in done.levels.items():
            if found_there.failures or found_there.untold:
                show(
                    f"  level {level_name(of_level)}: {found_there.failures:,} failures and "
                    f"{found_there.untold:,} without a verdict in {found_there.cases:,} cases"
                )
            for case in found_there.worst[:NAMED]:
                named = ", ".join(f"{name} {value:.4g}" for name, value in case.items())
                show(f"    {named}")
        show(f"certificate: {file}")
    raise typer.Exit(0 if done.certain else 1)
