"""What a user's VUT does wrong, of all kinds: it is its own case's outcome."""

# mypy: no-strict-optional

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from support.misbehaviours import CATALOGUE, DEADLINE_S, GUILTY_MPS, Misbehaviour
from support.processes import none_left
from support.vut_contract import cases_of, factory, run_cases

from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.trajectory import Trajectory

CASES = [case for k, case in enumerate(cases_of(6)) if k != 4]


@pytest.fixture(scope="module")
def without() -> list[Trajectory]:
    """Return what becomes of the cases without misbehaviour; one of them is guilty."""
    assert sum(map(guilty, CASES)) == 1
    return run_cases(factory("level0"), CASES, corridors=4)


def guilty(case: Case) -> bool:
    return case.v_pov0_mps > GUILTY_MPS


@pytest.mark.slow
@pytest.mark.parametrize("name", CATALOGUE)
def test_only_the_guilty_case_has_an_error_and_nothing_is_left(
    name, without, tmp_path, monkeypatch, capfd
):
    scratch, here = tmp_path / "scratch", Path.cwd()
    scratch.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    file, how = tmp_path / "my_vut.py", CATALOGUE[name]
    file.write_text(how.source, encoding="utf-8")
    options = {"deadline_s": DEADLINE_S, "memory_gib": 1.0, "log": tmp_path / "controller.log"}
    with none_left():
        if how.refused:
            with pytest.raises(UserError) as refused:
                run_cases(factory(f"{file}:Vut", **options), CASES, corridors=4)
            assert how.reason in str(refused.value)
        else:
            ran = run_cases(factory(f"{file}:Vut", **options), CASES, corridors=4)
            check(how, ran, without)
    assert Path.cwd() == here
    assert list(scratch.iterdir()) == []
    assert capfd.readouterr().out == ""


def check(how: Misbehaviour, ran: list[Trajectory], without: list[Trajectory]) -> None:
    for case, one, other in zip(CASES, ran, without, strict=True):
        if guilty(case) and how.reason is not None:
            assert one.error is not None
            assert how.reason in one.error
            assert one.error.isprintable()
            assert len(one.error) < 1000
        else:
            assert one.error is None
            assert np.array_equal(one.motion, other.motion)


def test_an_import_that_hangs_is_refused_in_a_bounded_time(tmp_path):
    (tmp_path / "my_vut.py").write_text("import time; time.sleep(600)")
    with none_left(), pytest.raises(UserError, match=r"opening the VUT .* took longer than 1 s"):
        factory(f"{tmp_path / 'my_vut.py'}:Vut", connect_s=1.0)
