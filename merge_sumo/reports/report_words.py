"""What the report says: the text and the tables of the page."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from merge_sumo.campaigns.avoidance import in_a_sentence
from merge_sumo.campaigns.run import SETTINGS, TRAJECTORIES, Run
from merge_sumo.campaigns.truth import TRUTH_CASES
from merge_sumo.drivers.reference import REFERENCES
from merge_sumo.drivers.vuts.output import LOG, end_of
from merge_sumo.reports.diagnosis import (
    CEDED_MPS,
    MEANING,
    Kind,
)
from merge_sumo.reports.foretelling import foretold_in_words
from merge_sumo.reports.report_facts import ERROR_CHARACTERS, LISTED, Facts
from merge_sumo.reports.report_levels import Level, levels_of
from merge_sumo.reports.summary import Summary
from merge_sumo.reports.surface import FEWEST_FAILURES, PLAUSIBLE
from merge_sumo.reports.verdict import Verdict, counted, in_words
from merge_sumo.system.printable import printable
from merge_sumo.values.criterion import COLLISION, Criterion
from merge_sumo.values.fmc import radius_for
from merge_sumo.values.merge import HARSH_MPS2, AfterMerge
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import Outcome


def page_words(facts: Facts) -> dict[str, Any]:
    """Return what the template needs for text and tables."""
    settings, summary = facts.run.settings, facts.summary
    criterion = facts.run.criterion
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
        ("Ten nearest misses", facts.near[:LISTED]),
    ]
    if facts.surprises:
        tables.append(("Ten largest errors of the twin's predictions", facts.surprises))
    return {
        "vut": facts.run.vut,
        "headline": headline(facts.verdict, summary, facts.worst, facts.kinds, criterion),
        "careful": in_a_sentence(facts.avoidance.values()),
        "avoidance": _avoidance(facts),
        "foretold": foretold_in_words(facts.run.outcomes),
        "counts": facts.verdict.counts,
        "found": facts.verdict,
        "troubles": facts.troubles(),
        "more_troubles": facts.verdict.troubles[LISTED:],
        "lost": in_words(lost) if lost else "",
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
        "avoidable": _avoidable(facts.worst),
        "after": after_words(facts.run.outcomes),
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
        "ceded": f"{CEDED_MPS:g}",
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


def _kinds(facts: Facts) -> list[dict[str, Any]]:
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


def _avoidance(facts: Facts) -> list[tuple[str, str]]:
    """Return by driver how many failures it avoids; nothing where that is not known."""
    known = list(facts.avoidance.values())
    if not known:
        return []
    counts = {name: sum(name in one.avoided_by for one in known) for name in REFERENCES}
    counts["careful, in the POV's place"] = sum(one.pov_careful for one in known)
    return [(name, f"{count} of {len(known)}") for name, count in counts.items()]


def _avoidable_kind(facts: Facts, outcome: Outcome) -> bool:
    return outcome.index in facts.kinds and bool(outcome.measures.avoidable)


def headline(
    verdict: Verdict,
    summary: Summary,
    worst: Sequence[Outcome],
    kinds: Mapping[int, Kind],
    criterion: Criterion = COLLISION,
) -> str:
    """Return the result of a campaign in a few sentences: what was not tested comes first."""
    if not verdict.cases:
        return "No case has run."
    said = verdict.sentences
    if verdict.tested:
        for level, found in summary.levels.items():
            if found.cases and not found.tested:
                said.append(f"At POV level {level_name(level)} nothing was tested.")
        said.append(_failures(verdict, summary, worst, kinds, criterion))
    return " ".join(said)


def _failures(
    verdict: Verdict,
    summary: Summary,
    worst: Sequence[Outcome],
    kinds: Mapping[int, Kind],
    criterion: Criterion,
) -> str:
    if not summary.failures:
        what = "collision" if criterion.is_papers else "failure"
        others = "the other " if verdict.tested < verdict.cases else ""
        when = "" if criterion.is_papers else f" ({criterion.in_short})"
        return (
            f"No {what}{when} in {others}{counted(verdict.tested, 'case')}. That is no proof: the "
            "search saw these cases and no others."
        )
    failing = {level: found for level, found in summary.levels.items() if found.failures}
    tested = {level: found for level, found in summary.levels.items() if found.tested}
    never = [level_name(level) for level, found in tested.items() if not found.failures]
    parts = [
        f"{found.failures} of {found.cases} cases at POV level {level_name(level)} "
        f"({counted(found.regions, 'region')})"
        for level, found in failing.items()
    ]
    verb = "Collides" if criterion.is_papers else f"Fails ({criterion.in_short})"
    text = f"{verb} in {in_words(parts)}"
    text += f", never at level {in_words(never)}." if never else "."
    common = Counter(kinds[o.index] for o in worst if o.index in kinds).most_common(1)
    if common:
        kind, count = common[0]
        share = "All are" if count == summary.failures else f"{count} of {summary.failures} are"
        text += f" {share} of the kind “{kind}”: {MEANING[kind]}."
    return text


def _avoidable(worst: Sequence[Outcome]) -> str | None:
    """Return how many collisions need not have been, among those that count as failures."""
    told = [o.measures.avoidable for o in worst if o.measures.avoidable is not None]
    return f"{sum(told)} of {len(told)} could have been avoided by the VUT." if told else None


def after_words(outcomes: Iterable[Outcome]) -> str | None:
    """Return how many cases without a failure ask too much of whoever is behind after the merge."""
    found = Counter(o.measures.after_merge for o in outcomes if not o.failed)
    forced, harsh = (
        counted(found[asked], "case") for asked in (AfterMerge.FORCED, AfterMerge.HARSH)
    )
    if not (found[AfterMerge.FORCED] or found[AfterMerge.HARSH]):
        return None
    return (
        f"No failure, but no harmless merge: in {harsh} whoever is behind at M has to brake "
        f"harder than {HARSH_MPS2:g} m/s², in {forced} harder than it can (--fail-when unsafe "
        "looks for these)."
    )


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
