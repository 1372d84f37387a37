"""The reward of the merging game: Wang et al., sections IV-C and VI-C.

r = W . Phi with three groups of terms. Running terms are per second, evaluated on the state at the
start of each 0.1 s step and the acceleration commanded for it. Terminal terms count once, at t1.
Every phi is 0 or negative, but for the reward of a wide gap in `phi_dx`. No discount.

    r_VUT = safe + VUT ego
    r_POV = safe + POV ego cos(psi) + VUT ego sin(psi)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import (
    DT_S,
    DX_CRASH_M,
    DX_CRITICAL_M,
    TTC_MIN_S,
    V_HW_MAX_MPS,
    V_HW_MIN_MPS,
    V_MIN_MPS,
)


@dataclass(frozen=True, kw_only=True, slots=True)
class RewardWeights:
    """Weights W; `policies/README.md` says how they were found.

    Attributes:
        pov_acc: per s and (m/s2)^2.
        pov_v_hw: per s and m/s outside [24.6, 35].
        vut_acc: per s and (m/s2)^2.
        vut_v_min: per s and m/s below 12.
        vut_v_end: once, per m/s outside [24.6, 35] at t1.
        ttc: once, for TTC = 0; falls linearly to 0 at 7 s.
        gap: once, the reward of |dx| >= `gap_full_m`; grows linearly from 0 at dx = 0.
        gap_full_m: |dx| from which the reward of a gap is full.
        critical: once, for dx = 0; falls linearly to 0 at 15 m.
        crash: once, for |dx| < 6 m.
    """

    pov_acc: float = 0.1
    pov_v_hw: float = 0.1
    vut_acc: float = 0.15
    vut_v_min: float = 0.1
    vut_v_end: float = 1.5
    ttc: float = 0.2
    gap: float = 1.0
    gap_full_m: float = 60.0
    critical: float = 0.5
    crash: float = 20.0


def phi_acc(a_mps2: FloatArray) -> FloatArray:
    """Return minus the squared acceleration, (m/s2)^2."""
    return -np.square(a_mps2)


def phi_v_hw(v_mps: FloatArray) -> FloatArray:
    """Return minus the m/s by which a speed is outside the highway's [24.6, 35]."""
    below, above = V_HW_MIN_MPS - v_mps, v_mps - V_HW_MAX_MPS
    return -np.maximum(np.maximum(below, above), 0.0)


def phi_v_min(v_vut_mps: FloatArray) -> FloatArray:
    """Return minus the m/s by which the VUT is slower than 12."""
    return -np.maximum(V_MIN_MPS - v_vut_mps, 0.0)


phi_v_end = phi_v_hw
"""The VUT's final speed is held against the same range as the POV's speed."""


def phi_ttc(dx_m: FloatArray, dv_mps: FloatArray) -> FloatArray:
    """Return -(1 - TTC / 7 s) for a TTC below 7 s, else 0."""
    closing = dx_m * dv_mps < 0.0
    ttc_s = np.abs(dx_m) / np.where(closing, np.abs(dv_mps), 1.0)
    return -np.where(closing, np.maximum(1.0 - ttc_s / TTC_MIN_S, 0.0), 0.0)


def phi_dx(dx_m: FloatArray, weights: RewardWeights) -> FloatArray:
    """Return the reward of a wide gap less the penalty of one below 15 m, both weighted."""
    gap = np.abs(dx_m)
    wide = np.minimum(gap / weights.gap_full_m, 1.0)
    near = np.maximum(1.0 - gap / DX_CRITICAL_M, 0.0)
    reward: FloatArray = weights.gap * wide - weights.critical * near
    return reward


def phi_crash(dx_m: FloatArray) -> FloatArray:
    """Return -1 for a collision, |dx| < 6 m."""
    crashed: NDArray[np.bool_] = np.abs(dx_m) < DX_CRASH_M
    return -crashed.astype(np.float64)


def safety(dx_m: FloatArray, dv_mps: FloatArray, weights: RewardWeights) -> FloatArray:
    """Return the safety reward of both vehicles at t1."""
    return (
        weights.ttc * phi_ttc(dx_m, dv_mps)
        + phi_dx(dx_m, weights)
        + weights.crash * phi_crash(dx_m)
    )


def pov_step(v_pov_mps: FloatArray, a_pov_mps2: FloatArray, weights: RewardWeights) -> FloatArray:
    """Return the POV's ego reward of one 0.1 s step."""
    rate = weights.pov_acc * phi_acc(a_pov_mps2) + weights.pov_v_hw * phi_v_hw(v_pov_mps)
    return rate * DT_S


def vut_step(v_vut_mps: FloatArray, a_vut_mps2: FloatArray, weights: RewardWeights) -> FloatArray:
    """Return the VUT's running ego reward of one 0.1 s step."""
    rate = weights.vut_acc * phi_acc(a_vut_mps2) + weights.vut_v_min * phi_v_min(v_vut_mps)
    return rate * DT_S


def vut_end(v_vut_mps: FloatArray, weights: RewardWeights) -> FloatArray:
    """Return the VUT's ego reward of its final speed, at t1."""
    return weights.vut_v_end * phi_v_end(v_vut_mps)


def pov_reward(
    safe: FloatArray, pov_ego: FloatArray, vut_ego: FloatArray, svo_rad: FloatArray
) -> FloatArray:
    """Return r_POV of the three parts for a social value orientation psi."""
    return safe + pov_ego * np.cos(svo_rad) + vut_ego * np.sin(svo_rad)
