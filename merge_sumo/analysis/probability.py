"""The failure probability of a VUT under a distribution over the pool, with an exact interval.

Fresh cases are drawn from where a campaign expects failures, and from where it expects none.
"""

# A campaign looks for failures, so no share of its cases is a probability. They only tell where a
# failure is to be expected: in cells, equally likely under the distribution, that more likely fail
# than not by its surrogate, and in the cells next to these. That cuts the pool into two strata of
# known shares W_h. Of each, n_h fresh cases are drawn independently, and k_h fail:
#
#     P(fail) = sum_h W_h p_h,    of which the estimate is sum_h W_h k_h / n_h.
#
# Each p_h has the interval of Clopper and Pearson (1934), and the chances of being wrong add up to
# at most 1 - confidence (union bound). It holds for any number of cases, and however wrong the
# surrogate is, which costs width alone. The stratum without expected failures is an audit of the
# campaign: its failures are those that the campaign has missed.
#
# With a traffic of k cars per metre, whose speeds are independent of their places, a merge fails
# with
#
#     N = k * integral dx E_v[P(fail | x, v)]
#
# cars of the mainline in the mean (Campbell's formula): no process of arrivals is assumed, and
# headways may depend on each other, as each car is judged by itself. The shares of POV levels on a
# road are not known. N is linear in them, so over all mixtures it is between the least and the most
# of the levels.

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from merge_sumo import config
from merge_sumo.analysis.exposure import Distribution, Traffic, named_traffic, read_distribution
from merge_sumo.analysis.run_study import RunStudy, StudyFile, check_least, end_of
from merge_sumo.analysis.surface import learn_surface
from merge_sumo.errors import UserError
from merge_sumo.files import check_new, write_new
from merge_sumo.metrics.summary import clopper_pearson
from merge_sumo.records import Record, to_json
from merge_sumo.result import Result
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import Scenario
from merge_sumo.simulation.evaluate import open_simulators
from merge_sumo.simulation.plan import Engine

DEFAULT_CASES = {Engine.KINEMATIC: 100_000, Engine.SUMO: 4000}
STREAM = 7
"""Key of the random stream, which no sampler uses."""
CELLS = 16_384
"""Maximum number of cells of a level."""
EXPECTED = 0.5
"""Failure probability of the surrogate from which a failure is expected."""
EXPECTED_LEAST = 0.25
"""Least share of the cases for the stratum where failures are expected, if there is one: it is
small, and nearly all of the variance is in it. With a surrogate that knows nothing the interval
becomes 15 % wider."""
NAMED = 20
"""Maximum number of unexpected failures that the result names."""


class Stratum(Record, frozen=True):
    """The cases that were drawn from a stratum, a part of the pool.

    Attributes:
        expects_failures: whether the campaign expects failures in the stratum.
        share: probability of a case in the stratum, from 0 to 1.
        cases: number of new cases.
        failures: number of new cases that fail.
        without_verdict: number of new cases that are not judged: errors, and timeouts that are not
            failures.
        low: lower end of the interval of the share that fails; cases that are not judged count as
            safe.
        high: upper end; cases that are not judged count as failures.
    """

    expects_failures: bool
    share: float
    cases: int
    failures: int
    without_verdict: int
    low: float
    high: float


class Estimate(Record, frozen=True):
    """A failure probability with its confidence interval.

    Attributes:
        probability: the estimate, from 0 to 1; cases that are not judged count as safe.
        low: lower end of the interval.
        high: upper end of the interval.
        strata: the part of the pool without expected failures, then the part with expected
            failures. One of them may be missing.
    """

    probability: float
    low: float
    high: float
    strata: tuple[Stratum, ...]


class PerMerge(Record, frozen=True):
    """The number of cars of the mainline with which a merge fails in a traffic.

    Attributes:
        traffic: the traffic.
        cars: number of counted cars of the mainline per merge: those that start in the pool.
        counted_speeds: share of the traffic's speeds that are in the pool.
        least: failures per merge for the mixture of levels with the fewest.
        most: failures per merge for the mixture with the most.
        low: lower end of the interval for all mixtures.
        high: upper end.
    """

    traffic: Traffic
    cars: float
    counted_speeds: float
    least: float
    most: float
    low: float
    high: float


class ProbabilityResult(Result, Record, frozen=True):
    """The failure probability of a controller, with its confidence interval.

    `ms.probability` returns it.

    Example:
        ```python
        found = ms.probability("runs/latest", cases=4000)
        assert found.overall.high < 0.01
        ```

    Attributes:
        overall: estimate over all levels, by their weights; None with traffic, which has no
            weights of levels.
        levels: estimate of each POV level.
        per_merge: failures per merge; None without traffic.
        confidence: confidence of each interval, 0.95 for 95 %.
        cases: number of new cases.
        in_sumo: number of new cases that ran in SUMO.
        missed: level and coordinates of at most 20 failures that the campaign did not expect.
        distribution: distribution of the cases, as in a distribution file.
        seed: seed of the new cases.
        engine: engine that moved the vehicles.
        campaign: settings, versions and hashes, as in `campaign.json`.
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
        number = 0
        for level in self.levels.values():
            number += sum(one.without_verdict for one in level.strata)
        return number

    @property
    def is_judged(self) -> bool:
        """Whether any case is judged; otherwise the probability is unknown."""
        return self.without_verdict < self.cases


PROBABILITY = StudyFile("probability.json", ProbabilityResult)


class Cells(NamedTuple):
    """The cells of a level in one stratum.

    Attributes:
        level: the level.
        expects_failures: whether the campaign expects failures in them.
        share: probability of a case in them, over all levels.
        numbers: indices of the cells, (c,).
    """

    level: int
    expects_failures: bool
    share: float
    numbers: NDArray[np.intp]


class Counted(NamedTuple):
    """The results of the cases that were drawn from cells.

    Attributes:
        cells: the cells.
        cases: number of cases.
        failures: number of those that fail.
        without_verdict: number of those without a verdict.
    """

    cells: Cells
    cases: int
    failures: int
    without_verdict: int


def failure_probability(
    study: RunStudy, options: config.Probability, out: Path
) -> ProbabilityResult:
    """Estimate the failure probability of the VUT of a campaign with fresh cases, and write it.

    Args:
        study: the study of the campaign.
        options: options of the verb.
        out: new file for the result.

    Returns:
        The result, as it is in the file.

    Raises:
        UserError: for a distribution, a traffic or numbers that make no sense, for a campaign with
            another net or other POVs, and for a file that exists or cannot be written.
    """
    levels, scenario = study.settings.levels, study.settings.scenario
    cases = DEFAULT_CASES[study.plan.engine] if options.cases is None else options.cases
    check_least(options, cases=1, seed=0)
    if not 0.5 <= options.confidence < 1.0:
        raise UserError(f"`confidence` is {options.confidence}: choose 0.5 to below 1")
    if options.distribution is not None and options.traffic is not None:
        raise UserError("`distribution` and `traffic` cannot be combined: choose one of them")
    check_new(out, endings=(".json",))
    study.check_same_system()
    traffic, distribution = None, read_distribution(options.distribution, levels, scenario)
    if options.traffic is not None:
        traffic = named_traffic(str(options.traffic))
        distribution = traffic.in_pool(scenario, levels)
    cells = expected_cells(study, distribution)
    drawn = draw(cells, scenario, cases, np.random.default_rng([options.seed, STREAM]))
    plan = study.plan.for_verdicts().for_cases(cases)
    open_simulators(plan, study.workers)
    counted, missed, in_sumo = [], list[dict[str, float]](), 0
    for one, chances in zip(cells, drawn, strict=True):
        names = [dimension.field for dimension in scenario.dimensions(one.level)]
        fresh = study.settings.pool.cases(distribution.points(one.level, chances), one.level)
        failures = without_verdict = 0
        for case, ended in zip(fresh, study.simulate(plan, fresh, end_of), strict=True):
            failed, is_tested, by_sumo = ended
            failures += failed
            without_verdict += not is_tested
            in_sumo += by_sumo
            if failed and not one.expects_failures and len(missed) < NAMED:
                place = {name: getattr(case, name) for name in names}
                missed.append({"level": case.level, **place})
        counted.append(Counted(one, len(fresh), failures, without_verdict))
    by_level = {}
    for level in distribution.levels:
        at_level = [one for one in counted if one.cells.level == level]
        by_level[level] = estimate(at_level, options.confidence)
    result = ProbabilityResult(
        overall=estimate(counted, options.confidence) if traffic is None else None,
        levels=by_level,
        per_merge=None if traffic is None else _per_merge(traffic, scenario, by_level),
        confidence=options.confidence,
        cases=cases,
        in_sumo=in_sumo,
        missed=tuple(missed),
        distribution=distribution.record(),
        seed=options.seed,
        engine=study.plan.engine,
        campaign=study.settings.to_record(study.plan),
    )
    write_new(out, to_json(result, indent=2))
    return result


def expected_cells(study: RunStudy, distribution: Distribution) -> list[Cells]:
    """Return the cells of each level and stratum.

    Args:
        study: the campaign, with whose outcomes a surrogate is learned.
        distribution: the distribution of cases: cells are equally likely under it.
    """
    found = []
    for level, weight in distribution.levels.items():
        shape = cells_of(distribution.scenario, level)
        surface = learn_surface(study.run.outcomes, level, tolerated=study.settings.tolerated)
        expects = np.zeros(shape, dtype=bool)
        if surface is not None:
            middle = (np.indices(shape).reshape(len(shape), -1).T + 0.5) / shape
            chance = surface(distribution.points(level, middle))
            expects = maximum_filter((chance >= EXPECTED).reshape(shape), 3)
        for expects_failures in (False, True):
            numbers = np.flatnonzero(expects == expects_failures)
            share = weight * len(numbers) / expects.size
            if share:
                found.append(Cells(level, expects_failures, share, numbers))
    return found


def cells_of(scenario: Scenario, level: int) -> tuple[int, ...]:
    """Return the number of cells along each coordinate.

    Args:
        scenario: the scenario.
        level: level of the POV.
    """
    dims = len(scenario.dimensions(level))
    return (int(CELLS ** (1.0 / dims) + 1e-9),) * dims


def draw(
    cells: Sequence[Cells], scenario: Scenario, cases: int, rng: np.random.Generator
) -> list[FloatArray]:
    """Draw independent cases of each stratum.

    Args:
        cells: the cells of each level and stratum.
        scenario: scenario of the cases.
        cases: number of cases in all.
        rng: random generator.

    Returns:
        The cases drawn from each of `cells`, as quantiles of the distribution, (n, d).
    """
    expected = sum(one.share for one in cells if one.expects_failures)
    if 0.0 < expected < 1.0 - 1e-9:
        expected = max(expected, EXPECTED_LEAST)
    failing = round(cases * expected)
    drawn = [np.empty(0)] * len(cells)
    for expects_failures, count in ((False, cases - failing), (True, failing)):
        rows = [row for row, one in enumerate(cells) if one.expects_failures == expects_failures]
        shares = np.array([cells[row].share for row in rows])
        numbers = rng.multinomial(count, shares / shares.sum()) if rows else ()
        for row, number in zip(rows, numbers, strict=True):
            shape = cells_of(scenario, cells[row].level)
            corner = np.unravel_index(rng.choice(cells[row].numbers, number), shape)
            drawn[row] = (np.stack(corner, axis=1) + rng.random((number, len(shape)))) / shape
    return drawn


def estimate(counted: Sequence[Counted], confidence: float) -> Estimate:
    """Return the estimate of the share of failures among the cases of some cells.

    Args:
        counted: the results of the cells.
        confidence: probability with which the interval holds.
    """
    whole = sum(one.cells.share for one in counted)
    groups = []
    for expects_failures in (False, True):
        group = [one for one in counted if one.cells.expects_failures == expects_failures]
        if group:
            groups.append(group)
    of_stratum = 1.0 - (1.0 - confidence) / len(groups)
    probability = low = high = 0.0
    strata = []
    for group in groups:
        share = sum(one.cells.share for one in group) / whole
        cases = sum(one.cases for one in group)
        failures = sum(one.failures for one in group)
        unjudged = sum(one.without_verdict for one in group)
        one_low, one_high = clopper_pearson(failures, cases, of_stratum, unjudged)
        expects_failures = group[0].cells.expects_failures
        strata.append(
            Stratum(expects_failures, share, cases, failures, unjudged, one_low, one_high)
        )
        probability += share * failures / max(cases, 1)
        low += share * one_low
        high += share * one_high
    return Estimate(probability, low, min(high, 1.0), tuple(strata))


def _per_merge(traffic: Traffic, scenario: Scenario, levels: dict[int, Estimate]) -> PerMerge:
    """Return the failures per merge for all mixtures of levels.

    The interval goes from the lowest end of a level to the highest. It fails for some mixture only
    where that of the least or of the most likely level fails, so it has the confidence of a level.
    """
    cars = traffic.cars_in_pool(scenario)
    ends = [(one.probability, one.low, one.high) for one in levels.values()]
    least, low, _ = (cars * np.min(ends, axis=0)).tolist()
    most, _, high = (cars * np.max(ends, axis=0)).tolist()
    return PerMerge(traffic, cars, traffic.share_in_pool(scenario), least, most, low, high)
