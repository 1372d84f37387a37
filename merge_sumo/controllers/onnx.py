"""A VUT as an ONNX network from the state to an acceleration, or to values of actions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_sumo.controllers.controller import Controller, Seen, Start, as_merge
from merge_sumo.controllers.spec import FileKind
from merge_sumo.drivers.levelk import ACTIONS, actions_mps2
from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import DT_S

STATE = ("x_pov_m", "v_pov_mps", "x_vut_m", "v_vut_mps")
"""The columns of a network's input, (1, 4)."""
SEED = "seed"
"""Name of an optional input: the seed of the case, one number."""
PERIOD = "decision_period_s"
"""Metadata of a network, or parameter of a spec: time between two decisions of the network."""
DTYPES: dict[str, Any] = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(int64)": np.int64,
}


class OnnxKind(FileKind):
    """A network: `onnx:FILE?decision_period_s=...`.

    Its last output may be the merge request, on a road with an acceleration lane.

    Attributes:
        period_steps: steps from one decision to the next.
    """

    form = "onnx:FILE[?decision_period_s=SECONDS]"
    what = "an ONNX network that returns an acceleration, or values of the 7 actions"
    example = "--vut onnx:policy.onnx"
    no_parameters = "the parameters of a network are its weights"
    library = "onnxruntime"
    names = (PERIOD,)

    def load(self) -> None:
        """Load the network.

        Raises:
            UserError: if it cannot be loaded, or cannot drive.
        """
        super().load()
        # One thread: answers must not depend on the cores of the machine.
        settings = self.api.SessionOptions()
        settings.intra_op_num_threads = settings.inter_op_num_threads = 1
        settings.log_severity_level = 4
        providers = ["CPUExecutionProvider"]
        try:
            self._session = self.api.InferenceSession(str(self.path), settings, providers)
        except Exception as error:  # onnxruntime has a class of its own for every failure
            raise UserError(f"{self.path} is not a usable ONNX network: {error}") from error
        self._input: Any = None
        self._seed: Any = None
        for each in self._session.get_inputs():
            if each.name == SEED:
                self._seed = each
            else:
                self._input = each
        self._check_output()
        metadata = self._session.get_modelmeta().custom_metadata_map
        text = self.chosen.get(PERIOD) or metadata.get(PERIOD) or str(DT_S)
        try:
            self.period_steps = round(float(text) / DT_S)
        except (ValueError, OverflowError):
            self.period_steps = 0
        if self.period_steps < 1:
            raise UserError(f"{self.path}: {PERIOD} is {text!r}: it must be {DT_S} s or more")

    def controller(self) -> Controller:
        """Return a controller of one corridor."""
        return OnnxController(self)

    def run(self, state: tuple[float, ...], seed: int = 0) -> NDArray[Any]:
        """Return the output for one state, flat.

        Args:
            state: values of `STATE`, in m and m/s.
            seed: seed of the case, for a network that has an input for it.
        """
        values = {self._input.name: np.array([state], DTYPES[self._input.type])}
        if self._seed is not None:
            # An axis without a number is that of a batch.
            shape = [size if isinstance(size, int) else 1 for size in self._seed.shape]
            values[SEED] = np.full(shape, seed, DTYPES[self._seed.type])
        return np.asarray(self._session.run(None, values)[0]).ravel()

    def _check_output(self) -> None:
        """Raise `UserError` if the network does not run, or its output cannot drive."""
        try:
            output = self.run((0.0, 0.0, 0.0, 0.0))
        except Exception as error:  # also of inputs of other types
            raise UserError(
                f"{self.path} does not run with the inputs of a VUT: floats of shape (1, 4) with "
                f"{', '.join(STATE)}, and optionally {SEED}, a float, a double or an int64 "
                f"({type(error).__name__}: {error})"
            ) from error
        if output.dtype.kind != "f" or output.size not in (1, 2, ACTIONS, ACTIONS + 1):
            raise UserError(
                f"{self.path} has {output.size} outputs of type {output.dtype}. A VUT has floats: "
                f"one acceleration, or {ACTIONS} action values from the hardest braking to the "
                "hardest acceleration (without ArgMax). One more output may request the merge."
            )


class OnnxController(Controller):
    """Asks the network when a decision is due, and holds the decision in between."""

    def __init__(self, network: OnnxKind) -> None:
        """Take the network, which all corridors share.

        Args:
            network: the network.
        """
        self._network = network
        self._held: Any = 0.0

    def reset(self, start: Start) -> None:
        """Take the accelerations of the actions, and the seed.

        Args:
            start: first observation of the episode.
        """
        self._actions_mps2, self._seed = actions_mps2(start), start.seed

    def act(self, seen: Seen) -> Any:
        """Return the last decision; the network decides again when that is due.

        Args:
            seen: the observation at this step.

        Returns:
            An acceleration in m/s2, or (acceleration, whether to merge).
        """
        if round(seen.t_s / DT_S) % self._network.period_steps == 0:
            self._held = self._decision(seen[1:])
        return self._held

    def _decision(self, state: tuple[float, ...]) -> Any:
        """Return the acceleration, or that of the best action; with any merge request."""
        output = self._network.run(state, self._seed)
        values = output if output.size in (1, ACTIONS) else output[:-1]
        acceleration_mps2 = math.nan
        if values.size == 1:
            acceleration_mps2 = float(values[0])
        elif np.isfinite(values).all():
            acceleration_mps2 = float(self._actions_mps2[int(values.argmax())])
        if values is output:
            return acceleration_mps2
        return acceleration_mps2, as_merge(float(output[-1]))
