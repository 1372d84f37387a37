"""The command probability."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from merge_sumo.commands.shared import (
    DaskOption,
    DeadlineOption,
    InProcessOption,
    JsonOption,
    NetOption,
    PoliciesOption,
    PovOption,
    QuietOption,
    RunArgument,
    TrustOption,
    VutCommandOption,
    VutMemoryOption,
    WorkersOption,
    app,
    print_result,
    written_settings,
)
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB

HOSTING: Final = (
    *("policies", "pov", "vut_command", "deadline_s", "vut_memory_gib", "in_process"),
)
"""Settings of a campaign that its estimate may have otherwise; cases and seed are of the fresh."""


@app.command()
def probability(
    context: typer.Context,
    run: RunArgument,
    cases: Annotated[int, typer.Option(help="Fresh cases to run.")] = 4000,
    distribution: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="JSON: how often cases occur.", show_default="uniform"),
    ] = None,
    confidence: Annotated[
        float, typer.Option(help="Chance that the interval holds the probability.")
    ] = 0.95,
    seed: Annotated[int, typer.Option(help="Same seed, same cases.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="New file to write.", show_default="RUN/probability.json"
        ),
    ] = None,
    net: NetOption = None,
    policies: PoliciesOption = None,
    pov: PovOption = None,
    vut_command: VutCommandOption = None,
    deadline: DeadlineOption = DEADLINE_S,
    vut_memory: VutMemoryOption = MEMORY_GIB,
    in_process: InProcessOption = False,
    workers: WorkersOption = 1,
    dask: DaskOption = None,
    quiet: QuietOption = False,
    trust_vut: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate how likely a VUT is to fail, with an interval that is valid.

    The cases of the campaign were chosen to fail: they only say where fresh cases are worth most.
    These are drawn independently, run in SUMO, and weighted; the interval is by betting, and holds
    for any number of cases.

    Example:  merge-sumo probability runs/design2 --cases 4000
    """
    from merge_sumo import api

    given = {name: value for name, value in written_settings(context).items() if name in HOSTING}
    found = api.probability(
        run,
        cases=cases,
        distribution=distribution,
        confidence=confidence,
        seed=seed,
        net=net,
        out=out,
        trust_vut=trust_vut,
        workers=workers,
        dask=dask,
        progress=not quiet,
        **given,
    )
    print_result(found, as_json=as_json)
