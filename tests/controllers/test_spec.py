"""Specs: how a text becomes a `ControllerSpec`, and how a VUT of this package becomes one."""

from __future__ import annotations

import pytest

from merge_sumo.controllers.kinds import parse
from merge_sumo.controllers.spec import ControllerSpec
from merge_sumo.errors import UserError


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
    assert parse(text) == ControllerSpec(*parts)
    assert str(parse(text)) == text


@pytest.mark.parametrize("text", ["design2?gap_m", "my.py:Vut?=1", "sumo:IDM?tau="])
def test_what_is_no_parameter_is_refused(text):
    with pytest.raises(UserError, match="is not an option: write NAME=VALUE"):
        parse(text)


def test_a_value_is_set_in_the_place_of_an_older_one():
    named = parse("a.py:V?x=1&y=2").with_value("y", 3.0).with_value("z", 0.5)
    assert str(named) == "a.py:V?x=1&y=3&z=0.5"
