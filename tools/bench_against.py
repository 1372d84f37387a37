"""How much of what a new version breaks a campaign against the old version finds.

    python tools/bench_against.py --seeds 10 --first 1000

Pairs of versions, at one level each: `design2` that gives way later, a controller with a longer
reaction time, and `gap`, on an acceleration lane, that accepts shorter gaps. A dense truth of each
version has the same space-filling cases; those that the new version alone fails are the regressions
of the truth. The share of these within the radius of the FMC of a regression that was found is
printed after 40 cases, as median with the least and the most over the seeds:

- of a campaign against the old version;
- of two independent campaigns of as many cases, whose failures run again with the other version;
- of as many greedy picks among the regressions of the truth (oracle).
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from bench_record import add_record_option, append_record
from scipy.spatial import cKDTree

from merge_sumo.campaigns.campaign import controller_model_of
from merge_sumo.campaigns.loop import Groups, SearchLoop
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.fmc import radius_for
from merge_sumo.metrics.outcome import Episode
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.samplers.candidates import spread_out
from merge_sumo.samplers.controller_model import ControllerModelPair
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import Case, FloatArray, to_unit
from merge_sumo.simulation.evaluate import evaluate
from merge_sumo.simulation.plan import SimulationPlan

sys.path.append(str(Path(__file__).parent / "benchmark"))
from oracle import greedy_cover

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
        """Return the settings of a campaign of the new version against the old one."""
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
        settings = pair.settings(1, 0)
        self.new = resolve(settings).with_engine(None)
        old = self.new.earlier
        assert old is not None, "a pair"  # noqa: S101
        self.old = old
        dims = settings.scenario.dimensions(pair.level)
        points = spread_out(truth_cases, len(dims), np.random.default_rng(7))
        cases = settings.pool.cases(points, pair.level)
        new = _failed(replace(self.new, against=None), cases)
        old_failed = _failed(self.old, cases)
        self.regressions = points[new & ~old_failed]
        self.shares = {
            "new fails": float(new.mean()),
            "old fails": float(old_failed.mean()),
            "regressions": len(self.regressions) / truth_cases,
        }

    def covered(self, found: FloatArray) -> float:
        """Return the share of the truth's regressions near one that was found."""
        if not len(found):
            return 0.0
        distance, _ = cKDTree(found).query(self.regressions)
        return float((distance <= radius_for(found.shape[1])).mean())

    def against(self, cases: int, seed: int) -> FloatArray:
        """Return the regressions that a campaign against the old version finds, (k, d)."""
        settings = self.pair.settings(cases, seed)
        models = ControllerModelPair(
            controller_model_of(self.new, settings.pool, settings.seed),
            controller_model_of(self.old, settings.pool, settings.seed),
        )
        sampler = make_sampler(settings.sampler, settings.pool, seed, models)
        groups: Groups = []
        SearchLoop(sampler, self.new, cases).run(groups.extend)
        broke = [
            one.outcome.case
            for one in chain.from_iterable(groups)
            if one.outcome.failed and one.earlier and _passes(one.earlier)
        ]
        return self._points(broke)

    def independent(self, cases: int, seed: int) -> FloatArray:
        """Return the regressions that two campaigns find, whose failures run with both, (k, d).

        The failures of the old version's campaign are none, so that campaign need not run.
        """
        settings = replace(self.pair.settings(cases, seed), against=None)
        model = controller_model_of(self.new, settings.pool, settings.seed)
        sampler = make_sampler(settings.sampler, settings.pool, seed, model)
        groups: Groups = []
        SearchLoop(sampler, replace(self.new, against=None), cases).run(groups.extend)
        ran = chain.from_iterable(groups)
        failing = [one.outcome.case for one in ran if one.outcome.failed]
        passes = [_passes(episode) for episode in evaluate(self.old, failing)]
        return self._points(case for case, broke in zip(failing, passes, strict=True) if broke)

    def _points(self, cases: Iterable[Case]) -> FloatArray:
        return to_unit(cases, self.pair.level, self.new.scenario)


def _failed(plan: SimulationPlan, cases: Sequence[Case]) -> Any:
    return np.array(list(evaluate(plan, cases, None, _has_failed)), dtype=bool)


def _has_failed(episode: Episode) -> bool:
    return episode.outcome.failed


def _passes(episode: Episode) -> bool:
    return episode.outcome.is_tested and not episode.outcome.failed


def measured(pair: Pair, arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the shares that are found of what a pair's new version breaks, and print them."""
    versions = Versions(pair, arguments.truth)
    said = ", ".join(f"{name} {share:.4f}" for name, share in versions.shares.items())
    print(f"  truth of {arguments.truth} cases: {said}", flush=True)
    oracle = versions.covered(greedy_cover(versions.regressions, arguments.cases)[0])
    figures: dict[str, Any] = {"truth": versions.shares, "oracle": oracle}
    print(f"  oracle {oracle:.3f}")
    for name in ("against", "independent"):
        found = [
            getattr(versions, name)(arguments.cases, seed)
            for seed in range(arguments.first, arguments.first + arguments.seeds)
        ]
        shares = [versions.covered(points) for points in found]
        figures[name] = {
            "median": statistics.median(shares),
            "least": min(shares),
            "most": max(shares),
            "found": statistics.median(map(len, found)),
        }
        row = " ".join(f"{key} {value:.3f}" for key, value in figures[name].items())
        print(f"  {name:12} {row}", flush=True)
    return figures


def main() -> None:
    """Measure all pairs, or those that are named."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--pair", action="append", choices=PAIRS)
    parser.add_argument("--cases", type=int, default=40)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--truth", type=int, default=10_000, help="cases of a truth")
    add_record_option(parser)
    arguments = parser.parse_args()
    figures = {}
    for name in arguments.pair or PAIRS:
        print(name)
        figures[name] = measured(PAIRS[name], arguments)
    settings = {name: getattr(arguments, name) for name in ("cases", "seeds", "first", "truth")}
    append_record(arguments.record, "against", {**settings, "pairs": figures})


if __name__ == "__main__":
    main()
