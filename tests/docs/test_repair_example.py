"""The example of a repair says "confirmed" only where it can know."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
from conftest import require

FILE = Path(__file__).resolve().parents[2] / "examples" / "repair.py"


@pytest.fixture
def example() -> ModuleType:
    """Return the example with a small budget."""
    require(importlib.util.find_spec("optuna") is not None, "optuna is not installed")
    spec = importlib.util.spec_from_file_location("repair_example", FILE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.TRIALS = 6  # type: ignore[attr-defined]
    module.SETTINGS = {"level": 0, "cases": 60}  # type: ignore[attr-defined]
    return module


@pytest.mark.slow
def test_confirms_values_where_those_of_today_fail(example, tmp_path, capsys):
    example.main(tmp_path / "repaired")
    said = capsys.readouterr().out
    assert said.endswith("0 with the new values alone, 0 with both: confirmed\n")


@pytest.mark.slow
def test_confirms_nothing_where_those_of_today_pass(example, tmp_path, capsys):
    example.VUT, example.TODAY = "design2", {"gap_m": 20.0, "x2_m": 60.0}
    example.main(tmp_path / "repaired")
    said = capsys.readouterr().out
    assert " 0 fail with today's values alone" in said
    assert said.endswith("not confirmed, these values are no repair\n")
