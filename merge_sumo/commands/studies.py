"""Commands that measure: truths, probabilities, causes, repairs, and samplers."""

from __future__ import annotations

from typing import Annotated

import typer

from merge_sumo import verbs
from merge_sumo.commands.application import Given, app
from merge_sumo.commands.campaigns import RunArgument, VutOption


@app.verb(verbs.GroundTruth)
def truth(given: Given, vut: VutOption) -> None:
    from merge_sumo import api

    given.print(api.truth(vut, **given.keywords))


@app.verb(verbs.Benchmark)
def benchmark(given: Given, vut: VutOption) -> None:
    from merge_sumo import api

    given.print(api.benchmark(vut, **given.keywords))


@app.verb(verbs.Probability)
def probability(given: Given, run: RunArgument) -> None:
    from merge_sumo import api

    file = given.keywords["out"] or run / "probability.json"
    given.print(api.probability(run, **given.written), file=file)


@app.verb(verbs.Explain)
def explain(
    given: Given,
    run: RunArgument,
    case: Annotated[
        int | None,
        typer.Argument(help="Index of the failure in outcomes.jsonl; the worst if left out."),
    ] = None,
) -> None:
    from merge_sumo import api

    given.print(api.explain(run, case, **given.written))


@app.verb(verbs.Repair)
def repair(given: Given, run: RunArgument) -> None:
    from merge_sumo import api

    result = api.repair(run, **given.written)
    given.print(result, page=result.folder / "repair.html")
    raise typer.Exit(0 if result.verified else 1)


@app.verb(verbs.Reproduce)
def reproduce(given: Given) -> None:
    from merge_sumo import api

    given.print(api.reproduce(**given.keywords))
