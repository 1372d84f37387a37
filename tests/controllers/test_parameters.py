"""Parameters in a spec, `SPEC?NAME=VALUE`: how they reach controllers of each kind."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from merge_sumo.controllers.built_in import BUILT_IN_VUTS
from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.python import objects
from merge_sumo.controllers.spec import ControllerOptions
from merge_sumo.errors import UserError

SOURCE = """
class Vut:
    late_m = 10.0

    def __init__(self, gain=2.0, name="x"):
        self.gain, self.shift, self._hidden, self.on = gain, 3, 1.0, True

    def act(self, seen):
        return self.gain


class Slots:
    __slots__ = ("a",)

    def __init__(self):
        self.a = 1.5

    def act(self, seen):
        return self.a


class Batch:
    def __init__(self, corridors, gain=1.0):
        self.gain = gain

    def act_batch(self, seen):
        return seen.x_vut_m * 0 + self.gain


def law(seen, gain=1.0):
    return gain
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "vut.py"
    path.write_text(SOURCE, encoding="utf-8")
    return path


def parameters(spec: str, *, in_process: bool = True) -> dict[str, float]:
    return load(spec, ControllerOptions(in_process=in_process)).parameters()


@pytest.mark.parametrize(
    ("named", "expected"),
    [
        ("Vut", {"gain": 2.0, "late_m": 10.0, "shift": 3}),
        ("Vut?gain=4&shift=5&late_m=0.5", {"gain": 4, "late_m": 0.5, "shift": 5}),
        ("Slots?a=2.5", {"a": 2.5}),
        ("Batch?gain=0.5", {"gain": 0.5}),
        ("law", {"gain": 1.0}),
        ("law?gain=3", {"gain": 3}),
    ],
)
def test_a_python_controller_takes_keywords_and_attributes(file, named, expected):
    assert parameters(f"{file}:{named}") == expected


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        ("{}:Vut?nothing=1", "it has no parameter 'nothing': choose from gain, late_m, shift"),
        ("{}:Vut?_hidden=1", "it has no parameter '_hidden'"),
        ("{}:Batch?corridors=3", "it has no parameter 'corridors': choose from gain"),
        ("{}:Vut?gain=fast", "gain is 'fast': it must be a number"),
        ("gap?headway=1", "it has no parameter 'headway': choose from brake_mps2, headway_s"),
        ("gap?headway_s=-1", "headway_s is -1.0: it must be 0 or more"),
        ("level1?x=1", "it has no parameter 'x': it has none"),
        ("sumo:IDM?taw=1", "it has no parameter 'taw': choose from accel,"),
        ("sumo:IDM?tau=-1", "tau is -1: it must be 0 or more"),
    ],
)
def test_what_is_no_parameter_is_refused_in_a_sentence(file, spec, said):
    with pytest.raises(UserError) as refused:
        parameters(spec.format(file))
    assert str(refused.value).startswith(f"{spec.format(file)}: {said}")


def test_an_object_is_copied_before_it_is_changed():
    class Vut:
        gain = 2.0

        def act(self, seen):
            return self.gain

    vut = Vut()
    objects["Vut"] = vut
    assert parameters("here:Vut?gain=5") == {"gain": 5}
    assert vut.gain == 2.0


@pytest.mark.parametrize("name", [n for n, vut in BUILT_IN_VUTS.items() if vut.design])
def test_a_built_in_vut_keeps_what_is_not_set(name):
    known = asdict(BUILT_IN_VUTS[name].design)  # type: ignore[arg-type]
    first = next(iter(known))
    assert parameters(f"{name}?{first}=150") == {**known, first: 150.0}
    load(f"{name}?{first}=150").open(2).close()
