"""The sections of the report: each is a template over the model of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

from markupsafe import Markup

from merge_sumo.coverage.fmc import radius_for
from merge_sumo.drivers.reference import REFERENCES
from merge_sumo.errors import UserError
from merge_sumo.reports.facts import STARTS_THAT_FAIL, by_level, headline
from merge_sumo.reports.pages import fragment, source_of
from merge_sumo.reports.report_data import pairs_of
from merge_sumo.reports.report_model import ReportModel
from merge_sumo.reports.text import comparison_headline, robustness
from merge_sumo.scenario.scenario import MergeScenario, lane_of
from merge_sumo.system.registry import Registry
from merge_sumo.verdict.diagnosis import BRAKED_MPS
from merge_sumo.verdict.severity import meanings


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportSection:
    """A section of the report.

    Attributes:
        template: source of a Jinja template, with values escaped: a whole `<section>`, or nothing
            where the section is left out. It has the `ReportModel` as `model`. Scripts and styles
            of its own do not run: the policy of the page names those of the page alone.
        words: returns what the template needs beside that; None leaves the section out.
    """

    template: str
    words: Callable[[ReportModel], Mapping[str, Any] | None] = lambda _: {}

    def html(self, model: ReportModel) -> Markup:
        """Return the section of a run; empty where it is left out."""
        words = self.words(model)
        return Markup() if words is None else fragment(self.template, {**shared(model), **words})


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


FIRST: Final = ["untested", "headline", "facts"]
OURS: Final = [*FIRST, "where", "against", "words", "stress", "cases", "all", "about"]
"""The templates in `templates/sections/`, in their order on the page."""

SECTIONS: Final[Registry[ReportSection]] = Registry(
    "merge_sumo.report_sections",
    "report section",
    {name: ReportSection(template=source_of(f"sections/{name}.html.jinja")) for name in OURS},
    accepts=lambda item: isinstance(item, ReportSection),
    contract="a merge_sumo.reports.report_sections.ReportSection",
)
"""The sections of the page; those of installed packages come last."""


def sections_of(model: ReportModel) -> list[Markup]:
    """Return the sections of a run as HTML; `UserError` where one of another package fails."""
    sections = []
    for name, section in SECTIONS.items():
        try:
            sections.append(section.html(model))
        except Exception as error:
            if name in SECTIONS.ours:
                raise
            raise UserError(
                f"the report section {name!r} failed: {type(error).__name__}: {error}"
            ) from error
    return sections
