"""How likely a VUT is to fail under a stated distribution over the pool, with an interval.

A sampler chose the cases of a campaign because they were expected to fail, given those before. No
share of them is the probability of a failure, and no binomial interval of theirs is valid. So they
only decide how the pool is cut into strata, from which fresh cases are drawn independently; the
estimate rests on these (`stratified.py`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.analysis.exposure import Distribution, read_distribution
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.engine.evaluate import evaluate, open_simulators, workers_or_here
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.samplers.belief import learn_chance
from merge_sumo.samplers.coverage import REPLAYED
from merge_sumo.samplers.prediction_skill import PredictionSkill, Query
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.studies.stratified import (
    Draws,
    Estimate,
    Strata,
    estimate,
    of_cells,
)
from merge_sumo.system.folders import add_to, check_new_file, write_new
from merge_sumo.system.records import Record, read_record
from merge_sumo.twin.twin import Twin
from merge_sumo.values.case import Case, FloatArray, to_unit
from merge_sumo.values.scenario import DX_CRASH_M, Scenario
from merge_sumo.values.score import Outcome

RESULT: Final = "probability.json"
LINES: Final = ".jsonl"
"""End of the name of the file beside it, with a line per fresh case."""
DEFAULT_CASES: Final = 4000
STREAM: Final = 7
"""Key of the random stream, so that it is none of a sampler's."""
MOST_LEARNED: Final = 1000
"""Cases, the last ones, that the twin learns from."""
CHUNK: Final = 1000
"""Cases that are predicted at a time."""
TWIN_ALONE: Final = 0.9
"""Weight of the twin from which the surrogate, which is slow, is not asked."""
WRITTEN: Final = 500
"""Cases after which outcomes are written and synced."""


def failure_probability(
    study: RunStudy,
    out: Path,
    *,
    cases: int = DEFAULT_CASES,
    distribution: Path | None = None,
    confidence: float = 0.95,
    seed: int = 0,
) -> Estimate:
    """Estimate how likely the VUT of a campaign is to fail, with fresh cases.

    Writes the estimate with all that decides it to `out`, and the fresh outcomes, each with its
    weight, to the file of the same name that ends in .jsonl, synced every few hundred cases.

    Args:
        study: the campaign, and how its cases run.
        out: new file, which ends in .json.
        cases: fresh cases.
        distribution: JSON file that states how often cases occur; uniform over the pool without.
        confidence: chance that the interval holds the probability.
        seed: of the draws.

    Raises:
        UserError: for a distribution or numbers that make no sense, a run whose net or policies are
            not those of today, or files that exist or cannot be written.
    """
    check_numbers(cases, confidence, seed)
    study.check_same_system()
    settings = study.settings
    stated = read_distribution(distribution, settings.levels, settings.scenario)
    lines = lines_beside(out)
    expected = Expected(study)
    strata = strata_of(expected, settings.scenario, stated, cases, confidence)
    draws = strata.draw(np.random.default_rng([seed, STREAM]))
    drawn = cases_of(settings, stated, draws)
    outcomes = run_fresh(study, drawn, notes_of(draws), lines)
    failed = np.array([outcome.failed for outcome in outcomes])
    judged = np.array([outcome.score is not None for outcome in outcomes])
    result = estimate(strata, draws, failed, judged, confidence)
    write_result(out, study, {**asdict(result), "distribution": stated.record()}, seed)
    return result


def write_result(out: Path, study: RunStudy, result: Mapping[str, Any], seed: int) -> None:
    """Write what a study found with fresh cases as a new file, with all that decides it."""
    decides = {"seed": seed, "engine": study.plan.engine, "campaign": study.record()}
    record = {**result, **decides}
    write_new(out, (json.dumps(record, indent=2, allow_nan=False) + "\n").encode())


class ProbabilityFile(Record, frozen=True):
    """What the file of an estimate says; its fields are those of `Estimate`.

    Attributes:
        distribution: how often cases occur, as it was stated.
        seed: of the draws.
        engine: what moved the vehicles.
        campaign: settings of the campaign that it is of.
    """

    probability: float
    low: float
    high: float
    confidence: float
    low_risk: float
    high_risk: float
    cases: int
    failures: int
    without_verdict: int
    strata: list[dict[str, Any]]
    plain: dict[str, float]
    distribution: dict[str, Any]
    seed: int
    engine: str
    campaign: dict[str, Any]


def probability_of(folder: Path) -> ProbabilityFile | None:
    """Return what the folder of a campaign says of a probability; None where it says nothing.

    Raises `UserError` for a file that is not as it was written.
    """
    return read_record(folder / RESULT, ProbabilityFile)


def check_numbers(cases: int, confidence: float, seed: int) -> None:
    """Raise `UserError` where a number makes no sense."""
    for name, number, fits, bounds in (
        ("cases", cases, cases >= 1, "it must be 1 or more"),
        ("confidence", confidence, 0.5 <= confidence < 1.0, "choose 0.5 or more, and below 1"),
        ("seed", seed, seed >= 0, "it must be 0 or more"),
    ):
        if not fits:
            raise UserError(f"--{name} is {number}: {bounds}")


def lines_beside(out: Path) -> Path:
    """Return the file of fresh cases beside a result; `UserError` unless both can be new files."""
    check_new_file(out)
    lines = out.with_suffix(LINES)
    if lines == out:
        raise UserError(f"--out is {out}: end it in .json, as cases go to {LINES} beside it")
    check_new_file(lines)
    return lines


def strata_of(
    expected: Expected, scenario: Scenario, stated: Distribution, cases: int, confidence: float
) -> Strata:
    """Return the strata that the outcomes of a campaign suggest."""
    from threadpoolctl import threadpool_limits

    chance = {}
    # One thread: rounding must not depend on the number of cores.
    with threadpool_limits(1):
        for level in stated.levels:
            dims = len(scenario.dimensions(level))
            chance[level] = of_cells(dims, _of_chances(stated, level, expected.at(level)))
    return Strata(stated.levels, chance, scenario, cases, confidence)


def _of_chances(
    stated: Distribution, level: int, of_points: Callable[[FloatArray], FloatArray]
) -> Callable[[FloatArray], FloatArray]:
    """Return a function of points as one of chances of the distribution."""
    return lambda chances: of_points(stated.points(level, chances))


class Expected:
    """P(fail) of cases as expected after a campaign: by twin and surrogate, or surrogate alone.

    What is expected decides the width of the interval, and not its validity.
    """

    def __init__(self, study: RunStudy) -> None:
        run, settings, plan = study.run, study.settings, study.plan
        self._sampler = make_sampler("uniform", settings.pool, 0)
        self._sampler.tell(run.outcomes)
        self._by_level: dict[int, Callable[[FloatArray], FloatArray]] = {}
        self._limit_m = settings.scenario.dx_crash_m if plan.criterion.is_papers else DX_CRASH_M
        lines = centre_lines(plan.road)
        self._twin = Twin(settings.pool, plan.povs, 0, criterion=plan.criterion, lines=lines)
        last = run.outcomes[-MOST_LEARNED:]
        # Without motions, as in a folder of which only the outcomes were kept, it learns nothing.
        with suppress(UserError):
            self._twin.tell(last, {o.index: run.trajectory(o.index).motion for o in last})

    def at(self, level: int) -> Callable[[FloatArray], FloatArray]:
        """Return P(fail), (n,), as a function of points, (n, d), of a level's unit cube."""
        if level not in self._by_level:
            self._by_level[level] = self._learned(level)
        return self._by_level[level]

    def _learned(self, level: int) -> Callable[[FloatArray], FloatArray]:
        history = self._sampler.history(level)
        surrogate = learn_chance(history)

        def by_surrogate(points: FloatArray) -> FloatArray:
            if surrogate is None:
                return np.zeros(len(points))
            return np.concatenate([surrogate(part) for part in _parts(points)])

        if not self._twin.can_predict(level) or not history.failed.any():
            return by_surrogate
        skill = self._skill(level)
        if skill.is_worthless:
            return by_surrogate

        def by_both(points: FloatArray) -> FloatArray:
            gaps = [self._twin.predict([Query(level, part)])[0] for part in _parts(points)]
            gaps_m = np.concatenate(gaps, axis=-1)
            chance = skill.chance(gaps_m)
            if surrogate is None or skill.twin.min() > TWIN_ALONE:
                return chance
            return skill.mixed(gaps_m, chance, by_surrogate(points))

        return by_both

    def _skill(self, level: int) -> PredictionSkill:
        """Return the skill of the twin, judged by predictions of its last cases, too."""
        last = self._sampler.observed(level)[-REPLAYED:]
        indices = [outcome.index for outcome in last]
        points = to_unit((o.case for o in last), level, self._sampler.pool.scenario)
        gaps_m = self._twin.predict([Query(level, points, held_out=indices)])[0]
        replayed = dict(zip(indices, gaps_m.T, strict=True))
        return PredictionSkill(self._sampler.observed(), level, self._limit_m, replayed)


def _parts(points: FloatArray) -> list[FloatArray]:
    return np.array_split(points, len(points) // CHUNK + 1)


def cases_of(settings: CampaignSettings, stated: Distribution, draws: Draws) -> list[Case]:
    """Return the cases of draws from a distribution, in their order."""
    by_place: dict[int, Case] = {}
    for level in stated.levels:
        places = np.flatnonzero(draws.level == level)
        dims = len(settings.scenario.dimensions(level))
        points = stated.points(level, draws.chances[places, :dims])
        drawn = settings.pool.cases(points, level)
        by_place.update(zip(places.tolist(), drawn, strict=True))
    return [by_place[place] for place in range(len(by_place))]


def notes_of(draws: Draws) -> list[dict[str, float]]:
    """Return what the line of each drawn case says beside its outcome."""
    weights, strata = draws.weight.tolist(), draws.stratum.tolist()
    return [{"weight": w, "stratum": h} for w, h in zip(weights, strata, strict=True)]


def run_fresh(
    study: RunStudy, cases: Sequence[Case], notes: Sequence[Mapping[str, float]], lines: Path
) -> list[Outcome]:
    """Run cases in order, some at a time; write each outcome with what is noted of its case."""
    outcomes: list[Outcome] = []
    with workers_or_here(study.workers) as processes:
        plan = study.plan.for_cases(len(cases))
        open_simulators(plan, processes)
        for first in range(0, len(cases), WRITTEN):
            ran = []
            for place, done in evaluate(plan, cases[first : first + WRITTEN], processes):
                ran.append(done.outcome(first + place, first // WRITTEN))
                study.on_cases(1)
            ran.sort(key=lambda outcome: outcome.index)
            append_lines(lines, ran, notes)
            outcomes += ran
    return outcomes


def append_lines(
    lines: Path, outcomes: Sequence[Outcome], notes: Sequence[Mapping[str, float]]
) -> None:
    """Add outcomes to the file of fresh cases, and sync it."""
    content = ""
    for o in outcomes:
        content += json.dumps({**o.to_record(), **notes[o.index]}, allow_nan=False) + "\n"
    add_to(lines, content.encode(), new=outcomes[0].index == 0)
