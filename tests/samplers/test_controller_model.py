"""The model of the controller: rollouts agree with SUMO, and predictions with outcomes."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from support.plans import POVS, plan_for

from merge_sumo.drivers.policies import policies_in, policies_of
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.metrics.outcome import Outcome, Prediction
from merge_sumo.records import decode, to_plain
from merge_sumo.road.loader import centre_lines, road_for
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.samplers.controller_model import FAR, ControllerModel, ModelRollout, TreeInputs
from merge_sumo.samplers.coverage import CoverageSampler
from merge_sumo.scenario.case import Pool
from merge_sumo.scenario.scenario import US23
from merge_sumo.simulation.evaluate import simulate
from merge_sumo.simulation.povs import Povs


def slows(inputs: np.ndarray) -> np.ndarray:
    return np.where(inputs[:, 6] > 10.0, -0.5, 1.0)


SLOWS = "def vut(seen):\n    return -0.5 if seen.v_vut_mps > 10.0 else 1.0\n"


def ran(vut: str, level: int, points, scenario=US23, povs=None):
    plan = plan_for(vut, scenario=scenario, povs=povs, corridors=16)
    pool = Pool(levels=(level,), scenario=scenario)
    done = simulate(plan, pool.cases(points, level))
    outcomes, motions = [], {}
    for index, one in enumerate(done):
        outcomes.append(Outcome(index, index // 10, one.trajectory.case, one.outcome.measures))
        motions[index] = one.trajectory.motion
    return outcomes, motions


def gaps_of(outcomes) -> np.ndarray:
    return np.array([outcome.signed_gap for outcome in outcomes], dtype=np.float64)


@pytest.fixture(scope="module")
def seen():
    return ran("design1", 0, np.random.default_rng(3).random((60, 2)))


class TestRollouts:
    @pytest.mark.parametrize(
        ("name", "level", "library"),
        [
            *(("us23", level, None) for level in (0, 1, 2)),
            *(("us23-traffic", 1, None), ("roundabout", 2, None)),
            *(("us23", level, "human") for level in (1, 2)),
        ],
    )
    def test_end_as_sumo_ends_them(self, name, level, library, tmp_path):
        (tmp_path / "slows.py").write_text(SLOWS)
        scenario = named_scenario(name)
        dims = len(scenario.dimensions(level))
        points = np.random.default_rng(level).random((24, dims))
        povs = Povs(policies=policies_in(library) if library else policies_of(scenario))
        outcomes, _ = ran(f"{tmp_path / 'slows.py'}:vut", level, points, scenario, povs)
        games = ModelRollout(Pool(levels=(level,), scenario=scenario), povs)

        found = games.play({level: points}, [slows])[0]
        assert np.isfinite(found).any()
        # The POV decides in float32 here: one that has no preference may choose otherwise.
        true = gaps_of(outcomes)
        off = (np.abs(found - true) > 1e-6) & ((found < FAR) | (true < FAR))
        assert off.sum() <= 1

    def test_end_where_the_pov_is_far_behind_the_merge_point(self):
        drives = []

        def stops(inputs):
            drives.append(len(inputs))
            return np.full(len(inputs), -4.0)

        rollout = ModelRollout(Pool(levels=(0,), scenario=US23), POVS)
        gaps = rollout.play({0: np.full((3, 2), 0.5)}, [stops])
        assert (gaps > FAR).all()
        assert len(drives) < US23.max_steps / 2

    @pytest.mark.parametrize(
        "text", ["unsafe or before_clearance_m < 3", 'pet_s < 2.5 or end == "TIMEOUT"']
    )
    def test_are_judged_as_cases_are(self, text, tmp_path):
        (tmp_path / "slows.py").write_text(SLOWS)
        criterion, pool, road = Criterion(text), Pool(levels=(0,), scenario=US23), road_for(US23)
        points = np.random.default_rng(5).random((24, 2))
        plan = plan_for(f"{tmp_path / 'slows.py'}:vut", corridors=16)
        done = simulate(plan, pool.cases(points, 0))
        lines = centre_lines(road)
        expected = [criterion.outcome(one.trajectory, lines).signed_gap for one in done]
        rollout = ModelRollout(pool, POVS, criterion, lines)
        (found,) = rollout.play({0: points}, [slows])
        assert found == pytest.approx(np.array(expected, dtype=np.float64), abs=1e-6)
        assert (np.abs(found) < 1.0).any()

    def test_of_several_levels_and_copies_are_those_of_each(self):
        random = np.random.default_rng(6)
        points = {0: random.random((5, 2)), 2: random.random((7, 3)), 1: random.random((4, 2))}
        rollout = ModelRollout(Pool(levels=(0, 1, 2), scenario=US23), POVS)

        together = rollout.play(points, [slows, slows])
        alone = [rollout.play({level: of}, [slows])[0] for level, of in points.items()]
        assert together == pytest.approx(np.tile(np.concatenate(alone), (2, 1)), nan_ok=True)

    def test_cannot_be_played_against_a_program(self):
        assert not ModelRollout(Pool(levels=(0,), scenario=US23), POVS).can_predict(3)


class TestObservation:
    def test_sees_the_state_and_what_was_before(self):
        observation = TreeInputs(US23, 1)
        for step in range(5):
            x = np.array([[-200.0 + step], [-100.0 + 2.0 * step]])
            v = np.array([[30.0], [20.0]])
            seen = observation.step(x, v, np.array([0.0 if step < 4 else -2.0]))[0].copy()
        assert seen[:7].tolist() == [-2.0, -104.0, 10.0, -196.0, 30.0, -92.0, 20.0]
        # The time, steps since the jump, the lowest and the highest acceleration so far.
        assert seen[17:21].tolist() == [4.0, 0.0, -2.0, 0.0]
        # Earlier accelerations, then gap and closing speed 0.3 s ago.
        assert seen[21:25].tolist() == [0.0] * 4
        assert seen[25:27].tolist() == [-101.0, 10.0]


class TestModel:
    def test_predictions_do_not_depend_on_the_order_of_outcomes(self, seen):
        outcomes, motions = seen
        points = np.random.default_rng(4).random((7, 2))
        rollout = ModelRollout(Pool(levels=(0,), scenario=US23), POVS)
        at_once, in_parts = ControllerModel(rollout, 5), ControllerModel(rollout, 5)
        at_once.tell(outcomes, motions)
        in_parts.tell(outcomes[30:], motions)
        in_parts.predict({0: points})
        in_parts.tell(outcomes[:40], motions)
        assert (at_once.predict({0: points})[0] == in_parts.predict({0: points})[0]).all()


class TestPrediction:
    def test_is_read_as_it_was_written(self):
        one = Prediction.of(np.array([1.23456, math.nan]), 0.5, 0.25, 0.4)
        assert one.dx_m == ((1.2346, None),)
        assert decode(json.dumps(to_plain(one)), Prediction) == one


def test_a_sampler_without_a_model_uses_the_surrogate_alone(seen):
    sampler = CoverageSampler(Pool(levels=(0,), scenario=US23), 1)
    sampler.tell(seen[0][:5])
    sampler.ask(3)
    assert [sampler.prediction(place) for place in range(3)] == [None] * 3
