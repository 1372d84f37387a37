"""Figures: what they draw, the files that they make, and what is refused before anything runs."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection

from merge_sumo.analysis.reproduction import Panel
from merge_sumo.errors import UserError
from merge_sumo.metrics.fmc import RADIUS
from merge_sumo.reports import figures


def curves():
    """Draw two samplers."""
    samplers = {
        name: SimpleNamespace(
            cases_by_batch=[20, 40],
            fmc_by_batch=[[0.0, end / 2.0], [end / 2.0, end], [end, 2.0 * end]],
        )
        for name, end in (("uniform", 0.01), ("gpr", 0.05))
    }
    study: Any = SimpleNamespace(samplers=samplers, truth_fmc=0.12, limit_fmc=0.15)
    return figures.coverage_curves("design1 v level 0", study)


def test_curves_show_each_sampler_and_the_truth():
    (axes,) = curves().axes
    lines = {line.get_label(): list(line.get_ydata()) for line in axes.lines}
    assert lines == {
        "uniform": [0.0, 0.005, 0.01],
        "gpr": [0.0, 0.025, 0.05],
        "truth": [0.12, 0.12],
        "limit": [0.15, 0.15],
    }
    assert {text.get_text() for text in axes.get_legend().texts} == lines.keys()
    assert len(axes.collections) == 2, "a band for each sampler"


def test_maps_show_cases_in_the_units_of_the_pool_and_the_balls_that_fmc_counts():
    one = Panel(np.array([[0.5, 0.5], [1.0, 0.0]]), np.array([True, False]))
    (axes,) = figures.maps("t", {"gpr": one}, 0).axes
    (balls,) = (c for c in axes.collections if isinstance(c, EllipseCollection))
    assert np.asarray(balls.get_offsets()).tolist() == [[-260.0, 30.0]]
    assert balls.get_widths() == pytest.approx([2 * RADIUS * 160.0])
    assert balls.get_heights() == pytest.approx([2 * RADIUS * 10.0])
    assert axes.get_xlim() == (-340.0, -180.0)
    assert "(m)" in axes.get_xlabel()
    assert "(m/s)" in axes.get_ylabel()
    assert axes.get_title("right") == "1 of 2 fail, FMC 0.0079"


@pytest.mark.parametrize("kind", [".png", ".svg"])
def test_a_file_is_the_same_for_the_same_numbers(tmp_path, kind):
    first, second = tmp_path / f"first{kind}", tmp_path / f"second{kind}"
    for path in (first, second):
        figures.save(curves(), path)
    assert first.read_bytes() == second.read_bytes()


def test_a_figure_without_matplotlib_is_refused_in_a_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(UserError, match=r"pip install 'merge-sumo\[plot\]'"):
        figures.require("matplotlib")
