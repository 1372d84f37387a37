"""The verbs, each a record of what it may be asked: keywords in Python, options of the command."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from merge_sumo.options import (
    CASES,
    EXPERTS,
    TESTED,
    VERDICT,
    WHERE,
    AnyPath,
    AnyRun,
    Asked,
    Beginning,
    Execution,
    Limits,
    Policies,
    Recorded,
    Search,
    Test,
    keyword,
    option,
    progress_option,
    required_option,
    seed_option,
    vut_again,
)

if TYPE_CHECKING:
    from merge_sumo.scenario.scenario import AnyLevels, Scenario
    from merge_sumo.verdict.score import Outcome
    from merge_sumo.vuts.in_memory import AnyVut
else:  # the command line reads no annotation, and importing these takes time
    AnyLevels = AnyVut = Outcome = Scenario = Any


VUT: Final = {
    "help": "Vehicle under test: a spec as after --vut, a class, a function, or an object."
}
RUN: Final = {"help": "The campaign, or its folder."}
TRUTH_CASES: Final = "10000, at level 2 20000"
COORDINATES: Final = ("x_pov0_m", "v_pov0_mps", "svo_rad", "headway_ahead_s", "headway_behind_s")
"""Coordinates of a case that are keywords; `at` takes any."""


def _level() -> Any:
    return option("all", str, "POV levels: 0, 1, 2, own, several with commas, or all.", TESTED)


def _params(help: str) -> dict[str, Any]:
    return required_option(list[str], help, CASES, "--param", metavar="NAME=LOW..HIGH")


def _engine() -> Any:
    return option(
        None,
        str,
        "kinematic: the equations of motion alone, and SUMO for at least one case of a hundred. Or "
        "sumo for all.",
        EXPERTS,
        metavar="NAME",
        shown="kinematic where VUT and POV are of this package",
    )


def _out(help: str, shown: str | None = None, **more: Any) -> Any:
    return option(None, Path, help, WHERE, shown=shown, **more)


def _page() -> Any:
    return _out(
        "New page (.html) to write: what changed, and each such case with both motions.",
        metavar="FILE",
    )


def _junit() -> Any:
    return option(None, Path, "New file to write for CI: JUnit XML (.xml).", WHERE, metavar="FILE")


def _any_scenario(help: str) -> Any:
    return option(None, str, help, TESTED, metavar="NAME|FILE", shown="us23")


# Verbs: search


@dataclass(frozen=True, kw_only=True)
class SearchOfTest(Execution, Search, Test):
    """The keywords of a campaign, begun or gone on with."""

    level: AnyLevels = _level()
    against: AnyVut | None = option(
        None,
        str,
        "An earlier version of the VUT, of any kind but traci: each case runs with both, and the "
        "sampler looks for those that the VUT alone fails.",
        TESTED,
        metavar="SPEC",
    )
    gates: Iterable[str] = option(
        (),
        list[str],
        'Exit with 1 if there are failures, errors, timeouts, "fmc>X": an FMC above X at some '
        "level, or, with --against, regressions. May be given several times.",
        VERDICT,
        "--gate",
        metavar="GATE",
    )
    junit: AnyPath | None = _junit()
    on_case: Callable[[Outcome], None] | None = keyword(
        None, "Called with the outcome of every case as it ends."
    )
    check: Callable[[], None] | None = keyword(
        None, "Called after every batch; may raise to stop there."
    )


@dataclass(frozen=True)
class Campaign(SearchOfTest):
    """Test a VUT: run cases in SUMO, find failures, write a report and replayable scenarios.

    Ctrl-C lets the running batch end and says how to go on; twice stops at once.

    Exit code 1 when a --gate is met, and always when the VUT merged in no case: then
    nothing was tested. 2 for bad use, 130 or 143 when it was stopped, else 0.

    Example:  merge-sumo campaign --vut design1 --level 0 --cases 400 --seed 1

    Example:  merge-sumo campaign --vut design1 --against design2 --level 0 --cases 40
    """

    vut: AnyVut = field(metadata=VUT)
    _: KW_ONLY
    out: AnyPath | None = _out("New folder to write.", "runs/VUT-DATE")


@dataclass(frozen=True)
class NoFailures(Campaign):
    """Test a VUT in a campaign, and raise `AssertionError` where a case fails or ends in an error.

    The message names the counts, the worst case, the report, and the command that replays the
    case. A timeout is no failure, unless `fail_when` says so. Returns the campaign.
    """

    _: KW_ONLY
    cases: int = keyword(
        200, "Number of test cases: seconds for a controller that answers at once."
    )


@dataclass(frozen=True)
class Resume(SearchOfTest):
    """Go on with a campaign that was stopped; the same as `merge-sumo campaign --resume`.

    The settings must be those of the campaign: `cases` may be more. A VUT, `pov` or `against` that
    is code is given again: a run folder names no code to run. Of an object only its name tells that
    it is the same.
    """

    run: AnyRun = field(metadata=RUN)
    _: KW_ONLY
    vut: AnyVut | None = keyword(None, "The VUT again, where it is code of your own.")


@dataclass(frozen=True)
class RunCase(Beginning, Test):
    """Run one case and show what happens: verdict, measures, and the motion second by second.

    Exit code 0 when the case passes, 1 when it fails, errs or times out, 2 for bad use. With --gui
    its replay opens in sumo-gui when it has ended; --from begins table and window later.

    Example:  merge-sumo run --vut design2 --level 2 --x -298.6 --v 34.5 --psi 0.62
    """

    vut: AnyVut | None = vut_again()
    case: Mapping[str, Any] | None = keyword(
        None, "A row of `run.cases` or `run.failures`: default of level and coordinates."
    )
    _: KW_ONLY
    recorded: tuple[AnyRun, int] | None = keyword(
        None, "A campaign, or its folder, and the index of its case: default of everything."
    )
    level: int | str | None = option(
        None, str, "POV level: 0, 1, 2 or own.", TESTED, shown="0, with --case the campaign's"
    )
    x_pov0_m: float | None = option(
        None, float, "Initial position of the POV in m; M is 0.", TESTED, "--x"
    )
    v_pov0_mps: float | None = option(
        None, float, "Initial speed of the POV in m/s.", TESTED, "--v"
    )
    svo_rad: float | None = option(
        None, float, "Social value orientation of the POV in rad, at level 2.", TESTED, "--psi"
    )
    headway_ahead_s: float | None = option(
        None, float, "Headway to the car ahead in s, in traffic.", TESTED, "--headway-ahead"
    )
    headway_behind_s: float | None = option(
        None, float, "Headway of the car behind in s, in traffic.", TESTED, "--headway-behind"
    )
    at: Mapping[str, float] | None = keyword(
        None, "Any coordinate of the case, by its name in outcomes.jsonl."
    )
    debug: bool = option(
        False,
        bool,
        "Run the VUT in this process without a deadline: breakpoints work.",
        WHERE,
        "--debug",
    )
    gui: bool = option(
        False, bool, "Show its replay in sumo-gui when it has ended.", WHERE, "--gui"
    )
    out: AnyPath | None = _out("New folder to keep it in, for `replay` and sumo-gui.")
    on_end: Callable[[Any], None] | None = keyword(
        None, "Called with the result when the case has ended, before a window is closed."
    )


@dataclass(frozen=True)
class Probability(Recorded):
    """Estimate how likely a VUT is to fail, with an interval that is valid.

    The cases of the campaign were chosen to fail: they only say where failures are expected. Fresh
    cases are drawn independently from where they are and from where they are not, and the interval
    is exact, however wrong the expectation is. What fails where nothing was expected to, the
    campaign has missed. Where VUT and POV are of this package, the equations of motion run them
    without SUMO, except for one of a hundred.

    Example:  merge-sumo probability runs/design2

    Example:  merge-sumo probability runs/design2 --traffic exid-5 --out per-merge.json
    """

    run: AnyRun = field(metadata=RUN)
    _: KW_ONLY
    cases: int | None = option(
        None, int, "Fresh cases to run.", CASES, shown="100000 without SUMO, 4000 in it"
    )
    traffic: AnyPath | None = option(
        None,
        str,
        "With how many cars a merge fails in a traffic: exid-2, exid-3, exid-5, or a TOML file "
        "with density and speeds.",
        CASES,
        metavar="NAME|FILE",
    )
    distribution: AnyPath | None = option(
        None, Path, "JSON: how often cases occur.", CASES, metavar="FILE", shown="uniform"
    )
    confidence: float = option(
        0.95, float, "Chance that the interval holds the probability.", VERDICT
    )
    seed: int = seed_option("Same seed, same cases.")
    out: AnyPath | None = _out("New file (.json) to write.", "RUN/probability.json", metavar="FILE")
    engine: str | None = _engine()


# Verbs: look


@dataclass(frozen=True)
class Explain(Recorded):
    """Say why a failure fails: the smallest change of one thing with which it passes.

    Each coordinate of the start, the level of the POV and each named parameter changes by itself:
    cases with other values run, and each value that is printed runs a second time. A campaign
    explains its worst failure, without parameters, if the VUT is of this package. `report` shows
    all failures that were explained.

    Example:  merge-sumo explain runs/design1
    """

    run: AnyRun = field(metadata=RUN)
    case: int | None = keyword(None, "Index of the failure; the worst by default.")
    _: KW_ONLY
    params: Iterable[str] = field(
        default=(),
        metadata=_params(
            "A parameter of the controller, and the range in which the nearest value that passes "
            "is searched. May be given several times."
        ),
    )


@dataclass(frozen=True)
class Export(Asked):
    """Write cases of a campaign for SUMO, for other simulators, as a table, or to commit.

    Example:  merge-sumo export runs/design2 17 42
    """

    run: AnyRun = field(metadata=RUN)
    indices: Iterable[int] | int | None = keyword(
        None, "Cases of the campaign; csv: all when left out, cases: 40 that watch a VUT."
    )
    _: KW_ONLY
    file_format: str = option(
        "sumo",
        str,
        "Format: {formats}. sumo: folders that sumo-gui replays. openscenario: folders with "
        "OpenSCENARIO and OpenDRIVE. csv: one table of motion. cases: one small TOML file to "
        "commit, for rerun.",
        WHERE,
        "--format",
    )
    out: AnyPath | None = _out(
        "Folder to write into; of cases also FILE.toml.", "RUN/scenarios for sumo, else RUN/exports"
    )


# Verbs: change


@dataclass(frozen=True)
class Rerun(Recorded):
    """Run recorded cases again with a changed VUT, and say which broke and which are fixed.

    The cases are those of the old version's search: `campaign --against` searches where the new one
    alone fails.

    Exit code 1 when a case broke: it passed, and does not pass now. A cases file of `export` may
    stand in the place of the campaign. Then what changed in the file is shown, `out` is the file as
    it is now, and the exit code is 1 also for a new error or contact, or too little margin.

    With a controller that others wrote, a case that changed runs a second time. Where that does not
    repeat, the case is "not repeatable", and is not counted by itself.

    Example:  merge-sumo rerun runs/design2 3 7 --vut design2 --out changes.html

    Example:  merge-sumo rerun cases.toml --vut design2 --junit changes.xml

    Example:  merge-sumo rerun runs/design2 --stress
    """

    run: AnyRun = field(metadata={"help": "The campaign, its folder, or a cases file."})
    indices: Iterable[int] | int = keyword((), "Cases of the campaign; all of them by default.")
    _: KW_ONLY
    level: AnyLevels = _level()
    out: AnyPath | None = _page()
    junit: AnyPath | None = _junit()


@dataclass(frozen=True)
class Stress(Recorded):
    """Run the cases of a campaign again, each time a little otherwise: `merge-sumo rerun --stress`.

    `robust` of the result has the failures that fail every time, the worst first.
    """

    run: AnyRun = field(metadata=RUN)


@dataclass(frozen=True)
class Compare(Asked):
    """Compare recorded versions of a VUT: what broke, and what was fixed.

    Everything is read from the records. Cases that two campaigns share are paired; where each has
    cases of its own, regions of failures are compared, as a hint.

    Exit code 1 when a case broke, when a version passes in a smaller share of its own cases than
    the one before it, by Fisher's exact test, or when the last version was tested in no case.

    Example:  merge-sumo compare runs/design1 runs/design2 --out changes.html
    """

    runs: Iterable[AnyRun] = field(
        metadata={"help": "The campaigns, or their folders, the oldest first."}
    )
    _: KW_ONLY
    out: AnyPath | None = _page()
    junit: AnyPath | None = _junit()


@dataclass(frozen=True)
class Repair(Recorded):
    """Find the smallest change of a controller's parameters that removes its failures.

    optuna proposes values; the failures, near misses and a share of the other cases of the campaign
    run with each. No case that passed may fail. Of the values with the fewest failures those are
    chosen that cost least, and of these the smallest change. Then all cases run, and a fresh
    campaign with another seed is compared with the one before. Needs the extra repair.

    Exit code 0 when values were found and the fresh campaign shows no case that broke, else
    1: then it says which cases stay.

    Example:  merge-sumo repair runs/design1 --param gap_m=10..40 --param x2_m=10..90
    """

    run: AnyRun = field(metadata=RUN)
    params: Iterable[str] = field(
        metadata=_params(
            "A parameter that may change: of a built-in VUT or of SUMO's model, a keyword of the "
            "constructor, or an attribute. May be given several times."
        )
    )
    _: KW_ONLY
    vut: AnyVut | None = vut_again(
        "The controller to repair.", "the campaign's, as its files are now"
    )
    cost: str = option(
        "time",
        str,
        "Cost to keep low, as a mean over the cases: time to the merge, or braking of the VUT.",
        CASES,
        metavar="time|braking",
    )
    trials: int = option(60, int, "Sets of values that a round tries.", CASES)
    rounds: int = option(
        3,
        int,
        "Most rounds: the failures of a fresh campaign join the cases of the next.",
        CASES,
    )
    cases: int | None = option(
        None, int, "Cases of a fresh campaign.", CASES, shown="as many as the campaign"
    )
    seed: int = seed_option("Same seed, same values.")
    out: AnyPath | None = _out("New folder to write.", "runs/repair-RUN-DATE")


# Verbs: bring your own


@dataclass(frozen=True)
class Vuts(Policies):
    """List the vehicles that can be tested: by name, and the kinds that you can bring.

    Example:  merge-sumo vuts
    """


@dataclass(frozen=True)
class CheckVut(Limits, Policies):
    """Let a VUT drive a few cases, and print what is wrong with it and the cost of a step.

    Says "nothing wrong" (exit code 0), or what is wrong in sentences (exit code 1).

    Example:  merge-sumo check-vut design1
    """

    vut: AnyVut = field(metadata=VUT)
    _: KW_ONLY
    scenario: Scenario | AnyPath | None = _any_scenario("Scenario to drive in, or a file of one.")


@dataclass(frozen=True)
class NewScenario(Asked):
    """Write a scenario for a merge in a net of your own, with a suggested pool.

    On a ramp with an acceleration lane the VUT chooses on it where to merge.
    A picture of the road is written beside it, as SVG.

    Example:  merge-sumo scenario new my-ramp.toml --net my.net.xml --mainline "a b" --ramp "r b"
    """

    file: AnyPath = field(metadata={"help": "New TOML file to write."})
    _: KW_ONLY
    net: AnyPath = field(metadata=required_option(Path, "SUMO net: NAME.net.xml[.gz].", TESTED))
    mainline: str = field(
        metadata=required_option(str, 'Edges of the mainline, past M: "e1 e2".', TESTED)
    )
    ramp: str = field(metadata=required_option(str, 'Edges of the ramp, past M: "r1 e2".', TESTED))
    point: bool = option(
        False,
        bool,
        "Make M a point, also where the ramp has an acceleration lane.",
        TESTED,
        "--point",
    )


@dataclass(frozen=True)
class CheckScenario(Policies):
    """Check that a scenario can be hosted, and that the learned drivers were trained on it.

    Example:  merge-sumo scenario check us23
    """

    scenario: Scenario | AnyPath = field(
        metadata={"help": "The scenario, its name, or its TOML file."}
    )


@dataclass(frozen=True)
class Train(Asked):
    """Train the learned drivers, level by level, and measure their regret in SUMO.

    The regret is the loss of a driver against its best response, as a share of the gain of the best
    response over level-0 behaviour. An interrupted training continues.

    Example:  merge-sumo train --out my-policies --seed 1
    """

    only: Iterable[str] | None = option(
        None, list[str], "Network to train: pov1, vut1, pov2 or vut2.", TESTED
    )
    _: KW_ONLY
    seed: int = seed_option("Same seed, same weights on one machine.")
    scenario: Scenario | AnyPath | None = _any_scenario("Scenario, or a file of one.")
    out: AnyPath | None = _out("Folder to write.", "the shipped policies, for us23 only")
    a_min: float | None = option(
        None,
        float,
        "Hardest braking of the POVs in m/s2, below 0, such as -2.",
        TESTED,
        "--a-min",
        shown="that of the scenario",
    )
    check: bool = option(
        False,
        bool,
        "Train nothing: measure the regret of the networks in the folder.",
        TESTED,
        "--check",
    )
    cases: int = option(300, int, "Random cases of a check.", CASES)
    progress: bool | None = progress_option()


# Verbs: research


@dataclass(frozen=True)
class GroundTruth(Execution, Test):
    """Find the ground truth of a VUT at each level, by uniform cases on all cores.

    It is kept in a cache (MERGE_SUMO_CACHE, or the user's cache folder) under a hash of all inputs,
    and used again while all files that the VUT has loaded are the same. The output says how many
    cases SUMO has run where the kinematic engine ran the others. The truth of an object of a Python
    process is not kept: its name does not tell it from another object.

    Example:  merge-sumo truth --vut design2 --level 1 --cases 10000
    """

    vut: AnyVut = field(metadata=VUT)
    level: AnyLevels = _level()
    _: KW_ONLY
    cases: int | None = option(None, int, "Uniform cases of a level.", CASES, shown=TRUTH_CASES)
    seed: int = seed_option("Same seed, same cases.")
    engine: str | None = _engine()


@dataclass(frozen=True)
class Benchmark(Execution, Test):
    """Compare samplers with each other and with the ground truth, over several seeds.

    With all levels, each run shares its cases out over them, and coverage is summed over them.
    The truth of the paper's size misses places that searches find, so coverage is also shown as a
    share of a limit: the coverage of all that truth and searches found together, or that of
    1,000,000 uniform cases, if `truth --cases 1000000` has run, whichever is more.

    Example:  merge-sumo benchmark --vut design1 --level 0 --samplers uniform,gpr --seeds 3
    """

    vut: AnyVut = field(metadata=VUT)
    level: AnyLevels = _level()
    _: KW_ONLY
    samplers: Iterable[str] | None = option(
        None,
        str,
        "Names, separated by commas: {samplers}.",
        CASES,
        shown="all",
        parse=lambda text: None if text is None else text.split(","),
    )
    seeds: int = option(10, int, "Runs of each sampler.", CASES)
    cases: int = option(400, int, "Cases of each run.", CASES)
    batch: int | None = option(
        None, int, "Cases per batch.", EXPERTS, shown="what coverage wants, 20 for the others"
    )
    truth_cases: int | None = option(None, int, "Cases of the truth.", CASES, shown=TRUTH_CASES)
    figure: AnyPath | None = option(
        None, Path, "New file for FMC against cases: .png or .svg.", WHERE, metavar="FILE"
    )


@dataclass(frozen=True)
class Reproduce(Execution, Policies):
    """Reproduce the paper: Table II and every figure of its results, beside the paper's numbers.

    Writes table2.md, table2.json, the figures as PNG, and index.html that shows it all.

    Example:  merge-sumo reproduce --seeds 10 --out reproduction
    """

    _: KW_ONLY
    seeds: int | None = option(
        None, int, "Runs of each sampler.", CASES, shown="10, with --quick 2"
    )
    out: AnyPath | None = _out("New folder to write.", "runs/reproduce-DATE")
    quick: bool = option(
        False, bool, "Few and short runs and a small truth: a first look.", CASES, "--quick"
    )
