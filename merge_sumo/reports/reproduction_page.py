"""The page and the figures of a reproduction of the paper, from what the study left in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from merge_sumo.reports import figures
from merge_sumo.reports.pages import page
from merge_sumo.studies.reproduction import (
    SAMPLERS,
    ColumnResult,
    Reproduction,
    read_reproduction,
    table_rows,
)
from merge_sumo.system.folders import write_new

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE: Final = "index.html"


def write_reproduction_page(folder: Path) -> Path:
    """Draw the figures and the page of a reproduction into its folder; return the page's path.

    Raises `UserError` where it holds no reproduction, or figures already, or without matplotlib.
    """
    result, captions = read_reproduction(folder), {}
    for name, figure, caption in _figures(result):
        figures.save(figure, folder / f"{name}.png")
        captions[f"{name}.png"] = caption
    index = folder / PAGE
    write_new(index, _page(result, captions).encode())
    return index


def _figures(result: Reproduction) -> Iterator[tuple[str, Figure, str]]:
    """Yield name, figure and caption of every picture."""
    for column in result.columns.values():
        yield from _column_figures(column)
    scale = result.scale
    yield (
        "allocation",
        figures.allocation(
            f"design2 against all levels, {scale.batches} batches of {2 * scale.batch}",
            result.levels,
        ),
        "How the samplers share each batch out over the POV levels, and the mean score at "
        "each level: median over the seeds, band from the first to the third quartile.",
    )


def _column_figures(result: ColumnResult) -> Iterator[tuple[str, Figure, str]]:
    vut, level = result.column.vut, result.column.level
    yield (
        f"curves-level{level}",
        figures.coverage_curves(
            f"Coverage of {vut} against a level-{level} POV",
            *(result.compared, result.truth_fmc, result.oracle, result.limit_fmc),
        ),
        "FMC against cases: median over the seeds, band from the first to the third quartile. "
        "The oracle knows the failures of the truth and takes the most useful one each time. "
        "The limit is the coverage of all that is known to fail.",
    )
    yield (
        f"cases-level{level}",
        figures.maps(f"Where {vut} fails against a level-{level} POV", result.panels, level),
        "Cases that fail, in colour, and cases that do not, in grey: the truth, and each "
        "sampler with the seed whose coverage is its median.",
    )
    if result.predicted:
        truth = result.panels["truth"]
        yield (
            f"gpr-surface-level{level}",
            figures.predicted_scores(
                f"The surrogate of gpr on {vut} against a level-{level} POV",
                *(result.predicted, level, truth.points[truth.failed]),
            ),
            "The score that the surrogate predicts, with the cases that it has learned from "
            "(white) and the failures of the truth (orange). Inside the white line it predicts a "
            "failure.",
        )


def _page(result: Reproduction, captions: dict[str, str]) -> str:
    return page(
        "reproduce.html.jinja",
        results=list(result.columns.values()),
        rows=dict(table_rows(result.columns)),
        samplers=SAMPLERS,
        scale=result.scale,
        pictures=captions,
        versions=result.versions,
    )
