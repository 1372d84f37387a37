"""The sections of the report: each is a template, and a function from a run to its words.

The head of the page and several sections share words: those of `shared_words`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

from markupsafe import Markup

from merge_sumo.analysis.diagnosis import BRAKED_MPS, MEANING
from merge_sumo.analysis.merging import REAR_HEADWAY_S, SITES, SOURCE
from merge_sumo.analysis.plausibility import doubts
from merge_sumo.analysis.summary import LevelSummary
from merge_sumo.analysis.surface import FEWEST_FAILURES, PLAUSIBLE
from merge_sumo.analysis.verdict import in_words
from merge_sumo.campaigns import repeats
from merge_sumo.campaigns.run import SETTINGS, TRAJECTORIES, Run
from merge_sumo.campaigns.settings import named_again
from merge_sumo.drivers.reference import REFERENCES
from merge_sumo.errors import UserError
from merge_sumo.reports.comparison_page import AGAINST_PAGE
from merge_sumo.reports.facts import by_level
from merge_sumo.reports.pages import fragment, source_of
from merge_sumo.reports.report_maps import pairs_of
from merge_sumo.reports.report_model import ERROR_CHARACTERS, LISTED, ReportModel
from merge_sumo.studies.comparison import compare_against
from merge_sumo.studies.stress import NOTHING
from merge_sumo.system.printable import counted, printable, quoted
from merge_sumo.system.registry import Registry
from merge_sumo.values.case import to_unit
from merge_sumo.values.fmc import covered, fmc, radius_for
from merge_sumo.values.scenario import OWN, MergeScenario, lane_of, level_name
from merge_sumo.values.severity import meanings
from merge_sumo.vuts.output import LOG, end_of


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportSection:
    """A section of the report.

    Attributes:
        template: source of a Jinja template, with values escaped: a whole `<section>`. Scripts and
            styles of its own do not run: the policy of the page names those of the page alone.
        words: returns what the template needs beside `shared_words`; None leaves the section out.
    """

    template: str
    words: Callable[[ReportModel], Mapping[str, Any] | None] = lambda _: {}

    def html(self, model: ReportModel, shared: Mapping[str, Any]) -> Markup | None:
        """Return the section of a run; None where it is left out."""
        words = self.words(model)
        if words is None:
            return None
        return fragment(self.template, {**shared, **words})


def shared_words(model: ReportModel) -> dict[str, Any]:
    """Return what the head of the page and several sections need."""
    run, summary = model.run, model.summary
    levels = [_level(model, level, found) for level, found in summary.levels.items()]
    return {
        "vut": run.vut,
        "troubles": model.troubles(),
        "summary": summary,
        "scenario": run.scenario,
        "is_merge": isinstance(run.scenario, MergeScenario),
        "lane_m": lane_of(run.scenario),
        "traffic": run.scenario.vehicles > 2,
        "coordinates": model.coordinates,
        "levels": levels,
        "any_truth": any(level["truth"] is not None for level in levels),
        "counted": summary.cases - len(model.shown),
        "predicted": any(outcome.prediction for outcome in run.outcomes),
        "avoidance": list(REFERENCES) if model.avoidance else [],
        "varied": any(one.varies for one in model.repeated.values()),
        "repeated": model.repeated,
    }


def _level(model: ReportModel, level: int, found: LevelSummary) -> dict[str, Any]:
    """Return what the page says of a level beside its facts.

    `plausible` is the coverage if all places failed that the surrogate does not exclude; `near`
    are the failures of the truth within the radius of the FMC of a failure that was found.
    """
    surface, truth = model.surfaces[level], model.truths[level]
    axes = model.coordinates_of(level)
    failing = () if truth is None else truth.failures
    failed = (o.case for o in model.cases if o.failed and o.case.level == level)
    return {
        "level": level,
        "found": found,
        "caption": f"own: {model.run.pov}" if level == OWN else str(level),
        "about": model.run.scenario.level_about.get(level, ""),
        "axes": axes,
        "plausible": None if surface is None else surface.plausible_fmc(),
        "truth": None if truth is None else fmc(truth.failures),
        "failing": len(failing),
        "near": int(covered(failing, to_unit(failed, level)).sum()) if len(failing) else 0,
        "radius": radius_for(len(axes)),
        "remarks": [] if truth is None else truth.remarks(),
        "pairs": [
            " × ".join(axes[axis].name for axis in pair.axes)
            + ("" if pair.share is None else f": {pair.share:.0%}")
            for pair in pairs_of(len(axes), surface)
        ],
    }


def head_words(model: ReportModel) -> dict[str, Any]:
    """Return what a reader is to know of the page as a whole."""
    run = model.run
    lost = [str(o.index) for o in model.shown if o.index not in model.motion]
    if len(lost) > LISTED:
        lost = [*lost[:LISTED], counted(len(lost) - LISTED, "other")]
    return {
        "unrepeatable": repeats.unrepeatable(model.repeats),
        "lost": in_words(lost) if lost else "",
        "notes": [*doubts(model.cases, run.criterion), *filter(None, [run.ran_again_in_words])],
        "interruption": run.interruption,
        "resume": f"merge-sumo campaign --resume {quoted(run.folder)}"
        f"{named_again(run.settings, goes_on=True)}",
        "wanted": run.settings.get("cases"),
    }


def _untested(model: ReportModel) -> dict[str, Any] | None:
    return {"more_troubles": model.verdict.troubles[LISTED:]} if model.troubles() else None


def _facts(model: ReportModel) -> dict[str, Any]:
    columns, rows = by_level(model.facts)
    names = {column.name for column in columns}
    overall = [fact for fact in model.facts if fact.level is None]
    dims = {len(model.run.scenario.dimensions(level)) for level in model.levels}
    return {
        "columns": columns,
        "rows": rows,
        "totals": {fact.name: fact for fact in overall if fact.name in names},
        "facts": [fact for fact in overall if fact.name not in names],
        "people": (SOURCE, SITES, REAR_HEADWAY_S),
        "radii": [(dim, radius_for(dim)) for dim in sorted(dims) if dim > 3],
    }


def _maps(model: ReportModel) -> dict[str, Any]:
    scenario = model.run.scenario
    return {
        "severities": meanings(scenario),
        "plausible_chance": f"{max(PLAUSIBLE, model.run.tolerated):.0%}",
        "fewest_failures": FEWEST_FAILURES,
        "learns": model.learns,
        "covered": any(len(scenario.dimensions(level)) <= 3 for level in model.levels),
    }


def _in_words(model: ReportModel) -> dict[str, Any] | None:
    kinds = Counter(model.kinds.values()).most_common()
    if not model.boxes and not kinds:
        return None
    described = Counter(box.level for box in model.boxes for _ in range(box.failures))
    left = {n: model.summary.levels[n].failures - described[n] for n in model.levels}
    return {
        "sentences": [box.sentence for box in model.boxes],
        "scattered": ", ".join(
            f"{counted(count, 'failure')} at level {level_name(level)}"
            for level, count in left.items()
            if count > 0
        ),
        "kinds": kinds,
        "meaning": MEANING,
        "braked": f"{BRAKED_MPS:g}",
    }


def _stress(model: ReportModel) -> dict[str, Any] | None:
    found = model.stress
    if found is None:
        return None
    unchanged = sum(rung.flips for rung in found.rungs if rung.name == NOTHING.name)
    repeats = (
        f"{counted(unchanged, 'verdict')} flipped where nothing was changed: a result depends on "
        "more than its case, and the other rows have that in them."
    )
    text = found.sentence
    return {
        "stress": found,
        "sentence": text[:1].upper() + text[1:],
        "repeats": repeats if unchanged else "",
        "is_older": found.cases != sum(outcome.is_tested for outcome in model.run.cases),
    }


def _cases(model: ReportModel) -> dict[str, Any]:
    tables = [
        (f"{trouble.count} {trouble.end}: {trouble.message}", model.examples_of(trouble))
        for trouble in model.troubles()
    ]
    first = "one of each region first"
    if model.stress is not None:
        first = "robust ones first, of these one of each region"
    tables += [
        (f"Ten worst failures, {first}", model.spread),
        ("Ten cases nearest to a failure", model.near[:LISTED]),
    ]
    other_net = model.run.settings.get("net_sha256") != model.road.sha256
    return {"tables": tables, "other_net": other_net}


def _about(model: ReportModel) -> dict[str, Any]:
    """Return what the search knows of itself, and what it ran with."""
    return {
        "surprises": model.surprises,
        "printed": end_of(model.run.folder / LOG),
        "recorded": _recorded(model.run),
        "flat_settings": list(_flat(model.run.settings)),
    }


def _recorded(run: Run) -> str | None:
    """Return when a run was recorded and how long it took, by the times of its files."""
    files = [run.folder / SETTINGS, *(run.folder / TRAJECTORIES).glob("*.npz")]
    times = [file.stat().st_mtime for file in files if file.is_file()]
    if len(times) < 2:
        return None
    began, took_s = datetime.fromtimestamp(min(times), UTC), max(times) - min(times)
    return f"{began:%Y-%m-%d %H:%M} UTC, in {took_s:.0f} s (by the times of its files)"


def _against(model: ReportModel) -> dict[str, Any] | None:
    """Return what changed from the version that a campaign is against; None where it is none."""
    compared = compare_against(model.run)
    if compared is None:
        return None
    return {
        "earlier": _shown(model.run.settings["against"]),
        "page": AGAINST_PAGE,
        "headline": compared.headline,
        "transitions": compared.steps[0].transitions,
    }


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Any:
    """Yield (name, value) of settings, nested ones with their path."""
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name} ")
        else:
            yield _shown(f"{prefix}{name}"), _shown(value)


def _shown(value: object) -> str:
    """Return a setting as a text that is fit to be shown; it may be a stranger's."""
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return printable(text[:ERROR_CHARACTERS])


def _own(name: str) -> str:
    """Return the source of a template of this package."""
    return source_of(f"sections/{name}.html.jinja")


SECTIONS: Final[Registry[ReportSection]] = Registry(
    "merge_sumo.report_sections",
    "report section",
    {
        "untested": ReportSection(template=_own("untested"), words=_untested),
        "facts": ReportSection(template=_own("facts"), words=_facts),
        "where": ReportSection(template=_own("where"), words=_maps),
        "against": ReportSection(template=_own("against"), words=_against),
        "words": ReportSection(template=_own("words"), words=_in_words),
        "stress": ReportSection(template=_own("stress"), words=_stress),
        "cases": ReportSection(template=_own("cases"), words=_cases),
        "all": ReportSection(template=_own("all")),
        "about": ReportSection(template=_own("about"), words=_about),
    },
    accepts=lambda item: isinstance(item, ReportSection),
    contract="a merge_sumo.reports.report_sections.ReportSection",
)
"""The sections of the page, in their order; those of installed packages come last."""


def sections_of(model: ReportModel, shared: Mapping[str, Any]) -> list[Markup]:
    """Return the sections of a run as HTML; `UserError` where one of another package fails."""
    sections = []
    for name, section in SECTIONS.items():
        try:
            html = section.html(model, shared)
        except Exception as error:
            if name in SECTIONS.ours:
                raise
            raise UserError(
                f"the report section {name!r} failed: {type(error).__name__}: {error}"
            ) from error
        if html is not None:
            sections.append(html)
    return sections
