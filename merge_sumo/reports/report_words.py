"""What the report says: the text and the tables of the page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from merge_sumo.analysis.diagnosis import (
    BRAKED_MPS,
    MEANING,
)
from merge_sumo.analysis.plausibility import notes_on
from merge_sumo.analysis.predictions import prediction_in_words
from merge_sumo.analysis.surface import FEWEST_FAILURES, PLAUSIBLE
from merge_sumo.analysis.verdict import counted, in_words
from merge_sumo.campaigns import repeats
from merge_sumo.campaigns.store import SETTINGS, TRAJECTORIES, Run
from merge_sumo.drivers.reference import REFERENCES
from merge_sumo.reports.headline import Rule, after_words, avoidable_words, before_words, headline
from merge_sumo.reports.report_levels import Level, levels_of
from merge_sumo.reports.report_model import ERROR_CHARACTERS, LISTED, ReportModel
from merge_sumo.studies.avoidance import in_a_sentence
from merge_sumo.studies.truth import TRUTH_CASES
from merge_sumo.system.printable import printable
from merge_sumo.values.fmc import radius_for
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import Outcome
from merge_sumo.values.severity import meanings
from merge_sumo.vuts.output import LOG, end_of


def page_words(facts: ReportModel) -> dict[str, Any]:
    """Return what the template needs for text and tables."""
    settings, summary = facts.run.settings, facts.summary
    criterion = facts.run.criterion
    rule = Rule(criterion, facts.run.scenario.dx_crash_m)
    wanted = settings.get("cases")
    described = Counter(box.level for box in facts.boxes for _ in range(box.failures))
    lost = [str(o.index) for o in facts.shown if o.index not in facts.motion]
    if len(lost) > LISTED:
        lost = [*lost[:LISTED], counted(len(lost) - LISTED, "other")]
    left = {n: summary.levels[n].failures - described[n] for n in facts.levels}
    levels, fmc_axis = levels_of(facts)
    tables = [
        (f"{trouble.count} {trouble.end}: {trouble.message}", facts.examples_of(trouble))
        for trouble in facts.troubles()
    ]
    tables += [
        ("Ten worst failures, one of each region first", facts.spread),
        ("Ten cases nearest to a failure", facts.near[:LISTED]),
    ]
    if facts.surprises:
        tables.append(("Ten largest errors of the twin's predictions", facts.surprises))
    found = headline(facts.verdict, summary, facts.worst, facts.kinds, rule)
    return {
        "vut": facts.run.vut,
        "headline": " ".join(filter(None, (found, facts.run.ran_again_in_words))),
        "unrepeatable": repeats.unrepeatable(facts.repeats),
        "careful": in_a_sentence(facts.avoidance.values()),
        "avoidance": _avoidance(facts),
        "predicted": prediction_in_words(facts.run.outcomes),
        "counts": facts.verdict.counts,
        "found": facts.verdict,
        "troubles": facts.troubles(),
        "more_troubles": facts.verdict.troubles[LISTED:],
        "lost": in_words(lost) if lost else "",
        "notes": notes_on(facts.run.outcomes, facts.run.criterion),
        "torn": facts.run.torn or (isinstance(wanted, int) and summary.cases < wanted),
        "counted": summary.cases - len(facts.shown),
        "summary": summary,
        "levels": levels,
        "fmc_axis": fmc_axis,
        "any_truth": any(level.truth is not None for level in levels),
        "truth_cases": " or ".join(
            f"{count:,}" for count in sorted({TRUTH_CASES[level] for level in facts.levels})
        ),
        "plausible_chance": f"{PLAUSIBLE:.0%}",
        "fewest_failures": FEWEST_FAILURES,
        "avoidable": avoidable_words(facts.worst, rule.crash_m),
        "after": after_words(facts.run.outcomes, rule.crash_m),
        "before": before_words(facts.run.outcomes),
        "batches": len({o.batch for o in facts.run.outcomes}),
        "recorded": _recorded(facts.run),
        "driven": _duration(sum(o.measures.t_end_s for o in facts.run.outcomes)),
        "sentences": [box.sentence for box in facts.boxes],
        "scattered": ", ".join(
            f"{counted(count, 'failure')} at level {level_name(level)}"
            for level, count in left.items()
            if count > 0
        ),
        "kinds": _kinds(facts),
        "braked": f"{BRAKED_MPS:g}",
        "severities": meanings(rule.crash_m),
        "scenario": facts.run.scenario,
        "criterion": None if criterion.is_papers else criterion.words,
        "traffic": facts.run.scenario.vehicles > 2,
        "coordinates": facts.coordinates,
        "covered": any(level.dims <= 3 for level in levels),
        "radii": _radii(levels),
        "printed": end_of(facts.run.folder / LOG),
        "tables": tables,
        "settings": {name: _shown(value) for name, value in settings.items() if value},
        "flat_settings": list(_flat(settings)),
        "other_net": settings.get("net_sha256") != facts.road.sha256,
    }


def _radii(levels: Sequence[Level]) -> str:
    """Return what to know of the radius where there are more than three coordinates."""
    more = sorted({level.dims for level in levels if level.dims > 3})
    if not more:
        return ""
    parts = [f"{radius_for(dims):.2f} for {dims} coordinates" for dims in more]
    return (
        f"It is {in_words(parts)}: there a ball is as large as in three. Then the volume is "
        "integrated by quasi-Monte Carlo, to within some tenths of a percent."
    )


def _kinds(facts: ReportModel) -> list[dict[str, Any]]:
    found = Counter(facts.kinds.values())
    avoidable = Counter(facts.kinds[o.index] for o in facts.worst if _avoidable_kind(facts, o))
    return [
        {
            "name": kind.value,
            "meaning": MEANING[kind],
            "count": count,
            "avoidable": avoidable[kind],
        }
        for kind, count in found.most_common()
    ]


def _avoidance(facts: ReportModel) -> list[tuple[str, str]]:
    """Return by driver how many failures it avoids; nothing where that is not known."""
    known = list(facts.avoidance.values())
    if not known:
        return []
    counts = {name: sum(name in one.avoided_by for one in known) for name in REFERENCES}
    counts["careful, in the POV's place"] = sum(one.pov_careful for one in known)
    return [(name, f"{count} of {len(known)}") for name, count in counts.items()]


def _avoidable_kind(facts: ReportModel, outcome: Outcome) -> bool:
    return outcome.index in facts.kinds and bool(outcome.measures.avoidable)


def _recorded(run: Run) -> str | None:
    """Return when a run was recorded and how long it took, by the times of its files."""
    files = [run.folder / SETTINGS, *(run.folder / TRAJECTORIES).glob("*.npz")]
    times = [file.stat().st_mtime for file in files if file.is_file()]
    if len(times) < 2:
        return None
    began, took_s = datetime.fromtimestamp(min(times), UTC), max(times) - min(times)
    took = f"{took_s:.0f} s" if took_s < 100.0 else _duration(took_s)
    return f"{began:%Y-%m-%d %H:%M} UTC, in {took} (by the times of its files)"


def _duration(seconds: float) -> str:
    minutes = round(seconds / 60.0)
    return f"{minutes // 60} h {minutes % 60} min" if minutes >= 60 else f"{seconds / 60.0:.1f} min"


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
