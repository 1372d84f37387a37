"""Measure the coverage and width of the intervals of `probability`.

    python tools/bench_probability.py

Each of 200 seeds runs a campaign of 400 cases of `design1` at level 0, and then estimates intervals
from 600 and from 100,000 fresh cases. The script prints how many intervals contain the probability,
and their mean width as a ratio to the interval of Clopper and Pearson from the same number of plain
cases. A truth of 1,000,000 uniform cases gives the share that fails. A fresh case is one of its
cases in the same stratum, so that each verdict is simulated.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from measuring import append_record, benchmark_parser

from merge_sumo.analysis.exposure import read_distribution
from merge_sumo.analysis.probability import (
    STREAM,
    Counted,
    cells_of,
    draw,
    estimate,
    expected_cells,
)
from merge_sumo.analysis.run_study import RunStudy
from merge_sumo.api import truth as truth_of
from merge_sumo.campaigns.campaign import run_campaign
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.summary import clopper_pearson
from merge_sumo.scenario.scenario import US23

SEEDS = range(1000, 1200)
CAMPAIGN = CampaignSettings(vut="design1", levels=(0,), cases=400, seed=5, scenario=US23)


def main() -> None:
    """Print how many intervals hold, and how wide they are."""
    parser = benchmark_parser(__doc__)
    parser.add_argument("--truth-cases", type=int, default=1_000_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        plan = CAMPAIGN.load_plan()
        study = RunStudy(run_campaign(CAMPAIGN, plan, Path(folder) / "run"), CAMPAIGN, plan)
        cells = expected_cells(study, read_distribution(None, (0,), US23))
    truth = truth_of("design1", 0, cases=options.truth_cases).truths[0]
    failing = truth.margin < 0.0
    shape = cells_of(US23, 0)
    number = np.ravel_multi_index(tuple((truth.points * shape).astype(np.int64).T), shape)
    banks = [failing[np.isin(number, one.numbers)] for one in cells]
    p, figures = sum(one.share * bank.mean() for one, bank in zip(cells, banks, strict=True)), {}
    for cases in (600, 100_000):
        held, widths = 0, []
        for seed in SEEDS:
            rng = np.random.default_rng([seed, STREAM])
            counted = [
                Counted(one, len(points), int(rng.choice(bank, len(points)).sum()), 0)
                for one, points, bank in zip(
                    cells, draw(cells, US23, cases, rng), banks, strict=True
                )
            ]
            found = estimate(counted, 0.95)
            held += found.low <= p <= found.high
            widths.append(found.high - found.low)
        low, high = clopper_pearson(round(p * cases), cases, 0.95)
        ratio = float(np.mean(widths)) / (high - low)
        print(f"{cases:,} cases: {held} of {len(SEEDS)} hold {p:.4f}, width {ratio:.2f} of plain")
        figures[str(cases)] = {"held": held, "width": ratio}
    append_record(options.record, "probability", figures)


if __name__ == "__main__":
    main()
