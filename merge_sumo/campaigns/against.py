"""A campaign against an earlier version of the VUT: what does the new one fail that passed before?

Each case runs with both versions. The sampler is told the margin of a regression (`regression`), so
it searches for cases that the new version alone fails. `outcomes.jsonl` of the campaign has the
outcomes of the new version. Those of the earlier one, in the same cases, are in a folder of the
campaign that is a campaign's itself:

against/            campaign.json, outcomes.jsonl, trajectories/ of the earlier version

There `foretold` is what was predicted of the regression.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable, Sequence
from dataclasses import replace
from typing import Final

from merge_sumo.campaigns.scheduler import motions_of
from merge_sumo.engine.evaluate import evaluate
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.samplers.base import Sampler
from merge_sumo.scenario.case import Case
from merge_sumo.system.workers import Workers
from merge_sumo.twin.pair import TwinPair
from merge_sumo.verdict.episode import Episode
from merge_sumo.verdict.regression import regression

FIRST_BATCH: Final = 5
"""Cases of each level in the first batch where twins predict, which they do from four cases on.
Measured with design2 and design2?x1_m=120 at level 2, seeds 0 to 4: after 40 cases .81 of what
broke is found in the median, and .69 with ten.
"""


def evaluate_both(
    new: SimulationPlan, old: SimulationPlan, workers: Workers, groups: Iterable[Sequence[Case]]
) -> Generator[tuple[int, list[Episode]], None, None]:
    """Run groups of cases with both versions of the VUT.

    Yields (place, episode by the new version, with that by the earlier one), as of `evaluate`.
    """
    first, plans = 0, [old, new]
    for cases in groups:
        before = dict(evaluate(plans[0], cases, workers))
        for place, episode in evaluate(plans[1], cases, workers):
            pair = before[place], episode
            earlier, later = pair if plans[1] is new else reversed(pair)
            yield first + place, [replace(later, earlier=earlier)]
        first += len(cases)
        # The simulator of the version that ran last is still open.
        plans.reverse()


def tell_both(sampler: Sampler, episodes: Sequence[Episode]) -> None:
    """Tell a sampler what both versions did in the same cases: the regressions."""
    old = [episode.earlier for episode in episodes if episode.earlier is not None]
    if isinstance(sampler.predictor, TwinPair):
        sampler.predictor.tell_old([one.outcome for one in old], motions_of(old))
    regressions = [
        regression(new.outcome, before.outcome, before.outcome.prediction)
        for new, before in zip(episodes, old, strict=True)
    ]
    sampler.tell(regressions, motions_of(episodes))
