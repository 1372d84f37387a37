"""What a user's VUT does wrong, of all kinds: it is its own case's outcome."""

# mypy: no-strict-optional

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from support.misbehaviours import CATALOGUE, DEADLINE_S, GUILTY_MPS
from support.processes import none_left
from support.vut_contract import cases_of, factory, run_cases

from merge_sumo.errors import UserError
from merge_sumo.scenario.trajectory import Trajectory

CASES = [case for k, case in enumerate(cases_of(6)) if k != 4]
GUILTY = [case.v_pov0_mps > GUILTY_MPS for case in CASES]


@pytest.fixture(scope="module")
def without() -> list[Trajectory]:
    """Return the cases without misbehaviour; one of them is guilty."""
    assert sum(GUILTY) == 1
    return run_cases(factory("level0"), CASES, corridors=4)


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
        ran = run_cases(factory(f"{file}:Vut", **options), CASES, corridors=4)
    for is_guilty, one, other in zip(GUILTY, ran, without, strict=True):
        if is_guilty and how.reason is not None:
            assert how.reason in one.error
            assert one.error.isprintable()
            assert len(one.error) < 1000
        else:
            assert one.error is None
            assert np.array_equal(one.motion, other.motion)
    assert Path.cwd() == here
    assert list(scratch.iterdir()) == []
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import time; time.sleep(600)", r"loading the VUT .* took longer than 1 s"),
        ("import os; os._exit(0)", "its process ended with exit code 0"),
    ],
)
def test_a_module_that_does_not_load_is_refused_in_a_bounded_time(tmp_path, source, reason):
    (tmp_path / "my_vut.py").write_text(source)
    with none_left(), pytest.raises(UserError, match=reason):
        factory(f"{tmp_path / 'my_vut.py'}:Vut", connect_s=1.0)
