"""Measure how often the interval of the share that fails holds the share of many more starts.

`python tools/bench_share.py`

Every built-in VUT drives 100,000 uniform cases of each level by the equations of motion: the truth.
Then each of some seeds has the 2,000 cases that a campaign with that seed would have, with their
interval. Printed are, by VUT and level, the truth and how many intervals hold it, and the total.
"""

from __future__ import annotations

import argparse
from typing import Any

from bench_record import add_record_option, append_record

from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.scenario.scenario import LEVELS, US23, level_name
from merge_sumo.studies.share import CASES, share_at, stream
from merge_sumo.vuts.built_in import BUILT_IN_VUTS

TRUTH_SEED = 20_000
"""Its random stream is that of no seed that is measured."""


def main() -> None:
    """Print how many intervals hold the truth."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--vut", nargs="*", default=sorted(BUILT_IN_VUTS))
    parser.add_argument("--truth-cases", type=int, default=100_000)
    parser.add_argument("--first", type=int, default=100, help="first seed")
    parser.add_argument("--seeds", type=int, default=4)
    add_record_option(parser)
    asked = parser.parse_args()
    seeds = range(asked.first, asked.first + asked.seeds)
    figures: dict[str, Any] = {}
    for vut in asked.vut:
        plan = resolve(CampaignSettings(vut=vut, levels=LEVELS, scenario=US23))
        for level in LEVELS:
            many = share_at(plan, level, asked.truth_cases, stream(TRUTH_SEED, level))
            truth = many.failures / many.cases
            drawn = [share_at(plan, level, CASES, stream(seed, level)) for seed in seeds]
            intervals = [one.interval for one in drawn]
            held = sum(low <= truth <= high for low, high in intervals)
            print(
                f"{vut}, level {level_name(level)}: {truth:.5f} fail, {held} of {len(seeds)} hold",
                flush=True,
            )
            figures[f"{vut}, level {level_name(level)}"] = {"truth": truth, "held": held}
    for title, some in (
        ("in all", list(figures.values())),
        ("where any fail", [one for one in figures.values() if one["truth"]]),
    ):
        held, pairs = sum(one["held"] for one in some), len(some) * len(seeds)
        print(f"{title}: {held} of {pairs} intervals hold the truth")
    append_record(asked.record, "share", figures)


if __name__ == "__main__":
    main()
