"""The facts of a campaign: each once, with its unit, and the file and the key that it is from.

The report prints them as one table, `merge-sumo report --json` as one list; the terminal and JUnit
take their lines from them. What no study has left in the folder is no fact.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from merge_sumo.analysis.counterfactuals import AVOIDANCE
from merge_sumo.analysis.probability import PROBABILITY
from merge_sumo.analysis.share import SHARES
from merge_sumo.analysis.stress import STRESS
from merge_sumo.campaigns.again import again, command
from merge_sumo.campaigns.run import OUTCOMES, SETTINGS, TRAJECTORIES, Run, failures
from merge_sumo.drivers.reference import REFERENCES
from merge_sumo.metrics.cause import cause
from merge_sumo.metrics.fmc import radius_for
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.summary import LevelSummary, Summary, Verdict, by_case, undecided
from merge_sumo.printable import printable
from merge_sumo.scenario.scenario import level_name

PERCENT = "%"
STARTS_THAT_FAIL = "starts that fail"
STARTS = "uniform starts of that"
UNDECIDED = "undecided"
RULE = "a case fails when"
AT_MOST = "cases at most; the search converged before"
TOUCH = "cases with contact that are no failures"
DRIVEN = "failures that reference drivers drove"
AVOIDED = "failures that driver {} avoids"
AVOIDED_BY_POV = "failures that a careful POV avoids"
PROBABLY = "probability that a case fails"
WORST = "worst case"
KIND = "kind of the worst case"
SCATTERED = "scattered"


@dataclass(frozen=True, slots=True)
class Fact:
    """A fact of a campaign.

    Attributes:
        name: what it is, in words.
        value: a number in `unit`, or a text.
        unit: "" for counts, for texts and for FMC.
        file: file of the run folder that it is from.
        key: key of that file, or the lines of it that are counted.
        level: POV level that it is of; None where it is of all.
    """

    name: str
    value: float | str
    unit: str
    file: str
    key: str
    level: int | None = None

    @property
    def shown(self) -> str:
        """The value as it is printed, with its unit."""
        if isinstance(self.value, str):
            text = printable(self.value)
        elif isinstance(self.value, int):
            text = f"{self.value:,}"
        else:
            text = f"{self.value:.3g}" if self.unit else f"{self.value:.4f}"
        return f"{text} {self.unit}".strip()


def facts_of(run: Run, summary: Summary, verdict: Verdict) -> list[Fact]:
    """Return the facts of a campaign, by what its folder holds.

    Raises `UserError` where a file of a study is not as it was written.

    Args:
        run: the campaign.
        summary: its summary.
        verdict: its verdict.
    """
    unsure = undecided(run.outcomes, run.tolerated)
    return [
        *_tested(run),
        *_shares(run),
        *_found(run, summary, verdict),
        *(
            fact
            for level, found in summary.levels.items()
            for fact in _of_level(run, level, found, untested=verdict.tested < verdict.cases)
        ),
        *_repeats(run),
        *_motion(run, unsure),
        *_avoided(run, unsure),
        *_studies(run),
    ]


def by_level(facts: Iterable[Fact]) -> tuple[list[Fact], list[tuple[int, list[Fact | None]]]]:
    """Return the facts of levels as a table: one of each name, and a row for each level."""
    of_levels = [fact for fact in facts if fact.level is not None]
    columns = list({fact.name: fact for fact in of_levels}.values())
    rows: dict[int, dict[str, Fact]] = {}
    for fact in of_levels:
        if fact.level is not None:
            rows.setdefault(fact.level, {})[fact.name] = fact
    return columns, [(level, [row.get(c.name) for c in columns]) for level, row in rows.items()]


def headline(run: Run, facts: Sequence[Fact]) -> list[str]:
    """Return the first lines about a campaign; each number is that of a fact."""
    of = {fact.name: fact for fact in facts if fact.level is None}
    cases = _counted(of["cases"], "case")
    if AT_MOST in of:
        cases = f"{of['cases'].shown} of {of[AT_MOST].shown} cases, converged"
    return [
        f"{of['VUT'].shown}: {RULE} {of[RULE].shown}; {cases}",
        *_level_lines(facts),
        *_not_said(run, of, {fact.name for fact in facts}),
        *_how_bad(run, of),
    ]


def _counted(fact: Fact, one: str, several: str = "") -> str:
    return f"{fact.shown} {one if fact.value == 1 else several or f'{one}s'}"


def _level_lines(facts: Iterable[Fact]) -> list[str]:
    """Return a line for each level, aligned."""
    lines = []
    for level, row in by_level(facts)[1]:
        of = {fact.name: fact for fact in row if fact is not None}
        share, failures = of.get(STARTS_THAT_FAIL), of.get("failures")
        unsure = of.get(UNDECIDED)
        found = "nothing tested" if failures is None else f"{_counted(failures, 'failure')} found"
        if unsure is not None and unsure.value:
            found += f", {unsure.shown} undecided"
        cells = [
            f"level {level_name(level)}",
            "" if share is None else f"{share.shown} of all starts fail, by {of[STARTS].shown}",
            found,
        ]
        if failures is not None and of["FMC"].value:
            regions = of["regions"]
            cells.append(SCATTERED if regions.value == SCATTERED else _counted(regions, "region"))
            cells.append(f"FMC {of['FMC'].shown}")
        lines.append(cells)
    widths = [max(map(len, column)) for column in zip_longest(*lines, fillvalue="")]
    return [
        "  ".join(["", *(cell.rjust(w) for cell, w in zip(cells, widths, strict=False) if w)])
        for cells in lines
    ]


def _not_said(run: Run, of: Mapping[str, Fact], known: set[str]) -> Iterator[str]:
    """Yield what the failures do not say: contacts under another rule, the share of starts."""
    parts = []
    if TOUCH in of:
        more = _counted(of[TOUCH], "more case touches", "more cases touch")
        where = run.scenario.said(" after M") if run.criterion.is_papers else ""
        parts.append(f"{more}{where}, which this rule does not count: `fail_when` unsafe")
    if PROBABLY not in known and SHARES.read(run.folder) is None:
        measure = again("probability", run.folder, run.record)
        parts.append(f"{STARTS_THAT_FAIL} are not measured: {measure}")
    if parts:
        yield "; ".join(parts)


def _how_bad(run: Run, of: Mapping[str, Fact]) -> Iterator[str]:
    """Yield how many failures other drivers avoid, and the command that shows the worst."""
    if AVOIDED_BY_POV in of:
        by = ", ".join(f"{name} {of[AVOIDED.format(name)].shown}" for name in REFERENCES)
        some = f"{of[DRIVEN].shown} of " if DRIVEN in of else ""
        failures, pov = _counted(of["failures"], "failure"), of[AVOIDED_BY_POV].shown
        yield f"avoided of {some}{failures}: by driver {by}, by a careful POV {pov}"
    if WORST in of:
        replay = command("replay", run.folder, of[WORST].value, gui=True)
        yield f"{WORST} ({of[KIND].shown}): {replay}"


def _tested(run: Run) -> Iterator[Fact]:
    settings, criterion = run.settings, run.criterion
    yield Fact("VUT", run.vut, "", SETTINGS, "vut")
    yield Fact("scenario", run.scenario.name, "", SETTINGS, "scenario.name")
    key = "fail_when" if criterion.require is None else "require"
    yield Fact(RULE, criterion.said(run.scenario), "", SETTINGS, key)
    sampler = f"{settings.sampler}, seed {settings.seed}"
    yield Fact("sampler", sampler, "", SETTINGS, "sampler, seed")


def _failing(run: Run) -> str:
    """Return the key of the failing lines of `outcomes.jsonl`: the paper's rule has no margin."""
    return run.criterion.words if run.criterion.is_papers else "margin < 0"


def _shares(run: Run) -> Iterator[Fact]:
    known = SHARES.read(run.folder)
    for one in () if known is None else known.levels:
        if one.without_verdict == one.cases:
            continue  # no start was judged: nothing is known of a share
        key = "levels: failures of cases"
        yield Fact(STARTS_THAT_FAIL, one.shown, "", SHARES.name, key, one.level)
        yield Fact(STARTS, one.cases, "", SHARES.name, "levels: cases", one.level)
        if one.without_verdict:
            name, key = "uniform starts without a verdict", "levels: without_verdict"
            yield Fact(name, one.without_verdict, "", SHARES.name, key, one.level)


def _found(run: Run, summary: Summary, verdict: Verdict) -> Iterator[Fact]:
    def counted(name: str, number: int, key: str) -> Fact:
        return Fact(name, number, "", OUTCOMES, key)

    yield counted("cases", summary.cases, "lines")
    if run.converged:
        yield Fact(AT_MOST, run.settings.cases, "", SETTINGS, "cases")
    if verdict.errors:
        yield counted("errors", verdict.errors, "end: VUT_ERROR, SIM_ERROR")
    if verdict.timeouts:
        yield counted("timeouts", verdict.timeouts, "end: TIMEOUT")
    failing = _failing(run)
    yield counted("failures", summary.failures, failing)
    if run.tolerated:
        yield counted(UNDECIDED, summary.undecided, "draw")
    if summary.failures:
        yield counted("failures with contact", verdict.contacts, f"{failing}, severity: contact")
    for severity, about in (
        (Severity.CONTACT, TOUCH),
        (Severity.CONFLICT, "cases with a conflict that are no failures"),
        (Severity.HARSH, "cases with harsh braking after the merge that are no failures"),
    ):
        number = sum(o.measures.severity == severity and not o.failed for o in run.cases)
        if number:
            yield counted(about, number, f"severity: {severity}, not {failing}")


def _of_level(run: Run, level: int, found: LevelSummary, *, untested: bool) -> Iterator[Fact]:
    def fact(name: str, value: float, key: str, unit: str = "") -> Fact:
        return Fact(name, value, unit, OUTCOMES, key, level)

    yield fact("cases", found.cases, "level")
    if untested:
        yield fact("without a verdict", found.cases - found.tested, "end")
    if found.tested or not found.cases:
        key = _failing(run)
        yield fact("failures", found.failures, key)
        if run.tolerated:
            yield fact(UNDECIDED, found.undecided, "draw")
        failing = found.failures + found.undecided
        # Failures from which on more than half as many regions are said to be scattered.
        scattered = failing >= 10 and 2 * found.regions > failing
        regions = SCATTERED if scattered else found.regions
        yield Fact("regions", regions, "", OUTCOMES, f"{key}: starts", level)
        radius = radius_for(len(run.scenario.dimensions(level)))
        yield fact("FMC", found.fmc, f"{key}: starts within {radius:.2g}")
    if run.scenario.lane_m is not None:
        yield from _of_lane(run, level)


def _of_lane(run: Run, level: int) -> Iterator[Fact]:
    """Yield where on the acceleration lane the VUT merges, and into which gaps."""
    at_level = [o.measures for o in run.cases if o.case.level == level]
    forced = sum((found.lane_share or 0.0) >= 1.0 for found in at_level)
    stood = sum(found.stood_s > 0.0 for found in at_level)
    yield Fact("merges where the lane ends", forced, "", OUTCOMES, "lane_share >= 1", level)
    yield Fact("cases that stood on the lane", stood, "", OUTCOMES, "stood_s > 0", level)
    for name, key, unit, scale in (
        ("place of the merge, median", "lane_share", "% of the lane", 100.0),
        ("time gap ahead, median", "time_gap_ahead_s", "s", 1.0),
        ("time gap behind, median", "time_gap_behind_s", "s", 1.0),
    ):
        known = [value for found in at_level if (value := found.value(key)) is not None]
        if known:
            yield Fact(name, scale * statistics.median(known), unit, OUTCOMES, key, level)


def _repeats(run: Run) -> Iterator[Fact]:
    cases, tolerated = by_case(run.outcomes), run.tolerated
    repeated = [one for one in cases if one.runs > 1]
    if not (tolerated or repeated):
        return
    varied = [one for one in repeated if one.varies]
    for name, number in (
        ("runs", sum(one.runs for one in cases)),
        ("cases that ran more than once", len(repeated)),
        ("of these, cases whose runs differ", len(varied)),
        ("of these, cases that both fail and pass", sum(0 < v.failures < v.runs for v in varied)),
    ):
        yield Fact(name, number, "", OUTCOMES, "draw")
    if tolerated:
        name = "share of its runs in which a case may fail"
        yield Fact(name, 100.0 * tolerated, PERCENT, SETTINGS, "tolerated")


def _motion(run: Run, unsure: set[int]) -> Iterator[Fact]:
    worst = failures(run.cases)
    key = f"t_end_s; the follow-up by {TRAJECTORIES}/"
    yield Fact("simulated time", run.simulated_s / 3600.0, "h", OUTCOMES, key)
    if not worst:
        return
    yield Fact(WORST, worst[0].index, "", OUTCOMES, "lowest margin")
    motion = run.trajectories([worst[0].index]).get(worst[0].index)
    kind, _, _ = cause(worst[0], motion).partition(":")
    key = "severity, impact_speed_mps; by its motion"
    yield Fact(KIND, kind[0].lower() + kind[1:], "", OUTCOMES, key)
    worst = [outcome for outcome in worst if outcome.index not in unsure]
    known = [o.measures.avoidable for o in worst if o.measures.avoidable is not None]
    if known:
        name = "failures that full braking or full acceleration of the VUT avoids"
        yield Fact(name, sum(known), "", OUTCOMES, f"{_failing(run)}, avoidable")
    for name, measure, unit in (
        ("hardest braking of the POV over 1.6 s in a failure", "pov_sustained_brake_mps2", "m/s²"),
        ("largest loss of speed of the POV in a failure", "pov_slowdown_mps", "m/s"),
    ):
        values = [v for o in worst if (v := o.measures.value(measure)) is not None]
        if values:
            yield Fact(name, max(values), unit, OUTCOMES, f"{_failing(run)}: {measure}")


def _avoided(run: Run, unsure: set[int]) -> Iterator[Fact]:
    known = [one for one in AVOIDANCE.read_lines(run) if one.index not in unsure]
    if not known:
        return
    if len(known) < sum(outcome.failed for outcome in run.cases) - len(unsure):
        yield Fact(DRIVEN, len(known), "", AVOIDANCE.name, "lines")
    for name in REFERENCES:
        number = sum(name in one.avoided_by for one in known)
        yield Fact(AVOIDED.format(name), number, "", AVOIDANCE.name, "avoided_by")
    times = [one.latest_takeover_s for one in known if one.latest_takeover_s is not None]
    if times:
        middle = statistics.median_low(times)
        name = "last time at which driver fsm may take over, in the median"
        yield Fact(name, middle, "s", AVOIDANCE.name, "latest_takeover_s")
    number = sum(one.pov_careful for one in known)
    yield Fact(AVOIDED_BY_POV, number, "", AVOIDANCE.name, "pov_careful")


def _studies(run: Run) -> Iterator[Fact]:
    stress = STRESS.read(run.folder)
    if stress is not None and stress.failures:
        name = f"failures that stay failures in all {stress.runs} runs of the stress test"
        yield Fact(name, len(stress.robust), "", STRESS.name, "rungs")
    known = PROBABILITY.read(run.folder)
    if known is not None and known.overall is not None and known.is_judged:
        for name in ("probability", "low", "high"):
            end = "" if name == "probability" else f", {name} end at {known.confidence:.0%}"
            value, key = 100.0 * getattr(known.overall, name), f"overall.{name}"
            yield Fact(f"{PROBABLY}{end}", value, PERCENT, PROBABILITY.name, key)
        yield Fact("fresh cases of that", known.cases, "", PROBABILITY.name, "cases")
