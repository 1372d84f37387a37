"""The formats of `merge-sumo export` by name; here, where their names cost no import."""

from __future__ import annotations

from typing import Final

from merge_sumo.reports.export_format import ExportFormat
from merge_sumo.system.registry import Registry

FORMATS: Final[Registry[ExportFormat]] = Registry(
    "merge_sumo.exports",
    "format",
    {
        "sumo": "merge_sumo.reports.exports:SUMO",
        "openscenario": "merge_sumo.reports.exports:OPENSCENARIO",
        "csv": "merge_sumo.reports.exports:CSV",
        "cases": "merge_sumo.reports.exports:CASES",
    },
    accepts=lambda item: (
        isinstance(item, ExportFormat) and (item.write_case is None) != (item.write_table is None)
    ),
    contract="a merge_sumo.reports.export_format.ExportFormat with one function that writes",
)
