"""The best response that a rational driver could give: the measure of training.

POV-1 and VUT-1 face an opponent that ignores them, so their best response is exact: forward
dynamic programming over the action lattice. Accelerations are whole numbers held for 0.5 s, so
speeds lie on a lattice of 0.5 m/s around the first one and positions on one of 0.05 m, and states
repeat. POV-2 and VUT-2 face an opponent that reacts: a beam search against the actual opponent
finds their best sequence; it is a lower bound of the best response, and tight where it matters.

All returns are sums of the reward over the game, from starts of the pool.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from merge_sumo.drivers.level0 import level0_acceleration
from merge_sumo.drivers.levelk import (
    ACTIONS_MPS2,
    DECISION_STEPS,
    LEVEL0_GAP_FEATURE,
    QNetwork,
)
from merge_sumo.training.game import MAX_DECISIONS, Game, IntArray, inputs_of
from merge_sumo.training.reward import (
    RewardWeights,
    pov_step,
    safety,
    vut_end,
    vut_step,
)
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import DT_S, MAX_STEPS, V_VUT0_MPS, X_VUT0_M

POSITION_LATTICE_M: Final = 0.05
SPEED_LATTICE_MPS: Final = 0.5
_CHUNK: Final = 16
"""Cases whose lattices are held in memory at once."""


def best_response_pov1(
    x_pov0_m: FloatArray, v_pov0_mps: FloatArray, weights: RewardWeights
) -> FloatArray:
    """Return the best return, (n,), of a POV against the level-0 VUT.

    The VUT's motion is known, so the game lasts a fixed number of steps T. The table is
    F[case, j, z]: the best running reward with which the POV has speed v0 + 0.5 j and, at constant
    speed from here on, would end at x0 + v0 T dt + 0.05 z. In these coordinates an action shifts
    the whole table by one constant offset.
    """
    starts = range(0, len(x_pov0_m), _CHUNK)
    chunks = [slice(start, start + _CHUNK) for start in starts]
    parts = [_best_pov1_chunk(x_pov0_m[c], v_pov0_mps[c], weights) for c in chunks]
    return np.concatenate([np.empty(0), *parts])


def _best_pov1_chunk(x0: FloatArray, v0: FloatArray, weights: RewardWeights) -> FloatArray:
    steps, x_vut, v_vut = _level0_arrival()
    full_holds, last_steps = divmod(steps, DECISION_STEPS)
    if last_steps == 0:
        full_holds, last_steps = full_holds - 1, DECISION_STEPS
    actions = ACTIONS_MPS2.astype(int)
    a_low, a_high = int(actions[0]), int(actions[-1])
    # Where an action of 1 m/s2 in hold k moves the end point: within the hold, and by the speed
    # gained for all steps after it; in lattice units.
    gained = DECISION_STEPS * DT_S
    within = DT_S**2 * DECISION_STEPS * (DECISION_STEPS - 1) / 2
    after = steps - DECISION_STEPS * np.arange(1, full_holds + 1)
    shifts = np.rint((within + gained * after * DT_S) / POSITION_LATTICE_M).astype(int)
    j = np.arange(a_low * full_holds, a_high * full_holds + 1)
    z = np.arange(a_low * shifts.sum(), a_high * shifts.sum() + 1)
    v = v0[:, None] + SPEED_LATTICE_MPS * j
    table = np.full((len(x0), len(j), len(z)), -np.inf, dtype=np.float32)
    table[:, -j[0], -z[0]] = 0.0
    running = _hold_reward(v, weights, DECISION_STEPS).astype(np.float32)
    for k, shift in enumerate(shifts.tolist()):
        # Only the part of the table that can have been reached by now.
        before = int(shifts[:k].sum())
        js = slice(a_low * k - j[0], a_high * k - j[0] + 1)
        zs = slice(a_low * before - z[0], a_high * before - z[0] + 1)
        reached = np.full_like(table, -np.inf)
        for i, a in enumerate(actions.tolist()):
            moved = table[:, js, zs] + running[:, js, i, None]
            moved[v[:, js] + SPEED_LATTICE_MPS * a < 0.0] = -np.inf
            into = reached[
                :, js.start + a : js.stop + a, zs.start + a * shift : zs.stop + a * shift
            ]
            np.maximum(into, moved, out=into)
        table = reached
    # The last hold is cut by the VUT's arrival; it and the safety reward are taken exactly.
    last = _hold_reward(v, weights, last_steps)
    x_end = (x0 + v0 * steps * DT_S)[:, None, None] + z * POSITION_LATTICE_M
    best = np.full(len(x0), -np.inf)
    for i, a in enumerate(ACTIONS_MPS2.tolist()):
        v_end = v + a * last_steps * DT_S
        dx = x_end + a * DT_S**2 * last_steps * (last_steps - 1) / 2 - x_vut
        total = table + last[:, :, i, None] + safety(dx, v_end[:, :, None] - v_vut, weights)
        total[v_end < 0.0] = -np.inf
        best = np.maximum(best, total.max(axis=(1, 2)))
    return best


def _hold_reward(v: FloatArray, weights: RewardWeights, steps: int) -> FloatArray:
    """Return the POV's ego reward of holding each action for some steps, (..., actions)."""
    speeds = (np.maximum(v[..., None] + DT_S * i * ACTIONS_MPS2, 0.0) for i in range(steps))
    total: FloatArray = sum(pov_step(s, ACTIONS_MPS2, weights) for s in speeds)  # type: ignore[assignment]
    return total


def _level0_arrival() -> tuple[int, float, float]:
    """Return steps, position and speed with which the level-0 VUT arrives at M."""
    x, v, steps = X_VUT0_M, np.array(V_VUT0_MPS), 0
    while x < 0.0:
        a = level0_acceleration(v)
        x, v, steps = x + float(v) * DT_S, v + a * DT_S, steps + 1
    return steps, x, float(v)


def best_response_vut1(
    x_pov0_m: FloatArray, v_pov0_mps: FloatArray, weights: RewardWeights
) -> FloatArray:
    """Return the best return, (n,), of a VUT against a POV of constant speed.

    The VUT's ego reward does not depend on the case. So all ways to arrive at M are listed once,
    (step, x, v) with the best running reward of each, and every case takes the best of them.
    """
    steps, x, v, reward = _arrivals(weights)
    reward = reward + vut_end(v, weights)
    best = np.empty(len(x_pov0_m))
    for n, (x_pov0, v_pov0) in enumerate(zip(x_pov0_m, v_pov0_mps, strict=True)):
        dx = x_pov0 + v_pov0 * steps * DT_S - x
        best[n] = (reward + safety(dx, v_pov0 - v, weights)).max()
    return best


def _arrivals(weights: RewardWeights) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return step, x, v and the best running reward of all ways of the VUT to arrive at M.

    The table is F[j, y] over speed 18 + 0.5 j and position -182 + 0.05 y. Ways that cost more
    than any safety reward could give back are left out.
    """
    goal = round(-X_VUT0_M / POSITION_LATTICE_M)
    j = np.arange(-round(V_VUT0_MPS / SPEED_LATTICE_MPS), 41)
    v = V_VUT0_MPS + SPEED_LATTICE_MPS * j
    table = np.full((len(j), goal), -np.inf)
    table[-j[0], 0] = 0.0
    bound = weights.crash + weights.critical + weights.ttc + weights.gap
    best_arrival = -np.inf
    found: list[FloatArray] = []
    for first_step in range(0, MAX_STEPS, DECISION_STEPS):
        speeds, places = np.nonzero(table > best_arrival - bound)
        if not speeds.size:
            break
        reached = np.full_like(table, -np.inf)
        for a in ACTIONS_MPS2.tolist():
            x_now = np.asarray(X_VUT0_M + POSITION_LATTICE_M * places, dtype=np.float64)
            v_now = np.asarray(v[speeds], dtype=np.float64)
            running = table[speeds, places]
            # No case is gained by braking below a stand: the next action could have waited.
            possible = v_now + a * DECISION_STEPS * DT_S >= 0.0
            driving = possible & (v_now + a * DECISION_STEPS * DT_S <= v[-1])
            for step in range(1, DECISION_STEPS + 1):
                held: FloatArray = np.full(len(v_now), a)
                running = running + vut_step(v_now, held, weights)
                x_now = x_now + v_now * DT_S
                v_now = v_now + held * DT_S
                arrived = driving & (x_now >= -1e-9)
                if arrived.any():
                    found.append(
                        np.stack(
                            [
                                np.full(arrived.sum(), float(first_step + step)),
                                np.maximum(x_now[arrived], 0.0),
                                v_now[arrived],
                                running[arrived],
                            ]
                        )
                    )
                    ends = running[arrived] + vut_end(v_now[arrived], weights)
                    best_arrival = max(best_arrival, float(ends.max()))
                    driving &= ~arrived
            to_j = speeds[driving] + round(a)
            to_y = np.rint((x_now[driving] - X_VUT0_M) / POSITION_LATTICE_M).astype(int)
            np.maximum.at(reached, (to_j, to_y), running[driving])
        table = reached
    ways = np.concatenate(found, axis=1)
    worth = ways[3] + vut_end(ways[2], weights) > best_arrival - bound
    steps, x, v_end, reward = ways[:, worth]
    return steps, x, v_end, reward


@dataclass(frozen=True, slots=True)
class BestGames:
    """What a search found from n states: the best returns, (n,), and the actions that lead there.

    `plans` has shape (n, MAX_DECISIONS): places in ACTIONS_MPS2, -1 behind the end of the game.
    """

    returns: FloatArray
    plans: IntArray


def beam_search(
    game: Game, state: FloatArray, svo_rad: FloatArray, agent: QNetwork, width: int = 64
) -> BestGames:
    """Return the best games that a beam search finds from states, (n, 4), of a game.

    Every state of the beam is continued by all actions. Of the results, half of the beam goes to
    those with the best reward so far plus the agent's own estimate of the rest, and half to the
    best of each class of predicted gap at M, so that the agent's errors cannot hide an answer.
    """
    chunks = [slice(start, start + _CHUNK) for start in range(0, len(state), _CHUNK)]
    found = [_beam_chunk(game, state[c], svo_rad[c], agent, width) for c in chunks]
    return BestGames(
        np.concatenate([np.empty(0), *(f.returns for f in found)]),
        np.concatenate([np.empty((0, MAX_DECISIONS), np.int64), *(f.plans for f in found)]),
    )


def _beam_chunk(
    game: Game, state: FloatArray, svo_rad: FloatArray, agent: QNetwork, width: int
) -> BestGames:
    n, actions = len(state), len(ACTIONS_MPS2)
    cases, so_far = np.arange(n), np.zeros(n)
    plan = np.full((n, MAX_DECISIONS), -1)
    best, best_plan = np.full(n, -np.inf), plan.copy()
    for decision in range(MAX_DECISIONS):
        action = np.tile(np.arange(actions), len(state))
        cases, so_far = np.repeat(cases, actions), np.repeat(so_far, actions)
        plan = np.repeat(plan, actions, axis=0)
        plan[:, decision] = action
        state = np.repeat(state, actions, axis=0)
        state, reward, over = game.advance(state, svo_rad[cases], ACTIONS_MPS2[action])
        so_far = so_far + reward
        ended = np.flatnonzero(over)
        # In rising order, so that the best of a case is written last.
        ended = ended[np.argsort(so_far[ended], kind="stable")]
        ended = ended[so_far[ended] > best[cases[ended]]]
        best[cases[ended]], best_plan[cases[ended]] = so_far[ended], plan[ended]
        # Nothing that goes on can win more than the reward of a full gap.
        alive = np.flatnonzero(~over & (so_far + game.weights.gap > best[cases]))
        if not alive.size:
            break
        alive = alive[_prune(cases[alive], state[alive], so_far[alive], svo_rad, agent, width)]
        cases, state, so_far, plan = cases[alive], state[alive], so_far[alive], plan[alive]
    return BestGames(best, best_plan)


def _prune(
    cases: np.ndarray,
    state: FloatArray,
    so_far: FloatArray,
    svo_rad: FloatArray,
    agent: QNetwork,
    width: int,
) -> np.ndarray:
    """Return the indices of at most `width` states per case that stay in the beam."""
    inputs = inputs_of(agent, state, svo_rad[cases])
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
