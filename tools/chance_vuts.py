"""Controllers that fail by chance, with probabilities that are known in closed form.

    merge-sumo campaign --vut tools/chance_vuts.py:Slope --level 0 --repeat auto
    python tools/bench_chance.py

They merge before a POV that keeps its speed, as at level 0: each decides at the start which gap at
M it wants, and keeps the acceleration that leads there. With an acceleration of 0.5 m/s2 the gap
would be g(x, v). Where |g| is below 8 m, a controller wants a gap of 0 with probability q(v), and
fails; otherwise a gap of 30 m, and passes. Elsewhere it goes on as it is, and passes. So

    P(fail | x, v) = q(v) where |g(x, v)| < 8 m, and 0 elsewhere.

All act in K corridors at once.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
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


class Chance(ABC):
    """Wants a gap of 0 with a probability, where its usual gap is small."""

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""
        self._luck = np.zeros(corridors)
        self._answer = np.zeros(corridors)

    def reset(self, corridor: int, seen: Any, seed: int) -> None:
        """Draw the number that decides in the episode that begins in a corridor."""
        self._luck[corridor] = np.random.default_rng(seed).random()

    @staticmethod
    @abstractmethod
    def erring(u: FloatArray) -> FloatArray:
        """Return q, (n,), by the speed of the POV from 0 to 1, (n,)."""

    @classmethod
    def chance(cls, x_pov_m: FloatArray, v_pov_mps: FloatArray) -> FloatArray:
        """Return P(fail) of cases of `us23`, (n,), by the start of the POV, (n,)."""
        gap_m = usual_gap_m(x_pov_m, v_pov_mps, np.array(-182.0), np.array(18.0))
        u = (v_pov_mps - V_POV0_MPS[0]) / (V_POV0_MPS[1] - V_POV0_MPS[0])
        return np.where(np.abs(gap_m) < CONTESTED_M, cls.erring(u), 0.0)

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
        errs = self._luck < self.erring(u)
        clear = np.where(usual >= 0.0, CLEAR_M, -CLEAR_M)
        gap = np.where(np.abs(usual) < CONTESTED_M, np.where(errs, 0.0, clear), usual)
        time_s = (gap - x) / v
        return np.asarray(2.0 * (-seen.x_vut_m - seen.v_vut_mps * time_s) / time_s**2)


class Slope(Chance):
    """Fails the likelier the faster the POV is: from never to always."""

    @staticmethod
    def erring(u: FloatArray) -> FloatArray:
        """Return q, (n,)."""
        return np.clip(u, 0.0, 1.0)


class Bell(Chance):
    """Fails most in the middle, in nine of ten runs, and hardly at the ends."""

    @staticmethod
    def erring(u: FloatArray) -> FloatArray:
        """Return q, (n,)."""
        return np.asarray(0.9 * np.exp(-np.square((u - 0.5) / 0.25)))


class Step(Chance):
    """Fails in one run of twenty with a slow POV, and in four of five with a fast one."""

    @staticmethod
    def erring(u: FloatArray) -> FloatArray:
        """Return q, (n,)."""
        return np.asarray(0.05 + 0.75 / (1.0 + np.exp(-(u - 0.4) / 0.05)))


class Even(Chance):
    """Fails in three of ten runs, wherever the usual gap is small."""

    @staticmethod
    def erring(u: FloatArray) -> FloatArray:
        """Return q, (n,)."""
        return np.full(np.shape(u), 0.3)
