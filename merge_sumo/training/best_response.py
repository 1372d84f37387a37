"""Best responses: the returns with which trained drivers are compared.

POV-1 and VUT-1 play against a driver that ignores them, so `best_response` is exact: dynamic
programming over all actions. POV-2 and VUT-2 play against a driver that reacts: `beam_search` gives
a lower bound of the best return. A return is the sum of the reward over a game.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.levelk import ACTIONS, LEVEL0_GAP_FEATURE, QNetwork
from merge_sumo.scenario.case import FloatArray
from merge_sumo.training.game import Game, IntArray
from merge_sumo.training.reward import RewardParts

SAME = 1e-2
"""States that differ by less, in m and m/s, count as one. Where the accelerations are multiples of
0.2 m/s2, states lie on a lattice that is coarser."""
MAX_STATES = 20_000
"""With more states, as on a long ramp without such a lattice, states that differ by twice as much
count as one, and so on. No effect on the returns was seen up to 0.2 m and m/s."""


def best_response(game: Game, state: FloatArray, known: FloatArray) -> FloatArray:
    """Search all paths against a level-0 opponent; of those to one state, only the best one.

    The POVs of level 0 keep their speeds, so VUTs with one start have the same paths against all of
    them. They are searched once, against a POV that begins at 0 m and drives 1 m/s. Its position is
    the time, from which those of the POVs follow.

    Args:
        game: the game.
        state: states at the start, (n, 4).
        known: returns that are known to be reached, (n,). A path ends where it cannot exceed them.

    Returns:
        The best returns, (n,).
    """
    clock = np.array([0.0, 1.0])
    start, pov = state.copy(), np.broadcast_to(clock, (len(state), 2))
    if game.role == "vut":
        pov = state[:, :2]
        start[:, :2] = clock
    best = known.copy()
    for searched in np.unique(start, axis=0):
        cases = np.flatnonzero((start == searched).all(axis=1))
        best[cases] = _best_of_all_paths(game, searched, pov[cases], known[cases])
    return best


def _best_of_all_paths(
    game: Game, start: FloatArray, pov: FloatArray, known: FloatArray
) -> FloatArray:
    """Return the best returns of cases that have the same paths, (n,).

    Args:
        game: the game.
        start: state at the start of the paths, (4,).
        pov: where the POV of a path is at 0 m and drives 1 m/s, that of the case is at this
            position and drives this speed, (n, 2); else in proportion.
        known: returns that are known to be reached, (n,).
    """
    own = slice(0, 2) if game.role == "pov" else slice(2, 4)
    best, same = known.copy(), SAME
    state, so_far = start[None], np.zeros(1)
    for _ in range(game.max_decisions):
        state, parts, over = _continued(game, state, np.zeros(len(state)))
        so_far = np.repeat(so_far, ACTIONS)
        so_far += parts.pov_ego if game.role == "pov" else parts.vut_ego
        x_pov, v_pov, x_vut, v_vut = state[over].T
        for case, (x_m, v_mps) in enumerate(pov):
            safe = game.reward.safety(x_m + v_mps * x_pov - x_vut, v_mps * v_pov - v_vut)
            best[case] = (so_far[over] + safe).max(initial=best[case])
        # The rest of a game wins at most the reward of a full gap.
        alive = np.flatnonzero(~over & (so_far + game.reward.weights.gap > best.min()))
        kept = _best_of_each(state[alive, own], so_far[alive], same)
        while len(kept) > MAX_STATES:
            same *= 2.0
            kept = _best_of_each(state[alive, own], so_far[alive], same)
        state, so_far = state[alive[kept]], so_far[alive[kept]]
    return best


def _continued(
    game: Game, state: FloatArray, svo_rad: FloatArray
) -> tuple[FloatArray, RewardParts, NDArray[np.bool_]]:
    """Continue paths by one decision, each by all actions in turn.

    Args:
        game: the game.
        state: last states of the paths, (n, 4).
        svo_rad: psi of the POV, (n,).

    Returns:
        The states of the 7 n longer paths, the parts of the rewards of the decision, and whether
        their games are over.
    """
    a_mps2 = np.tile(game.actions_mps2, len(state))
    return game.decide(np.repeat(state, ACTIONS, axis=0), np.repeat(svo_rad, ACTIONS), a_mps2)


def _best_of_each(own: FloatArray, so_far: FloatArray, same: float) -> IntArray:
    """Return the indices of the best of the paths to each state.

    Args:
        own: positions and speeds of the agent, (n, 2).
        so_far: returns so far, (n,).
        same: difference up to which states count as one, in m and m/s.
    """
    x, v = np.rint(own.T / same)
    order = np.lexsort((-so_far, x, v))
    return order[_begins(np.array([v, x])[:, order])]


def beam_search(
    game: Game, state: FloatArray, svo_rad: FloatArray, agent: QNetwork, width: int = 64
) -> tuple[FloatArray, IntArray]:
    """Search for the best games by a beam of states.

    Every state of the beam is continued by all actions. Half of the beam keeps the states with the
    best reward so far plus the agent's estimate of the rest. The other half keeps the best ones of
    each class of predicted gap at M, so that errors of the agent cannot hide an answer.

    Args:
        game: the game.
        state: states at the start, (n, 4).
        svo_rad: psi of the POV, (n,).
        agent: network that estimates the rest of the reward.
        width: number of states in the beam of a case.

    Returns:
        The best returns, (n,), and the actions that lead to them as indices of `game.actions_mps2`,
        (n, decisions); -1 after the end of the game.
    """
    n = len(state)
    cases, so_far = np.arange(n), np.zeros(n)
    plan = np.full((n, game.max_decisions), -1, dtype=np.int8)
    best, best_plan = np.full(n, -np.inf), np.full(plan.shape, -1)
    for decision in range(game.max_decisions):
        plan = np.repeat(plan, ACTIONS, axis=0)
        plan[:, decision] = np.tile(np.arange(ACTIONS), len(state))
        state, parts, over = _continued(game, state, svo_rad[cases])
        cases, so_far = np.repeat(cases, ACTIONS), np.repeat(so_far, ACTIONS)
        so_far += parts.of(game.role, svo_rad[cases])
        ended = np.flatnonzero(over)
        # In rising order, so that the best of a case is written last.
        ended = ended[np.argsort(so_far[ended], kind="stable")]
        ended = ended[so_far[ended] > best[cases[ended]]]
        best[cases[ended]], best_plan[cases[ended]] = so_far[ended], plan[ended]
        alive = np.flatnonzero(~over & (so_far + game.reward.weights.gap > best[cases]))
        inputs = agent.observe(state[alive].T, svo_rad[cases[alive]], game.scenario)
        # The networks give squashed returns; only the order matters here.
        estimate = so_far[alive] + agent.values_at_once(inputs).max(axis=1)
        gap_class = np.clip(np.rint(inputs[:, LEVEL0_GAP_FEATURE] * 8.0), -8, 8)
        keep = _highest(estimate, width // 2, cases[alive])
        keep |= _highest(estimate, max(width // 34, 1), cases[alive], gap_class)
        alive = alive[keep]
        cases, state, so_far, plan = cases[alive], state[alive], so_far[alive], plan[alive]
    return best, best_plan


def _highest(values: FloatArray, count: int, *groups: np.ndarray) -> NDArray[np.bool_]:
    """Mark the highest values of each group, (n,).

    Args:
        values: the values, (n,).
        count: number of values of a group that are marked.
        groups: values of one group have the same number in each of these, (n,).
    """
    order = np.lexsort((-values, *reversed(groups)))
    begins = _begins(np.array(groups)[:, order])
    rows = np.arange(len(values))
    rank = rows - np.maximum.accumulate(np.where(begins, rows, 0))
    marked = np.zeros(len(values), dtype=bool)
    marked[order[rank < count]] = True
    return marked


def _begins(keys: np.ndarray) -> NDArray[np.bool_]:
    """Return where sorted keys, (m, n), differ from those before, (n,)."""
    differs = np.ones(keys.shape[1], dtype=bool)
    differs[1:] = (keys[:, 1:] != keys[:, :-1]).any(axis=0)
    return differs
