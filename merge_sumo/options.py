"""Every option of a verb, once: the keyword in Python, the option on the command line, its help.

A verb has a record. Its fields are the keywords of the function in `api/` and, where a field is
an `option`, the options of the command. `Test` says what decides the outcome of a case, `Search`
which cases run, and `Execution` where they run, which decides nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, MISSING, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, Protocol

from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import DEADLINE_S, MEMORY_GIB

if TYPE_CHECKING:
    from merge_sumo.scenario.imperfection import Actuation, Sensing
    from merge_sumo.scenario.scenario import Scenario
    from merge_sumo.verdict.score import Outcome
    from merge_sumo.vuts.in_memory import AnyVut
else:  # the command line reads no annotation, and importing these takes time
    AnyVut = Actuation = Outcome = Scenario = Sensing = Any


class Opened(Protocol):
    """A campaign that was opened: `CampaignRun`."""

    @property
    def folder(self) -> Path:
        """Its folder."""


AnyPath = Path | str
AnyRun = Opened | Path | str
"""A campaign, or its folder."""
AnyWorkers = int | str | None

TESTED: Final = "What is tested"
CASES: Final = "How many cases, and which"
VERDICT: Final = "Verdict"
WHERE: Final = "Where it runs, and what it writes"
LIMITS: Final = "Limits"
EXPERTS: Final = "For experts"
GROUPS: Final = (TESTED, CASES, VERDICT, WHERE, LIMITS, EXPERTS)
"""Groups of options in the order in which help shows them."""
DEFAULT_CASES: Final = 800
DEFAULT_SAMPLER: Final = "coverage"
VUT: Final = {
    "help": "Vehicle under test: a spec as after --vut, a class, a function, or an object."
}
PROGRESS: Final = "Show progress; by default in a notebook and on a terminal."
RUN: Final = {"help": "The campaign, or its folder."}
TRUTH_CASES: Final = "10000, at level 2 20000"


@dataclass(frozen=True, slots=True)
class Option:
    """How a field is an option of the command line.

    Attributes:
        help: the help text; "{samplers}" and the like are the names of a registry.
        group: one of `GROUPS`.
        kind: type of the value on the command line.
        flags: its flags; by default the name of the field.
        metavar: the value in help.
        shown: the default in words.
        parse: makes the keyword of what was written.
        written: default on the command line, where that is another than in Python.
    """

    help: str
    group: str
    kind: Any
    flags: tuple[str, ...] = ()
    metavar: str | None = None
    shown: str | None = None
    parse: Callable[[Any], Any] | None = None
    written: Any = ...


def option(default: Any, kind: Any, help: str, group: str, *flags: str, **more: Any) -> Any:
    """Return a field that is an option; `more` is of `Option`."""
    return field(default=default, metadata=_required(kind, help, group, *flags, **more))


def keyword(default: Any, help: str) -> Any:
    """Return a field that is a keyword in Python alone."""
    return field(default=default, metadata={"help": help})


def _required(kind: Any, help: str, group: str, *flags: str, **more: Any) -> dict[str, Any]:
    return {"help": help, "option": Option(help, group, kind, flags, **more)}


def options_of(record: type[Any]) -> dict[str, tuple[Option, Any]]:
    """Return the options of a record by the names of their fields, each with its default.

    The default is that of the command line, `...` where there is none.
    """
    known = {}
    for one in fields(record):
        if "option" in one.metadata:
            of: Option = one.metadata["option"]
            default = one.default if of.written is ... else of.written
            known[one.name] = of, ... if default is MISSING else default
    return known


def flags_of(name: str, known: Option) -> tuple[str, ...]:
    """Return the flags of the command line that a field is."""
    return known.flags or ("--" + name.replace("_", "-"),)


def _runs_of_a_case(text: str) -> int | str:
    if text == "auto":
        return text
    if not text.isdecimal():
        raise UserError(f"`repeat` is {text!r}: give the number of runs of a case, or auto")
    return int(text)


def _workers(text: str | None) -> AnyWorkers:
    """Return a number of processes, or the address of a scheduler."""
    try:
        return None if text is None else int(text)
    except ValueError:
        return text


def _names(text: str | None) -> list[str] | None:
    return None if text is None else text.split(",")


def _unless(quiet: bool) -> bool:
    return not quiet


def _seed(help: str) -> Any:
    return option(0, int, help, CASES)


def _level() -> Any:
    return option("all", str, "POV level: 0, 1, 2, own or all.", TESTED)


def _tolerated() -> Any:
    about = "A case fails where more than this share of its runs do."
    return option(0.0, float, about, VERDICT, "--tolerate", metavar="SHARE")


def _params(help: str) -> dict[str, Any]:
    return _required(list[str], help, CASES, "--param", metavar="NAME=LOW..HIGH")


def _vut_again(help: str = "", shown: str = "the campaign's") -> Any:
    about = (
        "Vehicle under test, perhaps a changed one. A file, module, command or model is always "
        "named here: a run folder names no code to run."
    )
    return option(None, str, help or about, TESTED, metavar="SPEC", shown=shown)


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


def _progress() -> Any:
    quiet = _required(
        bool, "Show no progress.", WHERE, "--quiet", "-q", parse=_unless, written=False
    )
    return field(default=None, metadata={**quiet, "help": PROGRESS})


def _junit() -> Any:
    return option(None, Path, "New file to write for CI: JUnit XML.", WHERE, metavar="FILE")


def _any_scenario(help: str) -> Any:
    return option(None, str, help, TESTED, metavar="NAME|FILE", shown="us23")


class Asked:
    """What a verb is asked; `given` has the names of the keywords that a person gave."""

    given: frozenset[str] = frozenset()

    def values(self, *records: type[Any]) -> dict[str, Any]:
        """Return the values of the fields of some records, or of its own."""
        of: tuple[Any, ...] = records or (type(self),)
        names = [one.name for record in of for one in fields(record)]
        return {name: getattr(self, name) for name in names}

    def stated(self, *records: type[Any]) -> dict[str, Any]:
        """Return the same of the fields that a person gave with a value."""
        known = self.values(*records).items()
        return {name: one for name, one in known if name in self.given and one is not None}


# Groups of keywords


@dataclass(frozen=True, kw_only=True)
class Policies(Asked):
    """Learned drivers."""

    policies: AnyPath | None = option(
        None,
        Path,
        "Folder of learned drivers, as `train --out DIR` makes it, or a shipped library such as "
        "human, instead of the default ones.",
        EXPERTS,
        metavar="NAME|DIR",
    )


@dataclass(frozen=True, kw_only=True)
class Limits(Asked):
    """What a controller may take."""

    deadline_s: float = option(
        DEADLINE_S,
        float,
        "Seconds that a VUT may take for a step before it is a VUT_ERROR.",
        EXPERTS,
        "--deadline",
    )
    vut_memory_gib: float = option(
        MEMORY_GIB,
        float,
        "GiB of memory that the process of a VUT of your own may take.",
        LIMITS,
        "--vut-memory",
    )


@dataclass(frozen=True, kw_only=True)
class Hosting(Limits, Policies):
    """How the drivers run: what a recorded campaign may have otherwise."""

    pov: AnyVut | None = option(
        None,
        str,
        "A POV of your own, of any kind that --vut takes but traci: it drives at level own.",
        EXPERTS,
        metavar="SPEC",
    )


@dataclass(frozen=True, kw_only=True)
class Judged(Asked):
    """Where a case is played, and what counts as a failure."""

    scenario: Scenario | AnyPath = option(
        "us23",
        str,
        "Scenario that `merge-sumo scenario list` names, or a TOML file of your own: "
        "`merge-sumo scenario new` writes one.",
        TESTED,
        metavar="NAME|FILE",
    )
    fail_when: str | None = option(
        None,
        str,
        "What counts as a failure: {criteria} (paper: front bumpers within 6 m at the merge), or a "
        "condition over the measures of outcomes.jsonl: 'ttc_s < 1.5 or end == \"TIMEOUT\"'.",
        VERDICT,
        metavar="EXPR",
        shown="the scenario's: paper where M is a point, unsafe on a lane",
    )
    require: str | None = option(
        None,
        str,
        "Requirement over time, instead of --fail-when, in signal temporal logic: "
        "'always ((x_vut_m > -20) implies (bumper_gap_m > 2))'. Needs the extra stl.",
        EXPERTS,
        metavar="STL",
    )


@dataclass(frozen=True, kw_only=True)
class OfScenario(Asked):
    """Changes of the scenario."""

    follow_up_s: float | None = option(
        None,
        float,
        "Time for which both drive on after the merge, with measures of its own.",
        TESTED,
        "--follow-up",
        metavar="SECONDS",
        shown="the scenario's, 0",
    )
    sense: Sensing | str | None = option(
        None,
        str,
        "How the VUT senses other cars: delay_s, noise_x_m, noise_v_mps, dropout, range_m, "
        "occluded_until_m; a range, as delay_s=0..0.5, is tested as a whole.",
        TESTED,
        metavar="NAME=NUMBER,...",
        shown="the scenario's, perfectly",
    )
    act: Actuation | str | None = option(
        None,
        str,
        "How the VUT obeys its controller: lag_s, delay_s, power_w_per_kg; with ranges as --sense.",
        TESTED,
        metavar="NAME=NUMBER,...",
        shown="the scenario's, perfectly",
    )


@dataclass(frozen=True, kw_only=True)
class Test(OfScenario, Judged, Hosting):
    """What decides the outcome of a case, beside the VUT and the case itself."""


@dataclass(frozen=True, kw_only=True)
class Search(Asked):
    """Which cases run."""

    sampler: str = option(DEFAULT_SAMPLER, str, "What chooses the cases: {samplers}.", EXPERTS)
    cases: int = option(DEFAULT_CASES, int, "Number of test cases.", CASES)
    batch: int | None = keyword(None, "Cases per batch; by default as many as the sampler wants.")
    in_flight: int | None = option(
        None,
        int,
        "Most cases that run or wait for a worker while the sampler is asked for more, instead of "
        "batches: for controllers that take seconds for a case. About three times the workers.",
        EXPERTS,
        metavar="N",
    )
    repeat: int | Literal["auto"] = option(
        1,
        str,
        "Number of runs of each case, each with other random numbers; auto repeats a case where "
        "chance decides on it. Each run is one of the --cases.",
        CASES,
        metavar="N|auto",
        parse=_runs_of_a_case,
    )
    tolerated: float = _tolerated()
    seed: int = _seed("Same seed, same outcomes.")
    stop_when_converged: bool = option(
        False,
        bool,
        "Stop early when the last 100 cases have added less than 1 % to the coverage.",
        CASES,
        "--stop-when-converged",
    )


@dataclass(frozen=True, kw_only=True)
class Execution(Asked):
    """Where the cases of a verb run: nothing here decides an outcome."""

    workers: AnyWorkers = option(
        1,
        str,
        "Processes that run cases, or a Dask scheduler, tcp://HOST:PORT; the outcomes are the "
        "same.",
        WHERE,
        metavar="N|ADDRESS",
        shown="one a core",
        parse=_workers,
        written=None,
    )
    progress: bool | None = _progress()


@dataclass(frozen=True, kw_only=True)
class Recorded(Execution, Hosting):
    """How cases of a recorded campaign run today."""

    vut: AnyVut | None = _vut_again()


COORDINATES: Final = ("x_pov0_m", "v_pov0_mps", "svo_rad", "headway_ahead_s", "headway_behind_s")
"""Coordinates of a case that are keywords; `at` takes any."""


# Verbs: search


@dataclass(frozen=True, kw_only=True)
class SearchOfTest(Execution, Search, Test):
    """The keywords of a campaign, begun or gone on with."""

    level: int | str = _level()
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
class Case(Test):
    """Run one case and show what happens: verdict, measures, and the motion second by second.

    Exit code 0 when the case passes, 1 when it fails, errs or times out, 2 for bad use.

    Example:  merge-sumo run --vut design2 --level 2 --x -298.6 --v 34.5 --psi 0.62
    """

    vut: AnyVut | None = _vut_again()
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
        False, bool, "Show it in sumo-gui while it runs, in real time.", WHERE, "--gui"
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
    seed: int = _seed("Same seed, same cases.")
    out: AnyPath | None = _out("New file to write.", "RUN/probability.json", metavar="FILE")
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
    """Write cases of a campaign for SUMO, for other simulators, or as a table.

    Example:  merge-sumo export runs/design2 17 42
    """

    run: AnyRun = field(metadata=RUN)
    indices: Iterable[int] | int | None = keyword(
        None, "Cases of the campaign; of a table all of them when left out."
    )
    _: KW_ONLY
    file_format: str = option(
        "sumo",
        str,
        "Format: {formats}. sumo: folders that sumo-gui replays. openscenario: folders with "
        "OpenSCENARIO and OpenDRIVE. csv: one table of motion.",
        WHERE,
        "--format",
    )
    out: AnyPath | None = _out("Folder to write into.", "RUN/scenarios for sumo, else RUN/exports")


# Verbs: change


@dataclass(frozen=True)
class Rerun(Recorded):
    """Run recorded cases again with a changed VUT, and say which broke and which are fixed.

    The cases are those of the old version's search: `campaign --against` searches where the new one
    alone fails.

    Exit code 1 when a case broke: it passed, and does not pass now.

    Example:  merge-sumo rerun runs/design2 3 7 --vut design2

    Example:  merge-sumo rerun runs/design2 --stress
    """

    run: AnyRun = field(metadata=RUN)
    indices: Iterable[int] | int = keyword((), "Cases of the campaign; all of them by default.")
    _: KW_ONLY
    level: int | str = _level()


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

    Exit code 1 when a case broke, or the last version was tested in no case.

    Example:  merge-sumo compare runs/design1 runs/design2 --out changes.html
    """

    runs: Iterable[AnyRun] = field(
        metadata={"help": "The campaigns, or their folders, the oldest first."}
    )
    _: KW_ONLY
    out: AnyPath | None = _out(
        "New HTML page to write: what changed, in which cases, and both motions.", metavar="FILE"
    )
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
    vut: AnyVut | None = _vut_again(
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
    seed: int = _seed("Same seed, same values.")
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
    net: AnyPath = field(metadata=_required(Path, "SUMO net.", TESTED))
    mainline: str = field(
        metadata=_required(str, 'Edges of the mainline, past M: "e1 e2".', TESTED)
    )
    ramp: str = field(metadata=_required(str, 'Edges of the ramp, past M: "r1 e2".', TESTED))
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
    """Train the learned drivers in SUMO, level by level, and measure their regret.

    The regret is the loss of a driver against its best response, as a share of the gain of the best
    response over level-0 behaviour. An interrupted training continues.

    Example:  merge-sumo train --out my-policies --seed 1
    """

    only: Iterable[str] | None = option(
        None, list[str], "Network to train: pov1, vut1, pov2 or vut2.", TESTED
    )
    _: KW_ONLY
    seed: int = _seed("Same seed, same weights on one machine.")
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
    progress: bool | None = _progress()


# Verbs: research


@dataclass(frozen=True)
class Truth(Execution, Test):
    """Find the ground truth of a VUT at each level, by uniform cases on all cores.

    It is kept in a cache (MERGE_SUMO_CACHE, or the user's cache folder) under a hash of all inputs,
    and used again while all files that the VUT has loaded are the same. The output says how many
    cases SUMO has run where the kinematic engine ran the others. The truth of an object of a Python
    process is not kept: its name does not tell it from another object.

    Where a share of the runs is tolerated, a case fails where more than that share of its runs do;
    it runs until that is decided with 95 % probability, up to 20 times.

    Example:  merge-sumo truth --vut design2 --level 1 --cases 10000

    Example:  merge-sumo truth --vut design2 --level 1 --cases 200 --sense noise_x_m=2 --tolerate .2
    """

    vut: AnyVut = field(metadata=VUT)
    level: int | str = _level()
    _: KW_ONLY
    cases: int | None = option(None, int, "Uniform cases of a level.", CASES, shown=TRUTH_CASES)
    seed: int = _seed("Same seed, same cases.")
    engine: str | None = _engine()
    repeat: int | None = option(
        None,
        int,
        "Run each case until it is decided whether it fails, so often at most, with another draw "
        "of what is random.",
        CASES,
        metavar="N",
        shown="1, with --tolerate 20",
    )
    tolerated: float = _tolerated()


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
    level: int | str = _level()
    _: KW_ONLY
    samplers: Iterable[str] | None = option(
        None,
        str,
        "Names, separated by commas: {samplers}.",
        CASES,
        shown="all",
        parse=_names,
    )
    seeds: int = option(10, int, "Runs of each sampler.", CASES)
    cases: int = option(400, int, "Cases of each run.", CASES)
    batch: int | None = option(
        None, int, "Cases per batch.", EXPERTS, shown="what coverage wants, 20 for the others"
    )
    truth_cases: int | None = option(None, int, "Cases of the truth.", CASES, shown=TRUTH_CASES)
    figure: AnyPath | None = option(
        None, Path, "New file for FMC against cases: .png, .svg or .html.", WHERE, metavar="FILE"
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
