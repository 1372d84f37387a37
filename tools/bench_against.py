"""Measure how many of the failures of a new version a campaign against the old version finds.

    python tools/bench_against.py --seeds 10 --first 1000

A regression is a case that only the new version fails. There are three pairs of versions, at one
POV level each: `design2` that gives way later, a controller with a longer reaction time, and `gap`,
on an acceleration lane, that accepts shorter gaps. Dense truths of both versions have the same
uniform cases, and so contain the regressions.

The script prints the share of the regressions within the radius of FMC of a regression that was
found, after 40 cases: the median, the minimum and the maximum over the seeds.

- `against`: a campaign against the old version;
- `independent`: a campaign of each version, whose failures run again with the other version;
- `oracle`: greedy picks among the regressions of the truth.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from statistics import median
from typing import Any

from measuring import append_record, benchmark_parser, spread
from oracle import greedy_cover

from merge_sumo.analysis.sampler_study import search
from merge_sumo.analysis.truth import ground_truth
from merge_sumo.campaigns.campaign import controller_model_of
from merge_sumo.campaigns.loop import Batches, SearchLoop
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.fmc import covered
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.samplers.controller_model import ControllerModelPair
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import Case, FloatArray, to_unit
from merge_sumo.simulation.evaluate import simulate

TRIALS = Path(__file__).parent / "trial_vuts.py"
LATER = "design2?x1_m=120"


@dataclass(frozen=True)
class Pair:
    """Two versions of a VUT, and where they drive."""

    new: str
    old: str
    level: int = 0
    scenario: str = "us23"

    def settings(self, cases: int, seed: int) -> CampaignSettings:
        """Return the settings of a campaign of the new version against the old one.

        Args:
            cases: number of cases.
            seed: seed of the campaign.
        """
        scenario = named_scenario(self.scenario)
        return CampaignSettings(
            vut=self.new,
            against=self.old,
            levels=(self.level,),
            cases=cases,
            seed=seed,
            scenario=scenario,
            fail_when=scenario.criterion,
        )


PAIRS = {
    "threshold, level 1": Pair(LATER, "design2", level=1),
    "threshold, level 2": Pair(LATER, "design2", level=2),
    "reaction": Pair(f"{TRIALS}:SlowerDelayed", f"{TRIALS}:Delayed"),
    "headway": Pair("gap?headway_s=.5", "gap?headway_s=.7", scenario="us23-lane"),
}


class Versions:
    """The plans of both versions, and the regressions of their truths, (m, d)."""

    def __init__(self, pair: Pair, truth_cases: int) -> None:
        self.pair = pair
        self.both = pair.settings(1, 0).load_plan().with_engine(None)
        self.new = replace(self.both, against=None)
        assert self.both.earlier is not None, "a pair"  # noqa: S101
        self.old = self.both.earlier
        new, old = (ground_truth(one, pair.level, truth_cases) for one in (self.new, self.old))
        breaks = (new.margin < 0.0) & ~(old.margin < 0.0)
        self.regressions = new.points[breaks]
        self.shares = {
            "new fails": len(new.failures) / truth_cases,
            "old fails": len(old.failures) / truth_cases,
            "regressions": len(self.regressions) / truth_cases,
        }

    def covered(self, found: FloatArray) -> float:
        """Return the share of the regressions of the truth near a regression that was found.

        Args:
            found: regressions that were found, (m, d).
        """
        return float(covered(self.regressions, found).mean())

    def against(self, cases: int, seed: int) -> FloatArray:
        """Return the regressions that a campaign against the old version finds, (k, d).

        Args:
            cases: number of cases.
            seed: seed of the campaign.
        """
        settings = self.pair.settings(cases, seed)
        models = ControllerModelPair(
            controller_model_of(self.both, settings.pool, seed),
            controller_model_of(self.old, settings.pool, seed),
        )
        sampler = make_sampler(settings.sampler, settings.pool, seed, models)
        groups: Batches = []
        SearchLoop(sampler, self.both, cases).run(groups.extend)
        return self._points(
            one.outcome.case
            for one in chain.from_iterable(groups)
            if one.outcome.failed and one.earlier and passes(one.earlier.outcome)
        )

    def independent(self, cases: int, seed: int) -> FloatArray:
        """Return the regressions that two campaigns find, whose failures run with both, (k, d).

        Failures of the old version's campaign are no regressions, so that campaign need not run.

        Args:
            cases: number of cases of each campaign.
            seed: seed of the campaigns.
        """
        sampler = self.pair.settings(cases, seed).sampler
        (found,) = search(self.new, (self.pair.level,), cases, None, [(sampler, seed)])
        failing = [outcome.case for outcome in found.outcomes if outcome.failed]
        outcomes = [episode.outcome for episode in simulate(self.old, failing)]
        return self._points(outcome.case for outcome in outcomes if passes(outcome))

    def _points(self, cases: Iterable[Case]) -> FloatArray:
        return to_unit(cases, self.pair.level, self.new.scenario)


def passes(outcome: Outcome) -> bool:
    """Return whether a case has a verdict and does not fail.

    Args:
        outcome: outcome of the case.
    """
    return outcome.is_tested and not outcome.failed


def measured(pair: Pair, options: argparse.Namespace) -> dict[str, Any]:
    """Measure and print the covered share of the regressions of a pair.

    Args:
        pair: the versions.
        options: the options of the command line.

    Returns:
        Figures for the record: the truth, and the covered shares by seed of each kind of campaign.
    """
    versions = Versions(pair, options.truth)
    shares = ", ".join(f"{name} {share:.4f}" for name, share in versions.shares.items())
    print(f"  truth of {options.truth} cases: {shares}", flush=True)
    oracle = versions.covered(greedy_cover(versions.regressions, options.cases)[0])
    figures: dict[str, Any] = {"truth": versions.shares, "oracle": oracle}
    print(f"  oracle {oracle:.3f}")
    for name, campaign in (("against", versions.against), ("independent", versions.independent)):
        seeds = range(options.first, options.first + options.seeds)
        found = [campaign(options.cases, seed) for seed in seeds]
        figures[name] = [versions.covered(points) for points in found]
        number = median(len(points) for points in found)
        print(f"  {name:12} {spread(figures[name])}, {number:g} regressions", flush=True)
    return figures


def main() -> None:
    """Measure all pairs, or those that are named."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--pair", action="append", choices=PAIRS)
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--truth", type=int, default=10_000, help="cases per truth")
    options = parser.parse_args()
    figures = {}
    for name in options.pair or PAIRS:
        print(name)
        figures[name] = measured(PAIRS[name], options)
    append_record(options.record, "against", figures)


if __name__ == "__main__":
    main()
