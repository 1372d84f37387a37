"""The merging scenario as a value: where vehicles start, what they can do, what is too near.

Each lane has its own coordinate: the distance of the front bumper along the lane from the merge
point M, in metres, negative before M. A case is a point of a scenario and knows which; so drivers,
rollout and score take what holds for it from the case. `US23` is the paper's: Wang et al., sections
VI and VII and Table I.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from difflib import get_close_matches
from typing import Any, Final

from merge_sumo.errors import UserError

DT_S: Final = 0.1
"""Step of the equations of motion, eq. (4)."""
LEVELS: Final = (0, 1, 2)
"""Levels of reasoning of the POV."""
DEADLINE_S: Final = 5.0
"""A VUT that takes longer than this for one step, or for one reset, is a VUT_ERROR."""
MEMORY_GIB: Final = 4.0
"""A user's code that takes more memory than this fails to get it."""
MAX_EPISODE_S: Final = 120.0
"""No scenario lets an episode last longer."""

ROOM_AFTER_M: Final = 2000.0
"""Length behind M that the road has at least."""

Bounds = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Dimension:
    """One continuous coordinate of the pool: the name of a `Case` field and its bounds."""

    field: str
    low: float
    high: float


SVO: Final = Dimension("svo_rad", 0.0, math.pi / 2)
"""psi in [0, pi/2): the upper end itself is outside the pool."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Scenario:
    """A merge and what is asked of it; raises `UserError` for numbers that make none.

    Attributes:
        name: how people call it.
        net: the SUMO net; None for the shipped one.
        mainline: edges of the mainline, in driving order, past M.
        ramp: edges of the ramp, in driving order, past M.
        x_pov0_m: where the POV may start, low and high.
        v_pov0_mps: how fast it may be then.
        x_vut0_m: where the VUT starts.
        v_vut0_mps: how fast the VUT is then, unless a campaign says otherwise: it is observed, not
            chosen by the tester.
        a_min_mps2: hardest braking of both, negative.
        a_max_mps2: hardest acceleration of both.
        timeout_s: an episode that has not ended by then is a TIMEOUT.
        v_hw_min_mps: lowest speed that the mainline drives at.
        v_hw_max_mps: highest speed that it drives at.
        v_min_mps: below this the VUT is slow.
        ttc_min_s: a time to collision below this is short.
        dx_crash_m: front bumpers nearer than this when the VUT is at M are a collision.
        dx_critical_m: nearer than this is critical.
        level0_a_mps2: a level-0 VUT accelerates so,
        level0_v_mps: up to this speed, and holds it (section VI-B).
        reach_m: no vehicle starts farther from M than this.
        v_start_max_mps: no vehicle starts faster than this.
    """

    name: str = "us23"
    net: str | None = None
    mainline: tuple[str, ...] = ("main_in", "main_out")
    ramp: tuple[str, ...] = ("ramp", "main_out")
    x_pov0_m: Bounds = (-340.0, -180.0)
    v_pov0_mps: Bounds = (25.0, 35.0)
    x_vut0_m: float = -182.0
    v_vut0_mps: float = 18.0
    a_min_mps2: float = -4.0
    a_max_mps2: float = 2.0
    timeout_s: float = 30.0
    v_hw_min_mps: float = 24.6
    v_hw_max_mps: float = 35.0
    v_min_mps: float = 12.0
    ttc_min_s: float = 7.0
    dx_crash_m: float = 6.0
    dx_critical_m: float = 15.0
    level0_a_mps2: float = 1.0
    level0_v_mps: float = 28.0
    reach_m: float = 900.0
    v_start_max_mps: float = 45.0

    def __post_init__(self) -> None:
        """Check the numbers one by one, then how they go together."""
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = value if field.type == "Bounds" else (value,)
            if field.type in ("float", "Bounds") and not all(map(math.isfinite, numbers)):
                raise UserError(f"{field.name} is {value}: it must be finite")
        for name, fits, wanted in (
            ("x_pov0_m", -self.reach_m <= self.x_pov0_m[0] < self.x_pov0_m[1] <= 0.0, self._ahead),
            ("v_pov0_mps", 0.0 <= self.v_pov0_mps[0] < self.v_pov0_mps[1], "from 0 up, low < high"),
            ("v_pov0_mps", self.v_pov0_mps[1] <= self.v_start_max_mps, self._speeds),
            ("x_vut0_m", -self.reach_m <= self.x_vut0_m < 0.0, self._ahead),
            ("v_vut0_mps", 0.0 <= self.v_vut0_mps <= self.v_start_max_mps, self._speeds),
            ("a_min_mps2", self.a_min_mps2 < 0.0, "below 0"),
            ("a_max_mps2", self.a_max_mps2 > 0.0, "above 0"),
            ("timeout_s", DT_S <= self.timeout_s <= MAX_EPISODE_S, f"up to {MAX_EPISODE_S:g}"),
            ("v_hw_min_mps", 0.0 < self.v_hw_min_mps < self.v_hw_max_mps, "below v_hw_max_mps"),
            ("v_min_mps", self.v_min_mps > 0.0, "above 0"),
            ("ttc_min_s", self.ttc_min_s > 0.0, "above 0"),
            ("dx_crash_m", 0.0 < self.dx_crash_m <= self.dx_critical_m, "up to dx_critical_m"),
            ("level0_a_mps2", 0.0 < self.level0_a_mps2 <= self.a_max_mps2, "up to a_max_mps2"),
            ("level0_v_mps", self.level0_v_mps > 0.0, "above 0"),
        ):
            if not fits:
                raise UserError(f"{name} is {getattr(self, name)}: choose {wanted}")

    @classmethod
    def from_record(cls, record: Any) -> Scenario:
        """Return the scenario that JSON or TOML describes; `UserError` where it is none.

        What is left out is as in the paper's scenario.
        """
        if not isinstance(record, dict):
            raise UserError("a scenario is a table of names and values")
        known = {field.name: field for field in fields(cls)}
        values: dict[str, Any] = {}
        for name, value in record.items():
            if name not in known:
                near = get_close_matches(str(name), known, 1)
                meant = f": did you mean {near[0]}?" if near else f": it has {', '.join(known)}"
                raise UserError(f"a scenario has no {name!r}{meant}")
            values[name] = _read(name, value, known[name].type)
        return cls(**values)

    @property
    def _ahead(self) -> str:
        return f"metres before M, -{self.reach_m:g} to 0, low < high"

    @property
    def _speeds(self) -> str:
        return f"between 0 and {self.v_start_max_mps:g}"

    @property
    def max_steps(self) -> int:
        """Steps after which an episode that has not ended is a TIMEOUT."""
        return round(self.timeout_s / DT_S)

    @property
    def room_after_m(self) -> float:
        """How far behind M a POV may get until the timeout, at full acceleration."""
        far_m = self.v_start_max_mps * self.timeout_s + 0.5 * self.a_max_mps2 * self.timeout_s**2
        return max(far_m, ROOM_AFTER_M)

    def dimensions(self, level: int) -> tuple[Dimension, ...]:
        """Return the continuous coordinates of the pool at a level: two, or three at level 2."""
        plane = (Dimension("x_pov0_m", *self.x_pov0_m), Dimension("v_pov0_mps", *self.v_pov0_mps))
        return (*plane, SVO) if level == 2 else plane


def _read(name: str, value: Any, kind: Any) -> Any:
    """Return a value from JSON or TOML as what a field of a scenario holds."""

    def is_number(value: Any) -> bool:
        return type(value) in (int, float)

    if kind == "float" and is_number(value):
        return float(value)
    if kind == "Bounds" and isinstance(value, list | tuple):
        if len(value) == 2 and all(map(is_number, value)):
            return tuple(map(float, value))
    elif kind == "tuple[str, ...]" and isinstance(value, list | tuple):
        if value and all(isinstance(item, str) for item in value):
            return tuple(value)
    elif kind in ("str", "str | None") and isinstance(value, str):
        return value
    elif kind == "str | None" and value is None:
        return None
    wanted = {
        "float": "a number",
        "Bounds": "two numbers, [low, high]",
        "tuple[str, ...]": 'edges, as in ["e1", "e2"]',
    }
    raise UserError(f"{name} is {value!r:.60}: it must be {wanted.get(kind, 'a text')}")


US23: Final = Scenario()
"""The paper's."""

# The paper's numbers by name, for what is of this scenario alone: training and shipped policies.
A_MIN_MPS2: Final = US23.a_min_mps2
A_MAX_MPS2: Final = US23.a_max_mps2
X_VUT0_M: Final = US23.x_vut0_m
V_VUT0_MPS: Final = US23.v_vut0_mps
V_VUT0_MAX_MPS: Final = US23.v_start_max_mps
MAX_STEPS: Final = US23.max_steps
V_HW_MAX_MPS: Final = US23.v_hw_max_mps
V_HW_MIN_MPS: Final = US23.v_hw_min_mps
V_MIN_MPS: Final = US23.v_min_mps
TTC_MIN_S: Final = US23.ttc_min_s
DX_CRASH_M: Final = US23.dx_crash_m
DX_CRITICAL_M: Final = US23.dx_critical_m
LEVEL0_A_MPS2: Final = US23.level0_a_mps2
LEVEL0_V_MPS: Final = US23.level0_v_mps
