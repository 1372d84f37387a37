"""The command probability."""

from __future__ import annotations

import json
from dataclasses import asdict
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
    RunArgument,
    TrustOption,
    VutCommandOption,
    VutMemoryOption,
    app,
    show,
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
        typer.Option(metavar="FILE", help="JSON: how often cases occur.  [default: uniform]"),
    ] = None,
    confidence: Annotated[
        float, typer.Option(help="Chance that the interval holds the probability.")
    ] = 0.95,
    seed: Annotated[int, typer.Option(help="Same seed, same cases.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="New file to write.  [default: RUN/probability.json]"),
    ] = None,
    net: NetOption = None,
    policies: PoliciesOption = None,
    pov: PovOption = None,
    vut_command: VutCommandOption = None,
    deadline: DeadlineOption = DEADLINE_S,
    vut_memory: VutMemoryOption = MEMORY_GIB,
    in_process: InProcessOption = False,
    workers: Annotated[int, typer.Option(help="Processes that run cases.")] = 1,
    dask: DaskOption = None,
    trust_vut: TrustOption = False,
    as_json: JsonOption = False,
) -> None:
    """Estimate how likely a VUT is to fail, with an interval that is valid.

    The cases of the campaign were chosen to fail: they only say where fresh cases are worth most.
    These are drawn independently, run in SUMO, and weighted; the interval is by betting, and holds
    for any number of cases.

    Example:  merge-sumo probability runs/design2 --cases 4000
    """
    from merge_sumo.campaigns import probability as estimates
    from merge_sumo.campaigns.ground import road_for
    from merge_sumo.campaigns.run import Run
    from merge_sumo.campaigns.settings import settings_of
    from merge_sumo.reports.progress import Counter
    from merge_sumo.reports.verdict import counted
    from merge_sumo.system.workers import open_workers

    campaign = Run(run)
    target = out or run / estimates.RESULT
    given = {name: value for name, value in written_settings(context).items() if name in HOSTING}
    settings = settings_of(run, campaign.settings, given, trust=trust_vut)
    with (
        open_workers(settings.workers(workers), dask) as there,
        Counter("fresh cases", cases, "cases") as counter,
    ):
        found = estimates.failure_probability(
            campaign,
            target,
            cases=cases,
            distribution=distribution,
            confidence=confidence,
            seed=seed,
            net=road_for(campaign.scenario, net),
            given=given,
            trust=trust_vut,
            workers=there,
            on_case=lambda _: counter.ended(1),
        )
    if as_json:
        typer.echo(json.dumps({**asdict(found), "file": str(target)}, allow_nan=False))
        return
    failures = counted(found.failures, "failure")
    how = "under the stated distribution" if distribution else "under uniform cases"
    show(
        f"P(fail) {how}: {found.probability:.3g}, {100.0 * confidence:g} % interval "
        f"[{found.low:.3g}, {found.high:.3g}] ({failures} in {cases} fresh cases)"
    )
    if not campaign.criterion.is_papers:
        show(f"  a case fails when {campaign.criterion.words}")
    if found.without_verdict:
        show(
            f"  {found.without_verdict} cases without a verdict: safe for the lower end, failures "
            "for the upper end"
        )
    arm = found.uniform_arm
    show(
        f"  for comparison, the {arm.cases} plain cases among them alone: {arm.failures} failures, "
        f"[{arm.low:.3g}, {arm.high:.3g}]"
    )
    show(f"written: {target}")
