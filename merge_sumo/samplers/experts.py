"""Experts on what the VUT does next: extremely randomised trees (Geurts et al., 2006).

A controller is smooth here and jumps there, and what it looks at is not known: trees take both. In
an *expert* all trees look at the same inputs; each of its members has not seen every GROUPS-th
case, so that members disagree where few cases tell.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import numpy as np

from merge_sumo.samplers.observation import Inputs
from merge_sumo.scenario.case import FloatArray

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
    # What `predict` of the estimator checks costs more than the tree does.
    return tree.fit(seen, answers).tree_
