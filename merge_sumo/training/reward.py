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
    """Weights W, by default of the paper's scenario; `policies/README.md` tells of their origin.

    Attributes:
        pov_acc: cost of the POV's acceleration, per s and (m/s2)^2.
        pov_v_hw: cost of the POV's speed, per s and m/s outside the speeds of the mainline.
        vut_acc: cost of the VUT's acceleration, per s and (m/s2)^2.
        vut_v_min: cost of a slow VUT, per s and m/s below `v_min_mps`.
        vut_v_end: cost of the VUT's speed at t1, once, per m/s outside the speeds of the mainline.
        ttc: cost of TTC = 0 at t1, once; it falls linearly to 0 at `ttc_min_s`.
        gap: reward of a full gap at t1, once; it grows linearly from 0 at dx = 0.
        gap_full_m: |dx| from which a gap is full.
        critical: cost of dx = 0 at t1, once; it falls linearly to 0 at `dx_critical_m`.
        crash: cost of a collision, once.
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

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Return the weights of a scenario: the paper's, measured in its units.

        The cost of a second of acceleration, or of a wrong speed, is a share of the length of the
        game; accelerations count as shares of the hardest, speeds as shares of that of the VUT at
        M. The cost of a crash and the reward of a gap are the same everywhere.

        Args:
            scenario: the scenario.
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
    """Rewards in their three parts, which psi, a social value orientation, mixes.

    Attributes:
        safe: safety of both vehicles, (K,).
        pov_ego: comfort and speed of the POV, (K,).
        vut_ego: comfort and speed of the VUT, (K,).
    """

    safe: FloatArray
    pov_ego: FloatArray
    vut_ego: FloatArray

    def of(self, role: Role, svo_rad: FloatArray) -> FloatArray:
        """Return the reward of an agent, (K,).

        Args:
            role: vehicle of the agent, "pov" or "vut".
            svo_rad: psi of the POV, (K,).
        """
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

    Attributes:
        weights: the weights.
        scenario: gives the limits of the terms.
    """

    weights: RewardWeights
    scenario: Scenario

    @classmethod
    def of(cls, scenario: Scenario) -> Self:
        """Return the reward of a scenario with the weights that its drivers are trained with.

        Args:
            scenario: the scenario.
        """
        return cls(RewardWeights.of(scenario), scenario)

    def phi_v_hw(self, v_mps: FloatArray) -> FloatArray:
        """Return minus the m/s by which a speed is outside the speeds of the mainline.

        Args:
            v_mps: speeds of the POV, or of the VUT at t1.
        """
        below, above = self.scenario.v_hw_min_mps - v_mps, v_mps - self.scenario.v_hw_max_mps
        return -np.maximum(np.maximum(below, above), 0.0)

    def phi_ttc(self, dx_m: FloatArray, dv_mps: FloatArray) -> FloatArray:
        """Return -(1 - TTC / limit) for a TTC below the limit of the scenario, else 0.

        Args:
            dx_m: positions of the POV less those of the VUT.
            dv_mps: speeds of the POV less those of the VUT.
        """
        closing = dx_m * dv_mps < 0.0
        ttc_s = np.abs(dx_m) / np.where(closing, np.abs(dv_mps), 1.0)
        short = np.maximum(1.0 - ttc_s / self.scenario.ttc_min_s, 0.0)
        return -np.where(closing, short, 0.0)

    def phi_dx(self, dx_m: FloatArray) -> FloatArray:
        """Return the reward of a wide gap less the penalty of a critical one, both weighted.

        Args:
            dx_m: positions of the POV less those of the VUT.
        """
        gap, weights = np.abs(dx_m), self.weights
        wide = np.minimum(gap / weights.gap_full_m, 1.0)
        near = np.maximum(1.0 - gap / self.scenario.dx_critical_m, 0.0)
        return weights.gap * wide - weights.critical * near

    def safety(self, dx_m: FloatArray, dv_mps: FloatArray) -> FloatArray:
        """Return the safety reward of both vehicles at t1.

        Args:
            dx_m: positions of the POV less those of the VUT.
            dv_mps: speeds of the POV less those of the VUT.
        """
        crash = -(np.abs(dx_m) < self.scenario.dx_crash_m).astype(np.float64)
        near = self.weights.ttc * self.phi_ttc(dx_m, dv_mps) + self.phi_dx(dx_m)
        return near + self.weights.crash * crash

    def pov_step(self, v_pov_mps: FloatArray, a_pov_mps2: FloatArray) -> FloatArray:
        """Return the POV's ego reward of one step of 0.1 s.

        Args:
            v_pov_mps: its speed at the start of the step.
            a_pov_mps2: its commanded acceleration.
        """
        weights = self.weights
        speed = weights.pov_v_hw * self.phi_v_hw(v_pov_mps)
        return (weights.pov_acc * -np.square(a_pov_mps2) + speed) * DT_S

    def vut_step(self, v_vut_mps: FloatArray, a_vut_mps2: FloatArray) -> FloatArray:
        """Return the VUT's running ego reward of one step of 0.1 s.

        Args:
            v_vut_mps: its speed at the start of the step.
            a_vut_mps2: its commanded acceleration.
        """
        weights = self.weights
        speed = weights.vut_v_min * -np.maximum(self.scenario.v_min_mps - v_vut_mps, 0.0)
        return (weights.vut_acc * -np.square(a_vut_mps2) + speed) * DT_S

    def vut_end(self, v_vut_mps: FloatArray) -> FloatArray:
        """Return the VUT's ego reward of its final speed, at t1.

        Args:
            v_vut_mps: its speed at t1.
        """
        return self.weights.vut_v_end * self.phi_v_hw(v_vut_mps)
