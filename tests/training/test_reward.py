"""The reward's terms, by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from support.merges import LIKE_A_ROUNDABOUT

from merge_sumo.scenario.scenario import US23
from merge_sumo.training import reward

R = reward.Reward(reward.RewardWeights(
    pov_acc=0.1, pov_v_hw=0.2, vut_acc=0.04, vut_v_min=0.3, vut_v_end=0.5,
    ttc=1.4, gap=0.6, gap_full_m=60.0, critical=0.9, crash=20.0,
), US23)  # fmt: skip


def of(term, *numbers):
    return float(term(*(np.array([n]) if isinstance(n, float) else n for n in numbers))[0])


@pytest.mark.parametrize(
    ("v", "cost"), [(24.6, 0.0), (30.0, 0.0), (35.0, 0.0), (22.6, -2.0), (36.5, -1.5)]
)
def test_speed_outside_the_highways_range_costs_its_distance(v, cost):
    assert of(R.phi_v_hw, v) == pytest.approx(cost)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_ttc_below_7_s_costs_when_the_gap_closes(sign):
    assert of(R.phi_ttc, sign * 21.0, sign * -6.0) == pytest.approx(-0.5)  # 3.5 s
    assert of(R.phi_ttc, sign * 42.0, sign * -6.0) == 0.0  # 7 s
    assert of(R.phi_ttc, sign * 21.0, sign * 6.0) == 0.0  # opens
    assert of(R.phi_ttc, sign * 21.0, 0.0) == 0.0


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_wide_gap_is_rewarded_and_a_critical_one_is_penalised(sign):
    assert of(R.phi_dx, sign * 60.0) == pytest.approx(0.6)
    assert of(R.phi_dx, sign * 90.0) == pytest.approx(0.6)
    assert of(R.phi_dx, sign * 30.0) == pytest.approx(0.3)
    assert of(R.phi_dx, sign * 15.0) == pytest.approx(0.15)
    assert of(R.phi_dx, sign * 5.0) == pytest.approx(0.05 - 0.6)


def test_the_parts_of_the_reward_by_hand():
    # 21 m ahead, closing at 6 m/s: -1.4 / 2 + 0.6 * 21 / 60
    assert of(R.safety, 21.0, -6.0) == pytest.approx(-0.7 + 0.21)
    # 3 m behind, opening: 0.6 * 3 / 60 - 0.9 * 0.8 - 20
    assert of(R.safety, -3.0, -6.0) == pytest.approx(0.03 - 20.72)
    assert of(R.pov_step, 22.6, 2.0) == pytest.approx(0.1 * (-0.1 * 4 - 0.2 * 2))
    assert of(R.vut_step, 10.0, -1.0) == pytest.approx(0.1 * (-0.04 - 0.3 * 2))
    assert of(R.vut_end, 22.6) == pytest.approx(-1.0)


def test_orientation_turns_from_egoistic_to_altruistic():
    parts = (np.array([-1.0]), np.array([-2.0]), np.array([-3.0]))
    assert reward.RewardParts(*parts).of("pov", np.array([0.0])) == pytest.approx([-3.0])
    assert reward.RewardParts(*parts).of("pov", np.array([math.pi / 2])) == pytest.approx([-4.0])
    assert reward.RewardParts(*parts).of("pov", np.array([math.pi / 6])) == pytest.approx(
        [-1.0 - 2.0 * math.sqrt(0.75) - 1.5]
    )


def test_the_weights_of_a_short_and_slow_merge_by_hand():
    found = reward.RewardWeights.of(LIKE_A_ROUNDABOUT)
    # 40.02 m at 9 m/s take (40.02 / 182) / (9 / 28) of the time that 182 m at 28 m/s take.
    time, speed = (40.02 / 182) / (9 / 28), 9 / 28
    assert found.pov_acc == pytest.approx(0.1 / time)
    assert found.vut_acc == pytest.approx(0.15 / time)
    assert found.pov_v_hw == found.vut_v_min == pytest.approx(0.1 / time / speed)
    assert found.vut_v_end == pytest.approx(1.5 / speed)
    assert found.gap_full_m == pytest.approx(12.0 + 45.0 * 9.0 / 28.0)
    assert (found.ttc, found.gap, found.critical, found.crash) == (0.2, 1.0, 0.5, 20.0)
