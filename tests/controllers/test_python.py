"""A VUT in Python: the tutorial's example, what it may see, and what it may do wrong."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import random
import sys
from dataclasses import replace

import pytest
from support.packages import install
from support.vut_contract import LEVEL0_CLASS, cases_of, factory, in_process, run_cases, same

from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import US23, VUT
from merge_sumo.scenario.trajectory import End

BATCHED = """
import numpy as np
class Vut:
    def __init__(self, corridors):
        self.resets = [0] * corridors
    def reset(self, corridor, seen):
        self.resets[corridor] += 1
    def act_batch(self, seen):
        return np.clip((28.0 - seen.v_vut_mps) / 0.1, 0.0, 1.0)
"""


@pytest.mark.parametrize(("source", "name"), [(LEVEL0_CLASS, "Level0"), (BATCHED, "Vut")])
def test_the_level_0_law_in_python_drives_as_level0(write_vut, source, name):
    cases = cases_of(20)
    assert same(*(run_cases(factory(vut), cases) for vut in (write_vut(source, name), "level0")))


def test_a_module_in_the_working_folder_is_found(write_vut, tmp_path, monkeypatch):
    write_vut(LEVEL0_CLASS, file="module_of_a_user.py")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [p for p in sys.path if p])
    assert run_cases(in_process("module_of_a_user:Level0"), cases_of(3))[0].end is End.MERGED


def test_an_installed_package_can_register_a_name(tmp_path, monkeypatch):
    entries = "mine = registered_vut:Level0\nbad = registered_vut:Nothing"
    install(tmp_path, "registered_vut", LEVEL0_CLASS, "merge_sumo.vuts", entries)
    monkeypatch.syspath_prepend(tmp_path)
    assert run_cases(in_process("mine"), cases_of(3))[0].end is End.MERGED
    with pytest.raises(UserError, match="registered_vut has no 'Nothing'"):
        in_process("bad")


WATCHER = """
import json, pathlib
class Vut:
    def reset(self, seen):
        self.seen = [seen._asdict()]
    def act(self, seen):
        self.seen.append(seen._asdict())
        pathlib.Path(__file__).with_name("seen.json").write_text(json.dumps(self.seen))
        return 0.5
"""


def test_it_sees_time_and_state_and_nothing_about_who_drives_the_pov(write_vut, tmp_path):
    case = Case(
        level=2, x_pov0_m=-250.0, v_pov0_mps=30.0, svo_rad=0.5, v_vut0_mps=17.0, scenario=US23
    )
    (trajectory,) = run_cases(in_process(write_vut(WATCHER)), [case])
    at_reset, *steps = json.loads((tmp_path / "seen.json").read_text())
    start = {"t_s": 0.0, "x_pov_m": -250.0, "v_pov_mps": 30.0, "x_vut_m": -182.0, "v_vut_mps": 17.0}
    assert at_reset == start
    assert steps[0] == pytest.approx(start)
    assert len(steps) == len(trajectory.whole) - 1
    for number, x_m in enumerate(trajectory.x_pov_m[:-1].tolist()):
        assert (steps[number]["t_s"], steps[number]["x_pov_m"]) == (round(number * 0.1, 1), x_m)


def test_each_corridor_has_an_object_of_its_own(write_vut):
    source = """
class Vut:
    def reset(self, seen):
        self.count = 0
    def act(self, seen):
        self.count += 1
        assert self.count == round(seen.t_s * 10) + 1, self.count
        return 1.0
"""
    for trajectory in run_cases(in_process(write_vut(source)), cases_of(20)):
        assert trajectory.end is End.MERGED


def test_a_batched_vut_cannot_move_the_cars(write_vut):
    source = BATCHED.replace("return ", "seen.x_vut_m[:] = 5.0; seen.v_vut_mps[:] = 1.0; return ")
    for trajectory in run_cases(in_process(write_vut(source)), cases_of(4)):
        assert trajectory.end is End.MERGED


def test_answers_outside_the_limits_are_clipped_and_counted_but_rounding_is_not(write_vut):
    for answer, clipped in ((7.0, True), (2.0 + 1e-12, False), (2, False)):
        source = f"def Vut(seen):\n    return {answer}\n"
        (trajectory,) = run_cases(in_process(write_vut(source, file=f"v{answer}.py")), cases_of(1))
        assert trajectory.clipped_steps == (len(trajectory.motion) - 1) * clipped
        assert (trajectory.a_vut_mps2[:-1] == 2.0).all()


def test_what_it_prints_goes_to_standard_error_and_close_is_called(write_vut, capsys):
    source = """
class Vut:
    def act(self, seen):
        print("hello")
        return 1.0
    def close(self):
        print("goodbye")
        raise ValueError("too late")
"""
    (trajectory,) = run_cases(in_process(write_vut(source)), cases_of(1), corridors=1)
    said = capsys.readouterr()
    assert trajectory.end is End.MERGED
    assert said.out == ""
    assert "hello" in said.err
    assert "error while closing the VUT: ValueError: too late" in said.err


@pytest.mark.parametrize(
    ("source", "name", "said"),
    [
        ("", "Vut", "has no 'Vut'"),
        ("Vut = 3", "Vut", "a VUT is a class or an object"),
        ("class Vut: pass", "Vut", "a VUT is a class or an object"),
        ("def Vut(): pass", "Vut", "Vut() must accept the call Vut(seen)"),
        ("1 / 0", "Vut", "ZeroDivisionError"),
        ("import sys; sys.exit(1)", "Vut", "SystemExit"),
        ("def Vut(:", "Vut", "SyntaxError"),
    ],
)
def test_what_cannot_be_a_vut_is_refused_in_a_sentence(write_vut, source, name, said):
    with pytest.raises(UserError, match=r"(?i)vut") as refused:
        in_process(write_vut(source, name))
    assert said in str(refused.value)


def test_a_batched_class_that_takes_no_number_of_corridors_is_told_of_it(write_vut):
    batched = "class Vut:\n    def act_batch(self, seen):\n        return seen.t_s\n"
    with pytest.raises(UserError, match="cannot be made: TypeError"):
        in_process(write_vut(batched)).open(2)


SEEDED = """
import random
class Vut:
    def reset(self, seen, seed):
        self.a_mps2 = random.Random(seed).uniform(0.0, 1.0)
    def act(self, seen):
        return self.a_mps2
"""
SEEDED_BATCH = """
import random
class Vut:
    def __init__(self, corridors):
        self.a_mps2 = [0.0] * corridors
    def reset(self, corridor, seen, *, seed):
        self.a_mps2[corridor] = random.Random(seed).uniform(0.0, 1.0)
    def act_batch(self, seen):
        return self.a_mps2
"""


@pytest.mark.parametrize("source", [SEEDED, SEEDED_BATCH])
def test_a_controller_that_takes_a_seed_draws_again_for_each_draw_and_repeats_it(write_vut, source):
    first, *_ = cases_of(1)
    second = replace(first, draw=1)
    ran = run_cases(in_process(write_vut(source)), [first, second, first])
    for case, trajectory in zip((first, second, first), ran, strict=True):
        drawn = random.Random(case.controller_seed).uniform(0.0, 1.0)  # noqa: S311
        assert trajectory.motion[0, VUT, 2] == drawn
    assert first.controller_seed != second.controller_seed
