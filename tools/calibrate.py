"""Search what the paper does not give: the designs of the rule-based VUTs, and reward weights.

    python tools/calibrate.py designs                  designs against the policies
    python tools/calibrate.py designs --around JSON    beginning near one
    python tools/calibrate.py gaps                     of the VUT that accepts gaps
    python tools/calibrate.py weights FILE             reward weights, one JSON object a line

A design2 passes when it shows the paper's picture: no failure against the level-0 POV, at least
three failure regions well apart at level 1, few failures at level 2. Those rank high whose third
region is not small, whose failures at level 2 are many and in few regions, and around whose
failures dx grows step by step: a design that is close to failing before it fails, as controllers
are.
A design that accepts gaps passes when it never fails in the roundabout at level 0; all that do are
printed, with where they fail at the other levels.
For each set of weights, POV-1, VUT-1 and POV-2 are trained briefly in SUMO, and the first two
example runs are played. Designs are played in thousands of cases at once by eq. (4), which SUMO
follows to 1e-9. One JSON object per result, on standard output.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.gap_acceptance import GapAcceptanceVut, GapDesign
from merge_sumo.drivers.level0 import Level0Pov, Level0Vut
from merge_sumo.drivers.policies import load_driver, policies_of
from merge_sumo.drivers.rule_based import RuleBasedDesign, RuleBasedVut
from merge_sumo.metrics.fmc import RADIUS, fmc, regions
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.case import Case, FloatArray, from_unit, to_unit
from merge_sumo.scenario.scenario import DT_S, US23, Scenario

YIELDING = Case(level=1, x_pov0_m=-273.0, v_pov0_mps=33.0, scenario=US23)
"""The first example run of the paper."""
STALEMATE = Case(level=2, x_pov0_m=-273.0, v_pov0_mps=33.0, svo_rad=0.6, scenario=US23)
"""The second and the third."""


def gaps_at_m(cases: list[Case], pov: Driver, vut: Driver) -> tuple[FloatArray, FloatArray]:
    """Play cases side by side by eq. (4); return dx at M and the VUT's lowest acceleration, (n,).

    The cases are of one scenario. dx is infinite where the VUT does not arrive.
    """
    n, scenario = len(cases), cases[0].scenario
    for k, case in enumerate(cases):
        pov.begin(k, case)
        vut.begin(k, case)
    x_pov = np.array([case.x_pov0_m for case in cases])
    v_pov = np.array([case.v_pov0_mps for case in cases])
    x_vut, v_vut = np.full(n, scenario.x_vut0_m), np.array([case.v_vut0_mps for case in cases])
    active, dx, lowest = np.ones(n, dtype=bool), np.full(n, np.inf), np.zeros(n)
    for step in range(scenario.max_steps):
        scene = Scene.of_pair(active, np.full(n, step), x_pov, v_pov, x_vut, v_vut)
        a_pov = pov.act(scene) * active
        a_vut = np.clip(vut.act(scene), scenario.a_min_mps2, scenario.a_max_mps2) * active
        lowest = np.minimum(lowest, a_vut)
        x_pov, x_vut = x_pov + v_pov * DT_S * active, x_vut + v_vut * DT_S * active
        v_pov = np.maximum(v_pov + a_pov * DT_S, 0.0)
        v_vut = np.maximum(v_vut + a_vut * DT_S, 0.0)
        arrived = active & (x_vut >= 0.0)
        dx[arrived] = (x_pov - x_vut)[arrived]
        active = active & ~arrived
        # What has arrived stands at M, where no driver is asked for a distance before it.
        x_vut = np.minimum(x_vut, 0.0)
        if not active.any():
            break
    return dx, lowest


FEWEST: Final = 20
"""Failures at level 1 below which regions are chance."""
NEAR_MISS_M: Final = 14.0
"""Where cases miss by less than this around a region, dx grows out of it instead of jumping."""
CLIMBING: Final = 0.75
"""Share of the designs that are drawn near one of the best so far."""
GAIN_DRAWN: Final = 0.15
"""Share of those that also get another integral gain, and as many another derivative gain."""


@dataclass(frozen=True)
class Picture:
    """Where a design fails at a level; sizes of regions with the largest first."""

    failures: int
    fmc: float
    regions: list[int]
    near_misses_per_failure: float
    smallest_gap_m: float

    def share(self, regions: slice) -> float:
        """Return the share of the failures that some of the regions hold."""
        return sum(self.regions[regions]) / max(self.failures, 1)


class Bench:
    """The cases and POVs that designs are tried on."""

    def __init__(
        self,
        cases: int,
        policies: Path | None,
        levels: tuple[int, ...],
        scenario: Scenario = US23,
        seed: int = 0,
    ) -> None:
        """Draw cases for each level, twice as many at level 2, and load the POVs."""
        rng = np.random.default_rng(seed)
        policies = policies or policies_of(scenario)
        self.cases = {
            level: from_unit(
                rng.random((cases * 2, 3) if level == 2 else (cases, 2)),  # as many as truths have
                level,
                scenario=scenario,
            )
            for level in levels
        }
        self.povs: dict[int, Driver] = {0: Level0Pov(cases)}
        for level in levels:
            if level:
                self.povs[level] = load_driver(f"pov{level}", len(self.cases[level]), policies)
        self.one_pov = load_driver("pov2", 1, policies) if 2 in levels else None

    def at_level(
        self, design: RuleBasedDesign | GapDesign, level: int, apart: float = RADIUS
    ) -> Picture:
        """Return where a design fails at a level; regions are `apart` from each other."""
        cases = self.cases[level]
        vut: Driver
        if isinstance(design, GapDesign):
            vut = GapAcceptanceVut(len(cases), design)
        else:
            vut = RuleBasedVut(len(cases), design)
        dx, _ = gaps_at_m(cases, self.povs[level], vut)
        gap_m, crash_m = np.abs(dx), cases[0].scenario.dx_crash_m
        failed = gap_m < crash_m
        points = to_unit(
            (c for c, fails in zip(cases, failed, strict=True) if fails), level, scenario=US23
        )
        sizes = np.bincount(regions(points, apart)) if len(points) else np.zeros(0, np.int64)
        near = ((gap_m >= crash_m) & (gap_m < NEAR_MISS_M)).sum()
        return Picture(
            failures=len(points),
            fmc=round(fmc(points), 4) if len(points) else 0.0,
            regions=np.sort(sizes)[::-1].tolist(),
            near_misses_per_failure=round(float(near) / max(len(points), 1), 2),
            smallest_gap_m=round(float(gap_m.min()), 2),
        )

    def stalemate(self, design: RuleBasedDesign) -> dict[str, float]:
        """Return dx and the hardest braking of the VUT in the third example run."""
        assert self.one_pov is not None, "only asked where there is a level-2 POV"  # noqa: S101
        dx, lowest = gaps_at_m([STALEMATE], self.one_pov, RuleBasedVut(1, design))
        return {"dx_m": round(float(dx[0]), 2), "braking_mps2": round(-float(lowest[0]), 2)}


def draw(rng: np.random.Generator, around: RuleBasedDesign | None) -> RuleBasedDesign:
    """Draw a design at random, or near another one."""
    if around is not None:
        values = {
            name: value * float(np.exp(rng.normal(0.0, 0.08)))
            for name, value in asdict(around).items()
        }
        values["x2_m"] = min(values["x2_m"], values["x1_m"])
        near = RuleBasedDesign(**values)
        luck = rng.random()
        if luck < GAIN_DRAWN:
            return replace(near, kd=near.kp * 10.0 ** rng.uniform(-1.2, 0.2))
        if luck < 2.0 * GAIN_DRAWN:
            return replace(near, ki=near.kp * 10.0 ** rng.uniform(-1.0, 0.5))
        return near
    x1 = rng.uniform(90.0, 180.0)
    gap = rng.uniform(12.0, 32.0)
    kp = 10.0 ** rng.uniform(-1.6, 0.5)
    return RuleBasedDesign(
        x1_m=x1,
        x2_m=rng.uniform(25.0, 0.75 * x1),
        gap_m=gap,
        target_m=gap * rng.uniform(0.3, 1.3),
        kp=kp,
        kd=kp * 10.0 ** rng.uniform(-1.0, 0.5) * rng.integers(0, 2),
        lag_s=float(rng.choice([0.0, 0.0, 0.3, 0.6])),
    )


def try_design2(bench: Bench, design: RuleBasedDesign) -> dict[str, Any] | None:
    """Return the figures of a design that has the picture of design2 so far, else None."""
    level0 = bench.at_level(design, 0)
    if level0.smallest_gap_m < US23.dx_crash_m + 0.4:
        return None
    # Regions that stay apart in every sample of cases.
    level1 = bench.at_level(design, 1, apart=1.5 * RADIUS)
    third = level1.share(slice(2, 3))
    if level1.failures < FEWEST or third < 0.04 or not 0.05 <= level1.fmc <= 0.12:
        return None
    quality = 4.0 * min(third, 0.1)
    found: dict[str, Any] = {
        "design": {name: round(value, 4) for name, value in asdict(design).items()},
        "level0_smallest_gap_m": level0.smallest_gap_m,
        "level1": asdict(level1),
    }
    if 2 in bench.cases:
        level2 = bench.at_level(design, 2)
        if not 0.003 <= level2.fmc <= 0.02:
            return None
        quality += 0.04 * min(level2.failures, 45) + 0.5 * level2.share(slice(3))
        quality += 0.2 * min(level2.near_misses_per_failure, 2.0)
        found |= {"level2": asdict(level2), "stalemate": bench.stalemate(design)}
    return {"quality": round(quality, 3), **found}


def search_designs(options: argparse.Namespace) -> None:
    """Draw designs, most of them near the best so far, and print those that pass."""
    bench = Bench(options.cases, options.policies, tuple(map(int, options.levels.split(","))))
    rng = np.random.default_rng(options.seed)
    best: list[tuple[float, RuleBasedDesign]] = []
    if options.around:
        best.append((0.0, RuleBasedDesign(**json.loads(options.around))))
    for number in range(options.designs):
        climb = bool(best) and rng.random() < CLIMBING
        around = best[rng.integers(len(best))][1] if climb else None
        design = draw(rng, around)
        found = try_design2(bench, design)
        if found is not None:
            best = sorted([*best, (found["quality"], design)], key=lambda pair: -pair[0])[:8]
            print(json.dumps(found), flush=True)
        sys.stderr.write(f"\r{number + 1} designs, the best {best[0][0] if best else '-'}")
    sys.stderr.write("\n")


LINES_M: Final = (5.0, 6.0, 7.0, 9.0, 11.0)
"""The last is the yield line; at the first, the nose is in the lane of the ring."""
LEADS_S: Final = (1.6, 1.8, 2.0, 2.5)
LAGS_S: Final = (1.5, 2.0)
BRAKES_MPS2: Final = (1.0, 1.5, 2.0)


def search_gaps(options: argparse.Namespace) -> None:
    """Print where designs that accept gaps fail in the roundabout, if nowhere at level 0."""
    scenario = named_scenario("roundabout")
    bench = Bench(options.cases, options.policies, (0, 1, 2), scenario, options.seed)
    for numbers in itertools.product(LINES_M, LEADS_S, LAGS_S, BRAKES_MPS2):
        design = GapDesign(**dict(zip(GapDesign.__slots__, numbers, strict=True)))
        level0 = bench.at_level(design, 0)
        if level0.failures:
            continue
        found: dict[str, Any] = {
            "design": asdict(design),
            "level0_smallest_gap_m": level0.smallest_gap_m,
        }
        for level in (1, 2):
            picture = bench.at_level(design, level)
            found[f"level{level}"] = asdict(replace(picture, regions=picture.regions[:6]))
        print(json.dumps(found), flush=True)


def search_weights(options: argparse.Namespace) -> None:
    """Train a brief library for each set of weights and print how the example runs end."""
    from merge_sumo.training.ddqn import DdqnSettings
    from merge_sumo.training.helix import TrainingSettings, train_library
    from merge_sumo.training.refine import RefineSettings
    from merge_sumo.training.reward import RewardWeights

    for line in options.file.read_text(encoding="utf-8").splitlines():
        weights = RewardWeights(**json.loads(line))
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            settings = TrainingSettings(
                ddqn=DdqnSettings(updates=options.updates),
                refine=RefineSettings(rounds=4),
                check_cases=20,
            )
            names = ("pov1", "vut1", "pov2")
            train_library(folder, names, options.seed, weights, settings, scenario=US23)
            run1 = gaps_at_m([YIELDING], load_driver("pov1", 1, folder), Level0Vut(1))
            learned = load_driver("pov2", 1, folder), load_driver("vut1", 1, folder)
            run2 = gaps_at_m([STALEMATE], *learned)
            result = {
                "weights": asdict(weights),
                "run1_dx_m": round(float(run1[0][0]), 2),
                "run2_dx_m": round(float(run2[0][0]), 2),
            }
        print(json.dumps(result), flush=True)


def main() -> None:
    """Search."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    commands = parser.add_subparsers(required=True)
    designs = commands.add_parser("designs", help="search designs against the policies")
    designs.add_argument("--designs", type=int, default=200, help="designs to draw")
    designs.add_argument("--cases", type=int, default=10_000, help="cases per level")
    designs.add_argument("--seed", type=int, default=0)
    designs.add_argument("--policies", type=Path, help="folder of policies")
    designs.add_argument("--around", help="JSON of a design to draw near")
    designs.add_argument("--levels", default="0,1,2")
    designs.set_defaults(search=search_designs)
    gaps = commands.add_parser("gaps", help="designs that accept gaps, in the roundabout")
    gaps.add_argument("--cases", type=int, default=4_000, help="cases per level")
    gaps.add_argument("--seed", type=int, default=31, help="not that of a truth")
    gaps.add_argument("--policies", type=Path, help="folder of policies")
    gaps.set_defaults(search=search_gaps)
    weights = commands.add_parser("weights", help="screen sets of reward weights")
    weights.add_argument("file", type=Path, help="one JSON object of weights a line")
    weights.add_argument("--updates", type=int, default=15_000, help="of each brief training")
    weights.add_argument("--seed", type=int, default=0)
    weights.set_defaults(search=search_weights)
    options = parser.parse_args()
    options.search(options)


if __name__ == "__main__":
    main()
