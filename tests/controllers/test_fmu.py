"""A VUT as an FMU of FMI 2.0 and 3.0, compiled here from C."""

# mypy: no-strict-optional

from __future__ import annotations

import tempfile
from pathlib import Path

import pytest
from build_fmu import NAMES, build_fmu, compiler
from conftest import require, some
from support.vut_contract import (
    LEVEL0_CLASS,
    begin,
    cases_of,
    in_process,
    on_lane,
    run_cases,
    same,
)

from merge_sumo.drivers.base import MERGE, STAY
from merge_sumo.errors import UserError
from merge_sumo.scenario.trajectory import End

pytest.importorskip("fmpy")


@pytest.fixture(scope="module")
def unit(tmp_path_factory):
    """Return a function that builds an FMU: its version, names, and what it does wrong."""
    require(compiler() is not None, "gcc is not on the PATH")
    folder = tmp_path_factory.mktemp("fmu")

    def build(version="2.0", names=NAMES, fault="", **more) -> Path:
        path = folder / f"{len(list(folder.iterdir()))}.fmu"
        return build_fmu(path, version, names, fault, **more)

    return build


@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_an_fmu_drives_like_the_same_law_in_python_and_leaves_nothing(
    unit, tmp_path, monkeypatch, version
):
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    (tmp_path / "law.py").write_text(LEVEL0_CLASS)
    cases = cases_of(30)
    by_fmu = run_cases(in_process(f"fmu:{unit(version)}"), cases)
    assert same(by_fmu, run_cases(in_process(f"{tmp_path / 'law.py'}:Level0"), cases))
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize(
    ("fault", "reason"),
    [("return 3;", "failed with status 3"), ("u->v[4] = NAN; return 0;", "nan")],
)
@pytest.mark.parametrize("version", some(["2.0", "3.0"], "2.0"))
def test_what_an_fmu_does_wrong_is_the_outcome_of_its_own_case(unit, version, fault, reason):
    cases = cases_of(12)
    trajectories = run_cases(in_process(f"fmu:{unit(version, fault=fault)}"), cases)
    for case, trajectory in zip(cases, trajectories, strict=True):
        if case.v_pov0_mps > 30.0:
            assert trajectory.end is End.VUT_ERROR
            assert reason in trajectory.error
        else:
            assert trajectory.end is End.MERGED


def test_another_unit_is_refused_in_a_sentence(unit, tmp_path):
    (tmp_path / "text.fmu").write_text("no unit")
    good, other = unit(), unit(names=("a", "b", "c", "d", "e"))
    for spec, said in {
        tmp_path / "nothing.fmu": "the file does not exist",
        tmp_path / "text.fmu": "is not a readable FMU",
        other: "has none of the inputs",
        f"{other}?v_vut_mps=d": "has no variable 'acceleration_mps2'; it has a, b, c, d, e",
        f"{good}?v_vut_mps=wrong": "has no variable 'wrong'",
        f"{good}?speed=v": "it has no parameter 'speed': choose from acceleration_mps2",
        f"{good}?merge=nothing": "has no variable 'nothing'",
    }.items():
        with pytest.raises(UserError, match=r"fmu|FMU") as refused:
            in_process(f"fmu:{spec}")
        assert said in str(refused.value)


@pytest.mark.parametrize("wish", some(["number", "boolean"], "boolean"))
@pytest.mark.parametrize("version", ["2.0", "3.0"])
def test_an_output_merge_is_whether_to_merge(unit, version, wish):
    vut = in_process(f"fmu:{unit(version, merge=wish)}").open(2)
    begin(vut)
    assert vut.act(on_lane([-51.0, -50.0])).tolist() == [1.0, 1.0]
    assert vut.merge_requests().tolist() == [STAY, MERGE]
    vut.close()


def test_an_output_v_mps_is_the_speed_reached_unless_the_acceleration_alone_is_named(unit):
    fast = [case for case in cases_of(3) if case.v_pov0_mps > 30.0]
    # Its output acceleration_mps2 says something else in the fourth step.
    path = unit(fault="u->v[4] = -1.0; u->v[6] = u->v[3] - 0.3; return 0;", v_mps="number")
    for options, a_mps2 in (
        ("", -3.0),
        ("?acceleration_mps2=acceleration_mps2", -1.0),
        ("?acceleration_mps2=v_vut_mps&v_mps=v_mps", -3.0),
    ):
        for trajectory in run_cases(in_process(f"fmu:{path}{options}"), fast):
            assert trajectory.a_vut_mps2[:5] == pytest.approx([1.0, 1.0, 1.0, a_mps2, 1.0])


@pytest.mark.parametrize(("version", "kind"), [("2.0", "integer"), ("3.0", "number")])
def test_a_unit_gets_the_seed_of_each_case(unit, version, kind):
    fast = [case for case in cases_of(12) if case.v_pov0_mps > 30.0]
    path = unit(version, fault="u->v[4] = fmod(u->v[7], 1000.0) / 1000.0; return 0;", seed=kind)
    ran = run_cases(in_process(f"fmu:{path}"), fast, corridors=2)
    for case, trajectory in zip(fast, ran, strict=True):
        seed = case.controller_seed % 2**31 if kind == "integer" else case.controller_seed
        assert trajectory.a_vut_mps2[3] == seed % 1000 / 1000.0
    assert max(case.controller_seed for case in fast) > 2**31
