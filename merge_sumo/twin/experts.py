"""Experts on what the VUT does next: extremely randomised trees (Geurts et al., 2006).

A controller is smooth here and jumps there, and what it looks at is not known: trees take both. In
an *expert* all trees look at the same inputs; each of its members has not seen every GROUPS-th
case, so that members disagree where few cases tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.twin.observation import Inputs
from merge_sumo.values.case import FloatArray

GROUPS: Final = 4
"""Members of an expert."""
MAX_FEATURES: Final = 0.5
"""Share of the inputs among which each node of a tree chooses."""
OWN_WEIGHT: Final = 4.0
"""What a step of this VUT counts where those of others are learned from, too."""


@dataclass(frozen=True, slots=True)
class Steps:
    """What the VUT saw and did in the steps of one case.

    Attributes:
        inputs: see `Observation`, (T, inputs); those of the present are the first `now`.
        now: how many these are.
        a_mps2: what it did, (T,).
        own: whether it was this VUT, and not one whose campaign is learned from.
    """

    inputs: Inputs
    now: int
    a_mps2: FloatArray
    own: bool = True


@dataclass(frozen=True, slots=True)
class Expert:
    """What an expert looks at.

    Attributes:
        history: at what was before, too.
        others: at what other VUTs did, too. It is told which steps are whose, and can tell them
            apart where they differ.
    """

    history: bool
    others: bool = False

    def sees(self, inputs: Inputs, now: int, *, own: bool = True) -> Inputs:
        """Return what it looks at of all inputs, (n, inputs)."""
        seen = inputs if self.history else inputs[:, :now]
        if not self.others:
            return seen
        return np.column_stack([seen, np.full(len(seen), own, dtype=np.float32)])

    def places(self, now: int, inputs: int) -> NDArray[np.int64]:
        """Return which of `inputs` inputs and of the label after them it looks at, (n,)."""
        seen = np.arange(inputs if self.history else now)
        return np.append(seen, inputs) if self.others else seen

    def learn(self, cases: Sequence[Steps], seed: int) -> Any:
        """Return a tree that has learned from cases."""
        from sklearn.tree import ExtraTreeRegressor

        known = [case for case in cases if case.own or self.others]
        inputs = np.concatenate([self.sees(c.inputs, c.now, own=c.own) for c in known])
        answers = np.concatenate([case.a_mps2 for case in known])
        weights = None
        if self.others:
            weights = np.concatenate(
                [np.full(len(c.a_mps2), OWN_WEIGHT if c.own else 1.0) for c in known]
            )
        tree = ExtraTreeRegressor(max_features=MAX_FEATURES, random_state=seed)
        # Read at once: what the library wraps around it costs more than the tree does.
        return tree.fit(inputs, answers, sample_weight=weights).tree_


LABELS: Final = 2
"""Inputs of a forest after those of the observation: 1 for a step of this VUT, and which tree."""


class Forest:
    """Trees as one tree, whose first nodes choose among them: one call asks all of them."""

    def __init__(
        self, trees: Sequence[Any], places: Sequence[NDArray[np.int64]], inputs: int
    ) -> None:
        """Take trees, and the places of what each of them looks at among all inputs, (n,).

        The last one of `inputs` inputs is the number of the tree.
        """
        make, (_, classes, outputs), _ = trees[0].__reduce__()
        states = [tree.__getstate__() for tree in trees]
        choices = len(trees) - 1
        roots = choices + np.cumsum([0, *(state["node_count"] for state in states)])
        nodes = np.concatenate(
            [np.zeros(choices, states[0]["nodes"].dtype), *(state["nodes"] for state in states)]
        )
        for first, last, seen in zip(roots[:-1], roots[1:], places, strict=True):
            of_tree = nodes[first:last]
            inner = np.flatnonzero(of_tree["left_child"] >= 0)
            of_tree["left_child"][inner] += first
            of_tree["right_child"][inner] += first
            of_tree["feature"][inner] = seen[of_tree["feature"][inner]]
        nodes["feature"][:choices] = inputs - 1
        _choose(nodes, roots[:-1].tolist(), 0, 0)
        values = np.concatenate([np.zeros((choices, 1, 1)), *(state["values"] for state in states)])
        self._tree = make(inputs, classes, outputs)
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
