"""Check failures per merge by random traffic, and merges of this package against those of roads.

`python tools/check_failures_per_merge.py brute`

    Random stationary traffic on the mainline, by a Poisson process and by a renewal process with a
    least headway, at three densities: thousands of merges, each of which the VUT runs with every
    car that starts in the pool, one by one. Beside it, what `failures-per-merge` says after a
    campaign.

`python tools/check_failures_per_merge.py road`

    Merges on `us23-lane` among all cars of such traffic, also those outside the pool, with the
    density and the speeds of the shipped sites: the share in which a mainline car passes the VUT
    between the gore and the merge, beside that of the site. Exit code 0: it compares, and checks
    nothing.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.analysis.traffic import NormalSpeeds, Traffic, named_traffic
from merge_sumo.campaigns.campaign import run_campaign
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.engine.evaluate import CaseResults, evaluate
from merge_sumo.engine.plan import Engine, SimulationPlan
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.studies.failures_per_merge import OverMixtures, failures_per_merge
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.values.case import Case, FloatArray, MergeCase
from merge_sumo.values.scenario import US23, VUT, MergeScenario, as_merge
from merge_sumo.values.trajectory import Trajectory

DENSITIES: Final = (4.9, 8.7, 20.0)
"""In veh/km: two of the shipped sites, and a denser traffic."""
SPEEDS: Final = NormalSpeeds(mean=27.0, sd=2.85)
"""Of the traffic of `brute`, so that most cars are in the pool."""
LEAST_SHARE: Final = 0.4
"""Least headway of the renewal process, as a share of the mean one."""
FAR_M: Final = -450.0
"""No car that starts farther from M passes a VUT before the end of the lane."""
SITES: Final = {"exid-2": 0.077, "exid-3": 0.101, "exid-5": 0.011}
"""Share of merges in which a mainline car passes the merging one between gore and merge: types C
and F within 100 m. Li et al. 2023, arXiv 2303.11531."""
START_MPS: Final = 20.6
"""Mean speed of 23 ramp cars where their recordings begin (HEE, drone data of a German ramp)."""
SIZE: Final = 20_000


def places(
    process: str, density_veh_per_m: float, ends: tuple[float, float], rng: np.random.Generator
) -> FloatArray:
    """Return where the cars of a stationary traffic are between two ends, (n,)."""
    low, high = ends
    if process == "poisson":
        return rng.uniform(low, high, rng.poisson(density_veh_per_m * (high - low)))
    mean_m = 1.0 / density_veh_per_m
    least_m = LEAST_SHARE * mean_m
    # Twenty mean headways upstream the first car does not matter any more.
    count = int(30 + 3 * (high - low) * density_veh_per_m)
    x = low - 20.0 * mean_m + np.cumsum(least_m + rng.exponential(mean_m - least_m, count))
    return np.asarray(x[(x > low) & (x < high)], dtype=np.float64)


def merges(
    process: str,
    density: float,
    speeds: NormalSpeeds,
    ends: tuple[float, float],
    count: int,
    seed: int,
) -> tuple[NDArray[np.int64], FloatArray, FloatArray]:
    """Return the cars of `count` merges: number of the merge, place and speed of each, (n,)."""
    rng = np.random.default_rng(seed)
    each = [places(process, density / 1000.0, ends, rng) for _ in range(count)]
    merge = np.repeat(np.arange(count), [len(one) for one in each])
    x = np.concatenate(each)
    sd = speeds.sd if isinstance(speeds.sd, float) else float(np.mean(speeds.sd))
    return merge, x, np.abs(rng.normal(speeds.mean, sd, len(x)))


def brute(count: int, cases: int, vuts: Sequence[str], levels: Sequence[int], engine: str) -> bool:
    """Print and compare; return whether all of it agrees."""
    agrees = True
    for vut in vuts:
        settings = CampaignSettings(vut=vut, levels=tuple(levels), cases=400, scenario=US23)
        plan = resolve(settings).with_engine(engine)
        with tempfile.TemporaryDirectory() as folder:
            run = run_campaign(settings, resolve(settings), Path(folder) / "run")
            for density in DENSITIES:
                traffic = Traffic(
                    source="none", speeds=SPEEDS, density_veh_per_km=density, name="random"
                )
                out = Path(folder) / f"{density}.json"
                kinematic = plan.with_engine(Engine.KINEMATIC)
                study = RunStudy(run, settings, kinematic)
                found = failures_per_merge(study, traffic, out, cases=cases)
                for level in levels:
                    agrees &= _compare(vut, level, density, found.levels[level], count, plan)
    return agrees


def _compare(
    vut: str, level: int, density: float, one: OverMixtures, count: int, plan: SimulationPlan
) -> bool:
    low, high = one.low, one.high
    agrees = True
    (x_low, x_high), (v_low, v_high) = US23.x_pov0_m, US23.v_pov0_mps
    for seed, process in enumerate(("poisson", "renewal")):
        merge, x, v = merges(process, density, SPEEDS, (-900.0, 0.0), count, seed)
        inside = (x_low <= x) & (x <= x_high) & (v_low <= v) & (v <= v_high)
        failed = _failed(plan, level, x[inside], v[inside])
        per_merge = np.bincount(merge[inside], failed, count)
        mean, error = per_merge.mean(), 2.0 * per_merge.std() / np.sqrt(count)
        held = low <= mean + error and mean - error <= high
        agrees &= bool(held)
        print(
            f"{vut}, level {level}, {density:4g} veh/km, {process:7}: {mean:.4f} +- {error:.4f} in "
            f"{count} merges, formula [{low:.4f}, {high:.4f}]"
            f"{'' if low <= mean <= high else ', mean outside'}{'' if held else ', WRONG'}",
            flush=True,
        )
    return agrees


def _failed(plan: SimulationPlan, level: int, x: FloatArray, v: FloatArray) -> NDArray[np.bool_]:
    cases = [
        MergeCase(level=level, x_pov0_m=a, v_pov0_mps=b, scenario=US23)
        for a, b in zip(x.tolist(), v.tolist(), strict=True)
    ]
    failed = np.zeros(len(cases), dtype=bool)
    for place, outcome in evaluate(plan.for_cases(len(cases)), cases, None, _verdicts):
        failed[place] = outcome
    return failed


def _verdicts(results: CaseResults) -> list[bool]:
    return [verdict.failed for verdict in results.verdicts()]


def road(count: int, vuts: Sequence[str], levels: Sequence[int], start_mps: float) -> None:
    """Print how many merges have a mainline car pass, beside the sites."""
    lane = as_merge(named_scenario("us23-lane"))
    print(
        f"ramp drivers start at {-lane.x_vut0_m:g} m before M with {start_mps:g} m/s; cars of the "
        f"mainline one by one; {count} merges\n"
        f"{'':16}" + "".join(f"{name:>20}" for name in SITES)
    )
    print(f"{'on the road':16}" + "".join(f"{share:>20.1%}" for share in SITES.values()))
    for vut in vuts:
        for level in levels:
            shares = [_passed(lane, vut, level, name, count, start_mps) for name in SITES]
            cells = "".join(f"{a:>13.1%} ({b:4.1%})" for a, b in shares)
            print(f"{f'{vut}, level {level}':16}{cells}", flush=True)
    print("in brackets: merges in which the VUT passes a mainline car after the gore")


def _passed(
    lane: MergeScenario, vut: str, level: int, site: str, count: int, start_mps: float
) -> tuple[float, float]:
    """Return the shares of merges in which a car passes the VUT, and the VUT a car."""
    traffic = named_traffic(site)
    settings = CampaignSettings(vut=vut, levels=(level,), scenario=lane)
    plan = resolve(settings).with_engine(Engine.KINEMATIC)
    assert isinstance(traffic.speeds, NormalSpeeds)  # noqa: S101
    merge, x, v = merges(
        "renewal", 1000.0 * traffic.density_veh_per_m, traffic.speeds, (FAR_M, 0.0), count, 0
    )
    cases: list[Case] = [
        MergeCase(level=level, x_pov0_m=a, v_pov0_mps=b, v_vut0_mps=start_mps, scenario=lane)
        for a, b in zip(x.tolist(), v.tolist(), strict=True)
    ]
    sides = np.zeros(len(cases), dtype=np.int64)
    for place, side in evaluate(plan.for_cases(len(cases)), cases, None, _sides):
        sides[place] = side
    by_car, by_vut = (np.bincount(merge[sides == side], minlength=count) > 0 for side in (1, -1))
    return float(by_car.mean()), float(by_vut.mean())


def _sides(results: CaseResults) -> list[int]:
    return [_side(trajectory) for trajectory in results.trajectories]


def _side(trajectory: Trajectory) -> int:
    """Return 1 where the car passes the VUT between gore and merge, -1 where the VUT passes it."""
    ahead = trajectory.x_pov_m > trajectory.motion[:, VUT, 0]
    lane_m = as_merge(trajectory.case.scenario).lane_m or (0.0, 0.0)
    at_gore = int((trajectory.x_vut_m >= lane_m[0]).argmax())
    return int(ahead[-1]) - int(ahead[at_gore])


def main() -> None:
    """Print what was compared; exit code 1 where random traffic disagrees."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("part", choices=("brute", "road"))
    parser.add_argument("--merges", type=int, default=20_000)
    parser.add_argument("--cases", type=int, default=4000, help="fresh cases of the formula")
    parser.add_argument("--vut", nargs="+", default=None, metavar="SPEC")
    parser.add_argument("--level", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--start", type=float, default=START_MPS, help="of the ramp, in m/s")
    parser.add_argument("--engine", default=str(Engine.KINEMATIC), help="of the random traffic")
    args = parser.parse_args()
    if args.part == "road":
        road(args.merges, args.vut or ["level0", "gap"], args.level, args.start)
    elif not brute(
        args.merges, args.cases, args.vut or ["design1", "design2"], args.level, args.engine
    ):
        sys.exit(1)


if __name__ == "__main__":
    main()
