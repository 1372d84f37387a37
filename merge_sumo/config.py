"""Settings of the verbs: one dataclass each, whose fields are keywords in Python and options.

Shared fields stand in base classes. `None` means: as in the scenario; for a recorded campaign: as
it was recorded. An option has the name of its field, unless `FLAGS` gives another.

A field of `ScenarioChanges` has the name of a field of `Scenario`, which it replaces
(`from_config.scenario_from`). One of `Search`, `FailureRule` or `Limits` is a field of
`CampaignSettings`. `load_plan` gives the criterion to `SimulationPlan`, and the limits to its
controllers, as `ControllerOptions`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import KW_ONLY, dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from merge_sumo.controllers.in_memory import AnyVut
    from merge_sumo.metrics.outcome import Outcome
    from merge_sumo.scenario.imperfection import Actuation, Sensing
    from merge_sumo.scenario.scenario import AnyLevels, Scenario

    class Opened(Protocol):
        """A campaign that was opened: `CampaignRun`."""

        @property
        def folder(self) -> Path:
            """Its folder."""

    AnyPath = Path | str
    AnyRun = Opened | Path | str
    AnyScenario = Scenario | Path | str
    AnySensing = Sensing | str
    AnyActuation = Actuation | str
    Names = Iterable[str] | str
    Indices = Iterable[int] | int
else:  # Types of the values that a command line has; the others take time to import.
    AnyLevels = AnyScenario = AnySensing = AnyActuation = AnyVut = Names = str
    AnyPath = AnyRun = Path
    Indices = tuple[int, ...]
    Outcome = Any

MOST_CASES = 800
"""Maximum number of cases of a campaign that ends when its search has converged."""
FLAGS: Mapping[str, str] = {
    "deadline_s": "--deadline",
    "vut_memory_gib": "--vut-memory",
    "follow_up_s": "--follow-up",
    "from_s": "--from",
    "x_pov0_m": "--x",
    "v_pov0_mps": "--v",
    "svo_rad": "--psi",
    "headway_ahead_s": "--headway-ahead",
    "headway_behind_s": "--headway-behind",
    "recorded": "--case",
    "tolerated": "--tolerate",
    "gates": "--gate",
    "params": "--param",
    "file_format": "--format",
}
"""Options with another name than their field."""


def flag_of(name: str) -> str:
    """Return the option of the command line for a field.

    Args:
        name: name of the field.
    """
    return FLAGS.get(name, f"--{name.replace('_', '-')}")


@dataclass(frozen=True, kw_only=True)
class Policies:
    """Drivers."""

    policies: AnyPath | None = None
    """Folder of learned drivers, as `train --out DIR` makes it, or a shipped library such as human,
    instead of the default ones."""


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of a controller."""

    deadline_s: float | None = None
    """Seconds that a controller may take for a step before it is a VUT_ERROR; 5 by default."""
    vut_memory_gib: float | None = None
    """GiB of memory that the process of a controller of your own may take; 4 by default."""


@dataclass(frozen=True, kw_only=True)
class Drivers(Limits, Policies):
    """Drivers and limits of controllers."""

    pov: AnyVut | None = None
    """A POV of your own, of any kind that --vut takes but traci: it drives at level own."""


@dataclass(frozen=True, kw_only=True)
class FailureRule:
    """What counts as a failure."""

    fail_when: str | None = None
    """What counts as a failure: paper (front bumpers within 6 m at the merge), unsafe, contact, or
    a condition over the measures of outcomes.jsonl: 'ttc_s < 1.5 or end == "TIMEOUT"'. By default
    that of the scenario: paper where M is a point, unsafe on a lane."""
    require: str | None = None
    """Requirement over time, instead of --fail-when, in signal temporal logic:
    'always ((x_vut_m > -20) implies (bumper_gap_m > 2))'. Needs the extra stl."""


@dataclass(frozen=True, kw_only=True)
class ScenarioChanges:
    """Changes of a scenario."""

    follow_up_s: float | None = None
    """Seconds for which all drive on after the merge; 0 ends an episode there. By default 3,
    and 5 on an acceleration lane."""
    sense: AnySensing | None = None
    """How the VUT senses other cars: delay_s, noise_x_m, noise_v_mps, dropout, range_m,
    occluded_until_m, as NAME=NUMBER,...; a range, as delay_s=0..0.5, is tested as a whole."""
    act: AnyActuation | None = None
    """How the VUT obeys its controller: lag_s, delay_s, power_w_per_kg; with ranges as --sense."""


@dataclass(frozen=True, kw_only=True)
class Test(ScenarioChanges, FailureRule, Drivers):
    """What is tested."""

    scenario: AnyScenario | None = None
    """Scenario that `merge-sumo scenario list` names, or a TOML file of your own, which
    `merge-sumo scenario new` writes; us23 by default."""


@dataclass(frozen=True, kw_only=True)
class Search:
    """Which cases run."""

    sampler: str = "coverage"
    """Sampler that proposes the cases: coverage, gpr, subset, annealing or uniform."""
    cases: int | None = None
    """Number of cases; by default until the search has converged, at most 800."""
    batch: int | None = None
    """Cases per batch; by default the number that the sampler wants."""
    in_flight: int | None = None
    """Maximum number of cases that run or wait for a worker while the sampler proposes more,
    instead of batches: for controllers that take seconds for a case. About three times the
    workers."""
    repeat: int = 1
    """Number of runs of each case. They differ by the seed that a controller gets, and by the noise
    and dropouts of --sense; else all are alike. Each run is one of the --cases."""
    tolerated: float = 0.0
    """A case fails where more than this share of its runs do."""
    seed: int = 0
    """Seed of random numbers: same seed, same outcomes."""
    stop_when_converged: bool = False
    """Stop before --cases when the last 100 cases have added less than 1 % to the coverage."""


@dataclass(frozen=True, kw_only=True)
class Execution:
    """Where it runs."""

    workers: int | str | None = 1
    """Processes that run cases, auto for one a core (one in all for a campaign of up to 1,000 cases
    of built-in drivers), or a Dask scheduler, tcp://HOST:PORT; the outcomes are the same. By
    default auto for a command, and 1 in Python."""
    progress: bool | None = None
    """Show progress; by default in a notebook and on a terminal."""


@dataclass(frozen=True, kw_only=True)
class StudyOptions(Execution, Drivers):
    """How a study runs cases of a recorded campaign."""

    vut: AnyVut | None = None
    """Vehicle under test, perhaps a changed one. A file, module, command or model is always named
    here: a run folder names no code to run."""


@dataclass(frozen=True, kw_only=True)
class Junit:
    """A file for CI."""

    junit: AnyPath | None = None
    """New file to write for CI: JUnit XML (.xml)."""


@dataclass(frozen=True, kw_only=True)
class Page(Junit):
    """Files of a comparison."""

    out: AnyPath | None = None
    """New page (.html) to write: what changed, and each such case with both motions."""


@dataclass(frozen=True, kw_only=True)
class Levels:
    """Levels of the POV."""

    level: AnyLevels = "all"
    """POV levels: 0, 1, 2, own, several with commas, or all."""


@dataclass(frozen=True, kw_only=True)
class EngineChoice:
    """What moves the vehicles."""

    engine: str | None = None
    """kinematic: the equations of motion alone, and SUMO for at least one case of a hundred; or
    sumo for all. By default kinematic where VUT and POV are of this package."""


@dataclass(frozen=True, kw_only=True)
class Beginning:
    """From when on a case is shown."""

    from_s: float | None = None
    """Begin so long before the first conflict, as in -3: contact, else lowest TTC, merge, end."""


# Search


@dataclass(frozen=True, kw_only=True)
class CampaignOptions(Levels, Junit, Execution, Search, Test):
    """Test a VUT: run cases in SUMO, find failures, write a report and replayable scenarios.

    Ctrl-C ends after the running batch and prints how to continue; twice stops at once.

    Exit code 1 when a --gate is met, and always when the VUT merged in no case: then nothing was
    tested. 2 for bad use, 130 or 143 when it was stopped, else 0.

    Example:  merge-sumo campaign --vut design1 --level 0 --cases 400 --seed 1

    Example:  merge-sumo campaign --vut design1 --against design2 --level 0 --cases 40
    """

    against: AnyVut | None = None
    """An earlier version of the VUT, of any kind but a client that connects by itself (traci or
    traci:PORT): each case runs with both, and the sampler looks for those that the VUT alone
    fails."""
    gates: Iterable[str] = ()
    """Exit with 1 if there are failures, errors, timeouts, "fmc>X": an FMC above X at some level,
    or, with --against, regressions. May be given several times."""


@dataclass(frozen=True, kw_only=True)
class CampaignCalls(CampaignOptions):
    """A campaign with functions that it calls."""

    on_case: Callable[[Outcome], None] | None = None
    """Called with the outcome of every case as it ends."""
    check: Callable[[], None] | None = None
    """Called after every batch; may raise to stop there."""


@dataclass(frozen=True)
class Campaign(CampaignCalls):
    """Test a VUT and return the campaign, also one without failures."""

    vut: AnyVut
    """Vehicle under test: a spec as after --vut, a class, a function, or an object."""
    _: KW_ONLY
    out: AnyPath | None = None
    """New folder to write; runs/VUT-DATE by default."""


@dataclass(frozen=True)
class NoFailures(Campaign):
    """Test a VUT in a campaign, and raise `AssertionError` where a case fails or ends in an error.

    The message names the counts, the worst case, the report, and the command that replays the
    case. A timeout is not a failure, unless `fail_when` says so. Returns the campaign.
    """

    _: KW_ONLY
    cases: int = 200
    """Number of cases: seconds for a controller that answers at once."""


@dataclass(frozen=True)
class Resume(CampaignCalls):
    """Continue a campaign that was stopped; the same as `merge-sumo campaign --resume`.

    The settings must be those of the campaign: `cases` may be more. A VUT, `pov` or `against` that
    is code is given again: a run folder names no code to run. Of an object only its name tells that
    it is the same.
    """

    run: AnyRun
    """The campaign, or its folder."""
    _: KW_ONLY
    vut: AnyVut | None = None
    """The VUT again, where it is code of your own."""


@dataclass(frozen=True, kw_only=True)
class CaseOptions(Beginning, Test):
    """Run one case and show what happens: verdict, measures, and the motion second by second.

    Exit code 0 when the case passes, 1 when it fails, errs or times out, 2 for bad use. With --gui
    its replay opens in sumo-gui when it has ended; --from begins table and window later.

    Example:  merge-sumo run --vut design2 --level 2 --x -298.6 --v 34.5 --psi 0.62
    """

    level: int | str | None = None
    """POV level: 0, 1, 2 or own; by default 0, or that of the recorded case."""
    x_pov0_m: float | None = None
    """Initial position of the POV in m; M is 0."""
    v_pov0_mps: float | None = None
    """Initial speed of the POV in m/s."""
    svo_rad: float | None = None
    """Social value orientation of the POV in rad, at level 2."""
    headway_ahead_s: float | None = None
    """Headway to the car ahead in s, in traffic."""
    headway_behind_s: float | None = None
    """Headway of the car behind in s, in traffic."""
    debug: bool = False
    """Run the VUT in this process without a deadline: breakpoints work."""
    gui: bool = False
    """Show its replay in sumo-gui when it has ended."""
    out: AnyPath | None = None
    """New folder to keep it in, for `replay` and sumo-gui."""
    recorded: tuple[AnyRun, int] | None = None
    """A campaign, or its folder, and the index of its case: default of everything else."""


COORDINATE_OPTIONS = ("x_pov0_m", "v_pov0_mps", "svo_rad", "headway_ahead_s", "headway_behind_s")
"""Fields of `CaseOptions` that are coordinates of a case."""


@dataclass(frozen=True)
class RunCase(CaseOptions):
    """Run one case and return it."""

    vut: AnyVut | None = None
    """Vehicle under test; by default that of the recorded case."""
    case: Mapping[str, Any] | None = None
    """A row of `run.cases` or `run.failures`: default of level and coordinates."""
    _: KW_ONLY
    at: Mapping[str, float] | None = None
    """Any coordinate of the case, by its name in outcomes.jsonl."""
    on_end: Callable[[Any], None] | None = None
    """Called with the result when the case has ended, before a window is closed."""


@dataclass(frozen=True)
class Probability(EngineChoice, StudyOptions):
    """Estimate how likely a VUT is to fail, with an interval that is valid.

    The cases of the campaign were chosen to fail: they only say where failures are expected. Fresh
    cases are drawn independently from where they are and from where they are not, and the interval
    is exact, however wrong the expectation is. What fails where nothing was expected to, the
    campaign has missed. Where VUT and POV are of this package, the equations of motion run them
    without SUMO, except for one of a hundred.

    Example:  merge-sumo probability runs/design2

    Example:  merge-sumo probability runs/design2 --traffic exid-5 --out per-merge.json
    """

    run: AnyRun
    """The campaign, or its folder."""
    _: KW_ONLY
    cases: int | None = None
    """Fresh cases to run; by default 100000 without SUMO, 4000 in it."""
    traffic: AnyPath | None = None
    """State the failures per merge in a traffic: exid-2, exid-3, exid-5, or a TOML file with
    density and speeds."""
    distribution: AnyPath | None = None
    """JSON: how often cases occur; uniformly by default."""
    confidence: float = 0.95
    """Chance that the interval holds the probability."""
    seed: int = 0
    """Seed of random numbers: same seed, same cases."""
    out: AnyPath | None = None
    """New file (.json) to write; RUN/probability.json by default."""


# Look


@dataclass(frozen=True)
class Explain(StudyOptions):
    """Say why a failure fails: the smallest change of one thing with which it passes.

    Each coordinate of the start, the level of the POV and each named parameter changes by itself:
    cases with other values run, and each value that is printed runs a second time. A campaign
    explains its worst failure, without parameters, if the VUT is of this package. `report` shows
    all failures that were explained.

    Example:  merge-sumo explain runs/design1
    """

    run: AnyRun
    """The campaign, or its folder."""
    case: int | None = None
    """Index of the failure in outcomes.jsonl; the worst by default."""
    _: KW_ONLY
    params: Iterable[str] = ()
    """A parameter of the controller, NAME=LOW..HIGH, and the range in which the nearest value that
    passes is searched. May be given several times."""


@dataclass(frozen=True)
class Export:
    """Write cases of a campaign for SUMO, for other simulators, as a table, or to commit.

    Example:  merge-sumo export runs/design2 17 42
    """

    run: AnyRun
    """The campaign, or its folder."""
    indices: Indices | None = None
    """Cases of the campaign; csv: all by default, cases: 40 that watch a VUT."""
    _: KW_ONLY
    file_format: str = "sumo"
    """sumo: folders that sumo-gui replays. openscenario: folders with OpenSCENARIO and OpenDRIVE.
    csv: one table of motion. cases: one small TOML file to commit, for rerun."""
    out: AnyPath | None = None
    """Folder, or FILE.csv or FILE.toml for one file; by default RUN/scenarios for sumo, else
    RUN/exports."""


@dataclass(frozen=True)
class ReplayCase(Beginning):
    """Replay a scenario in SUMO and check every position and speed against its record.

    A case of a campaign is exported first. Says what happened, then "identical" (exit code 0) or
    "diverged at t = ..." (exit code 1).

    Example:  merge-sumo replay scenarios/stalemate --gui --from -3
    """

    folder: AnyRun
    """A scenario folder, or a campaign, or its folder."""
    index: int | None = None
    """Index of the case of the campaign in outcomes.jsonl."""


@dataclass(frozen=True)
class Report:
    """Write the report of a campaign again and print its path.

    With --json each of its facts is printed, with the file and the key that it is from.

    Example:  merge-sumo report runs/design2
    """

    run: AnyRun
    """The campaign, or its folder."""


# Change


@dataclass(frozen=True)
class Rerun(Page, Levels, StudyOptions):
    """Run recorded cases again with a changed VUT, and say which broke and which are fixed.

    The cases are those of the old version's search: `campaign --against` searches where the new one
    alone fails.

    Exit code 1 when a case broke: it passed, and does not pass now. A cases file of `export` may
    stand in the place of the campaign. Then what changed in the file is shown, `out` is the file as
    it is now, and the exit code is 1 also for a new error or contact, and for a margin that drops
    by more than the `tolerance` of a file that has one.

    With a controller that others wrote, a case that changed runs a second time. Where that does not
    repeat, the case is "not repeatable", and is not counted by itself.

    Example:  merge-sumo rerun runs/design2 3 7 --vut design2 --out changes.html

    Example:  merge-sumo rerun cases.toml --vut design2 --junit changes.xml

    Example:  merge-sumo rerun runs/design2 --stress
    """

    run: AnyRun
    """The campaign, its folder, or a cases file."""
    indices: Indices = ()
    """Cases of the campaign; all of them by default."""


@dataclass(frozen=True)
class Stress(StudyOptions):
    """Measure how results change with the simulation; the same as `merge-sumo rerun --stress`.

    `robust` of the result has the failures that fail every time, the worst first.
    """

    run: AnyRun
    """The campaign, or its folder."""


@dataclass(frozen=True)
class Compare(Page):
    """Compare recorded versions of a VUT: broken and fixed cases.

    Everything is read from the records. Cases that two campaigns share are paired; where each has
    cases of its own, the shares of cases that pass are compared.

    Exit code 1 when a case broke, when a version passes in a smaller share of its own cases than
    the one before it, by Fisher's exact test, or when the last version was tested in no case.

    Example:  merge-sumo compare runs/design1 runs/design2 --out changes.html
    """

    runs: Iterable[AnyRun]
    """The campaigns, or their folders, the oldest first."""


# Bring your own


@dataclass(frozen=True, kw_only=True)
class Vuts(Policies):
    """List the vehicles that can be tested: by name, and the kinds that you can bring.

    Example:  merge-sumo vuts
    """


@dataclass(frozen=True)
class CheckVut(Limits, Policies):
    """Let a VUT drive a few cases, and print its faults and the cost of a step.

    Says "nothing wrong" (exit code 0), or names the faults in sentences (exit code 1).

    Example:  merge-sumo check-vut design1
    """

    vut: AnyVut
    """Vehicle under test, as after --vut."""
    _: KW_ONLY
    scenario: AnyScenario | None = None
    """Scenario to drive in, or a TOML file of one; us23 by default."""


@dataclass(frozen=True)
class Scenarios:
    """List the scenarios that the package brings.

    Example:  merge-sumo scenario list
    """


@dataclass(frozen=True)
class NewScenario:
    """Write a scenario for a merge in a net of your own, with a suggested pool.

    On a ramp with an acceleration lane the VUT chooses on it where to merge.
    A picture of the road is written next to it, as SVG.

    Example:  merge-sumo scenario new my-ramp.toml --net my.net.xml --mainline "a b" --ramp "r b"
    """

    file: AnyPath
    """New TOML file to write."""
    _: KW_ONLY
    net: AnyPath
    """SUMO net: NAME.net.xml[.gz]."""
    mainline: str
    """Edges of the mainline, past M: "e1 e2"."""
    ramp: str
    """Edges of the ramp, past M: "r1 e2"."""
    point: bool = False
    """Make M a point, also where the ramp has an acceleration lane."""


@dataclass(frozen=True)
class CheckScenario(Policies):
    """Check that a scenario can be hosted, and that the learned drivers were trained on it.

    Example:  merge-sumo scenario check us23
    """

    scenario: AnyScenario
    """The scenario, its name, or its TOML file."""


@dataclass(frozen=True)
class Train:
    """Train the learned drivers, level by level, and measure their regret in SUMO.

    The regret is the loss of a driver against its best response, as a share of the gain of the best
    response over level-0 behaviour. An interrupted training continues.

    Example:  merge-sumo train --out my-policies --seed 1
    """

    only: Iterable[str] | None = None
    """Network to train: pov1, vut1, pov2 or vut2; all by default."""
    _: KW_ONLY
    seed: int = 0
    """Seed of random numbers: same seed, same weights on one machine."""
    scenario: AnyScenario | None = None
    """Scenario, or a TOML file of one; us23 by default."""
    out: AnyPath | None = None
    """Folder to write; by default the shipped policies, for us23 only."""
    a_min: float | None = None
    """Hardest braking of the POVs in m/s2, below 0, such as -2; by default that of the scenario."""
    check: bool = False
    """Train nothing: measure the regret of the networks in the folder."""
    cases: int = 300
    """Random cases of a check."""
    progress: bool | None = None
    """Show progress; by default in a notebook and on a terminal."""


# Research


@dataclass(frozen=True)
class GroundTruth(EngineChoice, Execution, Test):
    """Find the ground truth of a VUT at each level, by uniform cases on all cores.

    It is kept in a cache (MERGE_SUMO_CACHE, or the user's cache folder) under a hash of all inputs,
    and used again while all files that the VUT has loaded are the same. The output says how many
    cases SUMO has run where the kinematic engine ran the others. The truth of an object of a Python
    process is not kept: its name does not tell it from another object.

    Example:  merge-sumo truth --vut design2 --level 1 --cases 10000
    """

    vut: AnyVut
    """Vehicle under test: a spec as after --vut, a class, a function, or an object."""
    level: AnyLevels = "all"
    """POV levels: 0, 1, 2, own, several with commas, or all."""
    _: KW_ONLY
    cases: int | None = None
    """Uniform cases of a level; by default 10000, at level 2 20000."""
    seed: int = 0
    """Seed of random numbers: same seed, same cases."""


@dataclass(frozen=True)
class Benchmark(Execution, Test):
    """Compare samplers with each other and with the ground truth, over several seeds.

    With all levels, each run shares its cases out over them, and coverage is summed over them.
    The truth of the paper's size misses places that searches find, so coverage is also shown as a
    share of a limit: the coverage of all that truth and searches found together, or that of
    1,000,000 uniform cases, if `truth --cases 1000000` has run, whichever is more.

    Example:  merge-sumo benchmark --vut design1 --level 0 --samplers uniform,gpr --seeds 3
    """

    vut: AnyVut
    """Vehicle under test: a spec as after --vut, a class, a function, or an object."""
    level: AnyLevels = "all"
    """POV levels: 0, 1, 2, own, several with commas, or all."""
    _: KW_ONLY
    samplers: Names | None = None
    """Names of samplers, separated by commas; all by default."""
    seeds: int = 10
    """Runs of each sampler."""
    cases: int = 400
    """Cases of each run."""
    batch: int | None = None
    """Cases per batch; by default what coverage wants, and 20 for the others."""
    truth_cases: int | None = None
    """Cases of the truth; by default 10000, at level 2 20000."""
    figure: AnyPath | None = None
    """New file for FMC against cases: .png or .svg."""


@dataclass(frozen=True, kw_only=True)
class Reproduce(Execution, Policies):
    """Reproduce the paper: Table II and every figure of its results, with the paper's numbers.

    Writes table2.md, table2.json, the figures as PNG, and index.html that shows it all.

    Example:  merge-sumo reproduce --seeds 10 --out reproduction
    """

    seeds: int | None = None
    """Runs of each sampler; by default 10, with --quick 2."""
    out: AnyPath | None = None
    """New folder to write; runs/reproduce-DATE by default."""
    quick: bool = False
    """Few and short runs and a small truth: a first look."""


def values_of(config: object, kind: type[Any]) -> dict[str, Any]:
    """Return the values in a config of the fields of one of its base classes, by name.

    Args:
        config: the config.
        kind: the base class whose fields are returned.
    """
    return {one.name: getattr(config, one.name) for one in fields(kind)}


def non_defaults(config: object, kind: type[Any]) -> dict[str, Any]:
    """Return the fields of a base class whose values are not the defaults, by name.

    A default that the user wrote counts as not given.

    Args:
        config: the config.
        kind: the base class whose fields are returned.
    """
    found = values_of(config, kind)
    for field in fields(kind):
        if found[field.name] == field.default:
            del found[field.name]
    return found
