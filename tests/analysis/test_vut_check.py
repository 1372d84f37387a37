"""The commands on VUTs: the list, the drill, and the export."""

from __future__ import annotations

import json

import pytest
from support.calling import invoke

from merge_sumo import check_vut
from merge_sumo.controllers.built_in import BUILT_IN_VUTS
from merge_sumo.controllers.kinds import KINDS

GOOD = "def Vut(seen):\n    return min(max((28.0 - seen.v_vut_mps) / 0.1, 0.0), 1.0)\n"
CLASS = "class Vut:\n    shared = [0]\n    def reset(self, seen):\n        {reset}\n"
CLASS += "    def act(self, seen):\n        {act}\n"


@pytest.fixture
def check(tmp_path):
    def run(source: str, *arguments: str) -> tuple[int, str]:
        path = tmp_path / f"vut{len(list(tmp_path.iterdir()))}.py"
        path.write_text(source)
        arguments = "check-vut", f"{path}:Vut", *arguments
        done = invoke(*arguments)
        return done.exit_code, done.stdout

    return run


def test_the_list_names_every_vut_and_every_kind_with_an_example():
    said = invoke("vuts").stdout
    for kind in KINDS.values():
        assert kind.form in said
        assert kind.example in said
    assert all(name in said for name in BUILT_IN_VUTS)
    listed = json.loads(invoke("vuts", "--json").stdout)
    forms = [kind.form for kind in KINDS.values() if kind.form]
    assert [kind["form"] for kind in listed["kinds"]] == forms


def test_of_a_good_vut_it_says_nothing_wrong_and_what_a_step_costs(check):
    code, said = check(GOOD)
    assert code == 0
    assert said.startswith("nothing wrong\n")
    assert "us (median)" in said
    found = json.loads(check(GOOD, "--json")[1])
    assert (found["ok"], found["problems"]) == (True, [])
    assert found["us_per_step_median"] > 0.0


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        (
            "import random\ndef Vut(seen):\n    return random.random()\n",
            "the same cases run in another order",
        ),
        (
            CLASS.format(reset="pass", act="self.shared[0] += 1; return self.shared[0] % 7 * 0.1"),
            "differently",
        ),
        # A step depends on the number of episodes beside it.
        (
            "class Vut:\n    def __init__(self, corridors):\n        pass\n"
            "    def reset(self, corridor, seen):\n        pass\n"
            "    def act_batch(self, seen):\n"
            "        return 0.25 * seen.active.sum() + 0 * seen.t_s\n",
            "mixes the corridors of `act_batch`",
        ),
        ("def Vut(seen):\n    return None\n", "16 of 16 ordinary cases end as VUT_ERROR"),
        ("def Vut(seen):\n    return 1.0 / seen.v_vut_mps\n", "From standstill the VUT ends as"),
        ("def Vut(seen):\n    return 0.1 * (seen.v_vut_mps > 1)\n", "the VUT never starts"),
        (
            "class Vut:\n    def __init__(self):\n        raise ValueError('no licence')\n"
            "    def act(self, seen):\n        return 0.0\n",
            "The VUT does not start: ",
        ),
        ("raise ValueError('no licence')\n", "The VUT does not start: cannot load the VUT"),
        ("import os\nos._exit(3)\n", "The VUT does not start: loading the VUT"),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(check, source, problem):
    code, said = check(source)
    assert code == 1
    assert problem in said


def test_limits_are_a_note(check):
    code, said = check("def Vut(seen):\n    return 5.0\n")
    assert code == 0
    assert "steps the VUT commanded more than the limits, -4 to 2 m/s2" in said


@pytest.mark.parametrize(
    ("vut", "name"), [("design1", "roundabout"), ("sumo:IDM", "us23-lane-traffic")]
)
def test_a_good_vut_is_good_on_other_scenarios(vut, name):
    checked = check_vut(vut, scenario=name)
    assert checked.problems == []
