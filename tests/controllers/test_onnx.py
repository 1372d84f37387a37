"""A VUT as an ONNX network, and the export of the shipped ones."""

# mypy: no-strict-optional

from __future__ import annotations

import numpy as np
import pytest
from export_policy import export_onnx
from support.merges import SMALLER
from support.networks import constant_network as network
from support.vut_contract import begin, cases_of, in_process, on_lane, run_cases

from merge_sumo.drivers.base import MERGE, STAY
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import from_unit
from merge_sumo.scenario.scenario import US23

onnx = pytest.importorskip("onnx")
ort = pytest.importorskip("onnxruntime")


@pytest.mark.parametrize("scenario", [US23, SMALLER], ids=["us23", "smaller"])
def test_an_exported_policy_as_vut_drives_like_the_built_in_one(tmp_path, scenario):
    export_onnx("vut1", tmp_path / "vut1.onnx", scenario=scenario)
    cases = from_unit(np.random.default_rng(1).random((40, 3)), level=2, scenario=scenario)
    by_onnx, built_in = (
        run_cases(in_process(vut), cases) for vut in (f"onnx:{tmp_path / 'vut1.onnx'}", "level1")
    )
    for one, other in zip(by_onnx, built_in, strict=True):
        assert np.array_equal(one.motion, other.motion)


def test_one_number_is_an_acceleration_and_seven_are_values_of_actions(tmp_path):
    one = network(tmp_path / "one.onnx", answer=[0.5], dtype=np.float32)
    seven = network(tmp_path / "seven.onnx", answer=[0, 0, 0, 0, 0, 3, 1], dtype=np.float32)
    for path, expected in ((one, 0.5), (seven, 1.0)):
        (trajectory,) = run_cases(in_process(f"onnx:{path}"), cases_of(1))
        assert (trajectory.a_vut_mps2[:-1] == expected).all()


def test_one_number_more_is_whether_to_merge_and_is_held_as_the_acceleration(tmp_path):
    for name, answer, wish, a_mps2 in (
        ("two", [0.5, 0.51], MERGE, 0.5),
        ("stays", [0.5, 0.5], STAY, 0.5),
        ("eight", [0, 0, 0, 0, 0, 3, 1, 9], MERGE, 1.0),
    ):
        path = network(tmp_path / f"{name}.onnx", answer=answer)
        vut = in_process(f"onnx:{path}?decision_period_s=0.5").open(1)
        begin(vut)
        for step in (5, 6):
            assert vut.act(on_lane([-51.0])._replace(step=np.array([step]))).tolist() == [a_mps2]
            assert vut.wishes().tolist() == [wish]
    wrong = in_process(f"onnx:{network(tmp_path / 'nan.onnx', answer=[0.5, np.inf])}").open(1)
    begin(wrong)
    assert np.isnan(wrong.act(on_lane([-51.0])))[0]
    assert wrong.reason(0) == "WrongAnswerError: wishes inf instead of a number, to merge or not"


@pytest.mark.parametrize("shape", [[], [1], ["batch", 1]])
@pytest.mark.parametrize("kind", ["INT64", "DOUBLE"])
def test_a_network_with_an_input_seed_is_told_that_of_each_case(tmp_path, kind, shape):
    seed = getattr(onnx.TensorProto, kind), shape
    path = network(tmp_path / "seeded.onnx", answer=[0.0], seed=seed)
    cases = cases_of(4)
    found = run_cases(in_process(f"onnx:{path}"), cases, corridors=2)
    for case, trajectory in zip(cases, found, strict=True):
        expected = case.told_seed % 1000 / 1000.0
        assert trajectory.a_vut_mps2[:-1] == pytest.approx(expected, abs=1e-12)
    assert len({case.told_seed for case in cases}) == 4


def test_what_is_no_such_network_is_refused_in_a_sentence(tmp_path):
    (tmp_path / "text.onnx").write_text("no network")
    network(tmp_path / "wide.onnx", answer=[0.0], width=5)
    network(tmp_path / "three.onnx", answer=[0.0, 1.0, 0.0])
    network(tmp_path / "word.onnx", answer=[0.0], seed=(onnx.TensorProto.INT32, [1]))
    network(tmp_path / "pair.onnx", answer=[0.0], seed=(onnx.TensorProto.INT64, [2]))
    network(tmp_path / "flat.onnx", answer=[0.0], shape=[4])
    network(tmp_path / "index.onnx", answer=[0, 0, 3, 0, 1], last="ArgMax")
    network(tmp_path / "truth.onnx", answer=[0.0], last="IsNaN")
    good = network(tmp_path / "good.onnx", answer=[0.0])
    for spec, said in {
        tmp_path / "nothing.onnx": "there is no such file",
        tmp_path / "text.onnx": "is not a usable ONNX network",
        tmp_path / "wide.onnx": "a VUT has one of floats",
        tmp_path / "three.onnx": "gives 3 numbers",
        tmp_path / "word.onnx": "has the input seed tensor(int32) [1]: it must be one number",
        tmp_path / "pair.onnx": "has the input seed tensor(int64) [2]: it must be one number",
        tmp_path / "flat.onnx": "does not run with an input (1, 4)",
        tmp_path / "index.onnx": "gives int64, and a VUT gives floats: the index of",
        tmp_path / "truth.onnx": "gives bool, and a VUT gives floats",
        f"{good}?decision_period_s=0": "decision_period_s is '0'",
        f"{good}?decision_period_s=often": "decision_period_s is 'often'",
        f"{good}?period=1": "it has no parameter 'period': choose from decision_period_s",
    }.items():
        with pytest.raises(UserError, match=r"onnx|ONNX") as refused:
            in_process(f"onnx:{spec}")
        assert said in str(refused.value)
