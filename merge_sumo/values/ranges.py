"""The values that a measure can have at all in a scenario, as an interval of floats.

They follow from eq. (4), the limits of acceleration and where vehicles start: a vehicle that starts
with v0 and drives d metres is at most as fast as the root of v0^2 + 2 a d. A criterion that no such
value meets would pass every vehicle under test; one that all meet would fail every one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

from merge_sumo.values.bodies import WIDTH_M
from merge_sumo.values.measures import further_measures
from merge_sumo.values.merge import REACTION_S
from merge_sumo.values.scenario import DT_S, Scenario
from merge_sumo.values.score import MU_CRASH, MU_SAFETY, MU_TASK

ROUNDING: Final = 1.0
"""Added to a length in m and a speed in m/s that follow from sums of rounded steps."""


class Range(NamedTuple):
    """All values from `low` to `high`, both included; they may be infinite."""

    low: float
    high: float

    @property
    def text(self) -> str:
        """The range in words."""
        if self.low == self.high:
            return f"always {self.low:g}"
        if self.high == math.inf:
            return "above 0" if 0.0 < self.low < MINUTE else f"{self.low:g} or more"
        return (
            f"at most {self.high:g}" if self.low == -math.inf else f"{self.low:g} to {self.high:g}"
        )


MINUTE: Final = 1e-300
ABOVE_0: Final = math.nextafter(0.0, 1.0)
ANY: Final = Range(-math.inf, math.inf)
NOT_NEGATIVE: Final = Range(0.0, math.inf)


@dataclass(frozen=True, slots=True)
class Speeds:
    """The highest speeds in m/s.

    Attributes:
        vut_mps: of the VUT, up to M.
        car_mps: of a car of the mainline, until the VUT is at M.
        impact_mps: of one body towards another where they touch; lanes may meet at an angle.
        added_behind_mps: what the follow-up may add to the speed of any.
    """

    vut_mps: float
    car_mps: float
    impact_mps: float
    added_behind_mps: float

    @classmethod
    def possible(cls, scenario: Scenario) -> Speeds:
        """Return those that no vehicle of a scenario can pass, whatever drives it."""
        a_mps2, time_s = scenario.a_max_mps2, scenario.timeout_s
        v_vut0, v_car0 = scenario.v_start_max_mps, scenario.v_pov0_mps[1]
        vut_mps = _after_mps(scenario, v_vut0, -scenario.x_vut0_m)
        # Bodies touch where the car is at most a length, and a second's way, from M.
        near_m = scenario.mainline_m + 2.0 * _length_m(scenario) + vut_mps * REACTION_S
        impact_mps = vut_mps + _after_mps(scenario, v_car0, near_m)
        car_mps, added_mps = v_car0 + a_mps2 * time_s + ROUNDING, a_mps2 * scenario.follow_up_s
        if added_mps:  # a body may be hit far behind M
            impact_mps = max(impact_mps, car_mps) + added_mps
        return cls(vut_mps, car_mps, impact_mps, added_mps)

    @classmethod
    def usual(cls, scenario: Scenario) -> Speeds:
        """Return those that a scenario names: where vehicles start, and what the road allows."""
        v_mps = max(
            *(scenario.bounds("v_vut0_mps")[1], scenario.v_pov0_mps[1]),
            *(scenario.v_hw_max_mps, scenario.level0_v_mps),
        )
        return cls(v_mps, v_mps, v_mps, 0.0)


def _length_m(scenario: Scenario) -> float:
    return max(scenario.pov_length_m, scenario.vut_length_m)


def _after_mps(scenario: Scenario, v_mps: float, way_m: float) -> float:
    """Return a bound of the speed after some metres at full acceleration.

    A step of eq. (4) adds (a dt)^2 to what the way alone gives, and may pass the end by its length.
    """
    a_mps2, most_mps = scenario.a_max_mps2, v_mps + scenario.a_max_mps2 * scenario.timeout_s
    way_m += most_mps * DT_S
    of_steps = scenario.max_steps * (a_mps2 * DT_S) ** 2
    return min(most_mps, math.sqrt(v_mps**2 + 2.0 * a_mps2 * way_m + of_steps)) + ROUNDING


def measure_ranges(scenario: Scenario, speeds: Speeds) -> dict[str, Range]:
    """Return the range of every measure that is a number, as criteria count it.

    A measure without a value counts as one that is never met (`criterion.py`): that is in its
    range.
    """
    length_m, inf = _length_m(scenario), math.inf
    deepest_m = length_m + WIDTH_M + speeds.impact_mps * REACTION_S
    return {
        "ttc_s": Range(ABOVE_0, inf),
        "clearance_m": Range(-deepest_m, inf),
        "before_clearance_m": Range(-(length_m + WIDTH_M), inf),
        "bumper_gap_m": Range(-length_m, inf),
        "dx_m": Range(-(scenario.mainline_m + speeds.vut_mps * DT_S + ROUNDING), inf),
        "dv_mps": Range(-speeds.vut_mps, speeds.car_mps),
        "drac_mps2": NOT_NEGATIVE,
        "brake_after_mps2": NOT_NEGATIVE,
        "pet_s": NOT_NEGATIVE,
        "t_end_s": Range(DT_S, round(scenario.max_steps * DT_S, 1)),
        "impact_speed_mps": Range(0.0, speeds.impact_mps),
        "vut_max_brake_mps2": Range(0.0, -scenario.a_min_mps2),
        "pov_max_brake_mps2": Range(0.0, -scenario.a_min_mps2),
        "last_avoidable_s": ANY,
        "clipped_steps": Range(0.0, float(scenario.max_steps)),
        "score": Range(MU_CRASH - 2.0 * MU_SAFETY - MU_TASK, 0.0),
        "after_gap_m": Range(-length_m, inf),
        "after_ttc_s": NOT_NEGATIVE,
        "after_drac_mps2": NOT_NEGATIVE,
        **dict.fromkeys(further_measures(), ANY),
    }


def signal_ranges(scenario: Scenario, speeds: Speeds, never_s: float) -> dict[str, Range]:
    """Return the range of every signal of a formula; `never_s` is the longest time to collision."""
    v_vut = Range(0.0, speeds.vut_mps + speeds.added_behind_mps)
    v_pov = Range(0.0, speeds.car_mps + speeds.added_behind_mps)
    accelerations = Range(scenario.a_min_mps2, scenario.a_max_mps2)
    return {
        "x_pov_m": Range(-scenario.mainline_m, math.inf),
        "v_pov_mps": v_pov,
        "a_pov_mps2": accelerations,
        "x_vut_m": Range(scenario.x_vut0_m, math.inf),
        "v_vut_mps": v_vut,
        "a_vut_mps2": accelerations,
        "dx_m": ANY,
        "dv_mps": Range(-v_vut.high, v_pov.high),
        "bumper_gap_m": Range(-_length_m(scenario), math.inf),
        "ttc_s": Range(0.0, never_s),
    }
