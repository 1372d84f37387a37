"""Environments, DDQN, best responses and the helix, in real SUMO and small."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from calling import invoke
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import vector as vector_wrappers
from merges import HALF, LIKE_A_ROUNDABOUT

from merge_sumo.campaigns.scenario_suggestion import unseen
from merge_sumo.drivers.level0 import Level0Pov, Level0Vut, level0_acceleration
from merge_sumo.drivers.levelk import (
    ACTIONS,
    FEATURES,
    SVO_FEATURES,
    QNetwork,
    actions_mps2,
)
from merge_sumo.drivers.policies import MANIFEST, load_network, plays_as, read_manifest, scenario_of
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import to_toml
from merge_sumo.training import best_response, ddqn, helix, refine, reward
from merge_sumo.training.check import QuickRegret, check_cases, play, returns_of
from merge_sumo.training.env import MergeGame, MergeVectorEnv, exploring_starts, pool_starts
from merge_sumo.training.game import Game, greedy
from merge_sumo.training.helix import train_library
from merge_sumo.training.registration import ENV_ID
from merge_sumo.values.case import Case, MergeCase
from merge_sumo.values.scenario import DT_S, US23
from merge_sumo.vuts.onnx_export import export_onnx

WEIGHTS = reward.RewardWeights()
REWARD = reward.Reward(WEIGHTS, US23)
ACTIONS_MPS2 = actions_mps2(US23)
TINY = ddqn.DdqnSettings(transitions=600, warm_up=200, updates=1_000, width=16, batch=16)
QUICK = refine.RefineSettings(rounds=2, starts=20, searched=5, beam=4, updates=20, batch=64)
SMALL = helix.TrainingSettings(ddqn=TINY, refine=QUICK, check_cases=4)


@pytest.fixture
def env():
    made = gymnasium.make(ENV_ID, role="pov", opponent="level0")
    yield made
    made.close()


class TestEnvironments:
    @pytest.mark.parametrize("role", ["pov", "vut"])
    def test_the_single_environment_passes_gymnasiums_checker(self, role):
        made = gymnasium.make(ENV_ID, role=role, opponent="level0")
        try:
            check_env(made.unwrapped, skip_render_check=True)
        finally:
            made.close()

    def test_psi_is_part_of_what_a_pov_with_an_orientation_sees(self):
        made = gymnasium.make(ENV_ID, role="pov", opponent="level0", svo=0.6)
        try:
            observation, _ = made.reset(seed=3)
            assert observation.shape == (5,)
            assert observation[4] == 0.6
        finally:
            made.close()

    def test_a_step_is_half_a_second_of_eq_4_against_the_level0_vut(self, env):
        (x_pov, v_pov, x_vut, v_vut), _ = env.reset(seed=1)
        (x, v, xv, vv), r, terminated, truncated, _ = env.step(5)  # +1 m/s2
        assert x == pytest.approx(x_pov + 0.5 * v_pov + 0.1, abs=1e-9)
        assert v == pytest.approx(v_pov + 0.5, abs=1e-9)
        assert xv == pytest.approx(x_vut + 0.5 * v_vut + 0.1, abs=1e-9)
        assert vv == pytest.approx(v_vut + 0.5, abs=1e-9)
        assert r == pytest.approx(-0.5 * WEIGHTS.pov_acc)
        assert not terminated
        assert not truncated

    def test_the_return_of_an_episode_is_the_reward_of_its_trajectory(self):
        games = MergeVectorEnv(4, role="pov", opponent="level0")
        try:
            start, _ = games.reset(seed=2)
            returns, open_games = np.zeros(4), np.ones(4, dtype=bool)
            while open_games.any():
                _, r, terminated, truncated, _ = games.step(np.full(4, 4))
                returns[open_games] += r[open_games]
                open_games &= ~(terminated | truncated)
        finally:
            games.close()
        cases: list[Case] = [
            MergeCase(level=1, x_pov0_m=x, v_pov0_mps=v, scenario=US23)
            for x, v in start[:, :2].tolist()
        ]
        played = returns_of(play(cases, Level0Pov, Level0Vut), REWARD)
        assert returns == pytest.approx(played.safe + played.pov_ego, abs=1e-9)

    def test_games_of_a_vector_environment_begin_anew_in_the_step_after_their_end(self):
        games = MergeVectorEnv(3, role="vut", opponent="level0")
        try:
            games.reset(seed=0)
            ends, ended = 0, np.zeros(3, dtype=bool)
            for _ in range(45):
                observation, rewards, terminated, _, _ = games.step(np.full(3, 5))
                assert (observation[ended, 2] == -182.0).all()
                assert not rewards[ended].any()
                assert not terminated[ended].any()
                assert (observation[terminated, 2] >= 0.0).all()
                ends, ended = ends + int(terminated.sum()), terminated
            assert ends >= 6
        finally:
            games.close()

    def test_make_vec_plays_the_games_of_one_world_with_gymnasiums_wrappers(self):
        games = gymnasium.make_vec(ENV_ID, num_envs=3, role="vut", opponent="level0")
        try:
            wrapped = vector_wrappers.RecordEpisodeStatistics(
                vector_wrappers.NormalizeObservation(games)
            )
            wrapped.reset(seed=0)
            lengths, returns = [], np.zeros(3)
            for _ in range(45):
                _, rewards, terminated, truncated, info = wrapped.step(np.full(3, 5))
                returns += rewards
                for k in np.flatnonzero(terminated | truncated):
                    assert info["episode"]["r"][k] == pytest.approx(returns[k])
                    lengths.append(int(info["episode"]["l"][k]))
                    returns[k] = 0.0
            assert len(lengths) >= 6
            # +1 m/s2 from 18 m/s: at M, 182 m on, in the 17th decision.
            assert set(lengths) == {17}
        finally:
            games.close()

    @pytest.mark.parametrize("timeout_s", [30.0, 40.0])
    def test_a_game_is_truncated_by_the_timeout_of_its_own_scenario(self, timeout_s):
        scenario = dataclasses.replace(US23, timeout_s=timeout_s)
        one = gymnasium.make(ENV_ID, role="vut", scenario=scenario)
        several = gymnasium.make_vec(ENV_ID, num_envs=2, role="vut", scenario=scenario)
        for games, brake in ((one, 0), (several, np.zeros(2, dtype=np.int64))):
            try:
                games.reset(seed=0)
                truncated = [np.any(games.step(brake)[3]) for _ in range(round(2 * timeout_s))]
                assert [bool(t) for t in truncated] == [False] * (len(truncated) - 1) + [True]
            finally:
                games.close()

    def test_a_shorter_game_is_truncated_alike_by_make_and_make_vec(self):
        one = gymnasium.make(ENV_ID, role="vut", max_episode_steps=3)
        several = gymnasium.make_vec(ENV_ID, num_envs=2, role="vut", max_episode_steps=3)
        for games, keep in ((one, 4), (several, np.full(2, 4))):
            try:
                games.reset(seed=0)
                truncated = [np.all(games.step(keep)[3]) for _ in range(3)]
                assert [bool(t) for t in truncated] == [False, False, True]
            finally:
                games.close()

    def test_same_seed_same_starts(self):
        for starts in (pool_starts, exploring_starts):
            one, two = (starts(50, np.random.default_rng(7), scenario=US23) for _ in range(2))
            assert np.array_equal(one, two)

    def test_starts_of_half_the_size_are_half_of_the_paper_s(self):
        for starts in (pool_starts, exploring_starts):
            one = starts(500, np.random.default_rng(7), scenario=US23)
            half = starts(500, np.random.default_rng(7), scenario=HALF)
            assert half == pytest.approx(one / 2, rel=1e-12)

    def test_a_pool_with_a_range_of_speeds_of_the_vut_starts_in_all_of_it(self):
        ranged = dataclasses.replace(LIKE_A_ROUNDABOUT, v_vut0_mps=(3.0, 9.0))
        speeds = pool_starts(500, np.random.default_rng(7), ranged)[:, 3]
        assert 3.0 <= speeds.min() < 3.1
        assert 8.9 < speeds.max() < 9.0

    def test_another_scenario_is_played_in_its_units(self):
        games = MergeVectorEnv(2, role="vut", opponent="level0", scenario=LIKE_A_ROUNDABOUT)
        try:
            start, _ = games.reset(seed=0)
            assert start[:, 2:] == pytest.approx(np.array([[-40.02, 8.0]] * 2))
            state, r, _, _, _ = games.step(np.full(2, 6))  # +2 m/s2
            assert state[:, 3] == pytest.approx(9.0)
            weights = reward.RewardWeights.of(LIKE_A_ROUNDABOUT)
            assert r == pytest.approx(-0.5 * 4.0 * weights.vut_acc)
        finally:
            games.close()

    def test_exploring_starts_are_in_the_game_and_near_conflict(self):
        starts = exploring_starts(4000, np.random.default_rng(0), scenario=US23)
        assert (starts[:, 2] < 0.0).all()
        assert (starts[:, 1] > 0.0).all()
        assert 0.55 < (starts[:, 2] > -181.9).mean() < 0.65

    @pytest.mark.parametrize(
        ("settings", "sentence"),
        [
            ({"role": "bus"}, "no role 'bus'"),
            ({"role": "vut", "svo": 0.5}, "svo is the orientation of a POV"),
            ({"role": "pov", "opponent": "pov1"}, "cannot play against 'pov1'"),
            ({"max_episode_steps": 0}, "max_episode_steps is 0"),
        ],
    )
    def test_settings_that_make_no_game_are_refused_in_a_sentence(self, settings, sentence):
        with pytest.raises(UserError, match=sentence):
            MergeVectorEnv(1, **settings)

    @pytest.mark.long
    def test_another_library_trains_on_it(self, env):
        from stable_baselines3 import DQN

        agent = DQN("MlpPolicy", env, learning_starts=50, seed=0, device="cpu")
        before = [p.clone() for p in agent.policy.parameters()]
        agent.learn(300)
        changed = [not torch.equal(*p) for p in zip(before, agent.policy.parameters(), strict=True)]
        assert any(changed)


def test_the_tutorial_shows_the_code_that_its_commands_run():
    root = Path(__file__).parents[2]
    page = (root / "docs/tutorials/reinforcement-learning.md").read_text(encoding="utf-8")
    code = (root / "examples/merging_agent.py").read_text(encoding="utf-8")
    first, *blocks = re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL)
    assert "make_vec" in first
    assert len(blocks) == 3
    assert all(block in code for block in blocks)


class TestDdqn:
    def train(self, seed=0):
        game = MergeGame("pov", Level0Vut(16), REWARD)
        try:
            return ddqn.train(game, seed, dataclasses.replace(TINY, updates=200))
        finally:
            game.close()

    @pytest.mark.slow
    def test_same_seed_same_weights_and_another_seed_other_weights(self):
        one, two, other = self.train(), self.train(), self.train(seed=1)
        for (w1, b1), (w2, b2) in zip(one.layers, two.layers, strict=True):
            assert np.array_equal(w1, w2)
            assert np.array_equal(b1, b2)
        assert not np.array_equal(one.layers[0][0], other.layers[0][0])

    def test_squash_keeps_order_and_is_undone(self):
        q = torch.linspace(-30.0, 3.0, 200, dtype=torch.float64)
        squashed = ddqn.squash(q)
        assert (squashed.diff() > 0).all()
        assert torch.equal(squashed[q >= -2], q[q >= -2])
        assert torch.allclose(ddqn.unsquash(squashed), q)

    def test_the_numpy_network_equals_the_torch_network(self):
        torch.manual_seed(0)
        network = ddqn.make_network(FEATURES, 32)
        inputs = np.random.default_rng(0).normal(size=(20, FEATURES))
        with torch.no_grad():
            expected = network.double()(torch.from_numpy(inputs)).numpy()
        assert ddqn.export(network).values(inputs) == pytest.approx(expected, abs=1e-12)


class TestBestResponse:
    def replayed(self, role, case, actions):
        """Return the return of an action sequence of 0.5 s holds by eq. (4)."""
        xp, vp, xv, vv = case.x_pov0_m, case.v_pov0_mps, -182.0, 18.0
        total = 0.0
        for step in range(300):
            hold = actions[min(step // 5, len(actions) - 1)]
            level0 = float(
                level0_acceleration(np.array([vv]), US23.level0_a_mps2, US23.level0_v_mps)[0]
            )
            ap, av = (hold, level0) if role == "pov" else (0.0, hold)
            ego = REWARD.pov_step(np.array([vp]), np.array([ap]))
            if role == "vut":
                ego = REWARD.vut_step(np.array([vv]), np.array([av]))
            total += float(ego[0])
            xp, vp = xp + vp * DT_S, max(vp + ap * DT_S, 0.0)
            xv, vv = xv + vv * DT_S, max(vv + av * DT_S, 0.0)
            if xv >= 0.0:
                total += float(REWARD.safety(np.array([xp - xv]), np.array([vp - vv]))[0])
                if role == "vut":
                    total += float(REWARD.vut_end(np.array([vv]))[0])
                return total
        return -np.inf

    @pytest.mark.parametrize("role", ["pov", "vut"])
    def test_no_sequence_that_changes_twice_beats_it_and_it_beats_level0(self, role):
        rng = np.random.default_rng(4)
        x, v = rng.uniform(-340, -180, 2), rng.uniform(25, 35, 2)
        starts = np.stack([x, v, np.full(2, -182.0), np.full(2, 18.0)], axis=1)
        best = best_response.best_response(Game(role, None, REWARD), starts)
        for x0, v0, bound in zip(x.tolist(), v.tolist(), best.tolist(), strict=True):
            case = MergeCase(level=1, x_pov0_m=x0, v_pov0_mps=v0, scenario=US23)
            tried = [
                self.replayed(role, case, [a] * n + [b] * m + [1.0 if role == "vut" else 0.0])
                for a, b in itertools.product(ACTIONS_MPS2.tolist(), repeat=2)
                for n, m in itertools.product((0, 1, 4, 8), (0, 3))
            ]
            assert max(tried) <= bound + 1e-5
            assert max(tried) > bound - 0.3, "the bound is near what simple sequences reach"

    @pytest.mark.parametrize("role", ["pov", "vut"])
    @pytest.mark.parametrize("v_vut0", [6.0, (5.0, 7.0)])
    def test_it_is_the_best_of_all_sequences_also_where_actions_have_no_common_unit(
        self, role, v_vut0
    ):
        tiny = dataclasses.replace(
            LIKE_A_ROUNDABOUT,
            x_pov0_m=(-18.0, -4.0),
            x_vut0_m=-9.0,
            v_vut0_mps=v_vut0,
            a_min_mps2=-3.1,
            a_max_mps2=2.3,
            timeout_s=2.5,
        )
        game = Game(role, None, reward.Reward.of(tiny))
        start = pool_starts(12, np.random.default_rng(6), tiny)
        sequences = list(itertools.product(range(ACTIONS), repeat=game.max_decisions))
        index, state = np.arange(len(start) * len(sequences)), np.repeat(start, len(sequences), 0)
        returns, arrived = np.zeros(len(index)), np.zeros(len(index), dtype=bool)
        for actions in np.tile(sequences, (len(start), 1)).T:
            a = game.actions_mps2[actions[index]]
            state, gained, over = game.advance(state, np.zeros(len(index)), a)
            returns[index] += gained
            arrived[index[over]] = True
            index, state = index[~over], state[~over]
        returns[~arrived] = -np.inf
        every = returns.reshape(len(start), -1)
        assert best_response.best_response(game, start) == pytest.approx(every.max(axis=1))
        assert (every.argmax(axis=1) > 0).any()

    def test_that_of_half_the_size_is_the_same(self):
        start = pool_starts(8, np.random.default_rng(3), scenario=US23)
        for role in ("pov", "vut"):
            one = best_response.best_response(Game(role, None, reward.Reward.of(US23)), start)
            half = best_response.best_response(Game(role, None, reward.Reward.of(HALF)), start / 2)
            assert one == pytest.approx(half, rel=1e-12)

    def test_a_beam_search_against_a_driver_that_ignores_it_finds_the_exact_answer(self):
        # A network whose action +1 is always the best is the level-0 VUT until 28 m/s.
        zeros = np.zeros((ACTIONS, FEATURES))
        always_1 = QNetwork([(zeros, (ACTIONS_MPS2 == 1.0).astype(float))])
        rng = np.random.default_rng(5)
        x, v = rng.uniform(-340, -180, 6), rng.uniform(25, 35, 6)
        starts = np.stack([x, v, np.full(6, -182.0), np.full(6, 18.0)], axis=1)
        exact = best_response.best_response(Game("pov", None, REWARD), starts)
        game = Game("pov", always_1, REWARD)
        found = best_response.beam_search(game, starts, np.zeros(6), always_1, width=400).returns
        assert (found <= exact + 1e-5).all()
        assert np.median(exact - found) < 0.02


class TestGame:
    """The game as a function of states, beside the one in SUMO."""

    @pytest.fixture
    def network(self):
        torch.manual_seed(1)
        return ddqn.export(ddqn.make_network(FEATURES, 32))

    @pytest.fixture
    def policy(self, network):
        return greedy(network, US23)

    @pytest.mark.parametrize("role", ["pov", "vut"])
    @pytest.mark.parametrize("learned", [False, True])
    def test_a_merge_of_half_the_size_is_the_same_game_to_the_last_bit(
        self, role, network, learned
    ):
        torch.manual_seed(3)
        opponent = ddqn.export(ddqn.make_network(FEATURES, 16)) if learned else None
        start, psi = pool_starts(200, np.random.default_rng(9), scenario=US23), np.zeros(200)
        one, half = (
            Game(role, opponent, reward.Reward.of(s)).play(start * size, psi, greedy(network, s))
            for s, size in ((US23, 1.0), (HALF, 0.5))
        )
        assert np.array_equal(one, half)

    def test_a_decision_is_half_a_second_of_eq_4(self):
        game = Game("vut", None, REWARD)
        state, rewards, over = game.advance(
            np.array([[-300.0, 33.0, -100.0, 20.0]]), np.zeros(1), np.array([-2.0])
        )
        # x: 20 + 19.8 + 19.6 + 19.4 + 19.2 = 98 steps of 0.1 s
        assert state[0] == pytest.approx([-283.5, 33.0, -90.2, 19.0], abs=1e-9)
        assert rewards[0] == pytest.approx(-0.5 * 4.0 * WEIGHTS.vut_acc)
        assert not over[0]

    def test_the_level0_vut_stops_accelerating_at_28_in_the_middle_of_a_decision(self):
        game = Game("pov", None, REWARD)
        state, _, _ = game.advance(
            np.array([[-300.0, 33.0, -100.0, 27.85]]), np.zeros(1), np.zeros(1)
        )
        assert state[0, 3] == 28.0

    @pytest.mark.parametrize("role", ["pov", "vut"])
    @pytest.mark.parametrize("scenario", [US23, LIKE_A_ROUNDABOUT], ids=lambda s: s.name)
    def test_its_returns_are_those_of_the_game_in_sumo(self, role, network, scenario):
        rng = np.random.default_rng(2)
        policy, played = greedy(network, scenario), reward.Reward.of(scenario)
        start = pool_starts(8, rng, scenario)
        expected = Game(role, None, played).play(start, np.zeros(8), policy)
        game = MergeGame(role, Level0Vut(8) if role == "pov" else Level0Pov(8), played)
        try:
            for corridor, state in enumerate(start):
                game.begin(corridor, state)
            returns, over = np.zeros(8), np.zeros(8, dtype=bool)
            for _ in range(60):
                actions = game.actions_mps2[policy(game.state(), np.zeros(8))]
                _, parts, ended = game.decide(np.where(over, 0.0, actions))
                returns += np.where(over, 0.0, parts.of(role, np.zeros(8)))
                over |= ended
        finally:
            game.close()
        assert returns[over] == pytest.approx(expected[over], abs=1e-9)
        assert over.any()

    def test_playing_every_action_out_is_never_worse_than_the_policy(self, policy):
        game = Game("pov", None, REWARD)
        start, svo_rad = pool_starts(40, np.random.default_rng(3), scenario=US23), np.zeros(40)
        before = game.play(start, svo_rad, policy)
        after = game.play(start, svo_rad, game.improved(policy))
        assert (after >= before - 1e-9).all()
        assert after.mean() > before.mean() + 0.1

    def test_an_action_is_held_as_long_as_asked_before_the_policy_goes_on(self, policy):
        game, held = Game("pov", None, REWARD), 3
        start, svo_rad = pool_starts(4, np.random.default_rng(5), scenario=US23), np.zeros(4)
        of_actions = game.action_returns(start, svo_rad, policy, held)
        for action in range(ACTIONS):
            state, gained = start, np.zeros(4)
            for _ in range(held):
                a_mps2 = np.full(4, game.actions_mps2[action])
                state, reward_of_decision, over = game.advance(state, svo_rad, a_mps2)
                gained += reward_of_decision
                assert not over.any()
            after = game.play(state, svo_rad, policy)
            assert of_actions[:, action] == pytest.approx(gained + after, abs=1e-9)

    def test_the_plan_of_a_beam_search_has_the_return_that_it_states(self, policy):
        torch.manual_seed(2)
        agent = ddqn.export(ddqn.make_network(FEATURES, 16))
        game = Game("vut", None, REWARD)
        start, svo_rad = pool_starts(5, np.random.default_rng(4), scenario=US23), np.zeros(5)
        found = best_response.beam_search(game, start, svo_rad, agent, width=16)
        for n in range(5):
            actions = iter(found.plans[n])
            returns = game.play(start[[n]], np.zeros(1), lambda *_, a=actions: np.array([next(a)]))
            assert returns[0] == pytest.approx(found.returns[n], abs=1e-9)


class TestRefinement:
    def refined(self, seed, settings=QUICK):
        torch.manual_seed(0)
        network = ddqn.export(ddqn.make_network(FEATURES, 32))
        return network, refine.refine(Game("pov", None, REWARD), network, seed, settings)

    def test_it_lowers_the_regret(self):
        regret = QuickRegret(Game("pov", None, REWARD), sees_svo=False)
        enough = dataclasses.replace(QUICK, starts=40, searched=10, beam=8, updates=200)
        before, after = map(regret, self.refined(seed=0, settings=enough))
        assert after < 0.5 * before

    def test_the_regret_of_a_network_that_is_worse_than_level0_is_not_negative(self):
        zeros = np.zeros((ACTIONS, FEATURES))
        always_brakes = QNetwork([(zeros, (ACTIONS_MPS2 == -4.0).astype(float))])
        regret = QuickRegret(Game("vut", None, REWARD), sees_svo=False)
        assert regret(always_brakes) > 1.0

    def test_states_are_labelled_where_two_actions_are_nearly_equal_or_a_better_game_was(self):
        values = np.zeros((1000, ACTIONS), dtype=np.float32)
        values[:, 2], values[:100, 4] = 1.0, 0.98
        better = np.arange(1000) >= 900
        rng = np.random.default_rng(0)
        few = dataclasses.replace(QUICK, sure_share=0.0)
        kept = refine._worth_labels(values, better, rng, few)
        assert kept.tolist() == [*range(100), *range(900, 1000)]
        kept = refine._worth_labels(values, better, rng, QUICK)
        assert 0.1 < (len(kept) - 200) / 800 < 0.2

    def test_some_searched_starts_are_near_those_where_the_last_search_found_most(self):
        torch.manual_seed(0)
        network = ddqn.export(ddqn.make_network(FEATURES + SVO_FEATURES, 32))
        game, rng = Game("pov", None, REWARD), np.random.default_rng(0)
        s = dataclasses.replace(QUICK, searched=20, starts=200, midway=0.0)
        hard = refine._Starts(np.array([[-300.0, 30.0, -182.0, 18.0]]), np.array([0.7]))
        starts = refine._starts(game, network, hard, rng, s)
        near = np.abs(starts.state - hard.state)[:, :2] < [10.0, 0.5]
        assert near[:10].all()
        assert near[10:].all(axis=1).mean() < 0.1
        assert (starts.state[:10, 2:] == hard.state[:, 2:]).all()
        assert np.abs(starts.svo_rad[:10] - 0.7).max() < 0.1

    @pytest.mark.slow
    def test_same_seed_same_weights_and_another_seed_other_weights(self):
        one, two, other = (self.refined(seed)[1] for seed in (0, 0, 1))
        for (w1, b1), (w2, b2) in zip(one.layers, two.layers, strict=True):
            assert np.array_equal(w1, w2)
            assert np.array_equal(b1, b2)
        assert not np.array_equal(one.layers[0][0], other.layers[0][0])


class TestHelix:
    @pytest.fixture(scope="class")
    @classmethod
    def library(cls, tmp_path_factory):
        folder = tmp_path_factory.mktemp("policies")
        train_library(folder, ("pov1",), settings=SMALL, scenario=US23)
        return folder

    @pytest.mark.slow
    def test_a_network_has_a_manifest_entry_and_a_log(self, library):
        entry = read_manifest(library)["pov1"]
        assert entry["command"] == "merge-sumo train --only pov1 --seed 0"
        assert entry["check"]["cases"] == 4
        lines = (library / "pov1.training.jsonl").read_text().splitlines()
        first, last = json.loads(lines[0]), json.loads(lines[-1])
        assert (first["stage"], first["done"]) == ("ddqn", TINY.updates)
        assert (last["stage"], last["done"]) == ("refine", QUICK.rounds)
        assert last["regret"] >= 0.0
        assert load_network("pov1", library).layers[-1][0].shape[0] == 7

    @pytest.mark.slow
    def test_a_finished_network_is_not_trained_again(self, library):
        before = (library / "pov1.safetensors").stat().st_mtime_ns
        told = []
        train_library(
            library,
            ("pov1",),
            settings=SMALL,
            on_done=lambda *said: told.append(said),
            scenario=US23,
        )
        assert told == [("pov1", None)]
        assert (library / "pov1.safetensors").stat().st_mtime_ns == before

    @pytest.mark.slow
    def test_another_seed_does_not_overwrite_a_network(self, library):
        before = (library / "pov1.safetensors").read_bytes()
        with pytest.raises(UserError, match=r"has a pov1 of another scenario, seed.*--out"):
            train_library(library, ("pov1",), seed=1, settings=SMALL, scenario=US23)
        assert (library / "pov1.safetensors").read_bytes() == before

    @pytest.mark.slow
    def test_a_pov_with_a_limit_of_braking_keeps_it_in_its_file(self, tmp_path):
        train_library(tmp_path, ("pov1",), settings=SMALL, scenario=US23, a_min_mps2=-2.0)
        entry = read_manifest(tmp_path)["pov1"]
        assert entry["command"] == "merge-sumo train --only pov1 --seed 0 --a-min -2"
        assert entry["a_min_mps2"] == load_network("pov1", tmp_path).a_min_mps2 == -2.0
        for other in (None, -1.0):
            with pytest.raises(UserError, match=r"has a pov1 of another .*--out"):
                train_library(tmp_path, ("pov1",), settings=SMALL, scenario=US23, a_min_mps2=other)
        with pytest.raises(UserError, match="accelerations of its own, down to -2 m/s2"):
            export_onnx("pov1", tmp_path / "pov1.onnx", tmp_path)

    @pytest.mark.parametrize("a_min_mps2", [0.0, 1.0, -4.5, float("nan")])
    def test_a_limit_that_is_none_of_the_scenario_is_refused(self, tmp_path, a_min_mps2):
        with pytest.raises(UserError, match="choose a number from -4 to below 0"):
            train_library(tmp_path / "new", scenario=US23, a_min_mps2=a_min_mps2)
        assert not (tmp_path / "new").exists()

    def test_level_2_needs_level_1_first(self, library):
        with pytest.raises(UserError, match="pov2 is trained against vut1: train that one first"):
            train_library(library, ("pov2",), settings=SMALL, scenario=US23)

    @pytest.mark.parametrize("cut", [0, 7, 100, -1])
    def test_a_truncated_or_altered_file_is_refused_with_a_sentence(self, library, tmp_path, cut):
        content = (library / "pov1.safetensors").read_bytes()
        (tmp_path / MANIFEST).write_text((library / MANIFEST).read_text())
        altered = content[:-1] + bytes([content[-1] ^ 1]) if cut == -1 else content[:cut]
        (tmp_path / "pov1.safetensors").write_bytes(altered)
        with pytest.raises(UserError, match="is not the file that its manifest describes"):
            load_network("pov1", tmp_path)

    def test_a_file_that_is_no_network_is_refused_even_with_its_own_hash(self, library, tmp_path):
        import hashlib

        content = b"\x08\x00\x00\x00\x00\x00\x00\x00not json"
        manifest = json.loads((library / MANIFEST).read_text())
        manifest["networks"]["pov1"]["sha256"] = hashlib.sha256(content).hexdigest()
        (tmp_path / MANIFEST).write_text(json.dumps(manifest))
        (tmp_path / "pov1.safetensors").write_bytes(content)
        with pytest.raises(UserError, match="holds no action-value network"):
            load_network("pov1", tmp_path)

    def test_a_missing_network_says_how_to_make_it(self, tmp_path):
        with pytest.raises(UserError, match="run `merge-sumo train --out"):
            load_network("vut1", tmp_path)


class TestTrainingForAnotherScenario:
    """`merge-sumo train --scenario`, end to end and very small."""

    @pytest.fixture(scope="class")
    @classmethod
    def ring(cls, tmp_path_factory):
        """Write the scenario as a file; it lies on the shipped road."""
        file = tmp_path_factory.mktemp("scenario") / "ring.toml"
        file.write_text(to_toml(LIKE_A_ROUNDABOUT, []))
        return file

    @pytest.fixture(scope="class")
    @classmethod
    def trained(cls, ring, tmp_path_factory):
        """Train one network."""
        out = tmp_path_factory.mktemp("own") / "policies"
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(helix, "LEVEL_SETTINGS", {1: SMALL, 2: SMALL})
            done = invoke("train", "--scenario", ring, "--out", out, "--only", "pov1")
        assert done.exit_code == 0, done.output
        return out, done.output

    @pytest.mark.slow
    def test_the_regret_is_printed_and_the_manifest_has_the_scenario(self, trained):
        folder, said = trained
        assert "pov1: mean regret" in said
        entry = read_manifest(folder)["pov1"]
        assert entry["command"] == "merge-sumo train --only pov1 --seed 0 --scenario ring"
        assert entry["scenario"]["x_vut0_m"] == -40.02
        assert plays_as(scenario_of(entry), LIKE_A_ROUNDABOUT)
        assert not plays_as(scenario_of(entry), US23)
        expected = dataclasses.asdict(reward.RewardWeights.of(LIKE_A_ROUNDABOUT))
        assert entry["reward_weights"] == expected

    @pytest.mark.slow
    def test_its_drivers_know_the_scenario_and_the_shipped_ones_do_not(self, trained, ring):
        assert unseen(LIKE_A_ROUNDABOUT, trained[0]) == []
        said = invoke("scenario", "check", ring, "--policies", trained[0]).output
        assert "were trained on such starts" in said
        said = invoke("scenario", "check", ring).output
        assert "a_min_mps2 -4 is like -8.51 in us23 (trained on -4)" in said
        assert f"merge-sumo train --scenario {ring} --out ring-policies" in said

    @pytest.mark.slow
    def test_a_check_measures_the_regret_on_the_scenario(self, trained, ring):
        words = ("train", "--check", "--scenario", ring, "--only", "pov1", "--cases", 4, "--json")
        done = invoke(*words, "--out", trained[0])
        assert json.loads(done.stdout)["pov1"] == read_manifest(trained[0])["pov1"]["check"]

    def test_a_check_without_the_scenario_says_what_is_missing(self, trained):
        done = invoke("train", "--check", "--out", trained[0], "--only", "pov1")
        assert "was trained for ring: say with --scenario" in str(done.exception)

    def test_other_cars_are_not_trained_for(self):
        traffic = dataclasses.replace(US23, headway_ahead_s=(1.0, 3.0), headway_behind_s=(1.0, 3.0))
        assert plays_as(traffic, US23)
        assert unseen(traffic) == []
        assert {len(case.starts()) for case in check_cases("pov2", 3, scenario=traffic)} == {2}

    def test_without_a_folder_nothing_is_written_into_the_shipped_policies(self, ring):
        done = invoke("train", "--scenario", ring)
        assert "the shipped policies are for us23: say with --out" in str(done.exception)

    def test_networks_of_two_scenarios_do_not_mix_in_a_folder(self, trained):
        with pytest.raises(UserError, match=r"pov1 .* was trained for another scenario, ring"):
            train_library(trained[0], ("vut2",), settings=SMALL, scenario=US23)
        with pytest.raises(UserError, match="has a pov1 of another scenario"):
            train_library(trained[0], ("pov1",), settings=SMALL, scenario=US23)

    @pytest.mark.parametrize(
        "record",
        [7, {"x_vut0_m": "far"}, {"x_vut0_m": -40.0, "mainline": ["e"]}, {"a_min_mps2": 4.0}],
    )
    def test_a_manifest_with_no_such_scenario_is_refused(self, trained, tmp_path, record):
        manifest = json.loads((trained[0] / MANIFEST).read_text())
        manifest["networks"]["pov1"]["scenario"] = record
        (tmp_path / MANIFEST).write_text(json.dumps(manifest))
        with pytest.raises(UserError, match="is not a readable manifest of policies"):
            read_manifest(tmp_path)
