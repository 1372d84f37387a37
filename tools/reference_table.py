"""Print the site's table of built-in VUTs, SUMO's models and reference drivers.

python tools/reference_table.py                         all of them, 1,000 uniform cases a level
python tools/reference_table.py --cases 100 design2     fewer cases, of one VUT

The columns are failures and timeouts at POV levels 0, 1 and 2; the failure mode coverage of these
failures; how many of them the careful driver and the fuzzy safety model avoid in the VUT's place;
and the median of the latest times at which the fuzzy safety model can take over.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path

from merge_sumo.analysis.counterfactuals import TAKES_OVER, write_avoidance
from merge_sumo.analysis.run_study import RunStudy
from merge_sumo.campaigns.campaign import run_campaign
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.drivers.reference_drivers import REFERENCE_DRIVERS
from merge_sumo.metrics.summary import summarise
from merge_sumo.scenario.scenario import LEVELS, US23
from merge_sumo.scenario.trajectory import End
from merge_sumo.workers import open_workers

MODELS = ("Krauss", "IDM", "EIDM", "ACC", "CACC")
VUTS = (
    *("design1", "design2", "level1", "level2"),
    *(f"sumo:{model}" for model in MODELS),
    *("level0", *REFERENCE_DRIVERS),
)
HEAD = (
    "| VUT | failures at levels 0, 1, 2 | timeouts | FMC at levels 0, 1, 2 | avoided by `careful` "
    "| by `fsm` | `fsm` takes over until |\n|---|---|---|---|---|---|---|"
)


def row(vut: str, cases: int, workers: int | None) -> str:
    """Run uniform cases at each level, and return the line of the table.

    Args:
        vut: spec of the VUT.
        cases: cases at each level.
        workers: number of processes; None for one a core.
    """
    failures, timeouts, coverage, known, times = [], 0, [], 0, []
    avoided = dict.fromkeys(("careful", TAKES_OVER), 0)
    with tempfile.TemporaryDirectory() as folder:
        for level in LEVELS:
            settings = CampaignSettings(
                vut=vut,
                levels=(level,),
                sampler="uniform",
                cases=cases,
                batch=min(cases, 500),
                scenario=US23,
            )
            plan = settings.load_plan()
            with open_workers(plan.workers(workers)) as there:
                run = run_campaign(settings, plan, Path(folder) / str(level), workers=there)
                failing = write_avoidance(RunStudy(run, settings, plan, there))
            found = summarise(run.outcomes, (level,)).levels[level]
            failures.append(found.failures)
            coverage.append(f"{found.fmc:.4f}")
            timeouts += sum(o.measures.end is End.TIMEOUT for o in run.outcomes)
            for one in failing:
                known += 1
                for name in avoided:
                    avoided[name] += name in one.avoided_by
                if one.latest_takeover_s is not None:
                    times.append(one.latest_takeover_s)
    shares = " | ".join(f"{count} of {known}" if known else "–" for count in avoided.values())
    until = f"{statistics.median(times):.1f} s" if times else "–"
    counts = ", ".join(map(str, failures))
    return f"| `{vut}` | {counts} | {timeouts} | {', '.join(coverage)} | {shares} | {until} |"


def main() -> None:
    """Print the table line by line."""
    parser = argparse.ArgumentParser(description="Print the table of VUTs that the site has.")
    parser.add_argument("vuts", nargs="*", default=VUTS)
    parser.add_argument("--cases", type=int, default=1000, help="uniform cases at each level")
    parser.add_argument("--workers", type=int, help="processes; by default one per core")
    arguments = parser.parse_args()
    print(HEAD, flush=True)
    for vut in arguments.vuts:
        print(row(vut, arguments.cases, arguments.workers), flush=True)


if __name__ == "__main__":
    main()
