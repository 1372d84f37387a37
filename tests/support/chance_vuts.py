"""A controller that fails by chance.

It merges before a POV that keeps its speed, as at level 0: it decides at the start which gap at M
it wants, and keeps the acceleration that leads there. Where its gap with 0.5 m/s2 would be below
8 m, it wants a gap of 0 with a probability that rises with the speed of the POV, and fails;
otherwise it wants a gap of 30 m. Elsewhere it accelerates by 0.5 m/s2, and passes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

USUAL_MPS2 = 0.5
CONTESTED_M = 8.0
CLEAR_M = 30.0
V_POV0_MPS = (25.0, 35.0)
"""Speeds that the POV may begin with in `us23`."""


def usual_gap_m(
    x_pov_m: FloatArray, v_pov_mps: FloatArray, x_vut_m: FloatArray, v_vut_mps: FloatArray
) -> FloatArray:
    """Return g, the gap at M of a VUT that accelerates by 0.5 m/s2."""
    speeding = np.sqrt(v_vut_mps**2 - 2.0 * USUAL_MPS2 * x_vut_m) - v_vut_mps
    return np.asarray(x_pov_m + v_pov_mps * speeding / USUAL_MPS2)


class Slope:
    """Fails the likelier the faster the POV is: from never to always."""

    def __init__(self, corridors: int) -> None:
        self._luck = np.zeros(corridors)
        self._answer = np.zeros(corridors)

    def reset(self, corridor: int, seen: Any, seed: int) -> None:
        self._luck[corridor] = np.random.default_rng(seed).random()

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        begins = seen.t_s == 0.0
        if begins.any():
            self._answer = np.where(begins, self._wanted(seen), self._answer)
        return self._answer

    def _wanted(self, seen: Any) -> FloatArray:
        """Return the acceleration that leads to the gap that it wants, (K,)."""
        x, v = seen.x_pov_m, np.maximum(seen.v_pov_mps, 1.0)
        usual = usual_gap_m(x, v, seen.x_vut_m, seen.v_vut_mps)
        u = (v - V_POV0_MPS[0]) / (V_POV0_MPS[1] - V_POV0_MPS[0])
        errs = self._luck < np.clip(u, 0.0, 1.0)
        clear = np.where(usual >= 0.0, CLEAR_M, -CLEAR_M)
        gap = np.where(np.abs(usual) < CONTESTED_M, np.where(errs, 0.0, clear), usual)
        time_s = (gap - x) / v
        return np.asarray(2.0 * (-seen.x_vut_m - seen.v_vut_mps * time_s) / time_s**2)
