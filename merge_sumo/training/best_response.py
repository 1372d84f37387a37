"""Best responses: the returns with which trained drivers are compared.

POV-1 and VUT-1 play against a driver that ignores them, so `best_response` is exact: dynamic
programming over all actions. POV-2 and VUT-2 play against a driver that reacts: `beam_search` gives
a lower bound of the best return. A return is the sum of the reward over a game.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.levelk import ACTIONS, LEVEL0_GAP_FEATURE, QNetwork
from merge_sumo.scenario.case import FloatArray
from merge_sumo.training.game import Game, IntArray, inputs_of

CHUNK = 16
"""Cases that are searched at a time."""
PATHS_AT_ONCE = 4096
"""Paths of a VUT that are compared with all cases at a time."""
SAME = 1e-2
"""States that differ by less, in m and m/s, count as one. Where the accelerations are multiples of
0.2 m/s2, states lie on a lattice that is coarser."""
MAX_STATES = 200_000
"""With more states, as on a long ramp without such a lattice, states that differ by twice as much
count as one, and so on. No effect on the returns was seen up to 0.2 m and m/s."""


def best_response(game: Game, state: FloatArray, known: FloatArray) -> FloatArray:
    """Return the best returns against a level-0 opponent, (n,).

    Args:
        game: the game.
        state: states at the start, (n, 4).
        known: returns that are known to be reached, (n,). A path ends where it cannot exceed them.

    Returns:
        The best returns, (n,).
    """
    best = known.copy()
    needed = known - game.reward.weights.gap
    if game.role == "pov":
        for first in range(0, len(state), CHUNK):
            rows = slice(first, first + CHUNK)
            cases, returns, _ = _all_paths(game, state[rows], needed[rows])
            np.maximum.at(best, first + cases, returns)
        return best
    starts, start_of = np.unique(state[:, 2:], axis=0, return_inverse=True)
    for number, start in enumerate(starts):
        rows_of_start = np.flatnonzero(start_of == number)
        best[rows_of_start] = _best_of_vut(game, state[rows_of_start], start, best[rows_of_start])
    return best


def _best_of_vut(game: Game, state: FloatArray, start: FloatArray, known: FloatArray) -> FloatArray:
    """Return the best returns of VUTs with one start, (n,).

    The ego reward of the VUT is the same in all cases. So its paths are searched once, and each
    case takes the best one.
    """
    weights = game.reward.weights
    ego = replace(weights, ttc=0.0, gap=0.0, critical=0.0, crash=0.0)
    ego_game = replace(game, reward=replace(game.reward, weights=ego))
    # The position of a POV that drives 1 m/s from 0 m on is the time.
    clock = np.array([[0.0, 1.0, *start]])
    _, returns, last = _all_paths(ego_game, clock, np.array([known.min() - weights.gap]))
    x_pov0, v_pov0 = state[:, 0], state[:, 1]
    best = known
    for first in range(0, len(last), PATHS_AT_ONCE):
        paths = slice(first, first + PATHS_AT_ONCE)
        time_s, _, x_vut, v_vut = last[paths].T[:, :, None]
        safety = game.reward.safety(x_pov0 + v_pov0 * time_s - x_vut, v_pov0 - v_vut)
        best = np.maximum(best, (returns[paths, None] + safety).max(axis=0))
    return best


def _all_paths(
    game: Game, state: FloatArray, needed: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Follow all paths; of those to one state, only the best one.

    Args:
        game: the game.
        state: states at the start, (n, 4).
        needed: a path that has less return before its end is left, (n,).

    Returns:
        Of the p paths that end: the indices of their starts, (p,), their returns, (p,), and their
        last states, (p, 4).
    """
    own = slice(0, 2) if game.role == "pov" else slice(2, 4)
    cases, so_far, same = np.arange(len(state)), np.zeros(len(state)), SAME
    ended = []
    for _ in range(game.max_decisions):
        action = np.tile(game.actions_mps2, len(state))
        cases, so_far = np.repeat(cases, ACTIONS), np.repeat(so_far, ACTIONS)
        state = np.repeat(state, ACTIONS, axis=0)
        state, reward, over = game.advance(state, np.zeros(len(action)), action)
        so_far = so_far + reward
        ended.append((cases[over], so_far[over], state[over]))
        alive = np.flatnonzero(~over & (so_far > needed[cases]))
        kept = _best_of_each(cases[alive], state[alive, own], so_far[alive], same)
        while len(kept) > MAX_STATES:
            same *= 2.0
            kept = _best_of_each(cases[alive], state[alive, own], so_far[alive], same)
        alive = alive[kept]
        cases, state, so_far = cases[alive], state[alive], so_far[alive]
    all_cases, returns, last = map(np.concatenate, zip(*ended, strict=True))
    return all_cases, returns, last


def _best_of_each(cases: IntArray, own: FloatArray, so_far: FloatArray, same: float) -> IntArray:
    """Return the indices of the best of the paths to each state.

    Args:
        cases: indices of the starts, (n,).
        own: positions and speeds of the agent, (n, 2).
        so_far: returns so far, (n,).
        same: difference up to which states count as one, in m and m/s.
    """
    x, v = np.rint(own.T / same)
    order = np.lexsort((-so_far, x, v, cases))
    return order[_begins(np.array([cases, v, x])[:, order])]


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
    n, psi = len(state), svo_rad
    cases, so_far = np.arange(n), np.zeros(n)
    plan = np.full((n, game.max_decisions), -1, dtype=np.int8)
    best, best_plan = np.full(n, -np.inf), np.full(plan.shape, -1)
    for decision in range(game.max_decisions):
        action = np.tile(np.arange(ACTIONS), len(state))
        cases, so_far = np.repeat(cases, ACTIONS), np.repeat(so_far, ACTIONS)
        plan = np.repeat(plan, ACTIONS, axis=0)
        plan[:, decision] = action
        state = np.repeat(state, ACTIONS, axis=0)
        state, reward, over = game.advance(state, psi[cases], game.actions_mps2[action])
        so_far = so_far + reward
        ended = np.flatnonzero(over)
        # In rising order, so that the best of a case is written last.
        ended = ended[np.argsort(so_far[ended], kind="stable")]
        ended = ended[so_far[ended] > best[cases[ended]]]
        best[cases[ended]], best_plan[cases[ended]] = so_far[ended], plan[ended]
        # The rest of a game wins at most the reward of a full gap.
        alive = np.flatnonzero(~over & (so_far + game.reward.weights.gap > best[cases]))
        inputs = inputs_of(agent, state[alive], psi[cases[alive]], game.scenario)
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
