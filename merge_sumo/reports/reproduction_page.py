"""The page and the figures of a reproduction of the paper."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from merge_sumo.analysis.reproduction import Reproduction
from merge_sumo.files import write_new
from merge_sumo.records import to_json
from merge_sumo.reports import figures
from merge_sumo.reports.pages import page
from merge_sumo.reports.text import table_ii

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
    pictures = []
    for name, figure in _figures(result):
        figures.save(figure, folder / f"{name}.png")
        pictures.append(f"{name}.png")
    text = page("reproduce.html.jinja", result=result, table=table_ii(result), pictures=pictures)
    write_new(folder / PAGE, text.encode())
    return folder / PAGE


def _figures(result: Reproduction) -> Iterator[tuple[str, Figure]]:
    """Yield name and figure of every picture; the template captions each by its name."""
    for one in result.columns.values():
        vut, level = one.column.vut, one.column.level
        against = f"{vut} against a level-{level} POV"
        curves = figures.coverage_curves(f"Coverage of {against}", one.study)
        yield f"curves-level{level}", curves
        yield f"cases-level{level}", figures.maps(f"Failures of {against}", one.panels, level)
        if level == 1:
            truth = one.panels["truth"]
            yield (
                f"gpr-surface-level{level}",
                figures.predicted_margins(
                    f"The surrogate of gpr on {against}",
                    *(one.predicted(), level, truth.points[truth.failed]),
                ),
            )
    scale = result.scale
    title = f"design2 against all levels, {scale.batches} batches of {2 * scale.batch}"
    yield "allocation", figures.allocation(title, result.levels)
