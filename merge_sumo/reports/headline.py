"""The result of a campaign in a few sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

from merge_sumo.analysis.diagnosis import MEANING, Kind
from merge_sumo.analysis.summary import Summary
from merge_sumo.analysis.verdict import Verdict, in_words
from merge_sumo.system.printable import counted
from merge_sumo.values.criterion import Criterion
from merge_sumo.values.merge import HARSH_MPS2
from merge_sumo.values.scenario import Scenario, level_name
from merge_sumo.values.score import Outcome
from merge_sumo.values.severity import Severity


def rule_in_words(criterion: Criterion, scenario: Scenario) -> str:
    """Return when a case of a scenario fails, in a clause."""
    if criterion.is_papers:
        return f"front bumpers within {scenario.dx_crash_m:g} m at {scenario.place}"
    return criterion.in_short


def headline(
    verdict: Verdict,
    summary: Summary,
    worst: Sequence[Outcome],
    kinds: Mapping[int, Kind],
    criterion: Criterion,
    scenario: Scenario,
) -> str:
    """Return the result of a campaign in a few sentences: what was not tested comes first."""
    if not verdict.cases:
        return "No case has run."
    said = verdict.sentences
    if verdict.tested:
        for level, found in summary.levels.items():
            if found.cases and not found.tested:
                said.append(f"At POV level {level_name(level)} nothing was tested.")
        said.append(_failures(verdict, summary, worst, kinds, criterion, scenario))
    return " ".join(said)


def _failures(
    verdict: Verdict,
    summary: Summary,
    worst: Sequence[Outcome],
    kinds: Mapping[int, Kind],
    criterion: Criterion,
    scenario: Scenario,
) -> str:
    rule, crash_m = rule_in_words(criterion, scenario), scenario.dx_crash_m
    if not summary.failures:
        others = "the other " if verdict.tested < verdict.cases else ""
        return (
            f"No failure ({rule}) in {others}{counted(verdict.tested, 'case')}. That is "
            "no proof: the search saw these cases and no others."
        )
    failing = {level: found for level, found in summary.levels.items() if found.failures}
    tested = {level: found for level, found in summary.levels.items() if found.tested}
    never = [level_name(level) for level, found in tested.items() if not found.failures]
    parts = [
        f"{found.failures} of {found.cases} cases at POV level {level_name(level)} "
        f"({counted(found.regions, 'region')})"
        for level, found in failing.items()
    ]
    text = f"{failures_in_words(worst, rule)}: {in_words(parts)}"
    text += f", never at level {in_words(never)}." if never else "."
    common = Counter(kinds[o.index] for o in worst if o.index in kinds).most_common(1)
    if common:
        (kind, count), of_a_kind = common[0], sum(o.index in kinds for o in worst)
        near = "" if of_a_kind == summary.failures else f" with front bumpers within {crash_m:g} m"
        share = "All are" if count == summary.failures else f"{count} of {of_a_kind}{near} are"
        text += f" {share} of the kind “{kind}”: {MEANING[kind]}."
    return text


def failures_in_words(failures: Sequence[Outcome], rule: str) -> str:
    """Return how many failures there are, what fails, and how severe they are, in a clause."""
    found = Counter(outcome.measures.severity for outcome in failures)
    severe = [
        f"{number} {word}" if word in (Severity.HARSH, Severity.SAFE) else counted(number, word)
        for word in Severity
        if (number := found[word])
    ]
    told = "; ".join(filter(None, (rule, ", ".join(severe))))
    return f"{counted(len(failures), 'failure')} ({told})"


def avoidable_text(failures: Sequence[Outcome], scenario: Scenario) -> str | None:
    """Return the number of avoidable failures in words; None if it is unknown for all."""
    told = [o.measures.avoidable for o in failures if o.measures.avoidable is not None]
    if not told:
        return None
    crash_m, place = scenario.dx_crash_m, scenario.place
    near = f" with front bumpers within {crash_m:g} m at {place}"
    of = "" if len(told) == len(failures) else near
    return (
        f"In {sum(told)} of {counted(len(told), 'failure')}{of}, full braking or full acceleration "
        f"of the VUT would have kept {crash_m:g} m at {place}."
    )


def harmful_merges_text(outcomes: Iterable[Outcome], scenario: Scenario) -> str | None:
    """Return the number of cases that are not failures and not harmless either, in words."""
    found = Counter(o.measures.severity for o in outcomes if not o.failed)
    said = {
        Severity.CONTACT: "bodies touch",
        Severity.CONFLICT: f"the front bumpers are within {scenario.dx_crash_m:g} m at M",
        Severity.HARSH: f"the car behind has to brake harder than {HARSH_MPS2:g} m/s² after M",
    }
    parts = [
        f"in {counted(found[key], 'case')} {scenario.said(what)}"
        for key, what in said.items()
        if found[key]
    ]
    if not parts:
        return None
    return f"No failures, but no harmless merges: {in_words(parts)} (--fail-when unsafe)."


def overlaps_before_m_text(outcomes: Iterable[Outcome], scenario: Scenario) -> str | None:
    """Return the number of cases in which bodies overlap before M alone, in words."""
    before = sum(
        (o.measures.before_clearance_m or 0.0) < 0.0 and o.measures.severity != Severity.CONTACT
        for o in outcomes
    )
    if not before:
        return None
    return scenario.said(
        f"In {counted(before, 'case')} bodies overlap before M, where the lanes run together, "
        "and not from M on: that is no contact (measure before_clearance_m)."
    )
