"""How likely a VUT is to fail under a stated distribution over the pool, with an exact interval.

A campaign looks for failures, so no share of its cases is a probability, and no binomial interval
of them is valid. They only tell where a failure is to be expected: in cells, equally likely under
the distribution, that are more likely to fail than not by its surrogate, and in those beside them.
That cuts the pool into two strata of known shares W_h. Fresh cases are drawn from each, n_h of them
independently, and k_h fail:

    P(fail) = sum_h W_h p_h,    of which the estimate is sum_h W_h k_h / n_h.

Each p_h has the interval of Clopper and Pearson (1934), and the chances of being wrong add up to at
most 1 - confidence (union bound). It holds for any number of cases, and however wrong the surrogate
is, which costs width alone. The stratum where no failure is expected is an audit of the campaign:
what fails there, the campaign has missed.

With a traffic of k cars per metre, whose speeds are independent of their places, a merge fails with

    N = k * integral dx E_v[P(fail | x, v)]

cars of the mainline in the mean (Campbell's formula): no process of arrivals is assumed, and
headways may depend on each other, as each car is judged by itself. How common POV levels are on a
road is not known. N is linear in their shares, so over all mixtures it is between the least and the
most of the levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from merge_sumo import config
from merge_sumo.analysis.exposure import Distribution, Traffic, named_traffic, read_distribution
from merge_sumo.analysis.run_study import RunStudy, StudyFile, check_least
from merge_sumo.analysis.surface import learn_surface
from merge_sumo.errors import UserError
from merge_sumo.files import check_new, write_new
from merge_sumo.metrics.outcome import Episode
from merge_sumo.metrics.summary import clopper_pearson
from merge_sumo.records import Record, to_json
from merge_sumo.result import Result
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import Scenario
from merge_sumo.simulation.evaluate import open_simulators
from merge_sumo.simulation.plan import Engine

DEFAULT_CASES = {Engine.KINEMATIC: 100_000, Engine.SUMO: 4000}
STREAM = 7
"""Key of the random stream, so that it is none of a sampler's."""
CELLS = 16_384
"""Cells of a level, at most."""
EXPECTED = 0.5
"""Chance to fail from which the surrogate expects a failure."""
EXPECTED_LEAST = 0.25
"""Least share of the cases for the stratum where failures are expected, if there is one: it is
small, and nearly all of the variance is in it. If the surrogate knows nothing, that costs 15 % of
the width."""
NAMED = 20
"""Failures where none was expected that the result names."""


class Stratum(Record, frozen=True):
    """What was drawn from a stratum.

    Attributes:
        expects_failures: whether the campaign does there.
        share: of the cases, as often as they occur.
        cases: fresh cases.
        failures: those of them that fail.
        without_verdict: those that are not judged: errors, and timeouts that are no failures.
        low: lower end of the interval of the share that fails there; they count as safe.
        high: upper end; they count as failures.
    """

    expects_failures: bool
    share: float
    cases: int
    failures: int
    without_verdict: int
    low: float
    high: float


class Estimate(Record, frozen=True):
    """A probability of failure; each interval holds with the confidence of the result.

    Attributes:
        probability: the estimate; cases without a verdict count as safe.
        low: lower end of its interval.
        high: upper end.
        strata: the one without expected failures, and the one with them where there is one.
    """

    probability: float
    low: float
    high: float
    strata: tuple[Stratum, ...]


class PerMerge(Record, frozen=True):
    """With how many cars of the mainline a merge fails in a traffic.

    Attributes:
        traffic: the traffic.
        cars: mainline cars per merge that are counted: those that start in the pool.
        counted_speeds: share of the traffic's speeds that are in the pool.
        least: failures per merge for the mixture of levels with the fewest.
        most: for that with the most.
        low: end of the interval, which holds the failures per merge of every mixture.
        high: end of the interval.
    """

    traffic: Traffic
    cars: float
    counted_speeds: float
    least: float
    most: float
    low: float
    high: float


class ProbabilityResult(Result, Record, frozen=True):
    """How likely a VUT is to fail, with all that decides it.

    Attributes:
        overall: over the levels as they were weighed; None where a traffic has no weights of them.
        levels: by level.
        per_merge: failures per merge; None without a traffic.
        confidence: chance that an interval holds.
        cases: fresh cases.
        in_sumo: those that ran in SUMO.
        missed: failures where none was expected: level and coordinates, at most `NAMED` of them.
        distribution: how often cases occur.
        seed: of the draws.
        engine: what moved the vehicles.
        campaign: settings of the campaign.
    """

    overall: Estimate | None
    levels: dict[int, Estimate]
    per_merge: PerMerge | None
    confidence: float
    cases: int
    in_sumo: int
    missed: tuple[dict[str, float], ...]
    distribution: dict[str, Any]
    seed: int
    engine: str
    campaign: dict[str, Any]

    @property
    def without_verdict(self) -> int:
        """Number of cases that are not judged."""
        strata = [one for level in self.levels.values() for one in level.strata]
        return sum(one.without_verdict for one in strata)

    @property
    def is_judged(self) -> bool:
        """Whether any case is judged: else no probability can be stated."""
        return self.without_verdict < self.cases


PROBABILITY = StudyFile("probability.json", ProbabilityResult)


class Cells(NamedTuple):
    """The cells of a level that are in one stratum.

    Attributes:
        level: the level.
        expects_failures: whether the campaign does there.
        share: of the cases of all levels, as often as they occur.
        numbers: of the cells, (c,).
    """

    level: int
    expects_failures: bool
    share: float
    numbers: NDArray[np.intp]


class Counted(NamedTuple):
    """Cells, and what became of the cases that were drawn from them."""

    cells: Cells
    cases: int
    failures: int
    without_verdict: int


def failure_probability(study: RunStudy, asked: config.Probability, out: Path) -> ProbabilityResult:
    """Estimate how likely the VUT of a campaign is to fail, with fresh cases; write it to a file.

    Raises `UserError` for a distribution, a traffic or numbers that make no sense, for a campaign
    with a net or POVs of another day, and for a file that exists or cannot be written.

    Args:
        study: the study of the campaign.
        asked: options of the verb.
        out: new file for the result.
    """
    levels, scenario = study.settings.levels, study.settings.scenario
    cases = DEFAULT_CASES[study.plan.engine] if asked.cases is None else asked.cases
    check_least(asked, cases=1, seed=0)
    if not 0.5 <= asked.confidence < 1.0:
        raise UserError(f"`confidence` is {asked.confidence}: choose 0.5 or more, and below 1")
    if asked.distribution is not None and asked.traffic is not None:
        raise UserError("choose a distribution or a traffic: a traffic states its own")
    check_new(out, endings=(".json",))
    study.check_same_system()
    traffic = None if asked.traffic is None else named_traffic(str(asked.traffic))
    if traffic is None:
        path = None if asked.distribution is None else Path(asked.distribution)
        stated = read_distribution(path, levels, scenario)
    else:
        stated = traffic.in_pool(scenario, levels)
    cells = expected_cells(study, stated)
    drawn = draw(cells, scenario, cases, np.random.default_rng([asked.seed, STREAM]))
    plan = study.plan.for_verdicts().for_cases(cases)
    if study.workers is not None:
        open_simulators(plan, study.workers)
    counted, in_sumo = [], 0
    missed: list[dict[str, float]] = []
    for one, chances in zip(cells, drawn, strict=True):
        at = study.settings.pool.cases(stated.points(one.level, chances), one.level)
        ran = np.array(study.simulate(at, plan, _judged), dtype=bool).reshape(-1, 3)
        failed, judged, by_sumo = ran.T
        in_sumo += int(by_sumo.sum())
        counted.append(Counted(one, len(at), int(failed.sum()), int((~judged).sum())))
        if not one.expects_failures:
            missed += [_named(at[place]) for place in np.flatnonzero(failed)[:NAMED].tolist()]
    by_level = {
        level: estimate([one for one in counted if one.cells.level == level], asked.confidence)
        for level in stated.levels
    }
    result = ProbabilityResult(
        overall=estimate(counted, asked.confidence) if traffic is None else None,
        levels=by_level,
        per_merge=None if traffic is None else _per_merge(traffic, scenario, by_level),
        confidence=asked.confidence,
        cases=cases,
        in_sumo=in_sumo,
        missed=tuple(missed[:NAMED]),
        distribution=stated.record(),
        seed=asked.seed,
        engine=study.plan.engine,
        campaign=study.record(),
    )
    write_new(out, to_json(result, indent=2))
    return result


def expected_cells(study: RunStudy, stated: Distribution) -> list[Cells]:
    """Return the cells of each level, by whether the campaign expects failures there."""
    found = []
    for level, weight in stated.levels.items():
        shape = cells_of(stated.scenario, level)
        surface = learn_surface(study.run.outcomes, level, tolerated=study.settings.tolerated)
        expects = np.zeros(shape, dtype=bool)
        if surface is not None:
            middle = (np.indices(shape).reshape(len(shape), -1).T + 0.5) / shape
            chance = surface.chance(stated.points(level, middle))
            expects = maximum_filter((chance >= EXPECTED).reshape(shape), 3)
        for expects_failures in (False, True):
            (numbers,) = np.nonzero(expects.ravel() == expects_failures)
            if len(numbers):
                share = weight * len(numbers) / expects.size
                found.append(Cells(level, expects_failures, share, numbers))
    return found


def cells_of(scenario: Scenario, level: int) -> tuple[int, ...]:
    """Return the number of cells along each coordinate of a level."""
    dims = len(scenario.dimensions(level))
    return (int(CELLS ** (1.0 / dims) + 1e-9),) * dims


def draw(
    cells: Sequence[Cells], scenario: Scenario, cases: int, rng: np.random.Generator
) -> list[FloatArray]:
    """Return independent cases of each stratum, as often as they occur there.

    They are places in the distribution, (n, d), uniform in the unit cube, for each of the cells.

    Args:
        cells: cells of each stratum.
        scenario: scenario of the cases.
        cases: number of cases in all.
        rng: random generator.
    """
    expected = sum(one.share for one in cells if one.expects_failures)
    some = cases > 1 and 0.0 < expected < 1.0 - 1e-9
    most = round(cases * max(expected, EXPECTED_LEAST)) if some else round(cases * expected)
    drawn: dict[int, FloatArray] = {}
    for expects_failures, count in ((False, cases - most), (True, most)):
        of_stratum = {n: c for n, c in enumerate(cells) if c.expects_failures == expects_failures}
        shares = np.array([one.share for one in of_stratum.values()])
        numbers = rng.multinomial(count, shares / shares.sum()) if of_stratum else ()
        for (place, one), number in zip(of_stratum.items(), numbers, strict=True):
            shape = cells_of(scenario, one.level)
            corner = np.unravel_index(rng.choice(one.numbers, number), shape)
            drawn[place] = (np.stack(corner, axis=1) + rng.random((number, len(shape)))) / shape
    return [drawn[place] for place in range(len(cells))]


def _judged(episode: Episode) -> tuple[bool, bool, bool]:
    """Return whether a case failed, is judged, and ran in SUMO."""
    return episode.outcome.failed, episode.outcome.is_tested, episode.in_sumo


def _named(case: Case) -> dict[str, float]:
    names = (dimension.field for dimension in case.scenario.dimensions(case.level))
    return {"level": case.level, **{name: getattr(case, name) for name in names}}


def estimate(counted: Sequence[Counted], confidence: float) -> Estimate:
    """Return the estimate of the share of failures among cases of some cells."""
    whole = sum(one.cells.share for one in counted)
    by_stratum = [
        [one for one in counted if one.cells.expects_failures == expects_failures]
        for expects_failures in (False, True)
    ]
    present = [of_stratum for of_stratum in by_stratum if of_stratum]
    strata = tuple(
        _stratum(of_stratum, whole, 1.0 - (1.0 - confidence) / len(present))
        for of_stratum in present
    )
    return Estimate(
        probability=sum(one.share * one.failures / max(one.cases, 1) for one in strata),
        low=sum(one.share * one.low for one in strata),
        high=min(sum(one.share * one.high for one in strata), 1.0),
        strata=strata,
    )


def _stratum(counted: Sequence[Counted], whole: float, confidence: float) -> Stratum:
    cases, failures, without_verdict = (
        sum(of) for of in zip(*(one[1:] for one in counted), strict=True)
    )
    return Stratum(
        expects_failures=counted[0].cells.expects_failures,
        share=sum(one.cells.share for one in counted) / whole,
        cases=cases,
        failures=failures,
        without_verdict=without_verdict,
        low=clopper_pearson(failures, cases, confidence)[0],
        high=clopper_pearson(failures + without_verdict, cases, confidence)[1],
    )


def _per_merge(traffic: Traffic, scenario: Scenario, levels: dict[int, Estimate]) -> PerMerge:
    """Return the range over mixtures of levels.

    Its low end is above the fewest only where the end of that level is, and its high end below the
    most likewise; so all mixtures are inside with the confidence of a level.
    """
    cars, found = traffic.cars_in_pool(scenario), [one.probability for one in levels.values()]
    low, high = min(e.low for e in levels.values()), max(e.high for e in levels.values())
    return PerMerge(
        traffic=traffic,
        cars=cars,
        counted_speeds=traffic.share_in_pool(scenario),
        least=cars * min(found),
        most=cars * max(found),
        low=cars * low,
        high=cars * high,
    )
