"""Figures of experiments, drawn by matplotlib (the extra `plot`), and the page of a reproduction.

Each sampler and each POV level has one colour in all figures, from a palette for all kinds of
colour vision (Okabe and Ito, 2008).
"""

from __future__ import annotations

import base64
import importlib
import io
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from merge_sumo.analysis.cases_file import verdict_of
from merge_sumo.analysis.reproduction import (
    ColumnResult,
    LevelBatches,
    Panel,
    PredictedMargins,
    Reproduction,
)
from merge_sumo.analysis.sampler_study import SamplerStudy
from merge_sumo.errors import UserError
from merge_sumo.files import write_new
from merge_sumo.metrics.fmc import RADIUS
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.timeline import Timeline
from merge_sumo.records import to_json
from merge_sumo.reports.pages import X_AXIS, page
from merge_sumo.reports.text import table_ii
from merge_sumo.road.drawing import POINT_COLOUR
from merge_sumo.samplers.registry import SAMPLERS
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import (
    COLOURS,
    DT_S,
    NAMES,
    OWN,
    US23,
    VEHICLES,
    Coordinate,
    level_name,
)
from merge_sumo.scenario.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Dims = Sequence[Coordinate]

TRUTH = "truth"
LEVEL_LOOKS = {
    0: ("#000000", "o"),
    1: ("#CC79A7", "s"),
    2: ("#56B4E9", "^"),
    OWN: ("#009E73", "D"),
}
"""Colour and marker of each level."""
VERDICT_COLOURS = {
    "pass": "#5c6b78",
    "timeout": "#b00020",
    "error": "#b00020",
    "fail": POINT_COLOUR,
}
"""Colours of verdicts, as in the report; marks of the last ones lie on top."""
KINDS = (".png", ".svg")
"""Endings of figures."""
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


def require(library: str, extra: str = "plot") -> Any:
    """Import a library of an extra and return it.

    Args:
        library: name of the library or of its module.
        extra: the extra that installs it.

    Raises:
        UserError: it is not installed.
    """
    try:
        return importlib.import_module(library)
    except ImportError as error:
        raise UserError(f"this needs {library}: pip install 'merge-sumo[{extra}]'") from error


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG or SVG; the same numbers give the same file.

    Args:
        figure: the figure.
        path: new file, whose ending is the format.

    Raises:
        UserError: the file exists or cannot be written.

    Example:
        >>> save(coverage_curves("design2", study), Path("curves.svg"))
    """
    import matplotlib

    kind = path.suffix[1:]
    metadata = {"Date": None} if kind == "svg" else {"Software": None}
    with io.BytesIO() as picture, matplotlib.rc_context(STYLE):
        figure.savefig(picture, format=kind, dpi=150, metadata=metadata)
        write_new(path, picture.getvalue(), "`figure`")


@contextmanager
def _drawing(title: str, width: float, height: float) -> Iterator[Figure]:
    """Yield a figure of a size in inches with a title, in the style of the package."""
    matplotlib = require("matplotlib")
    from matplotlib.figure import Figure

    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
        figure.suptitle(title, x=0.01, ha="left")
        yield figure


def colour(name: str) -> str:
    """Return the colour of a sampler, or of the truth.

    Args:
        name: name of the sampler, or `TRUTH`.
    """
    return "#000000" if name == TRUTH else SAMPLERS[name].colour


def coverage_curves(title: str, study: SamplerStudy) -> Figure:
    """Draw FMC over cases: a median with its quartile band per sampler, truth, and limit.

    Args:
        title: title of the figure.
        study: the study of samplers.
    """
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
        axes.set_xlabel("number of cases")
        axes.set_ylabel("failure mode coverage (FMC)")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def maps(title: str, panels: Mapping[str, Panel], level: int) -> Figure:
    """Draw cases and failures in the units of the pool, a panel per sampler.

    With two coordinates, a panel has the discs that FMC counts. With three, it has the first two.

    Args:
        title: title of the figure.
        panels: cases of each panel, by its title.
        level: level of the POV.
    """
    columns = min(len(panels), 3)
    rows = -(-len(panels) // columns)
    with _drawing(title, 3.6 * columns, 3.1 * rows + 0.4) as figure:
        for place, (name, panel) in enumerate(panels.items(), start=1):
            axes = figure.add_subplot(rows, columns, place)
            ink, size = colour(name), 3.0 if len(panel.points) > 2000 else 8.0
            safe = _physical(panel.points[~panel.failed], level)
            failing = _physical(panel.points[panel.failed], level)
            dots: Any = {"linewidths": 0, "rasterized": True}
            axes.scatter(safe[:, 0], safe[:, 1], s=size / 2, color="#c4c9cf", **dots)
            if panel.points.shape[1] == 2:
                _balls(axes, failing, US23.dimensions(level), ink)
            axes.scatter(failing[:, 0], failing[:, 1], s=size, color=ink, **dots)
            _pool_axes(axes, US23.dimensions(level))
            axes.label_outer()
            found = f"{len(failing)} of {len(panel.points)} fail, FMC {panel.fmc:.4f}"
            axes.set_title(name, color=ink, fontweight="bold")
            axes.set_title(found, loc="right", fontsize=8.5)
    return figure


def _physical(points: FloatArray, level: int) -> FloatArray:
    """Return points of the unit cube, (n, d), in the pool's units."""
    low, high = np.array([(d.low, d.high) for d in US23.dimensions(level)]).T
    return np.asarray(low + points * (high - low), dtype=np.float64)


def _balls(axes: Axes, centres: FloatArray, dims: Dims, ink: str) -> None:
    from matplotlib.collections import EllipseCollection

    width, height = (2 * RADIUS * (d.high - d.low) for d in dims[:2])
    balls = EllipseCollection(
        [width],
        [height],
        [0.0],
        units="xy",
        offsets=centres,
        offset_transform=axes.transData,
        facecolor=ink,
        alpha=0.1,
        linewidths=0,
    )
    axes.add_collection(balls)


def _pool_axes(axes: Axes, dims: Dims) -> None:
    x, y, *_ = dims
    axes.set_xlim(x.low, x.high)
    axes.set_ylim(y.low, y.high)
    axes.set_xlabel(x.symbol)
    axes.set_ylabel(y.symbol)
    axes.locator_params(axis="x", nbins=5)


def predicted_margins(
    title: str, by_batch: Mapping[int, PredictedMargins], level: int, truth: FloatArray
) -> Figure:
    """Draw the surrogate's margin after some batches, with the failures of the truth, (m, 2).

    Args:
        title: title of the figure.
        by_batch: predicted margins by the number of batches.
        level: level of the POV.
        truth: failing cases of the truth in the unit square, (m, 2).
    """
    x, v = US23.dimensions(level)
    steps = np.linspace(-1.0, 1.0, 21)
    extent = (x.low, x.high, v.low, v.high)
    failing = _physical(truth, level)
    rows, columns = -(-len(by_batch) // 2), min(len(by_batch), 2)
    with _drawing(title, 8.6, 6.6) as figure:
        for place, (batch, predicted) in enumerate(by_batch.items(), start=1):
            axes = figure.add_subplot(rows, columns, place)
            margin = np.minimum(predicted.margin, 1.0)
            look: Any = {"extent": extent, "cmap": "cividis", "extend": "min"}
            filled = axes.contourf(margin, steps, **look)
            if margin.min() < 0.0 < margin.max():
                axes.contour(margin, [0.0], extent=extent, colors="white", linewidths=1.6)
            marks: Any = {"s": 2, "color": "#D55E00", "linewidths": 0, "alpha": 0.5}
            axes.scatter(*failing.T, **marks)
            learned = _physical(predicted.learned, level)
            marks = {"s": 9, "color": "white", "edgecolors": "black", "linewidths": 0.5}
            axes.scatter(*learned.T, **marks)
            axes.set_title(f"after batch {batch} ({len(learned)} cases)")
            _pool_axes(axes, US23.dimensions(level))
            axes.label_outer()
        bar = figure.colorbar(filled, ax=figure.axes, shrink=0.85, ticks=steps[::5])
        bar.set_label("predicted margin (below 0, the white line, a case fails)")
    return figure


def allocation(title: str, by_sampler: Mapping[str, LevelBatches]) -> Figure:
    """Draw cases and mean margin of each level over batches: median and quartile band.

    Args:
        title: title of the figure.
        by_sampler: cases and margins by level and batch, by sampler.
    """
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
        grid[0, 0].set_ylabel("number of cases in the batch")
        grid[1, 0].set_ylabel("mean margin in the batch")
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


# Campaigns in a notebook


def _axes(axes: Axes | None) -> Axes:
    """Return the given axes, or the axes of a new figure that a notebook shows."""
    if axes is None:
        _, axes = require("matplotlib.pyplot").subplots(figsize=(8, 5), layout="constrained")
    return axes


def draw_map(cases: Sequence[Outcome], dims: Dims, axes: Axes | None = None) -> Axes:
    """Draw the cases of a POV level in the first two coordinates, in the report's colours.

    Args:
        cases: outcomes of the cases.
        dims: coordinates of the level.
        axes: axes to draw into; None for a new figure.

    Returns:
        The axes.
    """
    axes = _axes(axes)
    for verdict, ink in VERDICT_COLOURS.items():
        judged = [one.case for one in cases if verdict_of(one) == verdict]
        if judged:
            places = np.array([[d.of(case) for d in dims[:2]] for case in judged])
            x, y = places.T
            axes.scatter(x, y, s=12, color=ink, label=f"{len(judged)} {verdict}")
            if verdict == "fail" and len(dims) <= 3:
                _balls(axes, places, dims, ink)
    _pool_axes(axes, dims)
    axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.15), ncols=4)
    return axes


def maps_picture(draw: Callable[[int, Axes], Axes], levels: Sequence[int]) -> str:
    """Return maps side by side as an element of HTML.

    Args:
        draw: draws the map of a level into axes.
        levels: POV levels.

    Raises:
        UserError: matplotlib is not installed.
    """
    with _drawing("", 4.2 * len(levels), 3.8) as figure, io.BytesIO() as picture:
        for place, level in enumerate(levels, start=1):
            draw(level, figure.add_subplot(1, len(levels), place))
        figure.savefig(picture, format="png")
        data = base64.b64encode(picture.getvalue()).decode()
    return f'<img alt="A map of the cases of each POV level" src="data:image/png;base64,{data}">'


def draw_case(trajectory: Trajectory, told: Timeline, axes: Axes | None = None) -> Axes:
    """Draw the positions of all cars over time, with the events of the case.

    Args:
        trajectory: the motion.
        told: the timeline of the case.
        axes: axes to draw into; None for a new figure.

    Returns:
        The axes.
    """
    axes = _axes(axes)
    for name, x_m in zip(VEHICLES, trajectory.whole[:, :, 0].T, strict=False):
        times_s = DT_S * np.arange(len(x_m))
        axes.plot(times_s, x_m, color=COLOURS[name], label=NAMES[name])
    below = ["time, s"]
    for event in told.events:
        below.append(f"{event.time_s:.1f} s  {event.text}")
        axes.axvline(event.time_s, color="gray", ls=":")
    axes.set_xlabel("\n".join(below), loc="left", fontsize="small")
    axes.set(ylabel=X_AXIS, title=told.result)
    axes.legend()
    return axes


# Reproductions


def write_reproduction(result: Reproduction, folder: Path) -> Path:
    """Write the table, the figures and the page of a reproduction.

    Args:
        result: the reproduction.
        folder: folder for the files.

    Returns:
        The path of the page.

    Raises:
        UserError: a file exists already, or matplotlib is not installed.
    """
    write_new(folder / "table2.json", to_json(result.to_record()))
    write_new(folder / "table2.md", ("\n".join(result.lines()) + "\n").encode())
    pictures = []
    for name, figure in _figures(result):
        save(figure, folder / f"{name}.png")
        pictures.append(f"{name}.png")
    text = page("reproduce.html.jinja", result=result, table=table_ii(result), pictures=pictures)
    index = folder / "index.html"
    write_new(index, text.encode())
    return index


def _figures(result: Reproduction) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of every picture; the name selects its caption in the template."""
    for one in result.columns.values():
        yield from figures_of(one)
    scale = result.scale
    title = f"design2 against all levels, {scale.batches} batches of {2 * scale.batch}"
    yield "allocation", allocation(title, result.levels)


def figures_of(one: ColumnResult) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of every picture of a column, its curves first.

    Args:
        one: the column with its results.
    """
    vut, level = one.column.vut, one.column.level
    against = f"{vut} against a level-{level} POV"
    yield f"curves-level{level}", coverage_curves(f"Coverage of {against}", one.study)
    yield f"cases-level{level}", maps(f"Failures of {against}", one.panels, level)
    if level == 1:
        truth = one.panels[TRUTH]
        failing, title = truth.points[truth.failed], f"The surrogate of gpr on {against}"
        surface = predicted_margins(title, one.predicted(), level, failing)
        yield f"gpr-surface-level{level}", surface
