"""Experts on what the VUT does next: extremely randomised trees (Geurts et al., 2006).

A controller is smooth here and jumps there, and what it looks at is not known: trees take both. In
an *expert* all trees look at the same inputs; each of its members has not seen every GROUPS-th
case, so that members disagree where few cases tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.scenario.case import FloatArray
from merge_sumo.twin.observation import Inputs

GROUPS: Final = 4
"""Members of an expert."""
MAX_FEATURES: Final = 0.5
"""Share of the inputs among which each node of a tree chooses."""


Steps = tuple[Inputs, FloatArray]
"""What the VUT saw in the steps of one case, (T, inputs), and what it did, (T,), in m/s2."""


def learn(cases: Sequence[Steps], inputs: int, seed: int) -> Any:
    """Return a tree that has learned from the first of so many inputs of cases."""
    from sklearn.tree import ExtraTreeRegressor

    seen = np.concatenate([of_case[:, :inputs] for of_case, _ in cases])
    answers = np.concatenate([a_mps2 for _, a_mps2 in cases])
    tree = ExtraTreeRegressor(max_features=MAX_FEATURES, random_state=seed)
    # Read at once: what the library wraps around it costs more than the tree does.
    return tree.fit(seen, answers).tree_


class Forest:
    """Trees as one tree, whose first nodes choose among them: one call asks all of them."""

    def __init__(self, trees: Sequence[Any], inputs: int) -> None:
        """Take trees, of which each looks at the first of so many inputs.

        The number of the tree is one input more, behind them.
        """
        make, (_, classes, outputs), _ = trees[0].__reduce__()
        states = [tree.__getstate__() for tree in trees]
        choices = len(trees) - 1
        roots = choices + np.cumsum([0, *(state["node_count"] for state in states)])
        nodes = np.concatenate(
            [np.zeros(choices, states[0]["nodes"].dtype), *(state["nodes"] for state in states)]
        )
        for first, last in pairwise(roots):
            of_tree = nodes[first:last]
            inner = np.flatnonzero(of_tree["left_child"] >= 0)
            of_tree["left_child"][inner] += first
            of_tree["right_child"][inner] += first
        nodes["feature"][:choices] = inputs
        _choose(nodes, roots[:-1].tolist(), 0, 0)
        values = np.concatenate([np.zeros((choices, 1, 1)), *(state["values"] for state in states)])
        self._tree = make(inputs + 1, classes, outputs)
        self._tree.__setstate__(
            {
                "max_depth": max(state["max_depth"] for state in states) + choices,
                "node_count": len(nodes),
                "nodes": nodes,
                "values": values,
            }
        )

    def answer(self, inputs: Inputs) -> FloatArray:
        """Return what the trees say that the inputs, (R, inputs), name, (R,)."""
        answers: FloatArray = self._tree.predict(inputs)[:, 0]
        return answers


def _choose(nodes: NDArray[Any], roots: Sequence[int], first: int, place: int) -> int:
    """Write the nodes that choose among trees, the first of which has number `first`.

    Returns where the choice begins; its nodes lie from `place` on.
    """
    if len(roots) == 1:
        return roots[0]
    half = len(roots) // 2
    node = nodes[place]
    node["threshold"] = first + half - 0.5
    node["left_child"] = _choose(nodes, roots[:half], first, place + 1)
    node["right_child"] = _choose(nodes, roots[half:], first + half, place + half)
    return place
