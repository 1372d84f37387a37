"""Settings of the functions: one dataclass each. Its fields are keywords in Python, and options.

The first paragraph of a field's docstring is what `--help` shows. Further paragraphs are in the
reference and in Python's help. Base classes have the fields that several functions share. `None`
means: as in the scenario, or for a recorded campaign: as recorded. An option has the name of its
field, unless `FLAGS` gives another.

A field of `ScenarioChanges` replaces the field of `Scenario` with the same name
(`from_config.scenario_from`). The fields of `Search`, `FailureRule` and `Limits` are fields of
`CampaignSettings`. `load_plan` passes the criterion to `SimulationPlan`, and the limits to the
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
"""Options that are not named like their field."""


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
    """Learned POV drivers: a folder, or the name 'human' or 'roundabout'.

    `merge-sumo train --out FOLDER` writes such a folder. By default it is the shipped library for
    the scenario, or else the one for us23.
    """


@dataclass(frozen=True, kw_only=True)
class Limits:
    """Limits of the user's controllers."""

    deadline_s: float | None = None
    """Seconds that the controller may take for one step. [default: 5]

    A case whose controller takes longer ends as VUT_ERROR.
    """
    vut_memory_gib: float | None = None
    """Memory limit of the process of your controller. [default: 4]"""


@dataclass(frozen=True, kw_only=True)
class Drivers(Limits, Policies):
    """Drivers and limits of controllers."""

    pov: AnyVut | None = None
    """Your own driver of the POV, for --level own.

    It can be of any kind that --vut takes, except traci.
    """


@dataclass(frozen=True, kw_only=True)
class FailureRule:
    """What counts as a failure."""

    fail_when: str | None = None
    """Failure criterion: paper, contact, unsafe (contact or hard braking), or a condition such as
    'ttc_s < 1.5'. [default: as in the scenario]

    - paper: the front bumpers are within 6 m of each other when the VUT reaches the merge point M
    - contact: the bodies of two vehicles overlap
    - unsafe: a contact, or the rear vehicle must brake harder than 3 m/s2 after the merge

    A condition may name every measure of outcomes.jsonl: 'ttc_s < 1.5 or end == "TIMEOUT"'. The
    default is paper where the road has a merge point, and unsafe where it has an acceleration lane.
    """
    require: str | None = None
    """Requirement in signal temporal logic, instead of --fail-when.

    A case fails if it violates the formula, such as 'always ((x_vut_m > -20) implies (bumper_gap_m
    > 2))'. Install the extra stl for it: `pip install 'merge-sumo[stl]'`.
    """


@dataclass(frozen=True, kw_only=True)
class ScenarioChanges:
    """Settings that replace those of the scenario."""

    follow_up_s: float | None = None
    """Seconds simulated after the merge. [default: 3; acceleration lane: 5]

    With 0 an episode ends at the merge. The default is 3, and 5 on an acceleration lane.
    """
    sense: AnySensing | None = None
    """Errors of the sensors of the VUT, such as delay_s=0.3,noise_x_m=1.

    - delay_s: age of the states that the VUT gets
    - noise_x_m, noise_v_mps: standard deviation of the errors of positions and speeds
    - dropout: share of the steps in which the VUT gets the last state of a car again
    - range_m: largest distance at which the VUT gets the state of a car
    - occluded_until_m: position of the VUT from which it gets the states of other cars

    A range, such as delay_s=0..0.5, becomes a coordinate of the cases: the sampler chooses a value
    for each case.
    """
    act: AnyActuation | None = None
    """Errors of the actuators of the VUT, such as lag_s=0.3,delay_s=0.1.

    - lag_s: time constant of a first-order lag of the acceleration
    - delay_s: time between a command and its effect
    - power_w_per_kg: power divided by mass, which limits the acceleration at high speed

    A range becomes a coordinate of the cases, as with --sense.
    """


@dataclass(frozen=True, kw_only=True)
class Test(Drivers, ScenarioChanges, FailureRule):
    """The scenario and the rules of a test."""

    scenario: AnyScenario | None = None
    """Name of a scenario, or your own TOML file. For all names, run: merge-sumo scenario list.
    [default: us23]

    `merge-sumo scenario new` writes such a file.
    """


@dataclass(frozen=True, kw_only=True)
class Search:
    """How a campaign chooses its cases."""

    sampler: str = "coverage"
    """Sampler, which chooses the cases: coverage, gpr, subset, annealing or uniform."""
    cases: int | None = None
    """Number of cases. [default: until the search converges, at most 800]"""
    batch: int | None = None
    """Cases per batch. [default: chosen by the sampler]"""
    in_flight: int | None = None
    """Instead of batches: keep this number of cases running all the time.

    This suits controllers that take seconds for a case: the sampler proposes more cases while
    others run. About three times the number of workers is a good value.
    """
    repeat: int = 1
    """Runs per case, for random controllers or sensors.

    The runs of a case differ by the seed that the controller gets, and by the noise and the
    dropouts of --sense. Without these, all runs are alike. Each run counts as one of the --cases.
    """
    tolerated: float = 0.0
    """A case fails if more than this share of its runs fail."""
    seed: int = 0
    """Random seed. The same seed gives the same outcomes."""
    stop_when_converged: bool = False
    """With --cases: stop earlier if the search has converged.

    It has converged when the last 100 cases have added less than 1 % to the coverage.
    """


@dataclass(frozen=True, kw_only=True)
class Execution:
    """How cases are run."""

    workers: int | str | None = 1
    """Number of worker processes, or auto, or tcp://HOST:PORT, the address of a Dask scheduler.
    [default: auto]

    With auto each core gets one process. A campaign of up to 1,000 cases with built-in drivers uses
    only one. The number does not change the outcomes. On the command line the default is auto, in
    Python it is 1.
    """
    progress: bool | None = None
    """Show progress, or hide it. [default: shown in terminals and notebooks]"""


@dataclass(frozen=True, kw_only=True)
class StudyOptions(Execution, Drivers):
    """Settings of a study that runs cases of a recorded campaign."""

    vut: AnyVut | None = None
    """The VUT, if it has changed or is your own code. [default: as in the campaign]

    A run folder does not name code to run. If the VUT of the campaign was a file, a module, a
    command or a model, name it again.
    """


@dataclass(frozen=True, kw_only=True)
class Junit:
    """A report for CI."""

    junit: AnyPath | None = None
    """New JUnit XML file (.xml) for CI."""


@dataclass(frozen=True, kw_only=True)
class Page(Junit):
    """Files that a comparison writes."""

    out: AnyPath | None = None
    """New page (.html) of the cases whose result changed: it shows their motion before and now."""


@dataclass(frozen=True, kw_only=True)
class Levels:
    """Levels of the POV."""

    level: AnyLevels = "all"
    """POV levels, separated by commas: 0, 1, 2, or own (your own driver, given with --pov).

    Level 0 ignores the VUT. Level 1 makes room, because it assumes that the VUT does not yield.
    Level 2 assumes that the VUT reacts.
    """


@dataclass(frozen=True, kw_only=True)
class EngineChoice:
    """The engine that moves the vehicles."""

    engine: str | None = None
    """Engine: sumo, or kinematic (faster). [default: kinematic, if possible]

    The engine kinematic solves the equations of motion without SUMO, and repeats at least one case
    in a hundred in SUMO. It needs a VUT and a POV of this package. The engine sumo runs all cases
    in SUMO.
    """


@dataclass(frozen=True, kw_only=True)
class Beginning:
    """The part of a case that is shown."""

    from_s: float | None = None
    """Show from this time on: -3 is 3 s before the contact or near miss.

    Without a contact, the near miss is the lowest time to collision or the merge. Without a merge
    it is the end of the case.
    """


# Search


@dataclass(frozen=True, kw_only=True)
class CampaignOptions(Execution, Junit, Test, Search, Levels):
    """Test a controller: run cases in SUMO, find failures, and write a report.

    The controller drives the vehicle under test (VUT). The primary other vehicle (POV) reacts to
    it. The results are in a new run folder. Ctrl-C ends the campaign after the running batch and
    prints how to continue. A second Ctrl-C stops at once.

    Exit code: 0 if the campaign ends, 1 if the VUT merges in none of the cases, 2 for wrong usage,
    130 or 143 if stopped. With --gate, the exit code is also 1 if the result that you name occurs.
    For example, '--gate failures' gives exit code 1 if a case fails.

    Example:  merge-sumo campaign --vut design1 --level 0 --cases 400 --seed 1

    Example:  merge-sumo campaign --vut "design2?x1_m=120" --against design2 --level 1 --cases 40
    """

    against: AnyVut | None = None
    """Earlier version of the VUT. Each case runs with both versions, and the sampler searches for
    cases that only the new version fails.

    It can be of any kind except traci and traci:PORT, clients that connect by themselves.
    """
    gates: Iterable[str] = ()
    """Exit 1 if this occurs: failures, errors, timeouts, regressions, fmc>X.

    The option may be given several times. "fmc>X" is met if the FMC at some level is above X. The
    gate regressions needs --against.
    """


@dataclass(frozen=True, kw_only=True)
class CampaignCalls(CampaignOptions):
    """Functions that a campaign calls."""

    on_case: Callable[[Outcome], None] | None = None
    """Function that is called with the outcome of each case when it ends."""
    check: Callable[[], None] | None = None
    """Function that is called after each batch. It may raise an exception to stop there."""


@dataclass(frozen=True)
class Campaign(CampaignCalls):
    """Test a VUT and return the campaign, whether or not cases fail."""

    vut: AnyVut
    """Vehicle under test: a spec as for --vut, a class, a function, or an object."""
    _: KW_ONLY
    out: AnyPath | None = None
    """New folder to write. [default: runs/VUT-DATE]"""


@dataclass(frozen=True)
class NoFailures(Campaign):
    """Test a VUT in a campaign, and raise `AssertionError` if a case fails or ends in an error.

    The message gives the counts, the worst case, the report, and the command that replays the case.
    A timeout is not a failure, unless `fail_when` makes it one. Returns the campaign.
    """

    _: KW_ONLY
    cases: int = 200
    """Number of cases. A fast controller takes seconds for 200."""


@dataclass(frozen=True)
class Resume(CampaignCalls):
    """Continue a campaign that was stopped, as `merge-sumo campaign --resume` does.

    The settings must be those of the campaign, except that `cases` may be larger. A VUT, a `pov` or
    an `against` that is code must be given again, because a run folder does not name code to run.
    Of an object only the name is compared.
    """

    run: AnyRun
    """Run folder of the campaign."""
    _: KW_ONLY
    vut: AnyVut | None = None
    """The VUT again, if it is your own code."""


@dataclass(frozen=True, kw_only=True)
class CaseOptions(Beginning, Test):
    """Run one case and print its result, its measures and its motion.

    Exit code: 0 if the case passes, 1 if it fails, ends in an error or times out, 2 for wrong
    usage.

    Example:  merge-sumo run --vut design2 --level 2 --x -298.6 --v 34.5 --psi 0.62
    """

    level: int | str | None = None
    """POV level: 0, 1, 2 or own. [default: 0]

    With --case the default is the level of the recorded case.
    """
    x_pov0_m: float | None = None
    """Start of the POV: position of its front bumper. The merge point is at 0."""
    v_pov0_mps: float | None = None
    """Start of the POV: its speed."""
    svo_rad: float | None = None
    """Social value orientation of the POV at level 2: 0 is egoistic, pi/2 altruistic."""
    headway_ahead_s: float | None = None
    """With traffic in the scenario: headway from the POV to the car ahead."""
    headway_behind_s: float | None = None
    """With traffic in the scenario: headway from the car behind to the POV."""
    debug: bool = False
    """Run the VUT in this process without a deadline, for breakpoints."""
    gui: bool = False
    """Open the replay in sumo-gui when the case has ended."""
    out: AnyPath | None = None
    """New folder for the case. Open it with `merge-sumo replay` or in sumo-gui."""
    recorded: tuple[AnyRun, int] | None = None
    """A recorded case: the folder of the campaign and the index of the case. Other options override
    its values."""


COORDINATE_OPTIONS = ("x_pov0_m", "v_pov0_mps", "svo_rad", "headway_ahead_s", "headway_behind_s")
"""Fields of `CaseOptions` that are coordinates of a case."""


@dataclass(frozen=True)
class RunCase(CaseOptions):
    """Run one case and return it."""

    vut: AnyVut | None = None
    """Vehicle under test. [default: that of the recorded case]"""
    case: Mapping[str, Any] | None = None
    """A row of `run.cases` or `run.failures`: its level and coordinates are the defaults."""
    _: KW_ONLY
    at: Mapping[str, float] | None = None
    """Values of the start by their names in outcomes.jsonl."""
    on_end: Callable[[Any], None] | None = None
    """Function that is called with the result when the case has ended, before a window closes."""


@dataclass(frozen=True)
class Probability(EngineChoice, StudyOptions):
    """Estimate the failure probability of a VUT, with a valid confidence interval.

    The cases of the campaign were chosen to fail, so their share of failures is not a probability.
    But they show which starts are likely to fail. merge-sumo divides all possible starts into those
    that are likely to fail and the rest, and draws new random cases from both parts. The interval
    is valid even if the campaign has missed failures.

    Example:  merge-sumo probability runs/design2

    Example:  merge-sumo probability runs/design2 --traffic exid-5 --out per-merge.json
    """

    run: AnyRun
    """Run folder of the campaign."""
    _: KW_ONLY
    cases: int | None = None
    """Number of new cases. [default: 100000; with --engine sumo: 4000]"""
    traffic: AnyPath | None = None
    """Also estimate how many merges fail in this traffic: exid-2, exid-3 or exid-5 (sites of the
    exiD data set), or your own TOML file.

    The file contains the density and the speeds of the traffic.
    """
    distribution: AnyPath | None = None
    """JSON file with the probability of each start. [default: uniform]"""
    confidence: float = 0.95
    """Probability that the interval contains the true value."""
    seed: int = 0
    """Random seed. The same seed gives the same cases."""
    out: AnyPath | None = None
    """New file (.json) to write. [default: RUN/probability.json]"""


# Look


@dataclass(frozen=True)
class Explain(StudyOptions):
    """Explain a failure: find the smallest change of one value that makes the case pass.

    merge-sumo changes one value at a time: a coordinate of the start, the level of the POV, or a
    parameter of the controller. It searches the nearest value with which the case passes, and
    confirms this value with a second run. For a built-in VUT, the campaign already contains such an
    explanation of the worst failure, but only with changes of the start and the level.

    Example:  merge-sumo explain runs/design1
    """

    run: AnyRun
    """Run folder of the campaign."""
    case: int | None = None
    """Index of the failure in outcomes.jsonl. [default: the worst failure]"""
    _: KW_ONLY
    params: Iterable[str] = ()
    """Parameter of the controller and the range that is searched. May be given several times."""


@dataclass(frozen=True)
class Export:
    """Write cases of a campaign as scenarios, as a table, or as a file for `rerun`.

    Example:  merge-sumo export runs/design2 17 42
    """

    run: AnyRun
    """Run folder of the campaign."""
    indices: Indices | None = None
    """Indices of the cases. [default for csv: all; for a cases file: at most 40]

    With --format sumo and openscenario, name at least one. Without indices, cases writes those that
    show changes of a VUT best.
    """
    _: KW_ONLY
    file_format: str = "sumo"
    """What to write: sumo, openscenario, csv or cases.

    - sumo: folders that sumo-gui replays
    - openscenario: folders with OpenSCENARIO and OpenDRIVE
    - csv: one table of the motion
    - cases: one small TOML file to commit, which `rerun` reads
    """
    out: AnyPath | None = None
    """New folder, or FILE.csv, or FILE.toml. [default: RUN/scenarios for sumo, else RUN/exports]"""


@dataclass(frozen=True)
class ReplayCase(Beginning):
    """Replay a recorded case in SUMO and compare each position and speed with the record.

    The command prints the timeline of the case, then "identical" or "diverged at t = ...". If
    FOLDER is the run folder of a campaign, the command first exports the case.

    Exit code: 0 if identical, 1 if diverged, 2 for wrong usage.

    Example:  merge-sumo replay scenarios/stalemate --gui --from -3
    """

    folder: AnyRun
    """Folder of an exported case, or run folder of a campaign."""
    index: int | None = None
    """Index of the case, if FOLDER is the run folder of a campaign."""


@dataclass(frozen=True)
class Report:
    """Write the report of a campaign again and print its path.

    With --json the command prints each value of the report, with the result file and the key where
    the value is recorded.

    Example:  merge-sumo report runs/design2
    """

    run: AnyRun
    """Run folder of the campaign."""


# Change


@dataclass(frozen=True)
class Rerun(Page, Levels, StudyOptions):
    """Run recorded cases again with a changed VUT, and list which broke and which are fixed.

    The cases are those that the campaign recorded. To search for cases that only the new version
    fails, use `campaign --against`.

    RUN can also be a cases file, written by `merge-sumo export --format cases`. Then --out writes
    a new cases file instead of an HTML page.

    If your own controller gives another result than the recorded one, merge-sumo runs the case a
    second time with the new controller. If its two runs differ from each other, the case is "not
    repeatable", and counts neither as broken nor as fixed.

    Exit code: 0 if no case broke, 1 if a case broke, 2 for wrong usage. A case broke if it passed
    before and does not pass now. With a cases file, the exit code is also 1 if a case has a new
    error or contact, or if its margin drops by more than the tolerance that the file sets.

    Example:  merge-sumo rerun runs/design2 3 7 --vut design2 --out changes.html

    Example:  merge-sumo rerun cases.toml --vut design2 --junit changes.xml

    Example:  merge-sumo rerun runs/design2 --stress
    """

    run: AnyRun
    """Run folder of the campaign, or a cases file."""
    indices: Indices = ()
    """Indices of the cases. [default: all cases]"""


@dataclass(frozen=True)
class Stress(StudyOptions):
    """Measure how results change with the simulation, as `merge-sumo rerun --stress` does.

    `robust` of the result lists the failures that fail every time, the worst first.
    """

    run: AnyRun
    """Run folder of the campaign."""


@dataclass(frozen=True)
class Compare(Page):
    """Compare recorded versions of a VUT: broken and fixed cases.

    The command runs no cases. It pairs the cases that occur in two campaigns. If campaigns have no
    case in common, it compares which percentage of their cases passes.

    Exit code: 0 if nothing got worse, 2 for wrong usage, 1 if one of these is true:

    - a case broke
    - a version passes a significantly smaller share of its cases than the version before it
      (Fisher's exact test)
    - no case was judged with the last version

    Example:  merge-sumo compare runs/design1 runs/design2 --out changes.html
    """

    runs: Iterable[AnyRun]
    """Run folders of the campaigns, the oldest first."""


# Bring your own


@dataclass(frozen=True, kw_only=True)
class Vuts(Policies):
    """List the built-in vehicles under test, and the kinds of controllers that --vut accepts.

    Example:  merge-sumo vuts
    """


@dataclass(frozen=True)
class CheckVut(Limits, Policies):
    """Check a VUT in a few cases: list its errors and the time of a step.

    Exit code: 0 for "nothing wrong", 1 if the command lists errors, 2 for wrong usage.

    Example:  merge-sumo check-vut design1
    """

    vut: AnyVut
    """Vehicle under test, as in `campaign`."""
    _: KW_ONLY
    scenario: AnyScenario | None = None
    """Scenario of the check: a name, or your own TOML file. [default: us23]"""


@dataclass(frozen=True)
class Scenarios:
    """List the shipped scenarios.

    Example:  merge-sumo scenario list
    """


@dataclass(frozen=True)
class NewScenario:
    """Write a scenario for a merge in your own net, with a suggested pool of starts.

    If the ramp has an acceleration lane, the VUT chooses where on the lane it merges. The command
    also writes a picture of the road (.svg).

    Example:  merge-sumo scenario new my-ramp.toml --net my.net.xml --mainline "a b" --ramp "r b"
    """

    file: AnyPath
    """New TOML file to write."""
    _: KW_ONLY
    net: AnyPath
    """SUMO net: NAME.net.xml or NAME.net.xml.gz."""
    mainline: str
    """Edges of the mainline, up to and past the merge point: "e1 e2"."""
    ramp: str
    """Edges of the ramp, up to and past the merge point: "r1 e2"."""
    point: bool = False
    """Merge at a point, even if the ramp has an acceleration lane."""


@dataclass(frozen=True)
class CheckScenario(Policies):
    """Check that a scenario can run, and whether the learned drivers were trained on it.

    Example:  merge-sumo scenario check us23
    """

    scenario: AnyScenario
    """The scenario, its name, or its TOML file."""


@dataclass(frozen=True)
class Train:
    """Train the learned drivers, level by level, and measure their regret in SUMO.

    The regret of a driver is its loss compared with its best response. It is a share of the gain of
    the best response over level-0 behaviour. The command continues a training that was stopped.

    Example:  merge-sumo train --out my-policies --seed 1
    """

    only: Iterable[str] | None = None
    """Networks to train: pov1, vut1, pov2 or vut2. [default: all]"""
    _: KW_ONLY
    seed: int = 0
    """Random seed. The same seed gives the same weights on one machine."""
    scenario: AnyScenario | None = None
    """Scenario to train on: a name, or your own TOML file. [default: us23]"""
    out: AnyPath | None = None
    """Folder to write. [default: the shipped policies, for us23 only]"""
    a_min: float | None = None
    """Hardest braking of the POVs, such as -2. [default: as in the scenario]"""
    check: bool = False
    """Measure the regret of the networks in the folder, without training."""
    cases: int = 300
    """Number of random cases of a check."""
    progress: bool | None = None
    """Show progress, or hide it. [default: shown in terminals and notebooks]"""


# Research


@dataclass(frozen=True)
class GroundTruth(EngineChoice, Execution, Test):
    """Find the ground truth of a VUT: run random cases at each level, without a search.

    merge-sumo keeps the result in a cache (MERGE_SUMO_CACHE, or the cache folder of the user) and
    reads it again if no input has changed. The inputs include all files that the VUT has loaded.
    The result for a VUT that is a Python object is not kept. If the kinematic engine ran the cases
    (--engine), merge-sumo runs some of them in SUMO as a check, and the output shows how many.

    Example:  merge-sumo truth --vut design2 --level 1 --cases 10000
    """

    vut: AnyVut
    """Vehicle under test, as in `campaign`.

    In Python also a class, a function or an object.
    """
    level: AnyLevels = "all"
    """POV levels, separated by commas: 0, 1, 2, or own (your own driver, given with --pov)."""
    _: KW_ONLY
    cases: int | None = None
    """Random cases per level. [default: 10000, or 20000 at level 2]"""
    seed: int = 0
    """Random seed. The same seed gives the same cases."""


@dataclass(frozen=True)
class Benchmark(Execution, Test):
    """Compare samplers with each other and with the ground truth, over several seeds.

    With all levels, each run divides its cases among the levels, and the coverage is their sum. The
    ground truth misses places that searches find. The command therefore also prints the coverage as
    a share of a limit. The limit is the coverage of all cases together, or the coverage of
    1,000,000 uniform cases if it is larger and `truth --cases 1000000` has run.

    Example:  merge-sumo benchmark --vut design1 --level 0 --samplers uniform,gpr --seeds 3
    """

    vut: AnyVut
    """Vehicle under test, as in `campaign`.

    In Python also a class, a function or an object.
    """
    level: AnyLevels = "all"
    """POV levels, separated by commas: 0, 1, 2, or own (your own driver, given with --pov)."""
    _: KW_ONLY
    samplers: Names | None = None
    """Names of samplers, separated by commas. [default: all]"""
    seeds: int = 10
    """Number of runs of each sampler."""
    cases: int = 400
    """Number of cases of each run."""
    batch: int | None = None
    """Cases per batch. [default: 20, or chosen by coverage]"""
    truth_cases: int | None = None
    """Cases of the ground truth. [default: 10000, or 20000 at level 2]"""
    figure: AnyPath | None = None
    """New figure of the FMC over the cases (.png or .svg)."""


@dataclass(frozen=True, kw_only=True)
class Reproduce(Execution, Policies):
    """Reproduce Table II and all figures of the results of the paper, next to its numbers.

    The command writes table2.md, table2.json, the figures (.png), and index.html with all of them.

    Example:  merge-sumo reproduce --seeds 10 --out reproduction
    """

    seeds: int | None = None
    """Number of runs of each sampler. [default: 10, or 2 with --quick]"""
    out: AnyPath | None = None
    """New folder to write. [default: runs/reproduce-DATE]"""
    quick: bool = False
    """Run a small version: few and short runs, and a small ground truth."""


def values_of(config: object, kind: type[Any]) -> dict[str, Any]:
    """Return the values in a config of the fields of one of its base classes, by name.

    Args:
        config: the config.
        kind: the base class whose fields are returned.
    """
    return {one.name: getattr(config, one.name) for one in fields(kind)}


def non_defaults(config: object, kind: type[Any]) -> dict[str, Any]:
    """Return the fields of a base class whose values are not the defaults, by name.

    A default value that the user sets explicitly is not returned.

    Args:
        config: the config.
        kind: the base class whose fields are returned.
    """
    found = values_of(config, kind)
    for field in fields(kind):
        if found[field.name] == field.default:
            del found[field.name]
    return found
