"""Specs: how a text becomes a `VutSpec`, and how a VUT of this package becomes one."""

from __future__ import annotations

import pytest

from merge_sumo import drivers
from merge_sumo.errors import UserError
from merge_sumo.vuts import built_in, spec
from merge_sumo.vuts.base import VutSpec
from merge_sumo.vuts.factory import VutFactory
from merge_sumo.vuts.spec import parse


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("design2", ("built-in", "design2")),
        ("design2?gap_m=2e1&kp=.5", ("built-in", "design2", (("gap_m", "2e1"), ("kp", ".5")))),
        ("design9", ("installed", "design9")),
        ("package.module:Vut", ("python", "package.module:Vut")),
        ("/a b/my.py:Vut?gain=2", ("python", "/a b/my.py:Vut", (("gain", "2"),))),
        ("python:Vut", ("python", "python:Vut")),
        ("sumo:IDM?tau=1.2", ("sumo", "IDM", (("tau", "1.2"),))),
        ("fmu:x.fmu?v_vut_mps=a=b", ("fmu", "x.fmu", (("v_vut_mps", "a=b"),))),
        ("onnx:policy.onnx", ("onnx", "policy.onnx")),
        ("traci", ("traci",)),
        ("traci:8813", ("traci", "8813")),
        ("traci:python my.py --x?y {port}", ("traci", "python my.py --x?y {port}")),
        ("here:Vut-2?gain=1", ("here", "Vut-2", (("gain", "1"),))),
    ],
)
def test_a_text_is_parsed_into_parts_that_print_as_the_text(text, parts):
    assert parse(text) == VutSpec(*parts)
    assert str(parse(text)) == text


@pytest.mark.parametrize("text", ["design2?gap_m", "my.py:Vut?=1", "sumo:IDM?tau="])
def test_what_is_no_parameter_is_refused(text):
    with pytest.raises(UserError, match="is not an option: write NAME=VALUE"):
        parse(text)


def test_a_parameter_is_given_once():
    with pytest.raises(UserError, match="the option kp is there twice"):
        parse("design2?kp=1&kp=2")


def test_a_value_is_set_in_the_place_of_an_older_one_and_todays_is_left_out():
    named = parse("a.py:V?x=1&y=2")
    assert str(named.with_values({"y": 3.0, "z": 0.5})) == "a.py:V?x=1&y=3&z=0.5"
    assert str(parse("design2").with_values({"kp": 2.0}, {"kp": 2.0})) == "design2"


OWN = """
from dataclasses import dataclass

import numpy as np

from merge_sumo.drivers.base import BuiltInVut, Design, Driver


@dataclass(frozen=True, kw_only=True, slots=True)
class Steady(Design):
    a_mps2: float = 0.5
    v_mps: float = 20.0


class SteadyVut(Driver):
    def __init__(self, corridors, design):
        super().__init__(corridors)
        self.design = design

    def act(self, scene):
        return np.where(scene.v_vut_mps < self.design.v_mps, self.design.a_mps2, 0.0)


VUTS = {"steady": BuiltInVut(SteadyVut, Steady())}
"""


def test_a_file_in_drivers_is_all_that_a_vut_with_parameters_needs(tmp_path, monkeypatch):
    (tmp_path / "steady_vut.py").write_text(OWN, encoding="utf-8")
    monkeypatch.setattr(drivers, "__path__", [*drivers.__path__, str(tmp_path)])
    monkeypatch.setattr(built_in, "folders", drivers.__path__)
    known = built_in.found()
    assert known.keys() == built_in.BUILT_IN_VUTS.keys() | {"steady"}
    for module in (built_in, spec):
        monkeypatch.setattr(module, "BUILT_IN_VUTS", known)
    factory = VutFactory.of("steady?v_mps=25")
    assert factory.kind.by_arrays
    assert factory.parameters() == {"a_mps2": 0.5, "v_mps": 25.0}
    assert factory(4).corridors == 4
