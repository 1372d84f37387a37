"""Merges of other sizes than the paper's."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from merge_sumo.scenario.scenario import US23, Scenario

LIKE_A_ROUNDABOUT = Scenario(
    name="ring",
    x_pov0_m=(-60.0, -20.0),
    v_pov0_mps=(4.0, 10.0),
    x_vut0_m=-40.02,
    v_vut0_mps=8.0,
    v_hw_min_mps=5.0,
    v_hw_max_mps=12.0,
    v_min_mps=2.0,
    ttc_min_s=3.0,
    dx_critical_m=12.0,
    level0_v_mps=9.0,
)
"""Short and slow, with the paper's accelerations. The VUT's start is off the lattice of 0.05 m:
else many ways end at M to the last bit, and rounding decides in which step."""


def times(scenario: Scenario, factor: float, units: tuple[str, ...]) -> Scenario:
    """Return a scenario with the numbers of some units multiplied."""

    def multiplied(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(factor * x for x in value)
        return None if value is None else factor * value

    changed = {
        field.name: multiplied(getattr(scenario, field.name))
        for field in fields(scenario)
        if field.name.endswith(units)
    }
    return replace(scenario, name="multiple", **changed)


HALF = times(US23, 0.5, ("_m", "_mps", "_mps2"))
"""The paper's at half the size and half the speeds; times are the same."""
SMALLER = replace(times(US23, 0.9, ("_m", "_mps")), dx_crash_m=6.0, dx_critical_m=15.0)
"""A ramp a tenth shorter and slower, with the same cars."""
