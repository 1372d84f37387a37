"""The units of a scenario: what is large and what is small in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from merge_sumo.scenario.scenario import US23, Scenario


@dataclass(frozen=True, slots=True)
class Units:
    """How large a scenario is beside the paper's, of which all units are 1.

    A driver that measures in these units sees the same numbers in merges that are alike. Where
    lengths, speeds and accelerations are all the same multiple of the paper's, all else is equal,
    to the last bit if that is a power of two.
    """

    length: float  # of the way of the VUT to M
    speed: float  # of the VUT at M, on the level-0 profile
    time: float  # that such a way takes at such a speed
    gap: float  # of the gap below which two vehicles collide
    acceleration: float  # of the hardest acceleration

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Return the units of a scenario."""
        length = scenario.x_vut0_m / US23.x_vut0_m
        speed = scenario.level0_v_mps / US23.level0_v_mps
        return cls(
            length=length,
            speed=speed,
            time=length / speed,
            gap=scenario.dx_crash_m / US23.dx_crash_m,
            acceleration=scenario.a_max_mps2 / US23.a_max_mps2,
        )
