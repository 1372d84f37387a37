"""A suggested scenario for a road, and sentences about a scenario before it is run."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from merge_sumo.drivers.level0 import level0_time_to
from merge_sumo.drivers.policies import policies_of, read_manifest, scenario_of
from merge_sumo.road.road import Road, lane_around_m
from merge_sumo.scenario.scenario import MAX_EPISODE_S, US23, V_VUT0_MPS, Bounds, Scenario, Units

MARGIN: Final = 0.15
"""The pool reaches this far beyond the starts from which both vehicles meet at M."""
SLOWEST: Final = 0.7
"""Of the speed limit: the mainline drives at least so fast."""
ROOM: Final = 0.98
"""Of the length of a path that is used."""
BEFORE_GORE_M: Final = 50.0
"""A VUT starts at least so far before an acceleration lane, where the ramp allows: 2 to 3 s."""
PATIENCE: Final = 2.0
"""Minimum timeout, as a multiple of the time of the level-0 profile to the end of the lane."""
FOLLOW_UP_S: Final = 5.0
"""Duration of the simulation after a merge on a lane, in s."""


def suggested_lane_m(road: Road) -> Bounds | None:
    """Return where a scenario has the acceleration lane, around the expected merge, in m.

    Args:
        road: the road.

    Returns:
        Begin and end; None without a lane on which a driver chooses where to merge.
    """
    lane = road.acceleration_lane
    return lane_around_m(lane.length_m) if lane is not None and lane.gives_a_choice else None


def suggested(road: Road, name: str) -> Scenario:
    """Return a scenario for a road: limits and lengths from the road, the rest as in the paper.

    The VUT starts as far from M as in the paper, or as the ramp allows, and before an acceleration
    lane; the POV where, at some speed that the mainline drives at, it is at M about when a VUT on
    the level-0 profile is.

    Args:
        road: the road.
        name: name of the scenario.
    """
    limit_mps = min(road.mainline.piece(-1.0).speed_limit_mps, US23.v_hw_max_mps)
    gore_m = road.used_lane_m[0] if road.used_lane_m else 0.0
    far_m = min(US23.x_vut0_m, gore_m - BEFORE_GORE_M)
    x_vut0_m = _down(max(far_m, gore_m - ROOM * (road.ramp.before_m + gore_m)))
    v_vut0_mps = round(min(V_VUT0_MPS, road.ramp.piece(x_vut0_m).speed_limit_mps), 1)
    level0_v_mps = round(min(US23.level0_v_mps, limit_mps), 1)
    lane_m = road.used_lane_m and suggested_lane_m(road)
    way_m = np.array([0.0, lane_m[1] if lane_m else 0.0]) - x_vut0_m
    profile = replace(US23, level0_v_mps=level0_v_mps)
    due_s, end_s = level0_time_to(way_m, np.array(v_vut0_mps), profile).tolist()
    slow, fast = round(SLOWEST * limit_mps, 1), round(limit_mps, 1)
    low = max(-fast * due_s * (1.0 + MARGIN), -ROOM * road.mainline.before_m)
    high = max(-slow * due_s * (1.0 - MARGIN), low / 2.0)
    return replace(
        US23,
        name=name,
        net=road.path.name,
        mainline=road.mainline_edges,
        ramp=road.ramp_edges,
        x_pov0_m=(_down(low), _down(high)),
        v_pov0_mps=(slow, fast),
        x_vut0_m=x_vut0_m,
        v_vut0_mps=v_vut0_mps,
        v_hw_min_mps=slow,
        v_hw_max_mps=fast,
        v_min_mps=round(min(US23.v_min_mps, 0.5 * v_vut0_mps), 1),
        level0_v_mps=level0_v_mps,
        reach_m=max(US23.reach_m, float(math.ceil(-low)), float(math.ceil(-x_vut0_m))),
        lane_m=lane_m,
        timeout_s=min(max(US23.timeout_s, float(math.ceil(PATIENCE * end_s))), MAX_EPISODE_S),
        follow_up_s=FOLLOW_UP_S if road.used_lane_m else US23.follow_up_s,
    )


def _down(x_m: float) -> float:
    return math.ceil(x_m * 10.0) / 10.0


def about(road: Road) -> list[str]:
    """Describe a road in lines.

    Args:
        road: the road.
    """
    lines = [f"net: {road.path.name}"]
    paths = {
        "mainline": (road.mainline, road.mainline_edges),
        "ramp": (road.ramp, road.ramp_edges),
    }
    if road.is_one_path:
        paths = {"lane of all vehicles": paths["mainline"]}
    for name, (path, edges) in paths.items():
        # Those after M, too: all drive on there.
        limits_mps = [piece.speed_limit_mps for piece in path.pieces]
        lines.append(
            f"{name}: {' '.join(edges)}, {path.before_m:.1f} m before M; lowest speed "
            f"limit {min(limits_mps):g} m/s, highest {max(limits_mps):g} m/s"
        )
    m = road.lane_point(0.0, on_ramp=road.used_lane_m is None)
    merge = f"M: lane {m.lane} at ({m.x_m:.1f}, {m.y_m:.1f})"
    if road.is_one_path:
        return [*lines, merge]
    lane = road.acceleration_lane
    if lane is not None:
        ends = f"{' '.join(lane.lanes)}, from {lane.begin_m:.1f} m, the gore, to {lane.end_m:.1f} m"
        if road.used_lane_m is not None:
            merge += ", where a merge is expected"
            return [*lines, f"acceleration lane: {ends}", merge]
        lines.append(f"lane next to the mainline, not used as an acceleration lane: {ends}")
    lines.append(f"{merge}, junction {road.junction_type}")
    yields = road.mainline_approach.yields, road.ramp_approach.yields
    first = {
        (True, False): "the ramp has priority (did you swap mainline and ramp?)",
        (False, True): "the mainline has priority",
    }
    lines.append(f"right of way: {first.get(yields, 'neither road has priority')}")
    if road.lane_drop:
        lines.append("one path reaches M on a lane that ends")
    return lines


ALIKE: Final = 0.25
"""Maximum difference of a number from training, as a share of the number, and maximum excess over
a range of training, as a share of its width. In random scenarios within these bounds, the shipped
POV-1 and VUT-1 had a mean regret of up to 4 % and had no avoidable collision; outside, the regret
was up to 136 %."""


def unseen(scenario: Scenario, policies: Path | None = None) -> list[str]:
    """Return the differences of a scenario from the training of the learned drivers, in sentences.

    The drivers measure in the units of the scenario that they play, so its numbers are compared
    after a conversion into the units of training. Outside, levels 1 and 2 are extrapolations.

    Args:
        scenario: the scenario.
        policies: folder of the drivers; by default the shipped ones for the scenario.
    """
    folder = policies or policies_of(scenario)
    trained = {scenario_of(entry) for entry in read_manifest(folder).values()}
    if not trained:
        return [f"{folder} has no learned drivers"]
    found = [sentence for known in trained for sentence in _differences(scenario, known)]
    return list(dict.fromkeys(found))


def _differences(scenario: Scenario, trained: Scenario) -> list[str]:
    """Return the numbers of a scenario that differ from training, in sentences."""
    unit, known = Units.of(scenario), Units.of(trained)
    length, speed = known.length / unit.length, known.speed / unit.speed
    time = known.time / unit.time
    acceleration = speed / time
    factors = {
        "x_pov0_m": length,
        "v_pov0_mps": speed,
        "v_vut0_mps": speed,
        "v_hw_min_mps": speed,
        "v_hw_max_mps": speed,
        "v_min_mps": speed,
        "a_min_mps2": acceleration,
        "a_max_mps2": acceleration,
        "level0_a_mps2": acceleration,
        "ttc_min_s": time,
        "dx_crash_m": length,
        "dx_critical_m": known.gap / unit.gap,
    }
    # Initial speeds are relative to the slowest speed of the mainline.
    slower_mps = trained.v_hw_min_mps - speed * scenario.v_hw_min_mps
    sentences = []
    for name, factor in factors.items():
        offset = slower_mps if name in ("v_pov0_mps", "v_vut0_mps") else 0.0
        low, high = (factor * bound + offset for bound in scenario.bounds(name))
        known_low, known_high = trained.bounds(name)
        pool = trained.bounds("v_pov0_mps" if name == "v_vut0_mps" else name)
        margin = ALIKE * (pool[1] - pool[0] or abs(known_low))
        if low < known_low - margin or high > known_high + margin:
            sentences.append(
                f"{name} {_range(*scenario.bounds(name))} corresponds to {_range(low, high)} in "
                f"{trained.name}; training used {_range(known_low, known_high)}"
            )
    return sentences


def _range(low: float, high: float) -> str:
    return f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
