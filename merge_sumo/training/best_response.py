"""The best response that a rational driver could give: the measure of training.

POV-1 and VUT-1 face an opponent that ignores them, so their best response is exact: forward
dynamic programming over all actions. Ways that lead to one state are one way, the best of them, and
a way that can no longer win against one that is known is not followed. Accelerations that are held
for 0.5 s are few, so speeds and positions lie on a lattice, and states repeat. POV-2 and VUT-2 face
an opponent that reacts: a beam search against the actual opponent finds their best sequence; it is
a lower bound of the best response, and tight where it matters.

All returns are sums of the reward over the game, from starts of the pool.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from merge_sumo.drivers.levelk import ACTIONS, LEVEL0_GAP_FEATURE, QNetwork
from merge_sumo.scenario.case import FloatArray
from merge_sumo.training.game import Game, IntArray, inputs_of

_CHUNK = 16
"""Cases that are searched at once."""
_WAYS = 4096
"""Ways to M that are compared in all cases at once."""
_SAME = 1e-2
"""States nearer than this, in m and m/s, are one: finer than the lattice where the accelerations
are multiples of 0.2 m/s2."""
_MOST = 200_000
"""Where there are more states, as on a long ramp where the accelerations have no common unit, those
nearer than twice as much are one, and so on. Nothing was lost by 0.2 m and m/s."""
_SPEEDS = 1 << 16
_PLACES = 1 << 20
"""More than there are of them."""


def best_response(game: Game, state: FloatArray) -> FloatArray:
    """Return the best returns, (n,), from states, (n, 4), against a level-0 opponent."""
    best = _simple_returns(game, state)
    if game.role == "pov":
        for start in range(0, len(state), _CHUNK):
            of_chunk = best[start : start + _CHUNK]  # a view, which `ended` writes

            def ended(cases: IntArray, so_far: FloatArray, _: FloatArray) -> FloatArray:
                np.maximum.at(of_chunk, cases, so_far)  # noqa: B023 (called in this round)
                return of_chunk - game.reward.weights.gap  # noqa: B023

            _follow(game, state[start : start + _CHUNK], ended)
    else:
        starts, of_start = np.unique(state[:, 2:], axis=0, return_inverse=True)
        for number in range(len(starts)):
            cases = of_start == number
            best[cases] = _best_of_vuts(game, state[cases], best[cases])
    return best


def _best_of_vuts(game: Game, state: FloatArray, best: FloatArray) -> FloatArray:
    """Return the best returns, (n,), of VUTs that start alike, given those of known ways.

    The VUT's ego reward does not depend on the case. So all ways to arrive at M are found once,
    and every case takes the best of them.
    """
    weights = game.reward.weights
    ego = replace(weights, ttc=0.0, gap=0.0, critical=0.0, crash=0.0)
    x_pov0, v_pov0 = state[:, :2].T

    def ended(_: IntArray, so_far: FloatArray, last: FloatArray) -> FloatArray:
        for ways in range(0, len(last), _WAYS):
            t, _, x, v = last[ways : ways + _WAYS, :, None].swapaxes(0, 1)
            safe = game.reward.safety(x_pov0 + v_pov0 * t - x, v_pov0 - v)
            np.maximum(best, (so_far[ways : ways + _WAYS, None] + safe).max(axis=0), out=best)
        return np.full(1, best.min() - weights.gap)

    # The place of a POV that drives 1 m/s from 0 m on is the time.
    first = np.array([[0.0, 1.0, *state[0, 2:]]])
    _follow(replace(game, reward=replace(game.reward, weights=ego)), first, ended)
    return best


def _follow(
    game: Game,
    state: FloatArray,
    ended: Callable[[IntArray, FloatArray, FloatArray], FloatArray],
) -> None:
    """Follow all ways from states, (n, 4), of which the best to every state goes on.

    `ended` is told of ways that end: the places of their first states, their returns and their
    last states. It returns what a way from each first state must have so far to go on, (n,).
    """
    own = slice(0, 2) if game.role == "pov" else slice(2, 4)
    cases, so_far, same = np.arange(len(state)), np.zeros(len(state)), _SAME
    for _ in range(game.max_decisions):
        action = np.tile(game.actions_mps2, len(state))
        cases, so_far = np.repeat(cases, ACTIONS), np.repeat(so_far, ACTIONS)
        state = np.repeat(state, ACTIONS, axis=0)
        state, reward, over = game.advance(state, np.zeros(len(action)), action)
        so_far = so_far + reward
        needed = ended(cases[over], so_far[over], state[over])
        alive = np.flatnonzero(~over & (so_far > needed[cases]))
        if not alive.size:
            break
        kept = _best_of_each(cases[alive], state[alive, own], so_far[alive], same)
        while len(kept) > _MOST:
            same *= 2.0
            kept = _best_of_each(cases[alive], state[alive, own], so_far[alive], same)
        alive = alive[kept]
        cases, state, so_far = cases[alive], state[alive], so_far[alive]


def _best_of_each(cases: IntArray, own: FloatArray, so_far: FloatArray, same: float) -> IntArray:
    """Return the places of the best of the ways that led to each state [x, v], (n, 2)."""
    x, v = np.rint(own.T / same).astype(np.int64)
    key = (cases * _SPEEDS + v) * _PLACES + (x + _PLACES // 2)
    order = np.lexsort((-so_far, key))
    return order[np.r_[True, np.diff(key[order]) != 0]]


def _simple_returns(game: Game, state: FloatArray) -> FloatArray:
    """Return the best returns, (n,), of plans that change the action once."""
    n, best = len(state), np.full(len(state), -np.inf)
    for decisions in (1, 2, 4, 8):
        pairs = np.array(list(itertools.product(range(ACTIONS), repeat=2)))
        one, two = np.repeat(pairs, n, axis=0).T
        now, index = np.tile(state, (len(pairs), 1)), np.arange(n * len(pairs))
        returns, arrived = np.zeros(len(index)), np.zeros(len(index), dtype=bool)
        for decision in range(game.max_decisions):
            action = (one if decision < decisions else two)[index]
            now, reward, over = game.advance(now, np.zeros(len(index)), game.actions_mps2[action])
            returns[index] += reward
            arrived[index[over]] = True
            index, now = index[~over], now[~over]
            if not index.size:
                break
        returns[~arrived] = -np.inf
        best = np.maximum(best, returns.reshape(-1, n).max(axis=0))
    return best


BestGames = tuple[FloatArray, IntArray]
"""Best returns of a search from n states, (n,), and the actions that lead there, (n, decisions).

Actions are places in `game.actions_mps2`, -1 after the end of the game.
"""


def beam_search(
    game: Game, state: FloatArray, svo_rad: FloatArray, agent: QNetwork, width: int = 64
) -> BestGames:
    """Return the best games that a beam search finds from states, (n, 4), of a game.

    Every state of the beam is continued by all actions. Of the results, half of the beam goes to
    those with the best reward so far plus the agent's own estimate of the rest, and half to the
    best of each class of predicted gap at M, so that the agent's errors cannot hide an answer.

    Args:
        game: the game that is searched.
        state: starting states, (n, 4).
        svo_rad: psi of the POV, (n,).
        agent: network that estimates the rest of the reward.
        width: states in the beam of a case.
    """
    returns, plans = [np.empty(0)], [np.empty((0, game.max_decisions), np.int64)]
    for start in range(0, len(state), _CHUNK):
        rows = slice(start, start + _CHUNK)
        best, plan = _beam_chunk(game, state[rows], svo_rad[rows], agent, width)
        returns.append(best)
        plans.append(plan)
    return np.concatenate(returns), np.concatenate(plans)


def _beam_chunk(
    game: Game, state: FloatArray, svo_rad: FloatArray, agent: QNetwork, width: int
) -> BestGames:
    n, actions = len(state), game.actions_mps2
    cases, so_far = np.arange(n), np.zeros(n)
    plan = np.full((n, game.max_decisions), -1)
    best, best_plan = np.full(n, -np.inf), plan.copy()
    for decision in range(game.max_decisions):
        action = np.tile(np.arange(ACTIONS), len(state))
        cases, so_far = np.repeat(cases, ACTIONS), np.repeat(so_far, ACTIONS)
        plan = np.repeat(plan, ACTIONS, axis=0)
        plan[:, decision] = action
        state = np.repeat(state, ACTIONS, axis=0)
        state, reward, over = game.advance(state, svo_rad[cases], actions[action])
        so_far = so_far + reward
        ended = np.flatnonzero(over)
        # In rising order, so that the best of a case is written last.
        ended = ended[np.argsort(so_far[ended], kind="stable")]
        ended = ended[so_far[ended] > best[cases[ended]]]
        best[cases[ended]], best_plan[cases[ended]] = so_far[ended], plan[ended]
        # Nothing that goes on can win more than the reward of a full gap.
        alive = np.flatnonzero(~over & (so_far + game.reward.weights.gap > best[cases]))
        if not alive.size:
            break
        alive = alive[
            _prune(game, cases[alive], state[alive], so_far[alive], svo_rad, agent, width)
        ]
        cases, state, so_far, plan = cases[alive], state[alive], so_far[alive], plan[alive]
    return best, best_plan


def _prune(
    game: Game,
    cases: np.ndarray,
    state: FloatArray,
    so_far: FloatArray,
    svo_rad: FloatArray,
    agent: QNetwork,
    width: int,
) -> np.ndarray:
    """Return the indices of at most `width` states per case that stay in the beam."""
    inputs = inputs_of(agent, state, svo_rad[cases], game.scenario)
    # The networks rate with squashed returns; only the order matters here.
    promise = so_far + agent.values_at_once(inputs).max(axis=1)
    gap_class = np.clip(np.rint(inputs[:, LEVEL0_GAP_FEATURE] * 8.0), -8, 8)
    rows = np.arange(len(cases))

    def first(order: np.ndarray, group: tuple[np.ndarray, ...], count: int) -> np.ndarray:
        """Mark the first `count` rows of each group in an order."""
        keys = np.stack([g[order] for g in group])
        new = np.r_[True, (keys[:, 1:] != keys[:, :-1]).any(axis=0)]
        rank = rows - np.maximum.accumulate(np.where(new, rows, 0))
        marked = np.zeros(len(order), dtype=bool)
        marked[order[rank < count]] = True
        return marked

    by_promise = np.lexsort((-promise, cases))
    by_class = np.lexsort((-promise, gap_class, cases))
    keep = first(by_promise, (cases,), width // 2)
    keep |= first(by_class, (cases, gap_class), max(width // 34, 1))
    return np.flatnonzero(keep)
