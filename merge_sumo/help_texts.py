"""Help texts with the names of registries in them."""

from __future__ import annotations

from typing import Final

from merge_sumo.system.spawning import named
from merge_sumo.system.suggestions import either

REGISTRIES: Final = {
    "{samplers}": "merge_sumo.samplers.registry:SAMPLERS",
    "{criteria}": "merge_sumo.verdict.criteria:CRITERIA",
    "{formats}": "merge_sumo.reports.formats:FORMATS",
}
"""Registries whose names stand in help texts: they are imported where a text is shown."""


def with_names(help: str) -> str:
    """Return a help text with the names of registries in the place of "{samplers}" and the like."""
    for placeholder, registry in REGISTRIES.items():
        if placeholder in help:
            help = help.replace(placeholder, either(named(registry)))
    return help
