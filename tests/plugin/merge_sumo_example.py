"""One of each extension of merge-sumo; `pyproject.toml` registers them."""

from __future__ import annotations

import math

import numpy as np

from merge_sumo.controllers.controller import Controller, Seen
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions, ControllerSpec
from merge_sumo.errors import UserError
from merge_sumo.metrics.measures import Measures, measure
from merge_sumo.samplers.base import LevelwiseSampler
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import POV, VUT


class MiddleSampler(LevelwiseSampler):
    """Draws from a beta distribution around the middle of each coordinate."""

    about = "prefers the middle of the pool"
    colour = "#994F00"
    learns = False

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return `n` points, (n, d)."""
        return rng.beta(2.0, 2.0, size=(n, history.dims))


@measure(worse="low", unit="m", label="closest approach", column="closest", missing=math.inf)
def closest_m(episode: Measures) -> float:
    """Least distance of the front bumpers of VUT and POV up to M."""
    x_m = episode.trajectory.motion[:, :, 0]
    return float(np.abs(x_m[:, POV] - x_m[:, VUT]).min())


class ConstantController(Controller):
    """Drives with one acceleration in every step."""

    def __init__(self, acceleration_mps2: float) -> None:
        """Take the acceleration."""
        self._acceleration_mps2 = acceleration_mps2

    def act(self, _seen: Seen) -> float:
        """Return the acceleration."""
        return self._acceleration_mps2


class ConstantKind(ControllerKind):
    """`constant:MPS2`."""

    form = "constant:MPS2"
    what = "one acceleration in every step"
    example = "--vut constant:0.5"

    def __init__(self, spec: ControllerSpec, options: ControllerOptions) -> None:
        """Read the acceleration; `UserError` where it is not a number."""
        super().__init__(spec, options)
        try:
            self._acceleration_mps2 = float(spec.argument)
        except ValueError as error:
            raise UserError(f"{spec}: give an acceleration in m/s2") from error

    def controller(self) -> Controller:
        """Return a controller of one corridor."""
        return ConstantController(self._acceleration_mps2)
