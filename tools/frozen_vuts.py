"""The frozen VUTs of the benchmark of samplers: `frozen:NAME`.

They belong to families of real controllers. Each fails somewhere, and none is good. Their constants
are in this file and are never tuned: a change of a verdict ends the benchmark (`problems.py`). All
are for the merges of US-23. Importing this module registers the kind.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from merge_sumo.controllers.kinds import KINDS
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions, ControllerSpec
from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S

CRUISE_MPS: Final = 28.0


def _profile(v_mps: FloatArray) -> FloatArray:
    """Return the acceleration towards the cruising speed, (K,)."""
    return np.clip((CRUISE_MPS - v_mps) / DT_S, 0.0, 1.0)


def _gap_at_merge_m(scene: Scene) -> FloatArray:
    """Return the gap at M if both keep their speeds, (K,)."""
    time_s = np.maximum(-scene.x_vut_m, 0.0) / np.maximum(scene.v_vut_mps, 1.0)
    gap_m: FloatArray = scene.x_pov_m + scene.v_pov_mps * time_s
    return gap_m


def _pseudo_random(values: FloatArray) -> FloatArray:
    """Return numbers between 0 and 1 that look random, and are the same in every run."""
    mixed: FloatArray = np.sin(values) * 43758.5453 % 1.0
    return mixed


class Hysteresis(Driver):
    """Stateful: gives way below one gap, and goes again only above a larger one."""

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""
        super().__init__(corridors)
        self._yields = np.zeros(corridors, dtype=np.bool_)

    def begin(self, corridor: int, case: Case) -> None:
        """Go, until a gap is small."""
        self._yields[corridor] = False

    def act(self, scene: Scene) -> FloatArray:
        """Return accelerations, (K,)."""
        gap_m, decides = np.abs(_gap_at_merge_m(scene)), scene.x_vut_m > -60.0
        self._yields = decides & ((gap_m < 6.0) | (self._yields & (gap_m < 12.0)))
        slow = np.where(scene.v_vut_mps > 14.0, -1.5, 0.0)
        return np.where(self._yields, slow, _profile(scene.v_vut_mps))


class Table(Driver):
    """Tabular: looks its acceleration up by gap, closing speed and distance.

    The edges of its cells are odd numbers, on which no speed and no gap lies by its construction:
    there a rounding error would decide.
    """

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""
        super().__init__(corridors)
        cells = np.arange(12 * 6 * 8, dtype=np.float64).reshape(12, 6, 8)
        choices = np.array([-3.0, -1.5, 0.0, 1.0, 2.0])
        self._table = choices[(5.0 * _pseudo_random(12.9898 * cells)).astype(np.int64)]

    def act(self, scene: Scene) -> FloatArray:
        """Return accelerations, (K,)."""
        gap = np.clip((_gap_at_merge_m(scene) + 47.9371) // 8.0137, 0, 11).astype(np.int64)
        closing_mps = scene.v_pov_mps - scene.v_vut_mps
        closing = np.clip((closing_mps + 6.0317) // 3.0073, 0, 5).astype(np.int64)
        away = np.clip(-scene.x_vut_m // 23.9173, 0, 7).astype(np.int64)
        answer = self._table[gap, closing, away]
        return np.where(scene.v_vut_mps < 15.0, 1.0, answer)


class Planner(Driver):
    """A planner: of three accelerations, in each step, the one with the largest gap at M."""

    CHOICES_MPS2: Final = np.array([[-2.0], [0.0], [1.0]])
    HORIZON_S: Final = 1.5

    def act(self, scene: Scene) -> FloatArray:
        """Return accelerations, (K,)."""
        away_m = np.maximum(-scene.x_vut_m, 0.0)
        mean_mps = np.maximum(scene.v_vut_mps + self.CHOICES_MPS2 * self.HORIZON_S, 3.0)
        gap_m = np.abs(scene.x_pov_m + scene.v_pov_mps * away_m / mean_mps)  # (3, K)
        value = np.minimum(gap_m, 9.0) + 2.0 * self.CHOICES_MPS2
        chosen = self.CHOICES_MPS2[np.argmax(value, axis=0), 0]
        return np.where(away_m < 60.0, chosen, _profile(scene.v_vut_mps))


class Islands(Driver):
    """Errs on islands of the first observation, which nothing predicts.

    The islands come again with the speed of the POV and with the gap at M. There it drives towards
    a gap of 0, and elsewhere keeps 14 m on the side on which the POV would be.
    """

    KEEPS_M: Final = 14.0
    SLOWEST_MPS: Final = 8.0

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""
        super().__init__(corridors)
        self._errs = np.zeros(corridors, dtype=np.bool_)

    def act(self, scene: Scene) -> FloatArray:
        """Return accelerations, (K,)."""
        v_mps, gap_m = scene.v_vut_mps, self._gap_m(scene)
        v_pov = (scene.v_pov_mps - 25.0) / 10.0
        waves = np.sin(2.0 * np.pi * v_pov / 0.25) + np.sin(2.0 * np.pi * gap_m / 30.0)
        errs = (waves > 1.0) & (np.abs(gap_m) < 45.0)
        self._errs = np.where(scene.step == 0, errs, self._errs)
        side = np.where(gap_m >= 0.0, 1.0, -1.0)
        keeps = np.where(np.abs(gap_m) < self.KEEPS_M, 0.15 * (side * self.KEEPS_M - gap_m), 0.0)
        # To be later by a second changes the gap by about the POV's speed.
        answer = _profile(v_mps) + np.where(self._errs, 0.08 * gap_m, -keeps)
        return np.where((answer < 0.0) & (v_mps < self.SLOWEST_MPS), 0.0, answer)

    def _gap_m(self, scene: Scene) -> FloatArray:
        """Return the gap at M if the POV keeps its speed and the VUT takes the profile, (K,)."""
        v_mps, away_m = scene.v_vut_mps, np.maximum(-scene.x_vut_m, 0.0)
        run_up_m = np.maximum(CRUISE_MPS**2 - v_mps**2, 0.0) / 2.0
        time_s = np.sqrt(v_mps**2 + 2.0 * np.minimum(away_m, run_up_m)) - v_mps
        time_s += np.maximum(away_m - run_up_m, 0.0) / CRUISE_MPS
        gap_m: FloatArray = scene.x_pov_m + scene.v_pov_mps * time_s
        return gap_m


FROZEN_VUTS: Final[dict[str, Callable[[int], Driver]]] = {
    "hysteresis": Hysteresis,
    "islands": Islands,
    "planner": Planner,
    "table": Table,
}
"""The frozen VUTs by name."""


class FrozenKind(ControllerKind):
    """`frozen:NAME`."""

    own_code = asks_sumo = False

    def __init__(self, spec: ControllerSpec, options: ControllerOptions) -> None:
        """Find the VUT; `UserError` for another name."""
        super().__init__(spec, options)
        if spec.argument not in FROZEN_VUTS:
            raise UserError(f"unknown VUT {spec}: choose one of {', '.join(FROZEN_VUTS)}")

    def driver(self, corridors: int, _simulation: object) -> Driver:
        """Return its driver."""
        return FROZEN_VUTS[self.spec.argument](corridors)


KINDS.ours["frozen"] = FrozenKind
