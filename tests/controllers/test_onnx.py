"""A VUT as an ONNX network, and the export of the shipped ones."""

# mypy: no-strict-optional

from __future__ import annotations

import numpy as np
import pytest
from export_policy import export_onnx
from support.merges import SMALLER
from support.networks import constant_network as network
from support.vut_contract import begin, cases_of, in_process, on_lane, run_cases, same

from merge_sumo.drivers.base import MERGE
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import from_unit
from merge_sumo.scenario.scenario import US23

onnx = pytest.importorskip("onnx")
ort = pytest.importorskip("onnxruntime")


@pytest.mark.parametrize("scenario", [US23, SMALLER], ids=["us23", "smaller"])
def test_an_exported_policy_as_vut_drives_like_the_built_in_one(tmp_path, scenario):
    export_onnx("vut1", tmp_path / "vut1.onnx", scenario=scenario)
    cases = from_unit(np.random.default_rng(1).random((40, 3)), level=2, scenario=scenario)
    by_onnx = run_cases(in_process(f"onnx:{tmp_path / 'vut1.onnx'}"), cases)
    assert same(by_onnx, run_cases(in_process("level1"), cases))


def test_one_number_is_an_acceleration_and_seven_are_values_of_actions(tmp_path):
    one = network(tmp_path / "one.onnx", answer=[0.5], dtype=np.float32)
    seven = network(tmp_path / "seven.onnx", answer=[0, 0, 0, 0, 0, 3, 1], dtype=np.float32)
    for path, expected in ((one, 0.5), (seven, 1.0)):
        (trajectory,) = run_cases(in_process(f"onnx:{path}"), cases_of(1))
        assert (trajectory.a_vut_mps2[:-1] == expected).all()


def test_one_number_more_is_whether_to_merge_and_is_held_as_the_acceleration(tmp_path):
    for name, answer, wish, a_mps2 in (
        ("two", [0.5, 0.51], MERGE, 0.5),
        ("eight", [0, 0, 0, 0, 0, 3, 1, 9], MERGE, 1.0),
    ):
        path = network(tmp_path / f"{name}.onnx", answer=answer)
        vut = in_process(f"onnx:{path}?decision_period_s=0.5").open(1)
        begin(vut)
        for step in (5, 6):
            assert vut.act(on_lane([-51.0])._replace(step=np.array([step]))).tolist() == [a_mps2]
            assert vut.merge_requests().tolist() == [wish]
    wrong = in_process(f"onnx:{network(tmp_path / 'nan.onnx', answer=[0.5, np.inf])}").open(1)
    begin(wrong)
    assert np.isnan(wrong.act(on_lane([-51.0])))[0]
    assert wrong.reason(0) == "WrongAnswerError: requested the merge with inf instead of a number"


@pytest.mark.parametrize("shape", [[], ["batch", 1]])
@pytest.mark.parametrize("kind", ["INT64", "DOUBLE"])
def test_a_network_with_an_input_seed_is_told_that_of_each_case(tmp_path, kind, shape):
    seed = getattr(onnx.TensorProto, kind), shape
    path = network(tmp_path / "seeded.onnx", answer=[0.0], seed=seed)
    cases = cases_of(4)
    found = run_cases(in_process(f"onnx:{path}"), cases, corridors=2)
    for case, trajectory in zip(cases, found, strict=True):
        expected = case.controller_seed % 1000 / 1000.0
        assert trajectory.a_vut_mps2[:-1] == pytest.approx(expected, abs=1e-12)
    assert len({case.controller_seed for case in cases}) == 4


@pytest.mark.parametrize(
    ("options", "parameter", "said"),
    [
        ({}, "?decision_period_s=often", "decision_period_s is 'often'"),
        ({}, "?period=1", "it has no parameter 'period': choose from decision_period_s"),
        ({"width": 5}, "", "does not run with the inputs of a VUT"),
        ({"answer": [0.0, 1.0, 0.0]}, "", "has 3 outputs"),
        ({"seed": (onnx.TensorProto.INT32, [1])}, "", "an int64 (KeyError: 'tensor(int32)')"),
        ({"answer": [0, 3, 1], "last": "ArgMax"}, "", "has 3 outputs of type int64"),
    ],
)
def test_a_network_that_cannot_drive_is_refused_in_a_sentence(tmp_path, options, parameter, said):
    path = network(tmp_path / "network.onnx", **{"answer": [0.0], **options})
    with pytest.raises(UserError) as refused:
        in_process(f"onnx:{path}{parameter}")
    assert said in str(refused.value)


def test_a_file_that_is_no_network_is_refused(tmp_path):
    (tmp_path / "text.onnx").write_text("text")
    for name, said in ("nothing", "the file does not exist"), ("text", "not a usable ONNX network"):
        with pytest.raises(UserError, match=said):
            in_process(f"onnx:{tmp_path / name}.onnx")
