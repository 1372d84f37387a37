"""Everything that a TraCI client can ask and command, against a real SUMO."""

# mypy: no-strict-optional

from __future__ import annotations

import pytest
import traci
import traci_page
from traci_pair import Pair, answer, questions, shown

from merge_sumo.sumo.traci_names import name_of

SAME = 0.95


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
    def test_there_are_as_many_as_the_client_has(self, answers):
        assert len(answers) > 500
        assert sum(not real.startswith("refused") for real, _ in answers.values()) > 290

    @pytest.mark.parametrize("kind", ["answers", "refusals"])
    def test_get_what_a_real_sumo_says(self, answers, kind):
        refused = kind == "refusals"
        of_kind = {q: b for q, b in answers.items() if b[0].startswith("refused") == refused}
        differ = {q: both for q, both in of_kind.items() if both[0] != both[1]}
        assert len(differ) <= (1.0 - SAME) * len(of_kind), differ

    @pytest.mark.parametrize("domain", ["edge", "lane", "junction", "route", "vehicletype"])
    def test_of_the_road_and_its_types_are_all_answered_the_same(self, answers, domain):
        assert {q: b for q, b in answers.items() if q[0] == domain and b[0] != b[1]} == {}

    def test_of_the_vehicle_differ_in_what_depends_on_how_it_was_commanded_alone(self, answers):
        differ = {q[1] for q, b in answers.items() if q[0] == "vehicle" and b[0] != b[1]}
        assert differ <= {"getSpeedWithoutTraCI", "getTimeLoss"}


SPEED, POSITION = traci.constants.VAR_SPEED, traci.constants.VAR_LANEPOSITION
VEHICLES_OF, LANES_OF = (
    traci.constants.CMD_GET_VEHICLE_VARIABLE,
    traci.constants.CMD_GET_LANE_VARIABLE,
)


class TestSubscriptions:
    @pytest.mark.parametrize(
        ("domain", "name", "of", "range_m", "variable"),
        [
            ("junction", "M", VEHICLES_OF, 150.0, SPEED),
            ("junction", "M", VEHICLES_OF, 1000.0, SPEED),
            ("edge", "ramp", VEHICLES_OF, 5.0, SPEED),
            ("lane", "main_out_0", LANES_OF, 10.0, traci.constants.VAR_LENGTH),
            ("vehicle", "vut", LANES_OF, 100.0, traci.constants.LAST_STEP_VEHICLE_NUMBER),
        ],
    )
    def test_to_what_is_around_anything_are_answered_as_by_sumo(
        self, pair, domain, name, of, range_m, variable
    ):
        def around(connection):
            mine = getattr(connection, domain)
            mine.subscribeContext(name, of, range_m, [variable])
            return shown(dict(sorted(mine.getContextSubscriptionResults(name).items())))

        assert around(pair.ours) == around(pair.real)

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
        assert not [s for s in pair.session.subscriptions.all if s.of == (VEHICLES_OF, "vut", None)]


def test_commands_without_a_name_are_named_by_their_number():
    assert name_of(0x7E) == "CMD_ADD_SUBSCRIPTION_FILTER"
    assert name_of(0x0E) == "the command 0x0e"


def test_the_page_is_made_from_these_tables():
    """Where this fails: python tools/traci_page.py."""
    assert traci_page.PAGE.read_text(encoding="utf-8") == traci_page.page()
