"""Commands that measure: truths, probabilities, coverage, and whether other simulators agree."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Final

import typer

from merge_sumo.commands.application import Given, app
from merge_sumo.commands.options import (
    CORES,
    HOSTING,
    RUNNING,
    SEED,
    SETUP,
    VUT_AGAIN,
    RunArgument,
    VutOption,
    flag,
    option,
    optional,
)
from merge_sumo.commands.printing import folder_of, same_command, stoppable

OF_RECORDED: Final = ("policies", "pov", *HOSTING, *RUNNING)
"""Options of the studies that run cases of a recorded campaign."""
TRUTH_CASES: Final = "10000, at level 2 20000"


@app.verb(
    options=("level", *SETUP, "tolerate", "quiet", "engine"),
    own={
        "cases": optional(int, "Uniform cases of a level.", show_default=TRUTH_CASES),
        "repeat": optional(
            int,
            "Run each case until it is decided whether it fails, so often at most, with another "
            "draw of what is random.",
            metavar="N",
            show_default="1, with --tolerate 20",
        ),
        "seed": SEED,
        "workers": CORES,
    },
)
def truth(given: Given, vut: VutOption) -> None:
    """Find the ground truth of a VUT at each level, by uniform cases on all cores.

    It is kept in a cache (MERGE_SUMO_CACHE, or the user's cache folder) under a hash of all inputs,
    and used again while all files that the VUT has loaded are the same. The output says how many
    cases SUMO has run where the kinematic engine ran the others.

    With --tolerate, a case fails where more than that share of its runs do; it runs until that is
    decided with 95 % probability, up to 20 times.

    Example:  merge-sumo truth --vut design2 --level 1 --cases 10000

    Example:  merge-sumo truth --vut design2 --level 1 --cases 200 --sense noise_x_m=2 --tolerate .2
    """
    from merge_sumo import api

    given.print(api.truth(vut, **given.keywords))


@app.verb(
    options=("level", *SETUP, "quiet"),
    own={
        "seeds": option(int, 10, "Runs of each sampler."),
        "cases": option(int, 400, "Cases of each run."),
        "batch": optional(
            int, "Cases per batch.", show_default="what coverage wants, 20 for the others"
        ),
        "truth_cases": optional(int, "Cases of the truth.", show_default=TRUTH_CASES),
        "figure": optional(
            Path, "New file for FMC against cases: .png, .svg or .html.", metavar="FILE"
        ),
        "workers": CORES,
    },
)
def benchmark(
    given: Given,
    vut: VutOption,
    samplers: Annotated[
        str | None,
        typer.Option(help="Names, separated by commas: {samplers}.", show_default="all"),
    ] = None,
) -> None:
    """Compare samplers with each other and with the ground truth, over several seeds.

    With all levels, each run shares its cases out over them, and coverage is summed over them.
    The truth of the paper's size misses places that searches find, so coverage is also shown as a
    share of a limit: the coverage of all that truth and searches found together, or that of
    1,000,000 uniform cases, if `truth --cases 1000000` has run, whichever is more.

    Example:  merge-sumo benchmark --vut design1 --level 0 --samplers uniform,gpr --seeds 3
    """
    from merge_sumo import api

    names = None if samplers is None else samplers.split(",")
    given.print(api.benchmark(vut, samplers=names, **given.keywords))


@app.verb(
    options=("engine", *OF_RECORDED),
    own={
        "vut": VUT_AGAIN,
        "cases": optional(
            int, "Fresh cases to run.", show_default="100000 without SUMO, 4000 in it"
        ),
        "traffic": optional(
            str,
            "With how many cars a merge fails in a traffic: exid-2, exid-3, exid-5, or a TOML file "
            "with density and speeds.",
            metavar="NAME|FILE",
        ),
        "distribution": optional(
            Path, "JSON: how often cases occur.", metavar="FILE", show_default="uniform"
        ),
        "confidence": option(float, 0.95, "Chance that the interval holds the probability."),
        "seed": SEED,
        "out": optional(
            Path, "New file to write.", metavar="FILE", show_default="RUN/probability.json"
        ),
    },
)
def probability(given: Given, run: RunArgument) -> None:
    """Estimate how likely a VUT is to fail, with an interval that is valid.

    The cases of the campaign were chosen to fail: they only say where failures are expected. Fresh
    cases are drawn independently from where they are and from where they are not, and the interval
    is exact, however wrong the expectation is. What fails where nothing was expected to, the
    campaign has missed. Where VUT and POV are of this package, the equations of motion run them
    without SUMO, except for one of a hundred.

    Example:  merge-sumo probability runs/design2

    Example:  merge-sumo probability runs/design2 --traffic exid-5 --out per-merge.json
    """
    from merge_sumo import api

    given.print(api.probability(run, **given.written))


@app.verb(options=OF_RECORDED, own={"vut": VUT_AGAIN})
def explain(
    given: Given,
    run: RunArgument,
    case: Annotated[
        int | None,
        typer.Argument(help="Index of the failure in outcomes.jsonl; the worst if left out."),
    ] = None,
    param: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=LOW..HIGH",
            help="A parameter of the controller, and the range in which the nearest value that "
            "passes is searched. May be given several times.",
        ),
    ] = None,
) -> None:
    """Say why a failure fails: the smallest change of one thing with which it passes.

    Each coordinate of the start, the level of the POV and each named parameter changes by itself:
    cases with other values run, and each value that is printed runs a second time. A campaign
    explains its worst failure, without parameters, if the VUT is of this package. `report` shows
    all failures that were explained.

    Example:  merge-sumo explain runs/design1
    """
    from merge_sumo import api

    given.print(api.explain(run, case, params=param or (), **given.written))


@app.verb(
    options=OF_RECORDED,
    own={
        "vut": optional(
            str,
            "The controller to repair.",
            metavar="SPEC",
            show_default="the campaign's, as its files are now",
        ),
        "cost": option(
            str,
            "time",
            "Cost to keep low, as a mean over the cases: time to the merge, or braking of the VUT.",
            metavar="time|braking",
        ),
        "trials": option(int, 60, "Sets of values that a round tries."),
        "rounds": option(
            int, 3, "Most rounds: the failures of a fresh campaign join the cases of the next."
        ),
        "cases": optional(
            int, "Cases of a fresh campaign.", show_default="as many as the campaign"
        ),
        "seed": option(int, 0, "Same seed, same values."),
    },
)
def repair(
    given: Given,
    run: RunArgument,
    param: Annotated[
        list[str],
        typer.Option(
            metavar="NAME=LOW..HIGH",
            help="A parameter that may change: of a built-in VUT or of SUMO's model, a keyword of "
            "the constructor, or an attribute. May be given several times.",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="New folder to write.", show_default="runs/repair-RUN-DATE")
    ] = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Go on with the repair in this folder.")
    ] = None,
) -> None:
    """Find the smallest change of a controller's parameters that removes its failures.

    optuna proposes values; the failures, near misses and a share of the other cases of the campaign
    run with each. No case that passed may fail. Of the values with the fewest failures those are
    chosen that cost least, and of these the smallest change. Then all cases run, and a fresh
    campaign with another seed is compared with the one before. Needs the extra repair.

    Exit code 0 when values were found and the fresh campaign shows no case that broke, else
    1: then it says which cases stay.

    Example:  merge-sumo repair runs/design1 --param gap_m=10..40 --param x2_m=10..90
    """
    from merge_sumo import api

    folder = folder_of(out, resume, f"repair-{run.name}")
    with stoppable("trial or batch", partial(same_command, folder)) as check:
        result = api.repair(
            run, param, out=folder, resume=resume is not None, check=check, **given.written
        )
    given.print(result)
    raise typer.Exit(0 if result.verified else 1)


@app.verb(
    options=["policies", "quiet"],
    own={
        "seeds": optional(int, "Runs of each sampler.", show_default="10, with --quick 2"),
        "out": optional(Path, "New folder to write.", show_default="runs/reproduce-DATE"),
        "quick": flag("Few and short runs and a small truth: a first look.", "--quick"),
        "workers": CORES,
    },
)
def reproduce(given: Given) -> None:
    """Reproduce the paper: Table II and every figure of its results, beside the paper's numbers.

    Writes table2.md, table2.json, the figures as PNG, and index.html that shows it all.

    Example:  merge-sumo reproduce --seeds 10 --out reproduction
    """
    from merge_sumo import api

    given.print(api.reproduce(**given.keywords))
