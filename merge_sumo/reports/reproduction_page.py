"""The page and the figures of a reproduction of the paper."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from merge_sumo.reports import figures
from merge_sumo.reports.pages import page
from merge_sumo.studies.reproduction import ColumnResult, Reproduction
from merge_sumo.system.folders import write_new
from merge_sumo.system.records import to_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAGE: Final = "index.html"
TABLE_JSON: Final = "table2.json"
TABLE_MARKDOWN: Final = "table2.md"


def write_reproduction(result: Reproduction, folder: Path) -> Path:
    """Write the table, the figures and the page of a reproduction; return the page's path.

    Raises `UserError` where a file is there already, or without matplotlib.
    """
    write_new(folder / TABLE_JSON, to_json(result.to_record()))
    write_new(folder / TABLE_MARKDOWN, ("\n".join(result.lines()) + "\n").encode())
    captions = {}
    for name, figure, caption in _figures(result):
        figures.save(figure, folder / f"{name}.png")
        captions[f"{name}.png"] = caption
    text = page("reproduce.html.jinja", result=result, pictures=captions)
    write_new(folder / PAGE, text.encode())
    return folder / PAGE


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
        "How the samplers share each batch out over the POV levels, and the mean margin at "
        "each level: median over the seeds, band from the first to the third quartile.",
    )


def _column_figures(result: ColumnResult) -> Iterator[tuple[str, Figure, str]]:
    vut, level = result.column.vut, result.column.level
    yield (
        f"curves-level{level}",
        figures.coverage_curves(f"Coverage of {vut} against a level-{level} POV", result.study),
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
    if level == 1:
        truth = result.panels["truth"]
        yield (
            f"gpr-surface-level{level}",
            figures.predicted_margins(
                f"The surrogate of gpr on {vut} against a level-{level} POV",
                *(result.predicted(), level, truth.points[truth.failed]),
            ),
            "The margin that the surrogate predicts, with the cases that it has learned from "
            "(white) and the failures of the truth (orange). Inside the white line it predicts a "
            "failure.",
        )
