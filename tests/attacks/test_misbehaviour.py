"""What a user's VUT does wrong, of a catalogue of all kinds: it is its own case's outcome."""

# mypy: no-strict-optional

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from misbehaviours import CATALOGUE, DEADLINE_S, GUILTY_MPS, Misbehaviour
from processes import none_left
from vut_contract import cases_of, factory, run_cases

from merge_sumo.errors import UserError
from merge_sumo.values.case import Case
from merge_sumo.values.trajectory import Trajectory

CASES = [case for k, case in enumerate(cases_of(6)) if k != 4]
"""One of them is guilty."""
SOME = (
    "os._exit 0",
    "loops",
    "a list that grows",
    "forks and comes back twice",
    "a BaseException",
    "answers type('Odd', (), {'__repr__': lambda s: 1 / 0})()",
    "closes all descriptors",
    "batched: dies",
    "loading: dies",
)
"""One of each kind: ends, hangs, takes all, leaves something behind, raises, talks, spoils."""


@pytest.fixture(scope="module")
def without() -> list[Trajectory]:
    """Return what becomes of the cases without misbehaviour."""
    return run_cases(factory("level0"), CASES, corridors=4)


def guilty(case: Case) -> bool:
    return case.v_pov0_mps > GUILTY_MPS


def test_one_case_is_guilty_and_the_catalogue_has_all_of_some():
    assert sum(map(guilty, CASES)) == 1
    assert set(SOME) <= set(CATALOGUE)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if n in SOME else pytest.mark.long) for n in CATALOGUE]
)
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
    if how.shared:
        return
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


def campaign(folder: Path, file: Path, workers: int) -> tuple[subprocess.CompletedProcess, bytes]:
    scratch = folder.with_name(f"scratch-{folder.name}")
    scratch.mkdir()
    command = [sys.executable, "-m", "merge_sumo.cli", "campaign", "--vut", f"{file}:Vut"]
    command += ["--level", "0", "--cases", "12", "--sampler", "uniform", "--quiet"]
    command += ["--deadline", str(DEADLINE_S), "--vut-memory", "1", "--out", str(folder)]
    ended = subprocess.run(
        [*command, "--workers", str(workers)],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        env={**os.environ, "TMPDIR": str(scratch)},
    )
    assert "Traceback" not in ended.stderr
    assert list(scratch.iterdir()) == []
    outcomes = folder / "outcomes.jsonl"
    return ended, outcomes.read_bytes() if outcomes.is_file() else b""
