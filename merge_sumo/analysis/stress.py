"""Stress tests: the sensitivity of verdicts to small changes of the simulation.

The cases of a campaign run again on each rung of a ladder: with one change of the plan or of the
cases. A failure is robust where it fails on every rung.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from merge_sumo.analysis.run_study import RunStudy, StudyFile, end_of
from merge_sumo.campaigns.recorded import failures
from merge_sumo.errors import UserError
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.records import Record
from merge_sumo.result import Result
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S
from merge_sumo.simulation.plan import SimulationPlan

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
    """The results of the cases on one rung of the ladder.

    Attributes:
        name: short name, as "lag-0.2".
        about: the change, in a phrase.
        runs: the verdicts that flip, run by run: several where the change is drawn at random.
        skipped: reason why it was not run, in a clause; empty where it was.
    """

    name: str
    about: str
    runs: tuple[Flips, ...] = ()
    skipped: str = ""

    @property
    def counts(self) -> tuple[int, int, int]:
        """Numbers of failures that pass, passes that fail, and cases without a verdict."""
        passes = fails = without_verdict = 0
        for run in self.runs:
            passes += len(run.passes)
            fails += len(run.fails)
            without_verdict += len(run.without_verdict)
        return passes, fails, without_verdict


class StressResult(Result, Record, frozen=True):
    """How small changes of the simulation change the results of a campaign.

    `ms.stress` returns it.

    Example:
        ```python
        found = ms.stress("runs/latest")
        print(len(found.robust), "of", len(found.failures), "failures are robust")
        ```

    Attributes:
        cases: number of judged cases of the campaign, which ran again.
        failures: indices of the recorded failures, the worst first.
        rungs: the results of each change.
        vut: spec of the controller.
    """

    computed = ("robust",)

    cases: int
    failures: tuple[Index, ...]
    rungs: tuple[Rung, ...]
    vut: str

    @property
    def runs(self) -> int:
        """Number of runs of each case."""
        return sum(len(rung.runs) for rung in self.rungs)

    @property
    def robust(self) -> tuple[int, ...]:
        """Indices of the failures that fail in every run of every change, the worst first."""
        fragile: set[int] = set()
        for rung in self.rungs:
            for run in rung.runs:
                fragile.update(run.passes, run.without_verdict)
        return tuple(index for index in self.failures if index not in fragile)

    def share(self, rung: Rung) -> float:
        """Return the share of results that flip with a change, from 0 to 1.

        Args:
            rung: the results of the change.
        """
        return sum(rung.counts) / max(self.cases * len(rung.runs), 1)


STRESS = StudyFile("stress.json", StressResult)
PART_S = 0.02
"""Step of the simulation on the rung `step`, in s; that of eq. (4) is longer."""
LAGS_S = (0.2, 0.35, 0.5)
"""Chosen; on lags of cruise control: Xiao, Darbha and Gao (2008)."""
POWER_W_PER_KG = 34.0
"""Power over mass: above this a car is of class 3, the highest. UN GTR No. 15, Annex 1."""
ERROR_X_M = 0.5
ERROR_V_MPS = 2.0 / 3.6
"""Accuracy of a radar for lane changes: 50 cm and 2 km/h. Autoliv NB24G1V2, user's manual, 3.1."""
START_ERRORS = {"x_pov0_m": ERROR_X_M, "v_pov0_mps": ERROR_V_MPS}
CAR_LENGTH_M = 5.0
DRAWS = 5
"""Number of runs of all cases where a change is drawn at random, with the seed of the case."""


@dataclass(frozen=True, slots=True)
class Disturbance:
    """A rung before it runs.

    Attributes:
        name: short name.
        about: the change, in a phrase.
        plan: returns the plan of the rung from that of the campaign; raises `UserError` where the
            rung cannot run.
        case: returns the case of the rung from one of the campaign and a random generator; None
            for the same coordinates.
    """

    name: str
    about: str
    plan: Callable[[SimulationPlan], SimulationPlan] = lambda plan: plan
    case: Callable[[Case, np.random.Generator], Case] | None = None

    @property
    def draws(self) -> int:
        """Number of runs of all cases."""
        return 1 if self.case is None else DRAWS


def _with_actuator(plan: SimulationPlan, **values: float) -> SimulationPlan:
    act = plan.scenario.act
    for name in values:
        if getattr(act, name) not in (0.0, None):
            raise UserError(f"the scenario already sets {name}")
    return _changed(plan, act=replace(act, **values))


def _changed(plan: SimulationPlan, **changes: Any) -> SimulationPlan:
    scenario = replace(plan.scenario, **changes)
    plan.criterion.check(scenario)
    return replace(plan, scenario=scenario)


def _start_off(case: Case, rng: np.random.Generator) -> Case:
    """Return a case whose POV starts a little elsewhere, at another speed; within the pool."""
    values: dict[str, Any] = {}
    for dimension in case.scenario.dimensions(case.level):
        name = dimension.field
        if name in START_ERRORS:
            value = getattr(case, name) + rng.uniform(-START_ERRORS[name], START_ERRORS[name])
            values[name] = min(max(value, dimension.low), dimension.high)
    return replace(case, **values)


UNCHANGED = "nothing"
RUNGS = (
    Disturbance(UNCHANGED, "no change"),
    Disturbance(
        "step",
        f"a step of {PART_S:g} s; each command lasts {DT_S:g} s",
        plan=lambda plan: replace(plan, substeps=round(DT_S / PART_S)),
    ),
    *(
        Disturbance(
            f"lag-{lag_s:g}",
            f"the acceleration of the VUT lags by {lag_s:g} s",
            partial(_with_actuator, lag_s=lag_s),
        )
        for lag_s in LAGS_S
    ),
    Disturbance(
        "power",
        f"the VUT has {POWER_W_PER_KG:g} W/kg, so it accelerates by at most P / (m v)",
        partial(_with_actuator, power_w_per_kg=POWER_W_PER_KG),
    ),
    Disturbance(
        "start",
        f"the POV starts within {ERROR_X_M:g} m and {ERROR_V_MPS:.2f} m/s of the recorded start",
        case=_start_off,
    ),
    Disturbance(
        "long-pov",
        f"cars of the mainline are {CAR_LENGTH_M:g} m longer, to the rear",
        plan=lambda plan: _changed(plan, pov_length_m=plan.scenario.pov_length_m + CAR_LENGTH_M),
    ),
)
"""The ladder; the first rung shows whether cases repeat at all."""
RUNS = sum(one.draws for one in RUNGS)


def stress(study: RunStudy) -> StressResult:
    """Run the cases of a campaign on every rung, and write the results into its folder.

    Args:
        study: the campaign, and how its cases run.

    Returns:
        The results, as they are in the file.

    Raises:
        UserError: for a campaign without a verdict, or with another net or other POVs.
    """
    study.check_same_system()
    run = study.run
    tested = [outcome for outcome in run.cases if outcome.is_tested]
    if not tested:
        raise UserError(f"{run.folder} has no case with a verdict, so there is nothing to stress")
    rungs = [_rung(study, tested, one) for one in RUNGS]
    failing = [outcome.index for outcome in failures(tested)]
    found = StressResult(len(tested), tuple(failing), tuple(rungs), run.vut)
    STRESS.write(run.folder, found)
    return found


def _rung(study: RunStudy, tested: Sequence[Outcome], one: Disturbance) -> Rung:
    """Run all cases with a change; a rung that cannot run is skipped with its reason."""
    flips: list[Flips] = []
    skipped = ""
    try:
        plan = one.plan(study.plan.for_cases(len(tested)))
        for draw in range(one.draws):
            cases = []
            for outcome in tested:
                case = replace(outcome.case, scenario=plan.scenario)
                if one.case is not None:
                    case = one.case(case, np.random.default_rng([draw, case.seed]))
                cases.append(case)
            flips.append(flips_of(tested, study.simulate(plan, cases, end_of)))
    except UserError as error:
        if one.name == UNCHANGED:
            raise
        study.on_cases((one.draws - len(flips)) * len(tested))
        flips, skipped = [], str(error)
    return Rung(one.name, one.about, tuple(flips), skipped)


def flips_of(tested: Sequence[Outcome], again: Sequence[tuple[bool, bool, bool]]) -> Flips:
    """Return the verdicts that flip in another run of the same cases.

    Args:
        tested: the recorded outcomes, each with a verdict.
        again: `end_of` the cases in the other run.
    """
    passes, fails, without_verdict = [], [], []
    for outcome, (failed, is_tested, _) in zip(tested, again, strict=True):
        if not is_tested:
            without_verdict.append(outcome.index)
        elif outcome.failed and not failed:
            passes.append(outcome.index)
        elif failed and not outcome.failed:
            fails.append(outcome.index)
    return Flips(tuple(passes), tuple(fails), tuple(without_verdict))
