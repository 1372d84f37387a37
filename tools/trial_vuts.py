"""Controllers of realistic kinds, on which no choice of a sampler was made.

    merge-sumo campaign --vut tools/trial_vuts.py:Idm
    python tools/bench_samplers.py --trials

All act in K corridors at once. Each fails somewhere; none is good.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

DT_S = 0.1
CRUISE_MPS = 28.0


def profile(v_mps: FloatArray) -> FloatArray:
    """Return the acceleration towards the cruising speed.

    Args:
        v_mps: speeds of the VUT, (K,).
    """
    return np.clip((CRUISE_MPS - v_mps) / DT_S, 0.0, 1.0)


def gap_at_merge(seen: Any) -> FloatArray:
    """Return the gap at M if the POV keeps its speed and the VUT follows the profile.

    Args:
        seen: the observation, with arrays of (K,).
    """
    time_s = np.maximum(-seen.x_vut_m, 0.0) / np.maximum(seen.v_vut_mps, 1.0)
    gap: FloatArray = seen.x_pov_m + seen.v_pov_mps * time_s
    return gap


class Idm:
    """The Intelligent Driver Model behind the POV, projected onto the ramp, once that is ahead."""

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        v, gap = seen.v_vut_mps, seen.x_pov_m - seen.x_vut_m - 5.0
        free = 1.5 * (1.0 - (v / CRUISE_MPS) ** 4)
        wanted = 2.0 + np.maximum(
            v * 1.2 + v * (v - seen.v_pov_mps) / (2.0 * np.sqrt(1.5 * 2.0)), 0.0
        )
        follows = (gap > 0.0) & (seen.x_vut_m > -120.0)
        brake = 1.5 * (wanted / np.maximum(gap, 0.5)) ** 2
        return np.asarray(np.where(follows, free - brake, free))


class Hysteresis:
    """Gap acceptance: gives way below one gap, and goes again only above a larger one."""

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""
        self.yields = np.zeros(corridors, dtype=bool)

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        gap, decides = np.abs(gap_at_merge(seen)), seen.x_vut_m > -60.0
        self.yields = (seen.t_s > 0.0) & self.yields
        self.yields = decides & ((gap < 6.0) | (self.yields & (gap < 12.0)))
        slow = np.where(seen.v_vut_mps > 14.0, -1.5, 0.0)
        return np.asarray(np.where(self.yields, slow, profile(seen.v_vut_mps)))


class Delayed:
    """Takes the acceleration of three with the largest gap at M, by the state 0.8 s ago."""

    DELAY = 8

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""
        self.past = np.zeros((self.DELAY + 1, 4, corridors))

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        state = np.array((seen.x_pov_m, seen.v_pov_mps, seen.x_vut_m, seen.v_vut_mps))
        self.past = np.roll(self.past, 1, axis=0)
        self.past[0] = state
        self.past = np.where(seen.t_s == 0.0, state, self.past)
        x_pov, v_pov, x_vut, v_vut = self.past[-1]
        choices = np.array((-2.0, 0.0, 1.0))
        distance = np.maximum(-x_vut, 0.0)
        gaps = []
        for a in choices:
            mean = np.maximum(v_vut + a * 1.5, 3.0)
            gaps.append(np.minimum(np.abs(x_pov + v_pov * distance / mean), 9.0) + 2.0 * a)
        chosen = choices[np.argmax(gaps, axis=0)]
        near = distance < 60.0
        return np.asarray(np.where(near, chosen, profile(seen.v_vut_mps)))


class SlowerDelayed(Delayed):
    """The same by the state 1 s ago: a version that reacts more slowly."""

    DELAY = 10


class Rss:
    """Brakes while the longitudinal distance to the POV, as if on one lane, is not safe."""

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        v, rho = seen.v_vut_mps, 0.4
        faster = v + rho * 2.0
        safe = v * rho + rho**2 + faster**2 / 8.0 - seen.v_pov_mps**2 / 12.0
        gap = seen.x_pov_m - seen.x_vut_m - 5.0
        ahead = (gap > -3.0) & (seen.x_vut_m > -70.0)
        unsafe = ahead & (gap < np.maximum(safe, 2.0))
        return np.asarray(np.where(unsafe, -3.0, profile(v)))


class Courteous:
    """Lets everybody pass who would be near, early and softly; hurries where it is first."""

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        gap, v = gap_at_merge(seen), seen.v_vut_mps
        lets = (gap > -12.0) & (gap < 12.0) & (v > 12.0)
        hurries = (gap <= -12.0) & (gap > -40.0)
        answer = np.where(hurries, 2.0, profile(v))
        return np.asarray(np.where(lets, -1.2, answer))


class Table:
    """Looks its acceleration up in a coarse table of gap, closing speed and distance."""

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""
        rng = np.random.default_rng(20)
        self.table = rng.choice([-3.0, -1.5, 0.0, 1.0, 2.0], size=(12, 6, 8))

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        gap = np.clip((gap_at_merge(seen) + 48.0) // 8.0, 0, 11).astype(int)
        closing = np.clip((seen.v_pov_mps - seen.v_vut_mps + 6.0) // 3.0, 0, 5).astype(int)
        away = np.clip(-seen.x_vut_m // 24.0, 0, 7).astype(int)
        answer = self.table[gap, closing, away]
        return np.asarray(np.where(seen.v_vut_mps < 15.0, 1.0, answer))


class Noisy:
    """Gives way too late, with a noise that looks like chance and is the same in every run."""

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        gap, v = gap_at_merge(seen), seen.v_vut_mps
        noise = 2.0 * ((np.sin(seen.x_vut_m * 127.1 + v * 311.7) * 43758.5453) % 1.0) - 1.0
        answer = np.where((np.abs(gap) < 12.0) & (seen.x_vut_m > -80.0), -2.0, profile(v))
        return np.asarray(answer + noise)


class Hidden:
    """Commits at a moment that depends on the first state irregularly."""

    def __init__(self, corridors: int) -> None:
        """Prepare for K corridors."""
        self.at_m = np.zeros(corridors)
        self.plan = np.zeros(corridors)

    def act_batch(self, seen: Any) -> FloatArray:
        """Return accelerations, (K,)."""
        first = seen.t_s == 0.0
        hashed = (np.sin(seen.x_pov_m * 12.9898 + seen.v_pov_mps * 78.233) * 43758.5453) % 1.0
        self.at_m = np.where(first, -120.0 + 70.0 * hashed, self.at_m)
        gap = gap_at_merge(seen)
        deciding = (seen.x_vut_m >= self.at_m) & (self.plan == 0.0)
        self.plan = np.where(first, 0.0, self.plan)
        self.plan = np.where(deciding, np.where(np.abs(gap) < 10.0, -1.8, 1.0), self.plan)
        answer = np.where(self.plan == 0.0, profile(seen.v_vut_mps), self.plan)
        return np.asarray(np.where((answer < 0.0) & (seen.v_vut_mps < 10.0), 0.0, answer))
