"""ONNX networks for tests."""

from __future__ import annotations

import numpy as np
import pytest


def constant_network(path, *, answer, dtype=None, width=4, shape=None, seed=None, last="Identity"):
    """Write a network that answers numbers whatever it sees, times its first input's 0.

    `seed` is (type, shape) of an input `seed`: by its fraction after division by 1,000 it answers.
    `last` is the operator of which the output `answer` is the result, as ArgMax.
    """
    onnx = pytest.importorskip("onnx")
    helper, proto = onnx.helper, onnx.TensorProto
    kind = proto.FLOAT if dtype == np.float32 else proto.DOUBLE
    answers = {"ArgMax": proto.INT64, "IsNaN": proto.BOOL}
    weight = np.zeros((width, len(answer)), dtype=dtype or np.float64)
    bias = np.array(answer, dtype=weight.dtype)
    graph = helper.make_graph(
        [
            helper.make_node("MatMul", ["in", "w"], ["m"]),
            *(_of_seed(helper, kind) if seed else ()),
            helper.make_node("Add", ["m", "s" if seed else "b"], ["out"]),
            helper.make_node(last, ["out"], ["answer"]),
        ],
        "g",
        [
            *([helper.make_tensor_value_info("seed", *seed)] if seed else []),
            helper.make_tensor_value_info("in", kind, shape or [1, width]),
        ],
        [helper.make_tensor_value_info("answer", answers.get(last, kind), None)],
        [
            onnx.numpy_helper.from_array(v, n)
            for v, n in ((weight, "w"), (bias, "b"), (np.array(1000.0, dtype=weight.dtype), "k"))
        ],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    path.write_bytes(model.SerializeToString())
    return path


def _of_seed(helper, kind):
    return (
        helper.make_node("Cast", ["seed"], ["f"], to=kind),
        helper.make_node("Mod", ["f", "k"], ["r"], fmod=1),
        helper.make_node("Div", ["r", "k"], ["s"]),
    )
