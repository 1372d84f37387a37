"""Level-k drivers: greedy on a learned action-value function Q (Wang et al., section IV-C).

The networks are trained by `merge_sumo.training` with torch. They act in float64 numpy, so that a
campaign needs no torch, and each corridor is evaluated on its own, so that an episode does not
depend on concurrent episodes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.level0 import level0_time_to
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import Scenario, Units

BRAKING = (1.0, 0.75, 0.5, 0.25)
"""Shares of the hardest braking that a learned driver chooses from; it may also coast."""
ACCELERATING = (0.5, 1.0)
"""Shares of the hardest acceleration that it chooses from."""
ACTIONS = len(BRAKING) + 1 + len(ACCELERATING)
DECISION_STEPS = 5
"""A learned driver decides every 0.5 s and holds its acceleration in between."""

BLOCK = 256
"""Rows of a product: their hidden units fit into the cache of a core."""

FEATURES = 26
SVO_FEATURES = 2
LEVEL0_GAP_FEATURE = 8
"""Column with the gap at M if the POV keeps its speed and the VUT the level-0 profile, as
tanh(gap / 25 m)."""
LIMIT = "a_min_mps2"
"""Name of the tensor, (1,), with the hardest braking that a network chooses, where it has one."""
_HORIZON_S = 20.0
_GAP_SCALES_M = (80.0, 25.0, 8.0)


class AccelerationLimits(Protocol):
    """Least and largest acceleration, m/s2, as of a scenario."""

    @property
    def a_min_mps2(self) -> float:
        """Least acceleration."""

    @property
    def a_max_mps2(self) -> float:
        """Largest acceleration."""


def actions_mps2(scenario: AccelerationLimits) -> FloatArray:
    """Return the accelerations of the actions of a learned driver, (7,), in rising order.

    In the paper's scenario they are the whole numbers from -4 to +2 m/s2.

    Args:
        scenario: gives the hardest braking and acceleration.
    """
    braking = np.array(BRAKING) * scenario.a_min_mps2
    accelerating = np.array(ACCELERATING) * scenario.a_max_mps2
    return np.concatenate([braking, [0.0], accelerating])


def features(
    state: Sequence[FloatArray] | FloatArray,
    svo_rad: FloatArray | None = None,
    *,
    scenario: Scenario,
) -> FloatArray:
    """Compute the inputs of a network.

    All are functions of the state [x_POV, v_POV, x_VUT, v_VUT] and psi alone: the state itself,
    scaled; the time of the VUT to M on the level-0 profile, at constant speed and at full
    acceleration; the gap at M that follows from them for a POV that keeps its speed, accelerates
    or brakes, each on three scales; and final speeds. A gap decides the reward, so that a network
    that sees gaps learns in minutes.

    Times and gaps follow from the limits of the scenario, in its units. The numbers below are those
    of the scenario of the paper, whose units are 1.

    Args:
        state: x_POV and v_POV, x_VUT and v_VUT, (n,) each, in m and m/s.
        svo_rad: social value orientations psi of the POV, (n,); None for a network without them.
        scenario: the scenario that is played.

    Returns:
        The inputs, (n, 26), or (n, 28) with psi.
    """
    unit = Units.of(scenario)
    x_pov_m, v_pov_mps, x_vut_m, v_vut_mps = state
    times, gaps, v_level0, v_full = prospects(state, scenario)
    v_hw = scenario.v_hw_min_mps
    columns = [
        x_pov_m / (100.0 * unit.length) + 1.0,
        (v_pov_mps - (v_hw + 3.4 * unit.speed)) / (6.0 * unit.speed),
        x_vut_m / (100.0 * unit.length) + 1.0,
        (v_vut_mps - (v_hw - 2.6 * unit.speed)) / (6.0 * unit.speed),
        *(t / (5.0 * unit.time) - 1.0 for t in times),
        *(np.tanh(gap / (scale * unit.gap)) for gap in gaps for scale in _GAP_SCALES_M),
        (v_level0 - v_hw) / (4.0 * unit.speed),
        (v_full - v_hw) / (8.0 * unit.speed),
        np.tanh((v_pov_mps - v_level0) / (3.0 * unit.speed)),
        (v_pov_mps - v_hw) / (4.0 * unit.speed),
    ]
    if svo_rad is not None:
        columns += svo_features(svo_rad)
    return np.stack(columns, axis=-1)


def svo_features(svo_rad: FloatArray) -> list[FloatArray]:
    """Return the inputs of a network for social value orientations, two arrays of their shape.

    Args:
        svo_rad: social value orientations of the POV, in rad.
    """
    return [np.cos(svo_rad) * 2.0 - 1.0, np.sin(svo_rad) * 2.0 - 1.0]


def prospects(
    state: Sequence[FloatArray] | FloatArray, scenario: Scenario
) -> tuple[tuple[FloatArray, ...], tuple[FloatArray, ...], FloatArray, FloatArray]:
    """Predict times, gaps and speeds at M; every array has the shape (n,).

    Args:
        state: x_POV and v_POV, x_VUT and v_VUT, (n,) each, in m and m/s.
        scenario: the scenario that is played.

    Returns:
        The VUT's times to M in s on the level-0 profile, at constant speed and at full
        acceleration; the gaps in m at M for a POV that keeps its speed, accelerates and brakes
        until the first of these times, and that keeps its speed until the others; the speeds of
        the VUT at M in m/s on the level-0 profile and at full acceleration.
    """
    x_pov_m, v_pov_mps, x_vut_m, v_vut_mps = state
    a_min, a_max = scenario.a_min_mps2, scenario.a_max_mps2
    a_level0, v_cruise = scenario.level0_a_mps2, scenario.level0_v_mps
    unit = Units.of(scenario)
    horizon_s = _HORIZON_S * unit.time
    distance = np.maximum(-x_vut_m, 0.0)
    t_level0 = np.minimum(level0_time_to(distance, v_vut_mps, scenario), horizon_s)
    t_constant = np.minimum(distance / np.maximum(v_vut_mps, 0.5 * unit.speed), horizon_s)
    t_full = (np.sqrt(v_vut_mps * v_vut_mps + 2.0 * a_max * distance) - v_vut_mps) / a_max
    t_brake = np.minimum(t_level0, v_pov_mps / -a_min)
    gaps = (
        x_pov_m + v_pov_mps * t_level0,
        x_pov_m + (v_pov_mps + 0.5 * a_max * t_level0) * t_level0,
        x_pov_m + (v_pov_mps + 0.5 * a_min * t_brake) * t_brake,
        x_pov_m + v_pov_mps * t_constant,
        x_pov_m + v_pov_mps * t_full,
    )
    v_level0 = np.maximum(v_vut_mps, np.minimum(v_vut_mps + a_level0 * t_level0, v_cruise))
    return (t_level0, t_constant, t_full), gaps, v_level0, v_vut_mps + a_max * t_full


class QNetwork:
    """A multilayer perceptron with rectified units that gives Q of every action.

    Example:
        network = load_network("pov1")
        actions = network.greedy(features(state, scenario=US23))

    Attributes:
        layers: pairs of weights, (outputs, inputs), and biases, (outputs,).
        a_min_mps2: hardest braking that its driver chooses; None for that of the scenario.
    """

    def __init__(
        self,
        layers: Sequence[tuple[FloatArray, FloatArray]],
        a_min_mps2: float | None = None,
    ) -> None:
        """Keep the layers in float64 and in float32.

        Args:
            layers: pairs of weights, (outputs, inputs), and biases, (outputs,).
            a_min_mps2: hardest braking that its driver chooses; None for that of the scenario.
        """
        self.a_min_mps2 = a_min_mps2
        self.layers = []
        self._single = []
        for weight, bias in layers:
            double = np.ascontiguousarray(weight, dtype=np.float64), bias.astype(np.float64)
            self.layers.append(double)
            self._single.append((weight.T.astype(np.float32), bias.astype(np.float32)))

    @classmethod
    def from_tensors(cls, tensors: Mapping[str, FloatArray], inputs: int) -> QNetwork:
        """Return the network of tensors, after a check of their names and shapes.

        Args:
            tensors: 0.weight, 0.bias, 1.weight, ..., and the limit of braking, (1,), if it has one.
            inputs: number of inputs that it must have.

        Raises:
            ValueError: for other names, shapes or types, some of which numpy would broadcast.
        """
        count = max(len(tensors) // 2, 1)
        names = [(f"{i}.weight", f"{i}.bias") for i in range(count)]
        if set(tensors) - {LIMIT} != set(chain(*names)):
            raise ValueError(f"its tensors are {sorted(tensors)} instead of 0.weight, 0.bias, ...")
        layers = [(tensors[weight], tensors[bias]) for weight, bias in names]
        for i, (weight, bias) in enumerate(layers):
            outputs = ACTIONS if i == count - 1 else bias.size
            fits = weight.shape == (outputs, inputs) and bias.shape == (outputs,)
            if not fits or {weight.dtype, bias.dtype} != {np.dtype(np.float32)}:
                raise ValueError(
                    f"{i}.weight is {weight.shape} of {weight.dtype}, and {i}.bias is "
                    f"{bias.shape} of {bias.dtype}: they must be float32, (outputs, {inputs}) and "
                    f"(outputs,), with {ACTIONS} outputs in the last layer"
                )
            inputs = outputs
        if LIMIT not in tensors:
            return cls(layers)
        limit_mps2 = float(tensors[LIMIT].item())
        if not -20.0 <= limit_mps2 < 0.0:
            raise ValueError("its braking limit is not from -20 to below 0 m/s2")
        return cls(layers, limit_mps2)

    def limited(self, scenario: Scenario) -> Scenario:
        """Return the scenario with the limit of braking of the network, if it brakes less hard.

        The observations and the actions of the network are those of this scenario.

        Args:
            scenario: the scenario that is played.
        """
        if self.a_min_mps2 is None or self.a_min_mps2 <= scenario.a_min_mps2:
            return scenario
        return replace(scenario, a_min_mps2=self.a_min_mps2)

    @property
    def sees_svo(self) -> bool:
        """Whether the network's input has the social value orientation."""
        return bool(self.layers[0][0].shape[1] == FEATURES + SVO_FEATURES)

    def observe(
        self, state: Sequence[FloatArray] | FloatArray, svo_rad: FloatArray, scenario: Scenario
    ) -> FloatArray:
        """Compute the inputs of this network.

        Args:
            state: x_POV and v_POV, x_VUT and v_VUT, (n,) each, in m and m/s.
            svo_rad: social value orientations of the POV, (n,), which not every network sees.
            scenario: the scenario that is played.

        Returns:
            The inputs, (n, 26) or (n, 28).
        """
        psi = svo_rad if self.sees_svo else None
        return features(state, psi, scenario=self.limited(scenario))

    def values(self, inputs: FloatArray) -> FloatArray:
        """Compute Q of every action.

        Every row is a matrix-vector product of its own, so that it is the same to the last bit with
        any other rows. Q is not finite where the products are too large.

        Args:
            inputs: inputs, (n, features).

        Returns:
            Q, (n, actions).
        """
        hidden = inputs[..., None]
        weight, bias = self.layers[-1]
        with np.errstate(over="ignore", invalid="ignore"):
            for of_hidden, bias_of_hidden in self.layers[:-1]:
                hidden = np.maximum(np.matmul(of_hidden, hidden) + bias_of_hidden[:, None], 0.0)
            return np.asarray((np.matmul(weight, hidden) + bias[:, None])[..., 0])

    def values_at_once(self, inputs: FloatArray) -> NDArray[np.float32]:
        """Compute Q in float32 by products of whole matrices, for training and searching.

        It is several times faster than `values` for many rows. Products of one size give the same
        row with any other rows, but no library promises that to the last bit, as driving needs it.

        Args:
            inputs: inputs, (n, features).

        Returns:
            Q, (n, actions).
        """
        n = len(inputs)
        rows: NDArray[np.float32] = np.zeros(
            (math.ceil(n / BLOCK) * BLOCK, inputs.shape[1]), np.float32
        )
        rows[:n] = inputs
        last_weight, last_bias = self._single[-1]
        values = np.empty((len(rows), len(last_bias)), dtype=np.float32)
        for first in range(0, n, BLOCK):
            hidden = rows[first : first + BLOCK]
            for weight, bias in self._single[:-1]:
                hidden = hidden @ weight
                hidden += bias
                np.maximum(hidden, 0.0, out=hidden)
            values[first : first + BLOCK] = hidden @ last_weight + last_bias
        return values[:n]

    def greedy(self, inputs: FloatArray) -> NDArray[np.int64]:
        """Choose the actions of the highest Q by `values`.

        Args:
            inputs: inputs, (n, features).

        Returns:
            Indices of actions, (n,); -1 where Q is not finite.
        """
        values = self.values(inputs)
        return np.where(np.isfinite(values).all(axis=1), values.argmax(axis=1), -1)


class LevelKDriver(Driver):
    """Takes the action of the highest Q every 0.5 s and holds it.

    Example:
        driver = LevelKDriver(corridors=1, network=load_network("vut1"))
        driver.begin(0, case)
        a_mps2 = driver.act(scene)

    Attributes:
        network: the network, trained as POV or as VUT.
    """

    def __init__(self, corridors: int, network: QNetwork) -> None:
        """Drive by a network.

        Args:
            corridors: number of corridors, K.
            network: the network.
        """
        super().__init__(corridors)
        self.network = network
        self._svo_rad = np.zeros(corridors)
        self._held = np.zeros(corridors)
        """Accelerations, (K,); NaN where the action values of the last decision were not finite."""

    def begin(self, corridor: int, case: Case) -> None:
        """Take the social value orientation of a case.

        Args:
            corridor: index of the corridor.
            case: the case of the next episode.
        """
        super().begin(corridor, case)
        self._svo_rad[corridor] = case.svo_rad or 0.0

    def act(self, scene: Scene) -> FloatArray:
        """Return the held accelerations, (K,), after a decision where one is due.

        They are NaN where an action value is not finite.

        Args:
            scene: the present state.
        """
        due = np.flatnonzero((scene.step % DECISION_STEPS == 0) & scene.active)
        if not due.size:
            return self._held
        columns = scene.x_pov_m, scene.v_pov_mps, scene.x_vut_m, scene.v_vut_mps
        state = [column[due] for column in columns]
        limited = self.network.limited(self.scenario)
        inputs = self.network.observe(state, self._svo_rad[due], limited)
        actions = self.network.greedy(inputs)
        self._held[due] = np.where(actions < 0, np.nan, actions_mps2(limited)[actions])
        return self._held

    def reason(self, corridor: int) -> str | None:
        """Return why the answer for a corridor is NaN; None for a finite one.

        Args:
            corridor: index of the corridor.
        """
        if np.isfinite(self._held[corridor]):
            return None
        return "its policy gives action values that are not finite"
