"""The reward of the merging game: Wang et al., sections IV-C and VI-C.

r = W . Phi with three groups of terms. Running terms are per second, evaluated on the state at the
start of each 0.1 s step and the acceleration commanded for it. Terminal terms count once, at t1.
Every phi is 0 or negative, but for the reward of a wide gap in `phi_dx`. No discount.

    r_VUT = safe + VUT ego
    r_POV = safe + POV ego cos(psi) + VUT ego sin(psi)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Self

import numpy as np

from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, Scenario, Units

Role = Literal["pov", "vut"]
FULL_GAP_M = 45.0
"""Width of a full gap beyond one that is not critical, in the scenario of the paper: the distance
that a vehicle on the level-0 profile drives in 1.6 s."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RewardWeights:
    """Weights W, by default of the paper's scenario; `policies/README.md` tells of their origin."""

    pov_acc: float = 0.1  # per s and (m/s2)^2
    pov_v_hw: float = 0.1  # per s and m/s outside the speeds that the mainline drives at
    vut_acc: float = 0.15  # per s and (m/s2)^2
    vut_v_min: float = 0.1  # per s and m/s below the speed at which the VUT is slow
    vut_v_end: float = 1.5  # once, per m/s outside the mainline's speeds at t1
    ttc: float = 0.2  # once, for TTC = 0; falls linearly to 0 where it is no longer short
    gap: float = 1.0  # once, the reward of |dx| >= `gap_full_m`; grows linearly from 0 at dx = 0
    gap_full_m: float = 60.0  # |dx| from which the reward of a gap is full
    critical: float = 0.5
    """Once, for dx = 0; falls linearly to 0 where the gap is no longer critical."""
    crash: float = 20.0  # once, for a collision

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Return the weights of a scenario: the paper's, measured in its units.

        The cost of a second of acceleration, or of a wrong speed, is a share of the length of the
        game; accelerations count as shares of the hardest, speeds as shares of that of the VUT at
        M. The cost of a crash and the reward of a gap are the same everywhere.
        """
        unit, paper = Units.of(scenario), cls()
        acceleration = unit.acceleration * unit.acceleration * unit.time
        speed = unit.speed * unit.time
        return cls(
            pov_acc=paper.pov_acc / acceleration,
            pov_v_hw=paper.pov_v_hw / speed,
            vut_acc=paper.vut_acc / acceleration,
            vut_v_min=paper.vut_v_min / speed,
            vut_v_end=paper.vut_v_end / unit.speed,
            gap_full_m=scenario.dx_critical_m + FULL_GAP_M * unit.speed,
        )


@dataclass(frozen=True, slots=True)
class RewardParts:
    """Rewards in their three parts, (K,) each; psi, a social value orientation, mixes them."""

    safe: FloatArray
    pov_ego: FloatArray
    vut_ego: FloatArray

    def of(self, role: Role, svo_rad: FloatArray) -> FloatArray:
        """Return the agent's reward, (K,); `svo_rad` is psi of the POV."""
        if role == "vut":
            return self.safe + self.vut_ego
        return self.safe + self.pov_ego * np.cos(svo_rad) + self.vut_ego * np.sin(svo_rad)


@dataclass(frozen=True, slots=True)
class Reward:
    """The reward of a scenario: the weights, and the scenario with its limits.

    Arguments and results are arrays of one shape.

    Example:
        reward = Reward.of(US23)
        cost = reward.pov_step(v_pov_mps, a_pov_mps2)
    """

    weights: RewardWeights
    scenario: Scenario

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Return the reward of a scenario with the weights that it is trained with."""
        return cls(RewardWeights.of(scenario), scenario)

    def phi_v_hw(self, v_mps: FloatArray) -> FloatArray:
        """Return minus the m/s by which a speed is outside the mainline's range.

        The speed of the POV, and the VUT's at t1.
        """
        below, above = self.scenario.v_hw_min_mps - v_mps, v_mps - self.scenario.v_hw_max_mps
        return -np.maximum(np.maximum(below, above), 0.0)

    def phi_ttc(self, dx_m: FloatArray, dv_mps: FloatArray) -> FloatArray:
        """Return -(1 - TTC / limit) for a TTC below the scenario's limit, else 0."""
        closing = dx_m * dv_mps < 0.0
        ttc_s = np.abs(dx_m) / np.where(closing, np.abs(dv_mps), 1.0)
        short = np.maximum(1.0 - ttc_s / self.scenario.ttc_min_s, 0.0)
        return -np.where(closing, short, 0.0)

    def phi_dx(self, dx_m: FloatArray) -> FloatArray:
        """Return the reward of a wide gap less the penalty of a critical one, both weighted."""
        gap, weights = np.abs(dx_m), self.weights
        wide = np.minimum(gap / weights.gap_full_m, 1.0)
        near = np.maximum(1.0 - gap / self.scenario.dx_critical_m, 0.0)
        return weights.gap * wide - weights.critical * near

    def safety(self, dx_m: FloatArray, dv_mps: FloatArray) -> FloatArray:
        """Return the safety reward of both vehicles at t1."""
        crash = -(np.abs(dx_m) < self.scenario.dx_crash_m).astype(np.float64)
        near = self.weights.ttc * self.phi_ttc(dx_m, dv_mps) + self.phi_dx(dx_m)
        return near + self.weights.crash * crash

    def pov_step(self, v_pov_mps: FloatArray, a_pov_mps2: FloatArray) -> FloatArray:
        """Return the POV's ego reward of one 0.1 s step."""
        weights = self.weights
        speed = weights.pov_v_hw * self.phi_v_hw(v_pov_mps)
        return (weights.pov_acc * -np.square(a_pov_mps2) + speed) * DT_S

    def vut_step(self, v_vut_mps: FloatArray, a_vut_mps2: FloatArray) -> FloatArray:
        """Return the VUT's running ego reward of one 0.1 s step."""
        weights = self.weights
        speed = weights.vut_v_min * -np.maximum(self.scenario.v_min_mps - v_vut_mps, 0.0)
        return (weights.vut_acc * -np.square(a_vut_mps2) + speed) * DT_S

    def vut_end(self, v_vut_mps: FloatArray) -> FloatArray:
        """Return the VUT's ego reward of its final speed, at t1."""
        return self.weights.vut_v_end * self.phi_v_hw(v_vut_mps)
