"""The example of a repair says "confirmed" only where it can know."""

from __future__ import annotations

import importlib.util
import runpy

import pytest
from conftest import require
from docs_pages import ROOT


@pytest.mark.slow
@pytest.mark.parametrize(
    ("vut", "today", "printed"),
    [
        ("design1", {"gap_m": 13.7, "x2_m": 30.8}, "new values only, 0 with both: confirmed"),
        ("design2", {"gap_m": 20.0, "x2_m": 60.0}, "not confirmed, these values are not a repair"),
    ],
)
def test_confirms_values_only_where_those_of_today_fail(vut, today, printed, tmp_path, capsys):
    require(importlib.util.find_spec("optuna") is not None, "optuna is not installed")
    repair = runpy.run_path(str(ROOT / "examples" / "repair.py"))["main"]
    settings = {"VUT": vut, "CURRENT": today, "TRIALS": 6, "SETTINGS": {"level": 0, "cases": 60}}
    repair.__globals__.update(settings)
    repair(tmp_path / "repaired")
    assert capsys.readouterr().out.endswith(f"{printed}\n")
