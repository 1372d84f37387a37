"""The sections of the report: each is a template over the model of a campaign."""

from __future__ import annotations

from typing import Any, Final

from markupsafe import Markup

from merge_sumo.drivers.reference import REFERENCES
from merge_sumo.metrics.cause import BRAKED_MPS
from merge_sumo.metrics.fmc import radius_for
from merge_sumo.metrics.merge import meanings
from merge_sumo.reports.facts import STARTS_THAT_FAIL, by_level, headline
from merge_sumo.reports.pages import fragment, source_of
from merge_sumo.reports.report_data import pairs_of
from merge_sumo.reports.report_model import ReportModel
from merge_sumo.reports.text import comparison_headline, robustness
from merge_sumo.scenario.scenario import MergeScenario, lane_of


def shared(model: ReportModel) -> dict[str, Any]:
    """Return the values that every template of the report has."""
    scenario = model.run.scenario
    return {
        "model": model,
        "run": model.run,
        "vut": model.run.vut,
        "scenario": scenario,
        "is_merge": isinstance(scenario, MergeScenario),
        "lane_m": lane_of(scenario),
        "traffic": scenario.vehicles > 2,
        "meanings": meanings,
        "by_level": by_level,
        "headline": headline(model.run, model.facts),
        "comparison_headline": comparison_headline,
        "robustness": robustness,
        "starts_that_fail": STARTS_THAT_FAIL,
        "pairs_of": pairs_of,
        "radius_for": radius_for,
        "references": list(REFERENCES),
        "braked_mps": BRAKED_MPS,
    }


SECTIONS: Final = (
    "untested",
    "headline",
    "facts",
    "where",
    "against",
    "words",
    "stress",
    "cases",
    "all",
    "about",
)
"""The templates in `templates/sections/`, in their order on the page."""


def sections_of(model: ReportModel) -> list[Markup]:
    """Return the sections of a campaign as HTML; a section that does not apply is empty."""
    values = shared(model)
    return [fragment(source_of(f"sections/{name}.html.jinja"), values) for name in SECTIONS]
