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
