"""What a driver sees and answers: the scene of a step, and the interface of all drivers."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import POV, US23, VUT, Scenario
from merge_sumo.scenario.signals import StepSignals


class Scene(NamedTuple):
    """The state of K corridors with A vehicles each at one step.

    Attributes:
        active: whether an episode runs in the corridor, (K,); elsewhere the numbers are undefined.
        step: steps since the episode of the corridor began, (K,).
        x_m: distances of the front bumpers to M along their lanes, (A, K), negative before M.
        v_mps: speeds, (A, K).
        conflicting: row of the car that a driver of two-car games takes for the POV, (K,); None for
            the POV itself everywhere.
        merged: whether the VUT is on the mainline, from M on or since its merge from an
            acceleration lane, (K,); None where episodes end at M.

    Example:
        scene = Scene(np.array([True]), np.array([0]), x_m, v_mps)
        gap_m = scene.dx_at_m(scene.distance_m / scene.v_vut_mps)
    """

    active: NDArray[np.bool_]
    step: NDArray[np.int64]
    x_m: FloatArray
    v_mps: FloatArray
    conflicting: NDArray[np.int64] | None = None
    merged: NDArray[np.bool_] | None = None

    @property
    def x_pov_m(self) -> FloatArray:
        """Positions of the POV, (K,), or of the car that counts as POV."""
        return self._of_conflicting(self.x_m)

    @property
    def v_pov_mps(self) -> FloatArray:
        """Speeds of the POV, (K,), or of the car that counts as POV."""
        return self._of_conflicting(self.v_mps)

    @property
    def x_vut_m(self) -> FloatArray:
        """Positions of the VUT, (K,)."""
        return np.asarray(self.x_m[VUT])

    @property
    def v_vut_mps(self) -> FloatArray:
        """Speeds of the VUT, (K,)."""
        return np.asarray(self.v_mps[VUT])

    @property
    def distance_m(self) -> FloatArray:
        """Distances of the VUT to M, (K,); 0 after M."""
        return np.maximum(-self.x_vut_m, 0.0)

    def dx_at_m(self, t_s: FloatArray) -> FloatArray:
        """Predict dx at M, (K,), for a POV that keeps its speed; after M, from the VUT.

        Args:
            t_s: times until the VUT is at M, (K,); 0 after M.
        """
        return self.x_pov_m - np.maximum(self.x_vut_m, 0.0) + self.v_pov_mps * t_s

    def _of_conflicting(self, values: FloatArray) -> FloatArray:
        if self.conflicting is None:
            return np.asarray(values[POV])
        return values[self.conflicting, np.arange(values.shape[1])]

    def of_mainline(self) -> Scene:
        """Return the scene for the driver of all C cars of the mainline.

        Each car is the POV of its own corridor. So there are C K corridors: those of the POVs, then
        those of the cars ahead, then those of the cars behind.
        """
        cars = len(self.x_m) - 1
        if cars == 1:
            return self
        pairs = []
        for values in (self.x_m, self.v_mps):
            others = np.delete(values, VUT, axis=0)
            pairs.append(np.stack((others.ravel(), np.tile(values[VUT], cars))))
        merged = None if self.merged is None else np.tile(self.merged, cars)
        x_m, v_mps = pairs
        active, step = np.tile(self.active, cars), np.tile(self.step, cars)
        return Scene(active, step, x_m, v_mps, merged=merged)


class EpisodesLostError(Exception):
    """The running episodes of a driver are lost, and have to begin again.

    The process of its controllers has ended, or a call for several episodes at once has failed.
    """


class PovEpisodesLostError(EpisodesLostError):
    """The running episodes of the driver of the POV are lost."""


NO_REQUEST, STAY, MERGE = -1, 0, 1
"""Merge requests of a VUT on an acceleration lane. Without a request it merges at M."""


class Driver(ABC):
    """Drives the same vehicle in K corridors at once; the corridors are independent.

    Example:
        driver = RuleBasedVut(corridors=1, design=DESIGNS["design2"])
        driver.begin(0, case)
        a_mps2 = driver.act(scene)

    Attributes:
        scenario: the scenario of the episodes, which all corridors share.
    """

    scenario: Scenario = US23
    _merge_requests: NDArray[np.int8] | None = None

    def __init__(self, corridors: int) -> None:
        """Prepare for corridors 0 to `corridors` - 1.

        Args:
            corridors: number of corridors, K.
        """
        self.corridors = corridors

    def begin(self, corridor: int, case: Case) -> None:
        """Forget everything about a corridor: a new episode begins there.

        Args:
            corridor: index of the corridor.
            case: the case of the episode.
        """
        self.scenario = case.scenario

    @abstractmethod
    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration in each corridor, (K,), m/s2, until the next step.

        A value that is not finite ends the episode of its corridor as an error.

        Args:
            scene: the present state.

        Raises:
            EpisodesLostError: if the episodes of all corridors have to begin again.
        """

    def reason(self, corridor: int) -> str | None:
        """Return the reason why the last answer for a corridor was not finite; None if unknown.

        Args:
            corridor: index of the corridor.
        """
        return None

    def merge_requests(self) -> NDArray[np.int8] | None:
        """Return the merge requests of the last answers, (K,), or None without any.

        Each is `NO_REQUEST`, `STAY` or `MERGE`. A request is granted in the next step, if the VUT
        has reached the acceleration lane.
        """
        return self._merge_requests

    def clipped(self) -> NDArray[np.bool_] | None:
        """Return which of the last answers follow from commands outside the limits, (K,).

        None where the answers are the commands themselves.
        """
        return None

    def parameters(self) -> Mapping[str, float]:
        """Return the numbers that a spec may set as `?NAME=VALUE`, with their present values."""
        return {}

    def signals(self) -> Mapping[int, StepSignals]:
        """Return the signals of the last answers by corridor."""
        return {}

    def in_vain(self, corridor: int) -> Collection[str]:
        """Return the commands of this episode that were accepted but changed nothing.

        Args:
            corridor: index of the corridor.
        """
        return ()

    def files(self) -> tuple[Path, ...]:
        """Return the files of the user on which the answers have depended so far."""
        return ()

    def close(self) -> None:  # noqa: B027 (most drivers hold nothing)
        """Release the processes and sockets of the driver."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Design:
    """Parameters of a driver of this package, with units in their names.

    Raises:
        UserError: for a parameter that is not a number from 0 up, or by a check of a subclass.
    """

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value >= 0.0):
                raise UserError(f"{field.name} is {value}: it must be 0 or more")


@dataclass(frozen=True, slots=True)
class BuiltInVut:
    """A VUT of this package: a value of `VUTS` in a file of this folder, by its name.

    Example:
        VUTS = {"careful": BuiltInVut(CarefulVut)}

    Attributes:
        make: makes its driver for a number of corridors, with its design if it has one, or with a
            folder of networks if it is learned.
        design: the parameters that a spec may set, with their defaults.
        network: name of the network of a learned VUT.
        ramp_only: whether it cannot drive a POV.
    """

    make: Callable[..., Driver]
    design: Design | None = None
    network: str = ""
    ramp_only: bool = False


class DriverWrapper(Driver):
    """Drives by another driver: a base for drivers that change its input or its output."""

    def __init__(self, driver: Driver) -> None:
        """Wrap a driver.

        Args:
            driver: the driver.
        """
        super().__init__(driver.corridors)
        self._driver = driver

    def begin(self, corridor: int, case: Case) -> None:
        """Begin an episode for the driver.

        Args:
            corridor: index of the corridor.
            case: the case of the episode.
        """
        super().begin(corridor, case)
        self._driver.begin(corridor, case)

    def reason(self, corridor: int) -> str | None:
        """Return the reason of the driver.

        Args:
            corridor: index of the corridor.
        """
        return self._driver.reason(corridor)

    def merge_requests(self) -> NDArray[np.int8] | None:
        """Return the merge requests of the driver, (K,)."""
        return self._driver.merge_requests()

    def clipped(self) -> NDArray[np.bool_] | None:
        """Return which of the commands of the driver were outside the limits, or None."""
        return self._driver.clipped()

    def signals(self) -> Mapping[int, StepSignals]:
        """Return the signals of the driver."""
        return self._driver.signals()

    def in_vain(self, corridor: int) -> Collection[str]:
        """Return the commands of the driver that changed nothing.

        Args:
            corridor: index of the corridor.
        """
        return self._driver.in_vain(corridor)

    def files(self) -> tuple[Path, ...]:
        """Return the files that the driver has loaded so far."""
        return self._driver.files()

    def close(self) -> None:
        """Close the driver."""
        self._driver.close()
