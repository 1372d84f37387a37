"""With how many cars of the mainline a merge fails, in a traffic of stated density and speeds.

In stationary traffic of k cars per metre, whose speeds are independent of their places, the
expected number of mainline cars with which a merge fails is

    N = k * integral dx E_v[P(fail | x, v)]

(Campbell's formula): no process of arrivals is assumed, and headways may depend on each other, as
each car is judged by itself. The pool's uniform x is natural as it is, and v is weighed; so N is
the number of cars that start in the pool, times their P(fail), whose interval is that of
`stratified.py`.

How common levels and orientations are on a road is not known. N is linear in their shares, so over
all mixtures it lies between the least and the most of the levels and of `PSI_PARTS` equal ranges
of psi; where the traffic states a range of its standard deviation, of both ends of it, too.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.analysis.exposure import Distribution, Marginal, Uniform
from merge_sumo.analysis.traffic import SpeedsInPool, Traffic
from merge_sumo.errors import UserError
from merge_sumo.studies.probability import (
    STREAM,
    Expected,
    cases_of,
    check_numbers,
    lines_beside,
    notes_of,
    run_fresh,
    strata_of,
    write_result,
)
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.studies.stratified import UPPER_RISK, Draws, Estimate, Strata, estimate
from merge_sumo.system.records import Record, read_record
from merge_sumo.values.scenario import MergeScenario, Scenario, as_merge
from merge_sumo.values.score import Outcome

RESULT: Final = "failures-per-merge.json"
DEFAULT_CASES: Final = 8000
PSI_PARTS: Final = 3
"""Ranges of psi at level 2, in each of which psi is uniform."""
X, V, PSI = "x_pov0_m", "v_pov0_mps", "svo_rad"
Bounds = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Part:
    """POVs of one level, in one range of psi, in traffic of one standard deviation of speeds.

    Attributes:
        level: the level.
        svo_rad: range of psi; None below level 2.
        speed_sd_mps: the standard deviation, where the traffic states a range of it.
        cars: mainline cars that start in the pool, per merge.
        failures_per_merge: those of them with which a merge is expected to fail.
        low: end of the interval.
        high: end of the interval.
        estimate: P(fail) of such a car, and what it rests on.
    """

    level: int
    svo_rad: Bounds | None
    speed_sd_mps: float | None
    cars: float
    failures_per_merge: float
    low: float
    high: float
    estimate: Estimate


@dataclass(frozen=True, slots=True)
class OverMixtures:
    """Failures per merge over all mixtures of some parts.

    Attributes:
        least: estimate for the mixture with the fewest.
        most: for that with the most.
        low: end of the interval, which holds the failures per merge of every mixture.
        high: end of the interval.
    """

    least: float
    most: float
    low: float
    high: float

    @classmethod
    def of(cls, parts: Iterable[Part]) -> OverMixtures:
        """Return the range of parts.

        Each part's ends are wrong by the same chances. The low end is above the fewest only where
        the end of that part is, and the high one below the most likewise: so all mixtures are
        inside with the confidence of a part.
        """
        known = list(parts)
        found = [part.failures_per_merge for part in known]
        low, high = min(part.low for part in known), max(part.high for part in known)
        return cls(min(found), max(found), low, high)


@dataclass(frozen=True, slots=True)
class FailuresPerMerge:
    """How many mainline cars a merge is expected to fail with.

    Attributes:
        all_levels: over all mixtures of the levels of the campaign, and of psi.
        levels: by level.
        parts: what they rest on.
        traffic: the traffic.
        x_m: where the cars start that are counted.
        v_mps: how fast they are then.
        outside: shares of the traffic's speeds outside the pool, least and most.
        confidence: chance that an interval holds.
        cases: fresh cases.
        without_verdict: cases that ended as VUT_ERROR or SIM_ERROR.
    """

    all_levels: OverMixtures
    levels: dict[int, OverMixtures]
    parts: tuple[Part, ...]
    traffic: Traffic
    x_m: Bounds
    v_mps: Bounds
    outside: Bounds
    confidence: float
    cases: int
    without_verdict: int

    @property
    def counted(self) -> str:
        """What is counted, and what is not, in a sentence."""
        (x_low, x_high), (v_low, v_high) = self.x_m, self.v_mps
        cars = _range((min(p.cars for p in self.parts), max(p.cars for p in self.parts)), ".2g")
        return (
            f"counted per merge: {cars} mainline cars, those that start in the pool, from "
            f"{x_low:g} to {x_high:g} m at {v_low:g} to {v_high:g} m/s; not counted: cars "
            "that start elsewhere, and those at other speeds, "
            f"{_range(self.outside, '.0%')} of this traffic"
        )

    def to_record(self) -> dict[str, Any]:
        """Return the result as JSON keeps it."""
        return {
            **asdict(self.all_levels),
            "levels": {str(level): asdict(one) for level, one in self.levels.items()},
            "parts": [asdict(part) for part in self.parts],
            "traffic": self.traffic.record(),
            "x_m": list(self.x_m),
            "v_mps": list(self.v_mps),
            "outside": list(self.outside),
            "counted": self.counted,
            "confidence": self.confidence,
            "cases": self.cases,
            "without_verdict": self.without_verdict,
        }


class PerMergeFile(Record, frozen=True):
    """What the file of a result says; its fields are those of `FailuresPerMerge`.

    Attributes:
        counted: what is counted, and what is not, in a sentence.
        seed: of the draws.
        engine: what moved the vehicles.
        campaign: settings of the campaign that it is of.
    """

    least: float
    most: float
    low: float
    high: float
    levels: dict[str, OverMixtures]
    parts: list[dict[str, Any]]
    traffic: Traffic
    x_m: Bounds
    v_mps: Bounds
    outside: Bounds
    counted: str
    confidence: float
    cases: int
    without_verdict: int
    seed: int
    engine: str
    campaign: dict[str, Any]


def per_merge_of(folder: Path) -> PerMergeFile | None:
    """Return what the folder of a campaign says of failures per merge; None where it says nothing.

    Raises `UserError` for a file that is not as it was written.
    """
    return read_record(folder / RESULT, PerMergeFile)


def _range(ends: Bounds, digits: str) -> str:
    low, high = (format(end, digits) for end in ends)
    return low if low == high else f"{low} to {high}"


@dataclass(frozen=True, slots=True)
class Stated:
    """A part before its cases have run.

    Attributes:
        level: the level.
        svo_rad: range of psi; None below level 2.
        speeds: the speeds within the pool.
        cars: mainline cars that start in the pool, per merge.
        distribution: of its cases.
    """

    level: int
    svo_rad: Bounds | None
    speeds: SpeedsInPool
    cars: float
    distribution: Distribution


def parts_of(traffic: Traffic, scenario: Scenario, levels: Sequence[int]) -> list[Stated]:
    """Return the parts whose mixtures the cars of a traffic are.

    Raises `UserError` where the scenario has no coordinates of a single car of the mainline, or the
    traffic has no density, or next to no speeds in the pool.
    """
    merge = _single(scenario)
    by_name = {d.field: d for d in merge.dimensions(2)}
    density, (x_low, x_high) = traffic.density_veh_per_m, merge.x_pov0_m
    found = []
    for speeds in traffic.speeds_within(by_name[V]):
        cars = density * (x_high - x_low) * speeds.share
        for level in levels:
            has_psi = PSI in {d.field for d in merge.dimensions(level)}
            ends = np.linspace(by_name[PSI].low, by_name[PSI].high, PSI_PARTS + 1).tolist()
            ranges: list[Bounds | None] = [*pairwise(ends)] if has_psi else [None]
            for svo_rad in ranges:
                marginals: dict[str, Marginal] = {
                    name: Uniform(low=d.low, high=d.high) for name, d in by_name.items()
                }
                marginals[V] = speeds.marginal
                if svo_rad is not None:
                    marginals[PSI] = Uniform(low=svo_rad[0], high=svo_rad[1])
                stated = Distribution({level: 1.0}, marginals, merge)
                found.append(Stated(level, svo_rad, speeds, cars, stated))
    return found


def _single(scenario: Scenario) -> MergeScenario:
    merge = as_merge(scenario)
    if merge.vehicles > 2:
        raise UserError(
            f"{merge.name} has cars ahead of the POV and behind it, at headways of its own: a "
            "traffic needs a scenario without them"
        )
    return merge


def failures_per_merge(
    study: RunStudy,
    traffic: Traffic,
    out: Path,
    *,
    cases: int = DEFAULT_CASES,
    confidence: float = 0.95,
    seed: int = 0,
) -> FailuresPerMerge:
    """Estimate with how many mainline cars a merge of a campaign's VUT fails, with fresh cases.

    Writes the result to `out`, and the fresh outcomes, with the number of their part, to the file
    of the same name that ends in .jsonl.

    Args:
        study: as of `failure_probability`.
        traffic: the traffic on the mainline.
        out: new file, which ends in .json.
        cases: fresh cases of all parts, which get about as many each.
        confidence: chance that an interval holds.
        seed: of the draws.

    Raises:
        UserError: as `failure_probability`, and where traffic and scenario do not go together.
    """
    check_numbers(cases, confidence, seed)
    settings = study.settings
    stated = parts_of(traffic, settings.scenario, settings.levels)
    if cases < len(stated):
        raise UserError(f"--cases is {cases}: give {len(stated)} or more, one for each part")
    study.check_same_system()
    lines = lines_beside(out)
    expected = Expected(study)
    shared = [len(part) for part in np.array_split(np.arange(cases), len(stated))]
    drawn, chosen, notes = [], [], []
    for number, (part, share) in enumerate(zip(stated, shared, strict=True)):
        strata = strata_of(expected, settings.scenario, part.distribution, share, confidence)
        draws = strata.draw(np.random.default_rng([seed, STREAM, number]))
        drawn.append((strata, draws))
        chosen += cases_of(settings, part.distribution, draws)
        notes += [{"part": number, **note} for note in notes_of(draws)]
    outcomes = run_fresh(study, chosen, notes, lines)
    result = result_of(traffic, settings.scenario, stated, drawn, outcomes, confidence)
    write_result(out, study, result.to_record(), seed)
    return result


def result_of(
    traffic: Traffic,
    scenario: Scenario,
    stated: Sequence[Stated],
    drawn: Sequence[tuple[Strata, Draws]],
    outcomes: Sequence[Outcome],
    confidence: float,
) -> FailuresPerMerge:
    """Return the result from the outcomes of the draws of all parts, one part after the other."""
    failed = np.array([outcome.failed for outcome in outcomes])
    judged = np.array([outcome.score is not None for outcome in outcomes])
    parts, first = [], 0
    for part, (strata, draws) in zip(stated, drawn, strict=True):
        own = slice(first, first + len(draws.level))
        first = own.stop
        parts.append(part_of(part, strata, draws, failed[own], judged[own], confidence))
    outside = [1.0 - part.speeds.share for part in stated]
    merge = as_merge(scenario)
    by_level = {
        level: OverMixtures.of(part for part in parts if part.level == level)
        for level in dict.fromkeys(part.level for part in parts)
    }
    return FailuresPerMerge(
        all_levels=OverMixtures.of(parts),
        levels=by_level,
        parts=tuple(parts),
        traffic=traffic,
        x_m=merge.x_pov0_m,
        v_mps=merge.v_pov0_mps,
        outside=(min(outside), max(outside)),
        confidence=confidence,
        cases=len(outcomes),
        without_verdict=int((~judged).sum()),
    )


def part_of(
    stated: Stated,
    strata: Strata,
    draws: Draws,
    failed: np.ndarray[Any, np.dtype[np.bool_]],
    judged: np.ndarray[Any, np.dtype[np.bool_]],
    confidence: float,
) -> Part:
    """Return the failures per merge of a part: which of its draws, (n,), failed, had a verdict."""
    # The same chances for all parts, so that those of a mixture's ends add up to no more.
    risk = (1.0 - UPPER_RISK) * (1.0 - confidence), UPPER_RISK * (1.0 - confidence)
    found = estimate(strata, draws, failed, judged, confidence, risk)
    low, middle, high = (stated.cars * p for p in (found.low, found.probability, found.high))
    sd_mps = stated.speeds.sd_mps
    return Part(stated.level, stated.svo_rad, sd_mps, stated.cars, middle, low, high, found)
