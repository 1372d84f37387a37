"""A VUT as an ONNX network: the state goes in, an acceleration or action values come out.

One number more is whether to merge, on a road with an acceleration lane.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.controllers.controller import Controller, Seen, Start, as_merge
from merge_sumo.controllers.spec import ControllerKind, ControllerOptions, ControllerSpec
from merge_sumo.drivers.levelk import ACTIONS, actions_mps2
from merge_sumo.errors import UserError
from merge_sumo.files import check_code
from merge_sumo.scenario.scenario import DT_S

PERIOD: Final = "decision_period_s"
"""Metadata of a network, or option: it decides this often and holds its decision."""
STATE: Final = ("x_pov_m", "v_pov_mps", "x_vut_m", "v_vut_mps")
"""The columns of a network's input, (1, 4)."""
SEED: Final = "seed"
"""An input that a network need not have: the seed of the case, one number."""
Decision = float | tuple[float, bool]
"""An acceleration, or it and whether to merge."""
_DTYPES: Final[dict[str, Any]] = {"tensor(float)": np.float32, "tensor(double)": np.float64}


class OnnxKind(ControllerKind):
    """A network: `onnx:FILE?decision_period_s=...`.

    Attributes:
        period_steps: steps from one decision to the next.
    """

    form = "onnx:FILE[?decision_period_s=SECONDS]"
    what = "a network from the state to an acceleration, or to values of the 7 actions"
    example = "--vut onnx:policy.onnx"
    no_parameters = "the parameters of a network are its weights"
    hosted, asks_sumo = True, False

    def __init__(self, spec: ControllerSpec, options: ControllerOptions) -> None:
        """Load the network; `UserError` for one that cannot drive."""
        super().__init__(spec, options)
        given, path = dict(spec.parameters), Path(spec.argument)
        if unknown := set(given) - {PERIOD}:
            raise UserError(f"{spec}: there is no option {unknown.pop()!r}, only {PERIOD}")
        check_code(path)
        self.code = (path,)
        self._session = session = _session(path)
        self._check_inputs()
        self._check_output()
        metadata = session.get_modelmeta().custom_metadata_map
        text = given.get(PERIOD) or metadata.get(PERIOD) or str(DT_S)
        try:
            self.period_steps = round(float(text) / DT_S)
        except (ValueError, OverflowError):
            self.period_steps = 0
        if self.period_steps < 1:
            raise UserError(f"{path}: {PERIOD} is {text!r}: give seconds, {DT_S} or more")

    def controller(self) -> Controller:
        """Return a controller of one corridor."""
        return OnnxController(self)

    def run(self, state: tuple[float, ...], seed: int = 0) -> np.ndarray[Any, Any]:
        """Return the flat output for one state, and a seed for a network that takes one."""
        fed = {self._input.name: np.array([state], dtype=_DTYPES[self._input.type])}
        if self._seed is not None:
            fed[SEED] = np.full(_shape(self._seed), seed, dtype=_seed_dtype(self._seed))
        return np.asarray(self._session.run(None, fed)[0]).ravel()

    def _check_inputs(self) -> None:
        """Find the inputs; raise `UserError` where the network has others than a VUT's."""
        inputs = list(self._session.get_inputs())
        self._seed: Any = None
        for each in inputs if len(inputs) > 1 else ():
            if each.name == SEED:
                self._seed = each
        others = [each for each in inputs if each is not self._seed]
        seed = self._seed
        if seed is not None and (_seed_dtype(seed) is None or math.prod(_shape(seed)) != 1):
            raise UserError(
                f"{self.code[0]} has the input {SEED} {seed.type} {seed.shape}: it is one number, "
                "a float, a double or an int64"
            )
        self._input: Any = others[0] if len(others) == 1 else None
        if (
            self._input is None
            or self._input.type not in _DTYPES
            or list(self._input.shape)[-1:] != [len(STATE)]
        ):
            said = ", ".join(f"{i.name} {i.type} {i.shape}" for i in others)
            raise UserError(
                f"{self.code[0]} has the inputs {said}: a VUT has one of floats, (1, 4), with "
                f"{', '.join(STATE)}"
            )

    def _check_output(self) -> None:
        """Raise `UserError` where the network does not run, or its output is none of a VUT."""
        output, path = self._session.get_outputs()[0], self.code[0]
        if output.type not in (*_DTYPES, "tensor(float16)"):
            raise UserError(
                f"{path} gives {output.name} {output.type}, and a VUT gives floats: the index of "
                f"an action is no acceleration, so let the network give the {ACTIONS} values of "
                "actions without ArgMax, or run it in a VUT in Python (FILE.py:CLASS) that answers "
                "the acceleration of its action in m/s2"
            )
        try:
            size = self.run((0.0, 0.0, 0.0, 0.0)).size
        except Exception as error:
            raise UserError(f"{path} cannot be run with an input (1, 4): {error}") from error
        if size not in (1, 2, ACTIONS, ACTIONS + 1):
            raise UserError(
                f"{path} gives {size} numbers: a VUT gives one acceleration, or {ACTIONS} values "
                "of actions, from the hardest braking to the hardest acceleration, and perhaps one "
                "number more, which is whether to merge"
            )


def _session(path: Path) -> Any:
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
        return ort.InferenceSession(str(path), settings, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime has a class of its own for every failure
        raise UserError(f"{path} is no ONNX network that can be run: {error}") from error


def _seed_dtype(seed: Any) -> Any:
    return np.int64 if seed.type == "tensor(int64)" else _DTYPES.get(seed.type)


def _shape(seed: Any) -> list[int]:
    """Return the shape of an input; an axis without a number is one of a batch."""
    return [size if isinstance(size, int) else 1 for size in seed.shape]


class OnnxController(Controller):
    """Asks the network when a decision is due, and holds the decision in between."""

    def __init__(self, network: OnnxKind) -> None:
        """Take the network, which all corridors share."""
        self._network = network
        self._held: Decision = 0.0

    def reset(self, start: Start) -> None:
        """Take the accelerations of the actions, and the seed."""
        self._of_actions, self._seed = actions_mps2(start), start.seed

    def act(self, seen: Seen) -> Decision:
        """Return the held decision; the network decides again where that is due."""
        if round(seen.t_s / DT_S) % self._network.period_steps == 0:
            self._held = self._decision(seen[1:])
        return self._held

    def _decision(self, state: tuple[float, ...]) -> Decision:
        """Return the acceleration, or that of the action of the highest value, and any wish."""
        output = self._network.run(state, self._seed)
        values = output if output.size in (1, ACTIONS) else output[:-1]
        if values.size == 1:
            acceleration_mps2 = float(values[0])
        elif np.isfinite(values).all():
            acceleration_mps2 = float(self._of_actions[int(values.argmax())])
        else:
            acceleration_mps2 = math.nan
        if values is output:
            return acceleration_mps2
        return acceleration_mps2, as_merge(float(output[-1]))
