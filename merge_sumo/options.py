"""Options of verbs, each once: keyword in Python, option on the command line, help, default.

A verb has a record (`verbs.py`). Its fields are the keywords of the function in `api/` and, where a
field is an `option`, the options of the command. `Test` says what decides the outcome of a case,
`Search` which cases run, and `Execution` where they run, which decides nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, Protocol

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
PROGRESS: Final = "Show progress; by default in a notebook and on a terminal."


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
    return field(default=default, metadata=required_option(kind, help, group, *flags, **more))


def keyword(default: Any, help: str) -> Any:
    """Return a field that is a keyword in Python alone."""
    return field(default=default, metadata={"help": help})


def required_option(kind: Any, help: str, group: str, *flags: str, **more: Any) -> dict[str, Any]:
    """Return the metadata of a field without a default that is an option."""
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


def _unless(quiet: bool) -> bool:
    return not quiet


def seed_option(help: str) -> Any:
    """Return the field of a seed."""
    return option(0, int, help, CASES)


def vut_again(help: str = "", shown: str = "the campaign's") -> Any:
    """Return the field of the VUT of a recorded campaign."""
    about = (
        "Vehicle under test, perhaps a changed one. A file, module, command or model is always "
        "named here: a run folder names no code to run."
    )
    return option(None, str, help or about, TESTED, metavar="SPEC", shown=shown)


def progress_option() -> Any:
    """Return the field that shows progress."""
    quiet = required_option(
        bool, "Show no progress.", WHERE, "--quiet", "-q", parse=_unless, written=False
    )
    return field(default=None, metadata={**quiet, "help": PROGRESS})


class Asked:
    """What a verb is asked; `given` has the names of the keywords that a person gave."""

    given: ClassVar[frozenset[str]] = frozenset()

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
        "Time for which all drive on after the merge; 0 ends an episode there.",
        TESTED,
        "--follow-up",
        metavar="SECONDS",
        shown="the scenario's, 3",
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
class Beginning(Asked):
    """From when on a case is shown."""

    from_s: float | None = option(
        None,
        float,
        "Begin so long before the first conflict, as in -3: contact, else lowest TTC, merge, end.",
        WHERE,
        "--from",
        metavar="SECONDS",
    )


@dataclass(frozen=True, kw_only=True)
class Search(Asked):
    """Which cases run."""

    sampler: str = option(DEFAULT_SAMPLER, str, "What chooses the cases: {samplers}.", EXPERTS)
    cases: int | None = option(
        None,
        int,
        "Number of test cases.",
        CASES,
        shown=f"until the search has converged, at most {DEFAULT_CASES}",
    )
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
    tolerated: float = option(
        0.0,
        float,
        "A case fails where more than this share of its runs do.",
        VERDICT,
        "--tolerate",
        metavar="SHARE",
    )
    seed: int = seed_option("Same seed, same outcomes.")
    stop_when_converged: bool = option(
        False,
        bool,
        "Stop before --cases when the last 100 cases have added less than 1 % to the coverage.",
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
    progress: bool | None = progress_option()


@dataclass(frozen=True, kw_only=True)
class Recorded(Execution, Hosting):
    """How cases of a recorded campaign run today."""

    vut: AnyVut | None = vut_again()
