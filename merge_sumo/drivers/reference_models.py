"""Published models of a reference driver: when it brakes for a vehicle ahead, and how hard.

They describe rear-end conflicts on one lane. Of two vehicles the rear one has to react. Parameters
are those of the JRC-FSM reference implementation (European Commission, Joint Research Centre:
ec-jrc/JRC-FSM, commit 01b05c2), which compares the models on the cut-ins of UN Regulation No. 157.
`tests/drivers/test_cut_in.py` compares these functions with its tables.

`drivers/reference_drivers.py` applies the models to a merge.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S

Flags = NDArray[np.bool_]


class Pair(NamedTuple):
    """Two vehicles on one lane, the rear one of which may have to react; arrays of shape (K,).

    Attributes:
        gap_m: distance from the front bumper of the rear vehicle to the rear bumper of the other.
        v_rear_mps: speed of the rear vehicle.
        v_front_mps: speed of the front vehicle.
        a_rear_mps2: acceleration of the rear vehicle.
    """

    gap_m: FloatArray
    v_rear_mps: FloatArray
    v_front_mps: FloatArray
    a_rear_mps2: FloatArray | float = 0.0


JERK_MPS3 = 12.65
"""Growth of the deceleration: UN R157, Annex 3, Appendix 3."""
HARDEST_MPS2 = 0.774 * 9.81
"""Hardest deceleration of the careful driver: UN R157, Annex 3, Appendix 3."""


class ReferenceModel(ABC):
    """When a driver brakes for a vehicle ahead, and how hard; arrays of shape (K,).

    Attributes:
        perception_steps: steps for which a risk is predicted before the delay begins.
        delay_steps: steps from the first risk to the first braking.
        delay_s: delay in the formulas.
        released_mps2: deceleration in the delay, with the pedal released.
        growth_mps2: growth of the deceleration in a step.
        hardest_mps2: hardest deceleration, positive.

    Example:
        unsafe = FsmModel().is_unsafe(Pair(gap_m, v_rear_mps, v_front_mps))
    """

    perception_steps: int = 0
    delay_steps: int = 8
    delay_s: float = 0.75
    released_mps2: float = 0.0
    growth_mps2: float = JERK_MPS3 * DT_S
    hardest_mps2: float = HARDEST_MPS2

    @abstractmethod
    def is_unsafe(self, pair: Pair) -> Flags:
        """Return whether the rear vehicle is too close, (K,).

        Args:
            pair: the vehicles.
        """

    def endangers(self, pair: Pair) -> Flags:
        """Return whether the front vehicle must not get in front of the rear one like this, (K,).

        Args:
            pair: the vehicles.
        """
        return self.is_unsafe(pair)

    def demand_mps2(self, pair: Pair) -> FloatArray:
        """Return the deceleration that an unsafe state demands, (K,), positive.

        Args:
            pair: the vehicles.
        """
        return np.full(np.shape(pair.v_rear_mps), self.hardest_mps2)


class CarefulModel(ReferenceModel):
    """The careful and competent human driver (CC): UN R157, Annex 3, performance model 1.

    Unsafe is a time to collision of 2 s or less.
    """

    perception_steps = 4
    released_mps2 = 0.4
    critical_ttc_s: float = 2.0

    def is_unsafe(self, pair: Pair) -> Flags:
        """Return whether the time to collision is at most 2 s, (K,).

        Args:
            pair: the vehicles.
        """
        return bumper_ttc_s(*pair[:3]) <= self.critical_ttc_s


class Reg157Model(ReferenceModel):
    """The requirement of UN R157 on lane-keeping systems in a cut-in (5.2.5.2), as a driver.

    A system has to avoid a collision where TTC > (v_r - v_f) / (2 * 6 m/s2) + 0.35 s when the other
    vehicle intrudes into its lane. The driver brakes at once by 6 m/s2, 0.35 s later.

    Attributes:
        bound_s: constant part of the bound. The published code adds a step, 0.1 s.
    """

    bound_s = 0.35

    delay_steps = 4
    delay_s = 0.35
    growth_mps2 = np.inf
    hardest_mps2 = 6.0

    def is_unsafe(self, pair: Pair) -> Flags:
        """Return whether the time to collision is at most the bound, (K,).

        Args:
            pair: the vehicles.
        """
        closing_mps = pair.v_rear_mps - pair.v_front_mps
        bound_s = closing_mps / (2.0 * self.hardest_mps2) + self.bound_s
        return bumper_ttc_s(*pair[:3]) <= bound_s


class RssModel(ReferenceModel):
    """Responsibility-sensitive safety (Shalev-Shwartz, Shammah, Shashua, arXiv:1708.06374, 2017).

    Unsafe is a gap below the safe distance of definition 1.
    """

    accel_mps2: float = 3.0
    brake_mps2: float = 6.0

    def is_unsafe(self, pair: Pair) -> Flags:
        """Return whether the gap is shorter than the safe distance, (K,).

        Args:
            pair: the vehicles.
        """
        limits = self.delay_s, self.accel_mps2, self.brake_mps2, self.brake_mps2
        return pair.gap_m < rss_distance_m(pair.v_rear_mps, pair.v_front_mps, *limits)


class FsmModel(ReferenceModel):
    """The fuzzy safety model: performance model 2 of UN R157 (Mattas et al., 2020 and 2022).

    Unsafe is PFS + CFS > 0. It brakes by 4 + 2 CFS where CFS > 0, else by 4 PFS.
    """

    hardest_mps2 = 6.0
    comfortable_mps2: float = 4.0
    leader_mps2: float = 7.0
    margin_m: float = 2.0

    def is_unsafe(self, pair: Pair) -> Flags:
        """Return whether one of the two metrics is above 0, (K,).

        Args:
            pair: the vehicles.
        """
        return self.cfs(pair) + self.pfs(pair) > 0.0

    def endangers(self, pair: Pair) -> Flags:
        """Return whether CFS is above 0, (K,): PFS is a precaution of the rear vehicle alone.

        Args:
            pair: the vehicles.
        """
        return self.cfs(pair) > 0.0

    def demand_mps2(self, pair: Pair) -> FloatArray:
        """Return the deceleration that follows from the metrics, (K,), positive.

        Args:
            pair: the vehicles.
        """
        critical, comfortable = self.cfs(pair), self.comfortable_mps2
        hard = comfortable + (self.hardest_mps2 - comfortable) * critical
        return np.where(critical > 0.0, hard, comfortable * self.pfs(pair))

    def pfs(self, pair: Pair) -> FloatArray:
        """Return the proactive fuzzy metric, 0 (safe) to 1: the leader may brake by 7 m/s2.

        With d = gap - margin: 0 from v_r tau + v_r^2 / (2 * 4) - v_f^2 / (2 * 7) + margin on, 1 up
        to v_r tau + v_r^2 / (2 * 6) - v_f^2 / (2 * 7), linear between.

        Args:
            pair: the vehicles.

        Returns:
            The metric, (K,).
        """
        gap_m, v_rear_mps, v_front_mps, _ = pair
        leader_m = v_front_mps * v_front_mps / (2.0 * self.leader_mps2)
        stop = v_rear_mps * v_rear_mps / 2.0
        reaction_m = v_rear_mps * self.delay_s - leader_m
        safe_m = reaction_m + stop / self.comfortable_mps2 + self.margin_m
        unsafe_m = reaction_m + stop / self.hardest_mps2
        return _between(gap_m - self.margin_m, safe_m, unsafe_m)

    def cfs(self, pair: Pair) -> FloatArray:
        """Return the critical fuzzy metric, 0 (safe) to 1: the leader keeps its speed.

        The rear vehicle keeps its acceleration a (not below -4 m/s2) for tau, and then brakes. With
        u its speed by then, s(b) = (v_r + a tau / 2 - v_f) tau + (u - v_f)^2 / (2 b): 0 from s(4)
        on, 1 up to s(6), linear between. Where u < v_f, 1 if the gap closes before the speeds are
        equal, else 0. Where v_r <= v_f, 0.

        Args:
            pair: the vehicles.

        Returns:
            The metric, (K,).
        """
        gap_m, v_rear_mps, v_front_mps, a_rear_mps2 = pair
        a = np.maximum(a_rear_mps2, -self.comfortable_mps2)
        after = v_rear_mps + self.delay_s * a - v_front_mps
        approach_m = (v_rear_mps + 0.5 * a * self.delay_s - v_front_mps) * self.delay_s
        stop = after * after / 2.0
        safe_m = approach_m + stop / self.comfortable_mps2
        found = _between(gap_m, safe_m, approach_m + stop / self.hardest_mps2)
        closing = v_rear_mps - v_front_mps
        # Only a vehicle that brakes gets slower than the leader within the delay.
        slowing = np.maximum(2.0 * np.abs(a_rear_mps2), 1e-12)
        slower = np.where(gap_m < closing * closing / slowing, 1.0, 0.0)
        return np.where(closing > 0.0, np.where(after < 0.0, slower, found), 0.0)


def bumper_ttc_s(gap_m: FloatArray, v_rear_mps: FloatArray, v_front_mps: FloatArray) -> FloatArray:
    """Compute the time to collision.

    Args:
        gap_m: gaps from bumper to bumper, (K,).
        v_rear_mps: speeds of the rear vehicle, (K,).
        v_front_mps: speeds of the front vehicle, (K,).

    Returns:
        The times in s, (K,): 0 where the vehicles overlap, infinite where the gap opens.
    """
    closing = v_rear_mps - v_front_mps
    times = np.where(closing > 0.0, gap_m / np.where(closing > 0.0, closing, 1.0), np.inf)
    return np.where(gap_m <= 0.0, 0.0, times)


def rss_distance_m(
    v_rear_mps: FloatArray,
    v_front_mps: FloatArray | float,
    response_s: float,
    accel_mps2: float,
    brake_min_mps2: float,
    brake_max_mps2: float,
) -> FloatArray:
    """Compute the safe distance of RSS.

    The rear vehicle accelerates for the response time, then brakes:
    [v_r rho + a rho^2 / 2 + (v_r + rho a)^2 / (2 b_min) - v_f^2 / (2 b_max)]+.

    Args:
        v_rear_mps: speeds of the rear vehicle v_r, (K,).
        v_front_mps: speeds of the front vehicle v_f, (K,) or one.
        response_s: response time rho.
        accel_mps2: acceleration a of the rear vehicle in that time.
        brake_min_mps2: its least braking b_min after that, positive.
        brake_max_mps2: hardest braking b_max of the front vehicle, positive.

    Returns:
        The distances in m, (K,).
    """
    fastest = v_rear_mps + response_s * accel_mps2
    stops_m = v_rear_mps * response_s + 0.5 * accel_mps2 * response_s**2
    stops_m = stops_m + fastest * fastest / (2.0 * brake_min_mps2)
    front_m = v_front_mps * v_front_mps / (2.0 * brake_max_mps2)
    return np.maximum(stops_m - front_m, 0.0)


def _between(gap_m: FloatArray, safe_m: FloatArray, unsafe_m: FloatArray) -> FloatArray:
    """Return 1 up to the unsafe distance, 0 from the safe one on, and linear between."""
    width = np.maximum(safe_m - unsafe_m, 1e-12)
    return np.clip((safe_m - gap_m) / width, 0.0, 1.0)


class Reaction:
    """The reaction of the published models in K corridors: a delay, then a growing deceleration.

    Unsafe steps first count as delay; from then on the deceleration grows in each. In a safe step
    the driver keeps its speed, and neither the delay nor the deceleration is reset.

    Example:
        reaction = Reaction(1, CarefulModel())
        a_mps2 = reaction.acceleration_mps2(unsafe, demand_mps2)
    """

    def __init__(self, corridors: int, model: ReferenceModel) -> None:
        """Begin with a full delay in all corridors.

        Args:
            corridors: number of corridors, K.
            model: gives the delay, the growth of the deceleration, and that with a released pedal.
        """
        self._model = model
        self._waited = np.zeros(corridors, dtype=np.int64)
        self._braking_mps2 = np.full(corridors, model.released_mps2)

    def forget(self, corridors: int | Flags) -> None:
        """Reset the delay and the deceleration.

        Args:
            corridors: index of a corridor, or a mask of corridors, (K,).
        """
        self._waited[corridors] = 0
        self._braking_mps2[corridors] = self._model.released_mps2

    def acceleration_mps2(self, unsafe: Flags, demand_mps2: FloatArray | float) -> FloatArray:
        """Return the accelerations of a step, (K,): 0 where it is safe, else 0 or less.

        Args:
            unsafe: whether the state is unsafe, (K,).
            demand_mps2: demanded deceleration, (K,) or one, positive.
        """
        waits = unsafe & (self._waited < self._model.delay_steps)
        brakes = unsafe & ~waits
        self._waited += waits
        harder = np.minimum(self._braking_mps2 + self._model.growth_mps2, demand_mps2)
        self._braking_mps2 = np.where(brakes, harder, self._braking_mps2)
        answer: FloatArray = np.where(brakes, -self._braking_mps2, 0.0)
        return np.where(waits, -self._model.released_mps2, answer)
