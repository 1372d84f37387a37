"""Records of release 0.1, upgraded to the fields of this one."""

from __future__ import annotations

import math
from typing import Any

from merge_sumo.values.merge import REACTION_S, needed_braking_mps2
from merge_sumo.values.scenario import Scenario
from merge_sumo.values.severity import severity_of
from merge_sumo.values.trajectory import End


def upgrade_from_0_1(values: dict[str, Any], scenario: Scenario) -> None:
    """Give a record of release 0.1 the fields of today, in place.

    That release called |dx| < 6 m a collision and recorded nothing of bodies. Their state at M
    follows from dx and dv of the nearest car; what bodies did before M is not known.
    """
    if values.get("end") == "COLLISION":
        values["end"] = End.MERGED.value
    values.pop("after_merge", None)
    values |= dict.fromkeys(
        ("severity", "bumper_gap_m", "clearance_m", "before_clearance_m", "brake_after_mps2")
    )
    values["impact_speed_mps"] = None
    dx, dv, score = (values.get(name) for name in ("dx_m", "dv_mps", "score"))
    if not (type(dx) is float and type(dv) is float and type(score) is float):
        return
    ahead = dx >= 0.0
    gap = abs(dx) - (scenario.pov_length_m if ahead else scenario.vut_length_m)
    closing = -dv if ahead else dv
    brake = needed_braking_mps2(gap, closing)
    if math.isinf(brake):
        values["impact_speed_mps"] = abs(dv)
    clearance = gap - max(closing, 0.0) * REACTION_S
    close = abs(dx) < scenario.dx_crash_m
    severity = severity_of(End.MERGED, clearance, is_close=close, brake_mps2=brake)
    values["severity"] = None if severity is None else severity.value
    values["bumper_gap_m"], values["clearance_m"], values["brake_after_mps2"] = (
        gap,
        clearance,
        None if math.isinf(brake) else brake,
    )
