"""Questions and subscriptions of a TraCI client, against a real SUMO."""

# mypy: no-strict-optional

from __future__ import annotations

import pytest
import traci
import traci_page
from support.traci_pair import Pair, answer, questions, shown
from traci.storage import Storage

from merge_sumo.sumo.traci_names import name_of


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    made = Pair(tmp_path_factory.mktemp("pair"))
    yield made
    made.close()


@pytest.fixture(scope="module")
def answers(pair):
    """Return both answers by question, where the client itself does not refuse to ask."""
    found = {}
    for question in questions():
        real = answer(pair.real, *question)
        if not real.startswith("not asked"):
            found[question[:2]] = real, answer(pair.ours, *question)
    return found


PROGRAMS = ("ProgramLogics", "CompleteRedYellowGreenDefinition", "ControlledLinks")
LEFT_OUT = ("Constraint", "Distance", "find", *PROGRAMS)
"""Parts of the names of questions that a merge does not need."""
DIFFERENT = {
    *(("vehicle", "getSpeedWithoutTraCI"), ("vehicle", "getTimeLoss")),
    # SUMO drives a vehicle of this name along the route that it finds.
    *(("simulation", "getLoadedIDList"), ("simulation", "getLoadedNumber")),
    # Refused by both, in other words.
    *(("simulation", "getIDList"), ("simulation", "getIDCount")),
}


class TestQuestions:
    def test_get_what_a_real_sumo_says_or_are_not_answered(self, answers):
        assert len(answers) > 500
        differ, refused = set(), 0
        for (domain, function), (real, ours) in answers.items():
            refused += real.startswith("refused")
            if "merge-sumo does not answer" in ours:
                assert domain == "gui" or any(part in function for part in LEFT_OUT), function
            elif real != ours:
                differ.add((domain, function))
        assert differ <= DIFFERENT
        assert len(answers) - refused > 300


VEHICLES = traci.constants.CMD_GET_VEHICLE_VARIABLE
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
        assert pair.session.subscriptions == {}

    @pytest.mark.parametrize("range_m", [0.0, 50.0, 300.0, 2000.0])
    @pytest.mark.parametrize("around", [("vehicle", "vut"), ("junction", "M")])
    def test_to_vehicles_around_an_object_get_what_a_real_sumo_says(self, pair, around, range_m):
        domain, name = around

        def seen(connection):
            for results in connection._subscriptionMapping.values():
                results.reset()
            api = getattr(connection, domain)
            api.subscribeContext(name, VEHICLES, range_m, [SPEED, 0x43])
            found = shown(api.getContextSubscriptionResults(name))
            api.unsubscribeContext(name, VEHICLES, range_m)
            return found

        assert seen(pair.ours) == seen(pair.real)
        assert pair.session.subscriptions == {}

    def test_to_other_objects_around_it_are_refused(self, pair):
        with pytest.raises(traci.TraCIException, match="context subscriptions to vehicles only"):
            pair.ours.vehicle.subscribeContext("vut", 0xA3, 100.0, [1])

    def test_to_vehicles_around_it_follow_the_steps(self, pair):
        vehicle = pair.ours.vehicle
        vehicle.subscribeContext("vut", VEHICLES, 400.0, [SPEED])
        subscribed = Storage(pair.session.results())
        assert subscribed.readInt() == 1
        pair.ours._readSubscription(subscribed)
        assert set(vehicle.getContextSubscriptionResults("vut")) == {"pov", "vut"}
        vehicle.unsubscribeContext("vut", VEHICLES, 400.0)
        assert Storage(pair.session.results()).readInt() == 0

    def test_to_a_parameter_get_it(self, pair):
        def seen(connection):
            connection.vehicle.setParameter("vut", "mine", "7")
            connection.vehicle.subscribeParameterWithKey("vut", "mine")
            return connection.vehicle.getSubscriptionResults("vut")[0x3E]

        assert seen(pair.ours) == seen(pair.real) == ("mine", "7")
        pair.ours.vehicle.unsubscribe("vut")


def test_commands_without_a_name_are_named_by_their_number():
    assert name_of(0xC4, 0x00) == "the command 0xc4 of variable 0x00"


def test_the_page_is_made_from_these_tables():
    """Where this fails: python tools/traci_page.py."""
    assert traci_page.PAGE.read_text(encoding="utf-8") == traci_page.page()
