"""The facts of a campaign, each with its unit and with the file and key that it comes from.

Report, terminal, JSON and JUnit take their numbers from this list.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from merge_sumo.analysis.counterfactuals import AVOIDANCE
from merge_sumo.analysis.probability import PROBABILITY
from merge_sumo.analysis.share import SHARES
from merge_sumo.analysis.stress import STRESS
from merge_sumo.campaigns.recorded import (
    OUTCOMES,
    SETTINGS,
    RecordedCampaign,
    failures,
)
from merge_sumo.drivers.reference_drivers import REFERENCE_DRIVERS
from merge_sumo.metrics.fmc import radius_for
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import LevelSummary, Summary, by_case
from merge_sumo.printable import printable
from merge_sumo.reports.text import timelines

PERCENT = "%"

# Names of facts that the terminal and the templates look up.
VUT = "VUT"
RULE = "failure criterion"
CASES = "cases"
AT_MOST = "maximum number of cases; the search converged earlier"
ERRORS = "errors"
TIMEOUTS = "timeouts"
FAILURES = "failures"
UNDECIDED = "undecided"
CONTACT = "cases with contact that are not failures"
STARTS_THAT_FAIL = "starts that fail"
DRIVEN = "failures that ran again with reference drivers"
AVOIDED = "failures that driver {} avoids"
AVOIDED_BY_POV = "failures that a careful POV avoids"
PROBABILITY_TO_FAIL = "probability that a case fails"
WORST = "worst case"
KIND = "kind of the worst case"


@dataclass(frozen=True, slots=True)
class Fact:
    """A fact of a campaign.

    Attributes:
        name: name of the quantity.
        value: number in `unit`, or a text.
        key: key in the file, or a condition on the lines that are counted.
        unit: unit of a number; empty for counts, for texts and for FMC.
        file: source file in the run folder.
        level: POV level; None for the whole campaign.

    Example:
        >>> Fact("simulated time", 2.5, "t_end_s", "h").shown
        '2.5 h'
    """

    name: str
    value: float | str
    key: str
    unit: str = ""
    file: str = OUTCOMES
    level: int | None = None

    @property
    def shown(self) -> str:
        """The value as text, with its unit."""
        if isinstance(self.value, str):
            text = printable(self.value)
        elif isinstance(self.value, int):
            text = f"{self.value:,}"
        elif self.unit:
            text = f"{self.value:.3g}"
        else:
            text = f"{self.value:.4f}"
        return f"{text} {self.unit}".strip()


Facts = Iterator[Fact]


def facts_of(run: RecordedCampaign, summary: Summary) -> list[Fact]:
    """Return the facts of a campaign and of the studies in its run folder.

    Args:
        run: the campaign.
        summary: its summary, with all levels.

    Raises:
        UserError: a file of a study is damaged.

    Example:
        >>> facts = facts_of(run, summarise(run.outcomes, run.levels, run.tolerated))
        >>> facts[0].name, facts[0].shown
        ('VUT', 'design2')
    """
    failing = run.criterion.condition if run.criterion.is_of_paper else "margin < 0"
    facts = [*_settings(run), *_shares(run), *_counts(run, summary, failing)]
    for level in summary.levels:
        facts += _of_level(run, level, summary.levels[level], failing)
    facts += _repeats(run)
    facts += _motion(run, summary.undecided_cases, failing)
    facts += _avoided(run, summary.undecided_cases)
    facts += _studies(run)
    return facts


def _settings(run: RecordedCampaign) -> Facts:
    settings, criterion = run.settings, run.criterion
    yield Fact(VUT, run.vut, "vut", file=SETTINGS)
    yield Fact("scenario", run.scenario.name, "scenario.name", file=SETTINGS)
    key = "fail_when" if criterion.require is None else "require"
    yield Fact(RULE, criterion.description(run.scenario), key, file=SETTINGS)
    sampler = f"{settings.sampler}, seed {settings.seed}"
    yield Fact("sampler", sampler, "sampler, seed", file=SETTINGS)


def _shares(run: RecordedCampaign) -> Facts:
    known = SHARES.read(run.folder)
    if known is None:
        return
    for one in known.levels:
        if one.without_verdict < one.cases:
            fact = partial(Fact, file=SHARES.name, level=one.level)
            yield fact(STARTS_THAT_FAIL, one.shown, "levels: failures / cases")
            yield fact("uniform starts simulated", one.cases, "levels: cases")
            if one.without_verdict:
                name = "uniform starts without a verdict"
                yield fact(name, one.without_verdict, "levels: without_verdict")


def _counts(run: RecordedCampaign, summary: Summary, failing: str) -> Facts:
    yield Fact(CASES, summary.cases, "lines")
    if run.converged:
        yield Fact(AT_MOST, run.settings.cases, "cases", file=SETTINGS)
    if summary.errors:
        yield Fact(ERRORS, summary.errors, "end: VUT_ERROR, SIM_ERROR")
    if summary.timeouts:
        yield Fact(TIMEOUTS, summary.timeouts, "end: TIMEOUT")
    yield Fact(FAILURES, summary.failures, failing)
    if run.tolerated:
        yield Fact(UNDECIDED, summary.undecided, "draw")
    if summary.failures:
        yield Fact("failures with contact", summary.contacts, f"{failing}, severity: contact")
    others = [one for one in run.cases if not one.failed]
    if contacts := sum(one.measures.severity == Severity.CONTACT for one in others):
        yield Fact(CONTACT, contacts, f"severity: contact, not {failing}")


def _of_level(run: RecordedCampaign, level: int, summary: LevelSummary, failing: str) -> Facts:
    fact = partial(Fact, level=level)
    yield fact(CASES, summary.cases, "level")
    if summary.tested < summary.cases:
        yield fact("without a verdict", summary.cases - summary.tested, "end")
    if summary.tested or not summary.cases:
        yield fact(FAILURES, summary.failures, failing)
        if run.tolerated:
            yield fact(UNDECIDED, summary.undecided, "draw")
        yield fact("regions", summary.regions, f"{failing}: their starts")
        radius = radius_for(len(run.scenario.dimensions(level)))
        yield fact("FMC", summary.fmc, f"{failing}: {radius:.2g} around their starts")
    if run.scenario.lane_m is None:
        return
    at_level = [outcome for outcome in run.cases if outcome.case.level == level]
    forced = sum(share >= 1.0 for share in _values(at_level, "lane_share"))
    yield fact("merges at the end of the lane", forced, "lane_share >= 1")
    stood = sum(time_s > 0.0 for time_s in _values(at_level, "stood_s"))
    yield fact("cases in which the VUT stood on the lane", stood, "stood_s > 0")
    for name, key, unit, scale in (
        ("place of the merge, median", "lane_share", "% of the lane", 100.0),
        ("time gap ahead, median", "time_gap_ahead_s", "s", 1.0),
        ("time gap behind, median", "time_gap_behind_s", "s", 1.0),
    ):
        if values := _values(at_level, key):
            yield fact(name, scale * statistics.median(values), key, unit)


def _values(outcomes: Iterable[Outcome], measure: str) -> list[Any]:
    """Return the values of a measure in the outcomes that have one."""
    values = []
    for outcome in outcomes:
        value = outcome.measures.value(measure)
        if value is not None:
            values.append(value)
    return values


def _repeats(run: RecordedCampaign) -> Facts:
    cases = by_case(run.outcomes)
    repeated = [case for case in cases if case.runs > 1]
    if run.tolerated or repeated:
        yield Fact("runs", sum(case.runs for case in cases), "draw")
        yield Fact("cases that ran more than once", len(repeated), "draw")
        both = sum(0 < case.failures < case.runs for case in repeated)
        yield Fact("of these, cases with failing and passing runs", both, "draw")
    if run.tolerated:
        name = "tolerated share of failing runs of a case"
        yield Fact(name, 100.0 * run.tolerated, "tolerated", PERCENT, SETTINGS)


def _motion(run: RecordedCampaign, undecided: frozenset[int], failing: str) -> Facts:
    simulated_s = sum(outcome.measures.t_end_s for outcome in run.outcomes)
    yield Fact("simulated time up to the merge", simulated_s / 3600.0, "t_end_s", "h")
    failed = failures(run.cases)
    if not failed:
        return
    worst = failed[0]
    yield Fact(WORST, worst.index, "lowest margin")
    kind = timelines(run, [worst])[worst.index].result
    yield Fact(KIND, kind, "severity, impact_speed_mps; and its motion")
    decided = [outcome for outcome in failed if outcome.index not in undecided]
    if avoidable := _values(decided, "avoidable"):
        name = "failures that full braking or full acceleration of the VUT avoids"
        yield Fact(name, sum(avoidable), f"{failing}, avoidable")


def _avoided(run: RecordedCampaign, undecided: frozenset[int]) -> Facts:
    known = [one for one in AVOIDANCE.read_lines(run) if one.index not in undecided]
    if not known:
        return
    fact = partial(Fact, file=AVOIDANCE.name)
    if len(known) < sum(outcome.failed for outcome in run.cases) - len(undecided):
        yield fact(DRIVEN, len(known), "lines")
    for name in REFERENCE_DRIVERS:
        number = sum(name in one.avoided_by for one in known)
        yield fact(AVOIDED.format(name), number, "avoided_by")
    yield fact(AVOIDED_BY_POV, sum(one.pov_careful for one in known), "pov_careful")


def _studies(run: RecordedCampaign) -> Facts:
    stress = STRESS.read(run.folder)
    if stress is not None and stress.failures:
        name = f"failures that fail in all {stress.runs} runs of the stress test"
        yield Fact(name, len(stress.robust), "rungs", file=STRESS.name)
    known = PROBABILITY.read(run.folder)
    if known is not None and known.overall is not None and known.is_judged:
        fact = partial(Fact, file=PROBABILITY.name)
        overall, at = known.overall, f"at {known.confidence:.0%}"
        for name, end in (
            (PROBABILITY_TO_FAIL, "probability"),
            (f"{PROBABILITY_TO_FAIL}, low end {at}", "low"),
            (f"{PROBABILITY_TO_FAIL}, high end {at}", "high"),
        ):
            yield fact(name, 100.0 * getattr(overall, end), f"overall.{end}", PERCENT)
        yield fact("fresh cases simulated", known.cases, "cases")
