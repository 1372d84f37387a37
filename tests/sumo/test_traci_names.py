"""Everything that a TraCI client can ask and command, against a real SUMO."""

# mypy: no-strict-optional

from __future__ import annotations

import pytest
import traci
import traci_page
from traci_pair import Pair, answer, questions

from merge_sumo.sumo.traci_names import name_of


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    made = Pair(tmp_path_factory.mktemp("pair"))
    yield made
    made.close()


@pytest.fixture(scope="module")
def answers(pair):
    """Return both answers by question, where the client itself does not refuse to ask."""
    found = {(q[0], q[1]): (answer(pair.real, *q), answer(pair.ours, *q)) for q in questions()}
    return {q: both for q, both in found.items() if not both[0].startswith("not asked")}


class TestQuestions:
    def test_get_what_a_real_sumo_says_or_are_not_answered(self, answers):
        assert len(answers) > 500
        left_out = {q for q, both in answers.items() if "merge-sumo does not answer" in both[1]}
        differ = {q for q, both in answers.items() if both[0] != both[1]} - left_out
        assert {q for q in differ if q[0] != "simulation"} <= {
            ("vehicle", "getSpeedWithoutTraCI"),
            ("vehicle", "getTimeLoss"),
        }, "what depends on how it was commanded alone"
        assert len(differ) < 10
        assert sum(not real.startswith("refused") for q, (real, _) in answers.items()) > 290


SPEED, POSITION = traci.constants.VAR_SPEED, traci.constants.VAR_LANEPOSITION


class TestSubscriptions:
    def test_that_follow_each_other_add_up_as_in_sumo(self, pair):
        def seen(connection):
            vehicle = connection.vehicle
            vehicle.subscribe("vut", [SPEED])
            vehicle.subscribe("vut", [POSITION])
            found = set(vehicle.getSubscriptionResults("vut"))
            vehicle.subscribeLeader("vut", 10.0)
            return found, set(vehicle.getSubscriptionResults("vut"))

        assert seen(pair.ours) == seen(pair.real)
        pair.ours.vehicle.unsubscribe("vut")
        assert pair.session.subscriptions == []


def test_commands_without_a_name_are_named_by_their_number():
    assert name_of(0x7E) == "CMD_ADD_SUBSCRIPTION_FILTER"
    assert name_of(0x0E) == "the command 0x0e"


def test_the_page_is_made_from_these_tables():
    """Where this fails: python tools/traci_page.py."""
    assert traci_page.PAGE.read_text(encoding="utf-8") == traci_page.page()
