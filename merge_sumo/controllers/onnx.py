"""A VUT as an ONNX network: the state goes in, an acceleration or action values come out.

One number more is whether to merge, on a road with an acceleration lane.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.controllers.base import ControllerKind, VutOptions, VutSpec
from merge_sumo.controllers.controller import Controller, Seen, Start, as_merge
from merge_sumo.drivers.levelk import ACTIONS, actions_mps2
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S

PERIOD: Final = "decision_period_s"
"""Metadata of a network, or option: it decides this often and holds its decision."""
STATE: Final = ("x_pov_m", "v_pov_mps", "x_vut_m", "v_vut_mps")
"""The columns of a network's input, (1, 4)."""
SEED: Final = "seed"
"""An input that a network need not have: the seed of the case, one number."""
WISH: Final = 1
"""Numbers of an output that say whether to merge: the last one, if there."""
Decision = float | tuple[float, bool]
"""An acceleration, or it and whether to merge."""
_DTYPES: Final = {"tensor(float)": np.float32, "tensor(double)": np.float64}
_ANSWERS: Final = (*_DTYPES, "tensor(float16)")
"""Types of outputs: an integer would be the index of an action, or a class, and no acceleration."""
_SEEDS: Final[dict[str, Any]] = {**_DTYPES, "tensor(int64)": np.int64}


class Network:
    """A checked network; `UserError` when the file is missing or is no such network."""

    def __init__(self, path: Path, period_s: str | None) -> None:
        try:
            import onnxruntime as ort
        except ImportError as error:
            raise UserError(
                "an ONNX network needs onnxruntime: run `pip install 'merge-sumo[onnx]'`"
            ) from error
        if not path.is_file():
            raise UserError(f"there is no ONNX file {path}")
        # One thread: answers must not depend on the cores of the machine.
        settings = ort.SessionOptions()
        settings.intra_op_num_threads = settings.inter_op_num_threads = 1
        settings.log_severity_level = 4
        try:
            self._session: Any = ort.InferenceSession(
                str(path), settings, providers=["CPUExecutionProvider"]
            )
        except Exception as error:  # onnxruntime has a class of its own for every failure
            raise UserError(f"{path} is no ONNX network that can be run: {error}") from error
        given = {i.name: i for i in self._session.get_inputs()}
        seed = given.pop(SEED, None) if len(given) > 1 else None
        inputs = list(given.values())
        self._seed: tuple[Any, list[int]] | None = None
        if seed is not None:
            # An axis without a number is one of a batch.
            self._seed = _SEEDS.get(seed.type), [d if isinstance(d, int) else 1 for d in seed.shape]
            if self._seed[0] is None or math.prod(self._seed[1]) != 1:
                raise UserError(
                    f"{path} has the input {SEED} {seed.type} {seed.shape}: it is one number, a "
                    "float, a double or an int64"
                )
        if len(inputs) != 1 or inputs[0].type not in _DTYPES or list(inputs[0].shape)[-1:] != [4]:
            said = ", ".join(f"{i.name} {i.type} {i.shape}" for i in inputs)
            raise UserError(
                f"{path} has the inputs {said}: a VUT has one of floats, (1, 4), with "
                f"{', '.join(STATE)}"
            )
        self._input, self._dtype = inputs[0].name, _DTYPES[inputs[0].type]
        self._check_output(path)
        metadata = self._session.get_modelmeta().custom_metadata_map
        text = period_s or metadata.get(PERIOD) or str(DT_S)
        try:
            self.period_steps = round(float(text) / DT_S)
        except (ValueError, OverflowError):
            self.period_steps = 0
        if self.period_steps < 1:
            raise UserError(f"{path}: {PERIOD} is {text!r}: give seconds, {DT_S} or more")

    def _check_output(self, path: Path) -> None:
        """Raise `UserError` where the network does not run, or its output is none of a VUT."""
        output = self._session.get_outputs()[0]
        if output.type not in _ANSWERS:
            raise UserError(
                f"{path} gives {output.name} {output.type}, and a VUT gives floats: the index of "
                f"an action is no acceleration, so let the network give the {ACTIONS} values of "
                "actions without ArgMax, or run it in a VUT in Python (FILE.py:CLASS) that answers "
                "the acceleration of its action in m/s2"
            )
        try:
            outputs = self.run((0.0, 0.0, 0.0, 0.0))
        except Exception as error:
            raise UserError(f"{path} cannot be run with an input (1, 4): {error}") from error
        if outputs.size not in (1, ACTIONS, 1 + WISH, ACTIONS + WISH):
            raise UserError(
                f"{path} gives {outputs.size} numbers: a VUT gives one acceleration, or "
                f"{ACTIONS} values of actions, from the hardest braking to the hardest "
                "acceleration, and perhaps one number more, which is whether to merge"
            )

    def run(self, state: tuple[float, ...], seed: int = 0) -> np.ndarray[Any, Any]:
        """Return the flat output for one state, and a seed for a network that takes one."""
        fed = {self._input: np.array([state], dtype=self._dtype)}
        if self._seed is not None:
            dtype, shape = self._seed
            fed[SEED] = np.full(shape, seed, dtype=dtype)
        return np.asarray(self._session.run(None, fed)[0]).ravel()

    def decision(self, state: tuple[float, ...], of_actions: FloatArray, seed: int) -> Decision:
        """Return the acceleration, or that of the action of the highest value, and any wish."""
        output = self.run(state, seed)
        values = output if output.size in (1, ACTIONS) else output[:-WISH]
        if values.size == 1:
            acceleration_mps2 = float(values[0])
        elif np.isfinite(values).all():
            acceleration_mps2 = float(of_actions[int(values.argmax())])
        else:
            acceleration_mps2 = float("nan")
        if values is output:
            return acceleration_mps2
        return acceleration_mps2, as_merge(float(output[-WISH]))


class OnnxController(Controller):
    """Asks the network when a decision is due, and holds the decision in between."""

    def __init__(self, network: Network) -> None:
        """Take the network, which all corridors share."""
        self._network = network
        self._held: Decision = 0.0

    def reset(self, start: Start) -> None:
        """Take the accelerations of the actions, and the seed."""
        self._of_actions, self._seed = actions_mps2(start), start.seed

    def act(self, seen: Seen) -> Decision:
        """Return the held decision; the network decides again where that is due."""
        if round(seen.t_s / DT_S) % self._network.period_steps == 0:
            self._held = self._network.decision(seen[1:], self._of_actions, self._seed)
        return self._held


class OnnxKind(ControllerKind):
    """A network: `onnx:FILE?decision_period_s=...`."""

    form = "onnx:FILE[?decision_period_s=SECONDS]"
    what = "a network from the state to an acceleration, or to values of the 7 actions"
    example = "--vut onnx:policy.onnx"
    no_parameters = "the parameters of a network are its weights"
    hosted, asks_sumo = True, False

    def __init__(self, spec: VutSpec, options: VutOptions) -> None:
        """Load the network; `UserError` for one that cannot be."""
        super().__init__(spec, options)
        given = dict(spec.parameters)
        if unknown := set(given) - {PERIOD}:
            raise UserError(f"{spec}: there is no option {unknown.pop()!r}, only {PERIOD}")
        self.files = (Path(spec.argument),)
        self._network = Network(self.files[0], given.get(PERIOD))

    @classmethod
    def file_of(cls, argument: str) -> str:
        """Return the file of the network."""
        return argument

    def controller(self) -> Controller:
        """Return a controller of one corridor."""
        return OnnxController(self._network)
