"""A campaign in a notebook: the data frame, the axes, and HTML; and what happens without extras."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from matplotlib.figure import Figure
from support.handmade import write_run

import merge_sumo as ms
from merge_sumo.errors import UserError
from merge_sumo.reports.text import timelines


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> ms.CampaignRun:
    return ms.open_run(write_run(tmp_path_factory.mktemp("notebook") / "run", 20).folder)


def test_a_data_frame_has_each_case_at_its_index_and_a_map_its_start(run):
    frame = run.to_dataframe()
    assert frame["index"].tolist() == list(frame.index) == list(range(60))
    assert (frame.margin < 0.0).tolist() == [outcome.failed for outcome in run.outcomes]
    axes = Figure().subplots()
    assert run.plot_map(2, axes) is axes
    drawn = {marks.get_label(): np.asarray(marks.get_offsets()) for marks in axes.collections}
    for verdict, rows in frame[frame.level == 2].groupby("verdict"):
        starts = rows[["x_pov0_m", "v_pov0_mps"]].to_numpy()
        assert drawn[f"{len(rows)} {verdict}"].tolist() == starts.tolist()
    with pytest.raises(UserError, match=r"no level 3 in .*: choose from \[0, 1, 2\]"):
        run.plot_map(3)


def test_a_case_is_drawn_over_time_with_its_events(run):
    axes = run.plot_case(4, Figure().subplots())
    motion = run.trajectory(4).whole
    for line, x_m in zip(axes.lines, motion[:, :, 0].T, strict=False):
        assert line.get_ydata().tolist() == x_m.tolist()
        assert line.get_xdata()[-1] == pytest.approx(0.1 * (len(x_m) - 1))
    events = timelines(run.recorded, [run.outcomes[4]])[4].events
    assert [line.get_xdata()[0] for line in axes.lines[2:]] == [one.time_s for one in events]
    assert axes.get_xlabel().endswith(f"{events[-1].time_s:.1f} s  {events[-1].text}")


def test_html_has_maps_or_says_what_is_missing(run, monkeypatch):
    assert "</pre><img alt=" in run._repr_html_()

    for name in ("matplotlib", "pandas"):
        monkeypatch.setitem(sys.modules, name, None)
    assert "<p>this needs matplotlib: pip install 'merge-sumo[plot]'</p>" in run._repr_html_()
    with pytest.raises(UserError, match=r"needs pandas: pip install 'merge-sumo\[notebook\]'"):
        run.to_dataframe()
