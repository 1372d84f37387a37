"""A second kind of scenario: two cars on one lane, of which the leader, the POV, brakes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import POV, VUT, Bounds, Edges, Notation, Scenario
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.verdict.bodies import CentreLines
from merge_sumo.verdict.score import Measures
from merge_sumo.verdict.severity import Severity


@dataclass(frozen=True, kw_only=True, slots=True)
class BrakingCase(Case):
    """A case: the distance from the VUT to the leader, and how hard the leader brakes."""

    gap0_m: float
    a_pov_mps2: float

    def _check_coordinates(self) -> None:
        """Raise `UserError` where the cars overlap or the leader does not brake."""
        if not 0.0 < self.gap0_m <= self.scenario.reach_m:
            raise UserError(f"gap0_m is {self.gap0_m}: choose above 0 to {self.scenario.reach_m:g}")
        if not self.scenario.a_min_mps2 <= self.a_pov_mps2 < 0.0:
            raise UserError(f"a_pov_mps2 is {self.a_pov_mps2}: choose a braking below 0")
        self._check_speed("v_vut0_mps")

    def starts(self) -> list[tuple[float, float]]:
        """Return position and speed of both cars: the same speed, the POV ahead."""
        x_vut_m, v_mps = self.scenario.x_vut0_m, self.v_vut0_mps
        return [(x_vut_m + self.gap0_m + self.scenario.pov_length_m, v_mps), (x_vut_m, v_mps)]

    @property
    def level0_pov_mps2(self) -> float:
        """Acceleration of the leader."""
        return self.a_pov_mps2


def measure(
    trajectories: Sequence[Trajectory], _lines: CentreLines | None, *, avoidability: bool = True
) -> list[Measures]:
    """Return the measures of episodes: the smallest gap decides."""
    return [_measure(trajectory) for trajectory in trajectories]


def _gap_m(scenario: Scenario, x_m: FloatArray) -> FloatArray:
    """Return the gap between bumpers in positions, (..., A)."""
    gap_m: FloatArray = x_m[..., POV] - x_m[..., VUT] - scenario.pov_length_m
    return gap_m


def _measure(trajectory: Trajectory) -> Measures:
    gap_m = _gap_m(trajectory.case.scenario, trajectory.motion[:, :, 0])
    closest_m = float(gap_m.min())
    (x_pov, v_pov, _), (x_vut, v_vut, _) = trajectory.motion[-1].tolist()
    touch = closest_m <= 0.0
    return Measures.of(
        trajectory,
        severity=Severity.CONTACT if touch else Severity.SAFE,
        dx_m=x_pov - x_vut,
        dv_mps=v_pov - v_vut,
        bumper_gap_m=float(gap_m[-1]),
        clearance_m=closest_m,
        impact_speed_mps=v_vut - v_pov if touch else None,
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class BrakingScenario(Scenario):
    """Two cars on one lane at one speed; the leader brakes until it stands.

    Attributes:
        lane: edges on which both drive, in order.
        gap0_m: distance between bumpers at the start, low and high.
        a_pov_mps2: acceleration of the leader, low and high.
    """

    kind: ClassVar[str] = "braking"
    case_type: ClassVar[type[Any]] = BrakingCase
    measures: ClassVar[Callable[..., Any]] = staticmethod(measure)
    levels: ClassVar[tuple[int, ...]] = (0,)
    level_about: ClassVar[Mapping[int, str]] = {0: "brakes"}
    measure_labels: ClassVar[Mapping[str, str]] = {
        "dx_m": "x_POV - x_VUT",
        "bumper_gap_m": "bumper gap at the end",
        "clearance_m": "smallest gap",
    }
    notation: ClassVar[Mapping[str, Notation]] = {
        "gap0_m": Notation("gap", "m", 1, "$g^0$ (m)"),
        "a_pov_mps2": Notation("braking", "m/s2", 2, "$a_{POV}$ (m/s$^2$)"),
    }

    name: str = "braking"
    lane: Edges = ("main_in", "main_out")
    gap0_m: Bounds = (5.0, 60.0)
    a_pov_mps2: Bounds = (-4.0, -0.5)

    @property
    def pov_edges(self) -> tuple[str, ...]:
        """The lane."""
        return self.lane

    @property
    def vut_edges(self) -> tuple[str, ...]:
        """The same lane."""
        return self.lane

    def has_ended(self, x_m: NDArray[np.float64], v_mps: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return in which corridors bodies touch, the VUT stands, or the POV drives away."""
        leaves = (v_mps[POV] >= v_mps[VUT]) & (v_mps[POV] <= 0.0)
        ended: NDArray[np.bool_] = (_gap_m(self, x_m.T) <= 0.0) | (v_mps[VUT] <= 0.0) | leaves
        return ended
