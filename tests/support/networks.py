"""ONNX networks for tests."""

from __future__ import annotations

import numpy as np
import pytest


def constant_network(path, *, answer, dtype=None, width=4, shape=None, seed=None, last="Identity"):
    """Write a network with a constant answer: its first input is multiplied by 0.

    Args:
        path: the file.
        answer: the numbers.
        dtype: type of its numbers, by default float64.
        width: number of the numbers of its first input.
        shape: shape of that input, by default (1, width).
        seed: (type, shape) of an input `seed`, whose fraction after division by 1,000 is then the
            answer.
        last: the operator whose result is the answer, as ArgMax.
    """
    onnx = pytest.importorskip("onnx")
    helper, proto = onnx.helper, onnx.TensorProto
    kind = proto.FLOAT if dtype == np.float32 else proto.DOUBLE
    kind_of_answer = {"ArgMax": proto.INT64, "IsNaN": proto.BOOL}.get(last, kind)
    weights = {"w": np.zeros((width, len(answer))), "b": np.array(answer), "k": np.array(1000.0)}
    inputs = [helper.make_tensor_value_info("in", kind, shape or [1, width])]
    nodes = [helper.make_node("MatMul", ["in", "w"], ["m"])]
    if seed:
        inputs.insert(0, helper.make_tensor_value_info("seed", *seed))
        nodes += [
            helper.make_node("Cast", ["seed"], ["f"], to=kind),
            helper.make_node("Mod", ["f", "k"], ["r"], fmod=1),
            helper.make_node("Div", ["r", "k"], ["s"]),
        ]
    nodes += [
        helper.make_node("Add", ["m", "s" if seed else "b"], ["out"]),
        helper.make_node(last, ["out"], ["answer"]),
    ]
    outputs = [helper.make_tensor_value_info("answer", kind_of_answer, None)]
    tensors = []
    for name, value in weights.items():
        tensors.append(onnx.numpy_helper.from_array(value.astype(dtype or np.float64), name))
    graph = helper.make_graph(nodes, "g", inputs, outputs, tensors)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path
