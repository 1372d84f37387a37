"""Which verdicts of a campaign hang by a thread: its cases run again, each time a little otherwise.

Every rung of the ladder (`RUNGS`) is a change of the plan or of the cases: one thing that the
simulation leaves out or simplifies. The recorded cases run again with each. A failure is robust
where it fails on every rung; a verdict flips where a case that failed passes, or the other way
round, or has no verdict any more.

stress.json             in the folder of a campaign: by rung, the cases whose verdicts flip

The file of a folder which somebody sent is data as everything in it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from msgspec import Meta

from merge_sumo.analysis.result import Result
from merge_sumo.campaigns.run import failures
from merge_sumo.engine.evaluate import Episodes, evaluate, workers_or_here
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.errors import UserError
from merge_sumo.studies.comparison import cut
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.system.folders import replace_own
from merge_sumo.system.printable import counted
from merge_sumo.system.records import Record, read_record, to_json
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import Case
from merge_sumo.values.scenario import COORDINATES, DT_S, Scenario
from merge_sumo.values.score import CaseVerdict, Outcome

STRESS: Final = "stress.json"
LISTED: Final = 10
"""Failures that are not robust that a sentence names."""
Index = Annotated[int, Meta(ge=0)]
"""The index of a case in its campaign."""


class Flips(Record, frozen=True):
    """The cases whose verdicts flip in one run of all cases.

    Attributes:
        passes: indices of failures that pass.
        fails: indices of passes that fail.
        without_verdict: indices of cases that end without a verdict.
    """

    passes: tuple[Index, ...] = ()
    fails: tuple[Index, ...] = ()
    without_verdict: tuple[Index, ...] = ()


class Rung(Record, frozen=True):
    """What became of the cases on one rung.

    Attributes:
        name: short name, as "lag-0.2".
        about: what is changed, in a phrase.
        source: where its number is from; empty for none.
        runs: the verdicts that flip, by run: several where the change is drawn at random.
        skipped: why it was not run, in a clause; empty where it was.
    """

    name: str
    about: str
    source: str = ""
    runs: tuple[Flips, ...] = ()
    skipped: str = ""

    @property
    def counts(self) -> tuple[int, int, int]:
        """Failures that pass, passes that fail, and cases without a verdict, over all runs."""
        return (
            sum(len(run.passes) for run in self.runs),
            sum(len(run.fails) for run in self.runs),
            sum(len(run.without_verdict) for run in self.runs),
        )

    @property
    def flips(self) -> int:
        """Verdicts that flip, over all runs."""
        return sum(self.counts)

    def passes_in(self, index: int) -> int:
        """Return in how many runs a failure does not fail."""
        return sum(index in (*run.passes, *run.without_verdict) for run in self.runs)


class Stress(Result, Record, frozen=True):
    """What a stress test of a campaign found.

    Attributes:
        cases: recorded cases with a verdict: those that ran again.
        failures: indices of those that had failed, the worst first.
        rungs: what became of them on each rung.
        vut: name of the VUT.
    """

    computed = ("robust", "fragile")

    cases: int
    failures: tuple[Index, ...]
    rungs: tuple[Rung, ...]
    vut: str

    @property
    def runs(self) -> int:
        """Number of times that every case ran."""
        return sum(len(rung.runs) for rung in self.rungs)

    @property
    def robust(self) -> tuple[int, ...]:
        """Indices of the failures that fail in every run of every rung, the worst first."""
        return tuple(index for index in self.failures if not self.passes_in(index))

    @property
    def fragile(self) -> tuple[int, ...]:
        """Indices of the other failures, those first that fail in the fewest runs."""
        others = (index for index in self.failures if self.passes_in(index))
        return tuple(sorted(others, key=lambda index: -self.passes_in(index)))

    @property
    def sentence(self) -> str:
        """How many failures are robust, and which others hang by the thinnest threads."""
        if not self.failures:
            return "no case failed: which passes fail on a rung is in the table"
        fragile = self.fragile
        text = (
            f"robust, as they fail on every rung: {len(self.robust)} of "
            f"{counted(len(self.failures), 'failure')}"
        )
        if not fragile:
            return text
        shown = ", ".join(f"{i} ({self.passes_in(i)})" for i in fragile[:LISTED])
        return (
            f"{text}; others, with the number of runs in which they do not fail"
            f"{cut(len(fragile), LISTED)}: {shown}"
        )

    def passes_in(self, index: int) -> int:
        """Return in how many runs of all rungs a failure does not fail."""
        return sum(rung.passes_in(index) for rung in self.rungs)

    def share(self, rung: Rung) -> float | None:
        """Return the share of verdicts that flip on a rung; None where it was not run."""
        verdicts = self.cases * len(rung.runs)
        return rung.flips / verdicts if verdicts else None

    def lines(self) -> list[str]:
        """Return a table of the rungs, and which failures are robust."""
        lines = [
            f"{counted(self.cases, 'case')} of {self.vut}, {len(self.failures)} of them "
            f"failures, {self.runs} times each",
            "   flips  now pass  now fail  no verdict  what is changed",
        ]
        for rung in self.rungs:
            if rung.skipped:
                lines.append(f"{'not run':>40}  {rung.about}: {rung.skipped}")
                continue
            passes, fails, without = rung.counts
            numbers = f"{passes:10d}{fails:10d}{without:12d}"
            drawn = f", {len(rung.runs)} draws" if len(rung.runs) > 1 else ""
            lines.append(f"{self.share(rung) or 0.0:8.1%}{numbers}  {rung.about}{drawn}")
        return [*lines, self.sentence]


def stress_of(folder: Path) -> Stress | None:
    """Return what the folder of a campaign says of a stress test; None where it says nothing.

    Raises `UserError` for a file that is not as it was written.
    """
    return read_record(folder / STRESS, Stress)


# The ladder.


@dataclass(frozen=True, slots=True, kw_only=True)
class Change:
    """A rung before it runs.

    Attributes:
        name: as of `Rung`.
        about: as of `Rung`.
        source: as of `Rung`.
        plan: returns the plan of the rung by that of the campaign; raises `UserError` where it
            cannot be.
        case: returns a case of the rung by one of the campaign, and what draws at random; None for
            the same coordinates.
    """

    name: str
    about: str
    source: str = ""
    plan: Callable[[SimulationPlan], SimulationPlan] = lambda plan: plan
    case: Callable[[Case, np.random.Generator], Case] | None = None


PART_S: Final = 0.02
"""Step of the rung with a shorter step than that of eq. (4)."""
LAGS_S: Final = (0.2, 0.35, 0.5)
POWER_W_PER_KG: Final = 34.0
"""Power over mass: above this a car is of class 3, the highest. UN GTR No. 15, Annex 1."""
ERROR_X_M: Final = 0.5
ERROR_V_MPS: Final = 2.0 / 3.6
"""Accuracy of a radar for lane changes: 50 cm and 2 km/h. Autoliv NB24G1V2, user's manual, 3.1."""
CAR_LENGTH_M: Final = 5.0
DRAWS: Final = 5
"""Times that all cases run where a change is drawn at random, with the seed of the case."""
ERRORS_BY_UNIT: Final = {"m": ERROR_X_M, "m/s": ERROR_V_MPS}
OF_VUT: Final = {"v_vut0_mps", *COORDINATES}
"""Coordinates that are no state of another car."""


def _with_actuator(plan: SimulationPlan, **values: float) -> SimulationPlan:
    act = plan.scenario.act
    for name in values:
        if getattr(act, name) not in (0.0, None):
            raise UserError(f"the scenario has {name} of its own")
    return _in_scenario(plan, replace(plan.scenario, act=replace(act, **values)))


def _with_long_pov(plan: SimulationPlan) -> SimulationPlan:
    length_m = plan.scenario.pov_length_m + CAR_LENGTH_M
    return _in_scenario(plan, replace(plan.scenario, pov_length_m=length_m))


def _in_scenario(plan: SimulationPlan, scenario: Scenario) -> SimulationPlan:
    plan.criterion.check(scenario)
    return replace(plan, scenario=scenario)


def _start_off(case: Case, rng: np.random.Generator) -> Case:
    """Return a case whose POV starts a little elsewhere, at another speed; within the pool."""
    values: dict[str, Any] = {}
    for dimension in case.scenario.dimensions(case.level):
        name = dimension.field
        most = ERRORS_BY_UNIT.get(case.scenario.notation[name].unit, 0.0)
        if not most or name in OF_VUT:
            continue
        value = getattr(case, name) + rng.uniform(-most, most)
        values[name] = min(max(value, dimension.low), dimension.high)
    return replace(case, **values)


NOTHING: Final = Change(name="nothing", about="nothing is changed")
RUNGS: Final = (
    NOTHING,
    Change(
        name="step",
        about=f"a step of {PART_S:g} s, with a command held for {DT_S:g} s",
        plan=lambda plan: replace(plan, substeps=round(DT_S / PART_S)),
    ),
    *(
        Change(
            name=f"lag-{lag_s:g}",
            about=f"the acceleration of the VUT lags by {lag_s:g} s",
            source="chosen; lags of cruise control: Xiao, Darbha and Gao (2008)",
            plan=partial(_with_actuator, lag_s=lag_s),
        )
        for lag_s in LAGS_S
    ),
    Change(
        name="power",
        about=f"the VUT has {POWER_W_PER_KG:g} W/kg: it accelerates by P / (m v) at most",
        source="UN GTR No. 15, Annex 1: lower limit of class 3",
        plan=partial(_with_actuator, power_w_per_kg=POWER_W_PER_KG),
    ),
    Change(
        name="start",
        about=f"the POV starts within {ERROR_X_M:g} m and {ERROR_V_MPS:.2f} m/s of where it did",
        source="accuracy of a radar, Autoliv NB24G1V2, user's manual, 3.1",
        case=_start_off,
    ),
    Change(
        name="long-pov",
        about=f"cars of the mainline are {CAR_LENGTH_M:g} m longer, to the rear",
        plan=_with_long_pov,
    ),
)
"""The ladder; the first rung shows whether cases repeat at all."""


def stress(study: RunStudy) -> Stress:
    """Run the cases of a campaign on every rung, and write what becomes of them into its folder.

    Raises `UserError` for a campaign without a verdict, or with a net or policies of another day.
    """
    study.check_same_system()
    run = study.run
    tested = [outcome for outcome in run.cases if outcome.is_tested]
    if not tested:
        raise UserError(f"{run.folder} has no case with a verdict: nothing can be stressed")
    with workers_or_here(study.workers) as opened:
        plan = study.plan.for_cases(len(tested))
        rungs = tuple(_rung(study, plan, tested, change, opened) for change in RUNGS)
    failing = tuple(outcome.index for outcome in failures(tested))
    found = Stress(len(tested), failing, rungs, run.vut)
    replace_own(run.folder / STRESS, to_json(found, indent=1))
    return found


def runs_of(change: Change) -> int:
    """Return how many times all cases run for a change."""
    return 1 if change.case is None else DRAWS


def _rung(
    study: RunStudy,
    plan: SimulationPlan,
    tested: Sequence[Outcome],
    change: Change,
    workers: Workers,
) -> Rung:
    """Run all cases with a change; one that cannot be is skipped with its reason."""
    runs = runs_of(change)
    flips: list[Flips] = []
    try:
        changed = change.plan(plan)
        for draw in range(runs):
            cases = [_case(o.case, change, draw, changed.scenario) for o in tested]
            found: dict[int, CaseVerdict] = {}
            for place, verdict in evaluate(changed, cases, workers, keep=Episodes.verdicts):
                found[place] = verdict
                study.on_cases(1)
            flips.append(flips_of(tested, found))
    except UserError as error:
        if change is NOTHING:
            raise
        study.on_cases((runs - len(flips)) * len(tested))
        return Rung(change.name, change.about, change.source, (), str(error))
    return Rung(change.name, change.about, change.source, tuple(flips))


def _case(case: Case, change: Change, draw: int, scenario: Scenario) -> Case:
    if scenario is not case.scenario:
        case = replace(case, scenario=scenario)
    if change.case is None:
        return case
    return change.case(case, np.random.default_rng([draw, case.seed]))


def flips_of(tested: Sequence[Outcome], found: Mapping[int, CaseVerdict]) -> Flips:
    """Return which verdicts flip, by those of a run at the places of the recorded outcomes."""
    passes: list[int] = []
    fails: list[int] = []
    without: list[int] = []
    for place, outcome in enumerate(tested):
        verdict = found[place]
        if not verdict.is_tested:
            without.append(outcome.index)
        elif verdict.failed != outcome.failed:
            (passes if outcome.failed else fails).append(outcome.index)
    return Flips(tuple(passes), tuple(fails), tuple(without))
