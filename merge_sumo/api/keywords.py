"""The keywords that the verbs share, and the settings of a campaign that they make."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, TypedDict

from merge_sumo.campaigns.scheduler import OnCase
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.engine.evaluate import evaluation_workers
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.engine.povs import parse_levels, policies_folder
from merge_sumo.errors import UserError
from merge_sumo.reports.progress import Counter
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.system.workers import HERE_S, AnyWorkers, Workers
from merge_sumo.values.imperfection import Actuation, Sensing
from merge_sumo.values.scenario import US23, Scenario
from merge_sumo.vuts.in_memory import AnyVut, drivers_of


class Hosting(TypedDict, total=False):
    """How the drivers run: keywords that a recorded campaign may have otherwise.

    Attributes:
        policies: folder of learned drivers instead of the shipped ones.
        pov: a POV of your own, at level "own": anything that `vut` takes, but not "traci".
        deadline_s: time in s that a VUT may take for a step before the case is a VUT_ERROR.
        vut_memory_gib: memory in GiB that the process of a VUT of your own may take.
    """

    policies: Path | str | None
    pov: AnyVut | None
    deadline_s: float
    vut_memory_gib: float


class Setup(Hosting, total=False):
    """How a case is run and judged: the keywords of `Hosting`, and these; none is required.

    Attributes:
        scenario: a `Scenario`, its name, or its TOML file; "us23" by default.
        follow_up_s: time in s for which both drive on after the merge; the scenario's by default.
        sense: how the VUT senses other cars: a `Sensing`, or a text as after `--sense`; by default
            as the scenario says.
        act: how it obeys its controller: an `Actuation`, or a text as after `--act`.
        fail_when: what counts as a failure: the name of a criterion, or a condition over the
            measures; by default the criterion of the scenario, "paper" in merges.
        require: what must hold over time instead, in signal temporal logic.
    """

    scenario: Scenario | Path | str
    follow_up_s: float | None
    sense: Sensing | str | None
    act: Actuation | str | None
    fail_when: str | None
    require: str | None


class CaseKeywords(Setup, total=False):
    """Keywords of `run`: those of `Setup`, and the coordinates of the case.

    Attributes:
        x_pov0_m: initial position of the POV's front bumper, relative to M, in m.
        v_pov0_mps: initial speed of the POV.
        svo_rad: social value orientation of the POV, at level 2.
        v_vut0_mps: initial speed of the VUT; the scenario's by default.
        headway_ahead_s: headway to the car ahead, in traffic.
        headway_behind_s: headway of the car behind, in traffic.
    """

    x_pov0_m: float
    v_pov0_mps: float
    svo_rad: float
    v_vut0_mps: float
    headway_ahead_s: float
    headway_behind_s: float


class Settings(Setup, total=False):
    """Settings of a campaign: the keywords of `Setup`, and which cases are chosen.

    Attributes:
        level: POV level 0, 1 or 2, "own" for a `pov`, or "all", which is the default.
        sampler: name of the sampler that chooses the cases.
        cases: number of cases; 800 by default.
        batch: cases per batch; by default as many as the sampler wants.
        in_flight: most cases that run or wait while the sampler is asked, instead of batches.
        seed: same seed, same outcomes.
        stop_when_converged: stop when the last 100 cases added less than 1 % to the coverage.
        repeat: how often each case runs, once by default, with another draw of what is random;
            "auto" repeats cases where chance decides. Runs count as cases.
        tolerated: share of its runs in which a case may fail, 0 by default: it fails where more do.
        against: an earlier version of the VUT, anything that `vut` takes but "traci": the sampler
            looks for cases that the VUT alone fails.
    """

    level: int | str
    sampler: str
    cases: int
    batch: int | None
    in_flight: int | None
    seed: int
    stop_when_converged: bool
    repeat: int | Literal["auto"]
    tolerated: float
    against: AnyVut | None


class Running(TypedDict, total=False):
    """Where the cases of a verb run; the outcomes are the same everywhere.

    Attributes:
        workers: processes that run cases, 1 by default, or the address of a Dask scheduler whose
            workers run them, "tcp://HOST:PORT". None is one a core, where a campaign, a rerun or
            fresh cases begin in this process and go on in those once cases have taken some seconds.
        progress: show progress; by default in a notebook and on a terminal.
    """

    workers: AnyWorkers
    progress: bool | None


class StudyKeywords(Setup, Running, total=False):
    """Keywords of a study: those of `Setup`, how a case is run and judged, and of `Running`."""


class RerunKeywords(Hosting, Running, total=False):
    """Keywords of what runs cases of a recorded campaign: of `Hosting` and `Running`, and these.

    Attributes:
        vut: vehicle under test, as of `campaign`; by default the one of the run, if it is of this
            package or of SUMO. One that is code is given again: a run folder names no code to run.
    """

    vut: AnyVut | None


class CampaignKeywords(Settings, Running, total=False):
    """Keywords of a campaign: those of `Settings` and `Running`, and who is told of it.

    Attributes:
        on_case: called with the outcome of every case as it ends.
        check: called after every batch; may raise to stop there.
        gates: "failures", "errors", "timeouts", "fmc>X", or "regressions" with `against`: what
            `passed` of the result depends on.
        junit: new file to write for CI: JUnit XML.
    """

    on_case: OnCase | None
    check: Callable[[], None] | None
    gates: Iterable[str]
    junit: Path | str | None


@dataclass(frozen=True, slots=True)
class Runner:
    """Where cases run, and who is told: nothing here decides an outcome.

    The fields are those of `Running` and the last four of `CampaignKeywords`.
    """

    workers: AnyWorkers = 1
    progress: bool | None = None
    on_case: OnCase | None = None
    check: Callable[[], None] | None = None
    gates: Iterable[str] = ()
    junit: Path | str | None = None

    def checks(self) -> None:
        """Call `check`, where there is one."""
        if self.check is not None:
            self.check()

    def open(self, plan: SimulationPlan, *, at_once: bool = False) -> Workers:
        """Return the workers that run the cases of a plan, to be used in `with`.

        Where nobody says how many, processes are started `at_once`, or as soon as they pay.
        """
        here_s = HERE_S if self.workers is None and not at_once else None
        return evaluation_workers(plan.workers(self.workers), here_s)

    def counter(self, title: str, total: int, unit: str = "cases") -> Counter:
        """Return a bar that counts things called `unit`, to be used in `with`."""
        return Counter(title, total, unit, shown=self.progress)


def runner_of(given: Mapping[str, Any]) -> tuple[Runner, dict[str, Any]]:
    """Return what keywords say of where cases run, and the other keywords."""
    names = Runner.__dataclass_fields__.keys()
    others = {name: value for name, value in given.items() if name not in names}
    return Runner(**{name: given[name] for name in names & given.keys()}), others


def check_keywords(function: str, given: Mapping[str, Any], known: Any) -> None:
    """Raise `TypeError`, as Python does, for a keyword that a function does not have."""
    names = known.__optional_keys__
    unknown = sorted(given.keys() - names)
    if unknown:
        from difflib import get_close_matches

        close = get_close_matches(unknown[0], names, n=1)
        hint = f": did you mean {close[0]!r}?" if close else ""
        raise TypeError(f"{function}() got an unexpected keyword argument {unknown[0]!r}{hint}")


OF_SCENARIO: Final = {"follow_up_s": "--follow-up", "sense": "--sense", "act": "--act"}
"""Keywords that change the scenario, and their options."""


def scenario_of(scenario: Scenario | Path | str, **changes: Any) -> Scenario:
    """Return the scenario that a person names, with changes that a person states.

    These are `follow_up_s`, `sense` and `act`, as of `Setup`; None changes nothing.
    """
    named = scenario if isinstance(scenario, Scenario) else named_scenario(str(scenario))
    values = {name: value for name, value in changes.items() if value is not None}
    for name, kind in (("sense", Sensing), ("act", Actuation)):
        if isinstance(text := values.get(name), str):
            values[name] = kind.parsed(text, f"--{name}")
    return replace(named, **values) if values else named


def recordable(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return keywords as the fields of `CampaignSettings`, without `level`.

    Drivers are specs by now. Raises `UserError` for what is of a scenario that is not named.
    """
    fields = {n: value for n, value in given.items() if n not in ("level", *OF_SCENARIO)}
    changes = {name: given.get(name) for name in OF_SCENARIO}
    if "scenario" in fields:
        fields["scenario"] = scenario_of(fields["scenario"], **changes)
    else:
        for name, option in OF_SCENARIO.items():
            if changes[name] is not None:
                raise UserError(f"{option} is of the scenario: name that, too, with --scenario")
    if fields.get("fail_when", "") is None:
        del fields["fail_when"]
    if fields.get("policies") is not None:
        fields["policies"] = str(fields["policies"])
    return fields


def with_criterion(fields: Mapping[str, Any]) -> dict[str, Any]:
    """Return the fields of `CampaignSettings` with a criterion, by default the scenario's."""
    if fields.get("require") is not None:
        return dict(fields)
    return {"fail_when": fields["scenario"].criterion, **fields}


def settings_for(vut: AnyVut, given: Mapping[str, Any]) -> tuple[CampaignSettings, Runner]:
    """Return the settings that keywords of `CampaignKeywords` make, and where their cases run."""
    runner, given = runner_of(given)
    spec, pov_spec, workers = drivers_of(vut, given.get("pov"), runner.workers, stacklevel=4)
    against, workers = _earlier_of(given, workers)
    drivers = {"pov": pov_spec, **against}
    fields = with_criterion(recordable({"scenario": US23, **given, **drivers}))
    scenario, level = fields["scenario"], str(given.get("level", "all"))
    policies = policies_folder(fields.get("policies"), scenario)
    levels = parse_levels(level, policies, scenario.levels, own=pov_spec is not None)
    settings = CampaignSettings(vut=spec, levels=levels, **fields)
    return settings, replace(runner, workers=workers)


def given_again(
    vut: AnyVut | None, given: Mapping[str, Any], recorded: Mapping[str, Any], stacklevel: int = 4
) -> tuple[dict[str, Any], Runner]:
    """Return the settings that are given for a recorded campaign, and where its cases run.

    `recorded` has VUT and POV for where they are not given; warnings are of the caller that many
    calls above.
    """
    runner, given = runner_of(given)
    named = {
        name: one for name, one in (("vut", vut), ("pov", given.get("pov"))) if one is not None
    }
    drivers = {"vut": "", "pov": None, **recorded, **named}
    spec, pov_spec, workers = drivers_of(
        drivers["vut"], drivers["pov"], runner.workers, stacklevel=stacklevel
    )
    specs = {"vut": spec, "pov": pov_spec}
    against, workers = _earlier_of(given, workers)
    fields = recordable({**given, **{n: specs[n] for n in named}, **against})
    return fields, replace(runner, workers=workers)


def _earlier_of(given: Mapping[str, Any], workers: AnyWorkers) -> tuple[dict[str, str], AnyWorkers]:
    """Return the spec of an earlier version that is given, by keyword, and how many workers."""
    if given.get("against") is None:
        return {}, workers
    spec, _, workers = drivers_of(given["against"], None, workers, stacklevel=5)
    return {"against": spec}, workers
