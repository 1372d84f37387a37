"""Pictures of experiments, drawn by matplotlib (the extra `plot`), and the page of a reproduction.

One colour per sampler in all pictures, and one per level of the POV; all of them are told apart
with any kind of colour vision (Okabe and Ito, 2008).
"""

from __future__ import annotations

import importlib
import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from merge_sumo.analysis.reproduction import LevelBatches, Panel, PredictedMargins, Reproduction
from merge_sumo.analysis.sampler_study import SamplerStudy
from merge_sumo.errors import UserError
from merge_sumo.files import check_new, write_new
from merge_sumo.metrics.fmc import RADIUS
from merge_sumo.records import to_json
from merge_sumo.reports.pages import page
from merge_sumo.reports.text import table_ii
from merge_sumo.samplers.registry import SAMPLERS
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import OWN, US23, level_name

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TRUTH = "truth"
LEVEL_LOOKS = {
    0: ("#000000", "o"),
    1: ("#CC79A7", "s"),
    2: ("#56B4E9", "^"),
    OWN: ("#009E73", "D"),
}
"""Colour and marker of each level."""
KINDS = (".png", ".svg")
STYLE: Any = {
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.titleweight": "bold",
    "legend.frameon": False,
    "svg.hashsalt": "merge-sumo",
    "svg.fonttype": "path",
    "mathtext.default": "regular",
}


def check_figure(path: Path) -> None:
    """Raise `UserError` where a figure cannot be drawn to `path`, before anything is run for it."""
    check_new(path, "`figure`", KINDS)
    require_matplotlib()


def require_matplotlib() -> None:
    """Raise `UserError` where matplotlib is not installed."""
    try:
        importlib.import_module("matplotlib")
    except ImportError as error:
        raise UserError("figures need matplotlib: pip install 'merge-sumo[plot]'") from error


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG or SVG; `UserError` when the file exists or cannot be written."""
    import matplotlib

    # No date: the same numbers give the same file.
    kind = path.suffix[1:]
    metadata = {"Date": None} if kind == "svg" else {"Software": None}
    with io.BytesIO() as picture, matplotlib.rc_context(STYLE):
        figure.savefig(picture, format=kind, dpi=150, metadata=metadata)
        write_new(path, picture.getvalue(), "`figure`")


@contextmanager
def _drawing(title: str, width: float, height: float) -> Iterator[Figure]:
    """Give a figure of a size in inches with a title alone, and our style while it is drawn."""
    require_matplotlib()
    import matplotlib
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
        figure.suptitle(title, x=0.01, ha="left")
        yield figure


def colour(name: str) -> str:
    """Return the colour of a sampler, or of the truth."""
    return "#000000" if name == TRUTH else SAMPLERS[name].colour


def coverage_curves(title: str, study: SamplerStudy) -> Figure:
    """Draw FMC against cases: a median with its quartile band per sampler, truth, limit."""
    with _drawing(title, 7.5, 4.6) as figure:
        axes = figure.subplots()
        for name, result in study.samplers.items():
            cases = [0, *result.cases_by_batch]
            low, median, high = ([0.0, *band] for band in result.fmc_by_batch)
            axes.fill_between(cases, low, high, color=colour(name), alpha=0.18, linewidth=0)
            axes.plot(cases, median, color=colour(name), lw=2, label=name)
            axes.set_xlim(0, cases[-1])
        axes.axhline(study.truth_fmc, color="black", lw=1.2, label=TRUTH)
        axes.axhline(study.limit_fmc, color="black", lw=1.2, ls=":", label="limit")
        axes.set_ylim(0.0)
        axes.set_xlabel("cases")
        axes.set_ylabel("failure mode coverage (FMC)")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def maps(title: str, panels: Mapping[str, Panel], level: int) -> Figure:
    """Draw where cases were run and where they failed, a panel per sampler, in the pool's units.

    The pale discs around failures are what FMC counts; of three coordinates the first two are
    drawn, without discs.

    Args:
        title: title of the figure.
        panels: what each panel shows, by its title.
        level: level of the POV.
    """
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    with _drawing(title, 3.6 * columns, 3.1 * rows + 0.4) as figure:
        for place, (name, panel) in enumerate(panels.items(), start=1):
            axes = figure.add_subplot(rows, columns, place)
            _map(axes, panel, level, colour(name))
            axes.label_outer()
            failures, cases = int(np.sum(panel.failed)), len(panel.points)
            axes.set_title(name, color=colour(name), fontweight="bold")
            axes.set_title(
                f"{failures} of {cases} fail, FMC {panel.fmc:.4f}", loc="right", fontsize=8.5
            )
    return figure


def _physical(points: FloatArray, level: int) -> FloatArray:
    """Return points of the unit cube, (n, d), in the pool's units."""
    low, high = np.array([(d.low, d.high) for d in US23.dimensions(level)]).T
    return np.asarray(low + points * (high - low), dtype=np.float64)


def _map(axes: Axes, panel: Panel, level: int, ink: str) -> None:
    from matplotlib.collections import EllipseCollection
    from matplotlib.colors import to_rgb

    x, v, *more = US23.dimensions(level)
    failing = _physical(panel.points[panel.failed], level)
    safe = _physical(panel.points[~panel.failed], level)
    size = 3.0 if len(panel.points) > 2000 else 8.0
    dots: Any = {"linewidths": 0, "rasterized": True}
    axes.scatter(safe[:, 0], safe[:, 1], s=size / 2, color="#c4c9cf", **dots)
    if not more:
        balls = EllipseCollection(
            [2 * RADIUS * (x.high - x.low)],
            [2 * RADIUS * (v.high - v.low)],
            [0.0],
            units="xy",
            offsets=failing[:, :2],
            offset_transform=axes.transData,
            # Mixed with white, so that discs on discs stay one colour.
            facecolor=tuple(0.22 * part + 0.78 for part in to_rgb(ink)),
            linewidths=0,
        )
        axes.add_collection(balls)
    axes.scatter(failing[:, 0], failing[:, 1], s=size, color=ink, **dots)
    _pool_axes(axes, level)


def _pool_axes(axes: Axes, level: int) -> None:
    x, y, *_ = US23.dimensions(level)
    axes.set_xlim(x.low, x.high)
    axes.set_ylim(y.low, y.high)
    axes.set_xlabel(US23.notation[x.field].symbol)
    axes.set_ylabel(US23.notation[y.field].symbol)
    axes.locator_params(axis="x", nbins=5)


def predicted_margins(
    title: str, by_batch: Mapping[int, PredictedMargins], level: int, truth: FloatArray
) -> Figure:
    """Draw the surrogate's margin after some batches, with the failures of the truth, (m, 2).

    Args:
        title: title of the figure.
        by_batch: predicted margins by the title of a panel.
        level: level of the POV.
        truth: failing cases of the truth, (m, 2).
    """
    x, v = US23.dimensions(level)
    steps = np.linspace(-1.0, 1.0, 21)
    failures = _physical(truth, level)
    rows, columns = -(-len(by_batch) // 2), min(len(by_batch), 2)
    with _drawing(title, 8.6, 6.6) as figure:
        shown = []
        for place, (batch, predicted) in enumerate(by_batch.items(), start=1):
            axes = figure.add_subplot(rows, columns, place)
            shown.append(axes)
            n = len(predicted.margin)
            across, up = np.linspace(x.low, x.high, n), np.linspace(v.low, v.high, n)
            filled = axes.contourf(
                across, up, np.minimum(predicted.margin, 1.0), steps, cmap="cividis", extend="min"
            )
            if predicted.margin.min() < 0.0 < predicted.margin.max():
                axes.contour(across, up, predicted.margin, [0.0], colors="white", linewidths=1.6)
            axes.scatter(
                failures[:, 0], failures[:, 1], s=2, color="#D55E00", linewidths=0, alpha=0.5
            )
            run = _physical(predicted.learned.points, level)
            axes.scatter(
                run[:, 0], run[:, 1], s=9, color="white", edgecolors="black", linewidths=0.5
            )
            axes.set_title(f"after batch {batch}: {len(run)} cases")
            _pool_axes(axes, level)
            axes.label_outer()
        bar = figure.colorbar(filled, ax=shown, shrink=0.85, ticks=steps[::5])
        bar.set_label("predicted margin (white line: 0, below which a case fails)")
    return figure


def allocation(title: str, by_sampler: Mapping[str, LevelBatches]) -> Figure:
    """Draw cases per level and mean margin per level over the batches: median and quartile band."""
    with _drawing(title, 4.6 * len(by_sampler), 6.4) as figure:
        grid = figure.subplots(2, len(by_sampler), sharex=True, sharey="row", squeeze=False)
        for (above, below), (name, levels) in zip(grid.T, by_sampler.items(), strict=True):
            for level in levels.cases:
                _band(above, levels.cases[level], level)
                _band(below, levels.margin[level], level)
            above.set_title(name, color=colour(name))
            below.set_xlabel("batch")
            below.locator_params(axis="x", integer=True)
        grid[0, 0].set_ylim(0)
        grid[0, 0].set_ylabel("cases of the batch")
        grid[1, 0].set_ylabel("mean margin of the batch")
        grid[0, 0].legend(loc="upper left", title="POV level", ncols=3)
    return figure


def _band(axes: Axes, values: FloatArray, level: int) -> None:
    """Draw median and quartiles of values, (seeds, batches); a batch without any is a gap."""
    batches = np.arange(1, values.shape[1] + 1)
    some = ~np.isnan(values).all(axis=0)
    parts = np.full((3, len(batches)), np.nan)
    parts[:, some] = np.nanquantile(values[:, some], [0.25, 0.5, 0.75], axis=0)
    ink, marker = LEVEL_LOOKS[level]
    axes.fill_between(batches, parts[0], parts[2], color=ink, alpha=0.18, linewidth=0)
    axes.plot(batches, parts[1], color=ink, marker=marker, ms=4, label=level_name(level))


def write_reproduction(result: Reproduction, folder: Path) -> Path:
    """Write the table, the figures and the page of a reproduction; return the path of the page.

    Raises `UserError` where a file is there already, or without matplotlib.
    """
    write_new(folder / "table2.json", to_json(result.to_record()))
    write_new(folder / "table2.md", ("\n".join(result.lines()) + "\n").encode())
    pictures = []
    for name, figure in _figures(result):
        save(figure, folder / f"{name}.png")
        pictures.append(f"{name}.png")
    text = page("reproduce.html.jinja", result=result, table=table_ii(result), pictures=pictures)
    page_file = folder / "index.html"
    write_new(page_file, text.encode())
    return page_file


def _figures(result: Reproduction) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of every picture; the template captions each by its name."""
    for one in result.columns.values():
        vut, level = one.column.vut, one.column.level
        against = f"{vut} against a level-{level} POV"
        curves = coverage_curves(f"Coverage of {against}", one.study)
        yield f"curves-level{level}", curves
        yield f"cases-level{level}", maps(f"Failures of {against}", one.panels, level)
        if level == 1:
            truth = one.panels["truth"]
            yield (
                f"gpr-surface-level{level}",
                predicted_margins(
                    f"The surrogate of gpr on {against}",
                    *(one.predicted(), level, truth.points[truth.failed]),
                ),
            )
    scale = result.scale
    title = f"design2 against all levels, {scale.batches} batches of {2 * scale.batch}"
    yield "allocation", allocation(title, result.levels)
