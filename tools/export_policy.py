"""Write a learned driver as an ONNX network: `python tools/export_policy.py vut1 vut1.onnx`.

The network takes the state and gives the action values. `--policies DIR` names another library.

The features are part of the graph. They are not written down a second time: the function that
computes them runs on columns that record each operation.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from merge_sumo.controllers.onnx import PERIOD, STATE
from merge_sumo.drivers.levelk import DECISION_STEPS, actions_mps2, features
from merge_sumo.drivers.policies import NETWORKS, load_network, read_manifest, scenario_of
from merge_sumo.errors import UserError
from merge_sumo.files import check_new, write_new
from merge_sumo.scenario.scenario import DT_S, Scenario

OPSET: Final = 17
IR_VERSION: Final = 8
"""Old enough for the runtimes of several years."""

_OPERATORS: Final = {
    "add": "Add",
    "subtract": "Sub",
    "multiply": "Mul",
    "divide": "Div",
    "negative": "Neg",
    "maximum": "Max",
    "minimum": "Min",
    "sqrt": "Sqrt",
    "tanh": "Tanh",
    "sin": "Sin",
}


def export_onnx(
    name: str, path: Path, folder: Path | None = None, scenario: Scenario | None = None
) -> None:
    """Write a policy as an ONNX file; `UserError` when it is not there or cannot be written.

    Input `state`, double (N, 4): x_pov_m, v_pov_mps, x_vut_m, v_vut_mps; for a policy with a
    social value orientation also `svo_rad`, double (N, 1). Output `values`, double (N, 7): the
    values of the accelerations from the hardest braking to the hardest acceleration. The numbers of
    a scenario are in the graph, by default of the one that the policy was trained for. The metadata
    hold the period of decisions, the name of the scenario and the accelerations.
    """
    try:
        import onnx
        from onnx import TensorProto, helper, numpy_helper
    except ImportError as error:
        raise UserError("an export needs onnx: run `pip install 'merge-sumo[onnx]'`") from error
    if name not in NETWORKS:
        raise UserError(f"unknown policy {name!r}: choose one of {', '.join(NETWORKS)}")
    check_new(path)
    network = load_network(name, folder)
    if network.a_min_mps2 is not None:
        raise UserError(
            f"{name} chooses from accelerations of its own, down to {network.a_min_mps2:g} m/s2, "
            "which an ONNX file does not say: export a policy without a limit of braking"
        )
    played = scenario or scenario_of(read_manifest(folder)[name])
    graph = _Graph(helper, numpy_helper)
    # Typed as anything: what `features` takes for arrays are columns that record.
    state: list[Any] = [_Column(graph, c) for c in graph.node("Split", "state", outputs=4, axis=1)]
    inputs = [helper.make_tensor_value_info("state", TensorProto.DOUBLE, ["N", len(STATE)])]
    orientation: Any = None
    if network.sees_svo:
        inputs.append(helper.make_tensor_value_info("svo_rad", TensorProto.DOUBLE, ["N", 1]))
        orientation = _Column(graph, "svo_rad")
    traced: Any = features(state, orientation, scenario=played)
    hidden = traced.name
    last = len(network.layers) - 1
    for place, (weight, bias) in enumerate(network.layers):
        (hidden,) = graph.node("MatMul", hidden, graph.constant(weight.T))
        name_of_sum = ["values"] if place == last else None
        (hidden,) = graph.node("Add", hidden, graph.constant(bias), names=name_of_sum)
        if place != last:
            (hidden,) = graph.node("Relu", hidden)
    actions = network.layers[-1][0].shape[0]
    outputs = [helper.make_tensor_value_info("values", TensorProto.DOUBLE, ["N", actions])]
    made = helper.make_graph(graph.nodes, name, inputs, outputs, graph.constants)
    model = helper.make_model(
        made,
        producer_name="merge-sumo",
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
    )
    properties = {
        PERIOD: f"{DECISION_STEPS * DT_S:g}",
        "scenario": played.name,
        "actions_mps2": " ".join(f"{a:g}" for a in actions_mps2(played)),
    }
    helper.set_model_props(model, properties)
    onnx.checker.check_model(model)
    write_new(path, model.SerializeToString())


class _Graph:
    """Nodes and constants in the order in which they were asked for."""

    def __init__(self, helper: Any, numpy_helper: Any) -> None:
        self._helper, self._numpy_helper = helper, numpy_helper
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: Any) -> str:
        name = f"c{len(self.constants)}"
        array = np.ascontiguousarray(value, dtype=np.float64)
        self.constants.append(self._numpy_helper.from_array(array, name))
        return name

    def node(
        self,
        operator: str,
        *inputs: str,
        outputs: int = 1,
        names: list[str] | None = None,
        **attributes: Any,
    ) -> list[str]:
        names = names or [f"n{len(self.nodes)}_{i}" for i in range(outputs)]
        self.nodes.append(self._helper.make_node(operator, inputs, names, **attributes))
        return names


class _Column(NDArrayOperatorsMixin):
    """A column (N, 1) of the graph; what numpy does to it becomes nodes."""

    def __init__(self, graph: _Graph, name: str) -> None:
        self._graph, self.name = graph, name

    def _name_of(self, value: Any) -> str:
        return value.name if isinstance(value, _Column) else self._graph.constant(value)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **_: Any) -> _Column:
        if ufunc is np.cos:
            # ONNX Runtime has had a sine of doubles for long, and a cosine only lately.
            shifted: _Column = inputs[0] + np.pi / 2.0
            return shifted.__array_ufunc__(np.sin, method, shifted)
        if method != "__call__" or ufunc.__name__ not in _OPERATORS:
            raise TypeError(f"{ufunc.__name__} has no ONNX operator here")
        operands = map(self._name_of, inputs)
        (name,) = self._graph.node(_OPERATORS[ufunc.__name__], *operands)
        return _Column(self._graph, name)

    def __array_function__(self, function: Any, _types: Any, arguments: Any, _named: Any) -> Any:
        if function is not np.stack:
            raise TypeError(f"{function.__name__} has no ONNX operator here")
        (name,) = self._graph.node("Concat", *(c.name for c in arguments[0]), axis=1)
        return _Column(self._graph, name)


def main() -> int:
    """Export the policy of the command line; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("name", help=" or ".join(NETWORKS))
    parser.add_argument("out", type=Path, help="new ONNX file")
    parser.add_argument("--policies", type=Path, help="folder of learned drivers")
    options = parser.parse_args()
    try:
        export_onnx(options.name, options.out, options.policies)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
