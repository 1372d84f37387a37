"""Write results as sentences and lines for a terminal: begin at the functions of `lines_of`.

Each writes one type of result. `timelines` and `episode_lines` write cases; `campaign_table.py`
writes campaigns.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from merge_sumo.analysis.cases_file import short
from merge_sumo.analysis.comparison import (
    Change,
    ComparedCase,
    Comparison,
    VersionChange,
    outcome_word,
)
from merge_sumo.analysis.counterfactuals import AVOIDANCE, TAKES_OVER, Avoidance
from merge_sumo.analysis.explanation import PSI, Axis, Explanation, ExplanationResult
from merge_sumo.analysis.probability import Estimate, PerMerge, ProbabilityResult
from merge_sumo.analysis.reproduction import ADAPTIVE, PAPER_SAMPLERS, Reproduction
from merge_sumo.analysis.sampler_study import SamplerStudy, Spread
from merge_sumo.analysis.stress import StressResult
from merge_sumo.analysis.truth import DENSE_CASES, REAL_REGION, Truth, TruthResult
from merge_sumo.analysis.vut_check import VutCheck
from merge_sumo.campaigns.printed_commands import command
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.metrics.fmc import fmc
from merge_sumo.metrics.measures import recorded_measures
from merge_sumo.metrics.merge import Conflict
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.plausibility import doubts, late_errors
from merge_sumo.metrics.timeline import Event, Timeline, timeline
from merge_sumo.printable import counted, either, printable
from merge_sumo.result import lines_of
from merge_sumo.road.loader import centre_lines, road_for, road_or_shipped
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, NAMES, VEHICLES, level_name
from merge_sumo.scenario.trajectory import Trajectory

LISTED = 10
"""Maximum number of cases of each kind that lines name."""


def aligned(rows: Sequence[Sequence[str]], left: int = 0) -> list[str]:
    """Return the lines of a table.

    Args:
        rows: cells of each row, the same number in each.
        left: number of left-aligned columns, the first ones; others are right-aligned.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        for place in range(left):
            cells[place] = row[place].ljust(widths[place])
        lines.append("   ".join(cells).rstrip())
    return lines


# Comparisons


def change_in_words(case: ComparedCase) -> str:
    """Return both outcomes of a case in words, with the runs of each where there are several.

    Args:
        case: the case of both versions.
    """
    if case.p_value is not None and case.earlier_runs is not None and case.later_runs is not None:
        shares = f"{case.earlier_runs.in_words} -> {case.later_runs.in_words}"
        return f"{shares}, by Fisher's exact test p = {case.p_value:.2g}"
    words = [outcome_word(case.earlier), outcome_word(case.later)]
    # Equal words do not show the change: add the margins.
    is_weaker = case.change is Change.WEAKER
    if is_weaker or (words[0] == words[1] and case.change is not Change.BOTH):
        for place, outcome in enumerate((case.earlier, case.later)):
            if outcome.margin is not None:
                words[place] += f", margin {short(outcome.margin)}"
    return " -> ".join(words)


def version_change_headline(version_change: VersionChange) -> str:
    """Return the worse and better cases of a change of version in a clause.

    Args:
        version_change: the change of version.
    """
    parts, later = [], version_change.number
    if version_change.passes_less:
        by = f"by Fisher's exact test p = {version_change.p_value:.2g}"
        parts.append(f"version {later} passes less often than version {later - 1}, {by}")
    if version_change.cases:
        numbers = [f"{number} {group}" for group, number in version_change.groups.items()]
        parts.append(f"of {counted(len(version_change.cases), 'shared case')} {', '.join(numbers)}")
    else:
        parts.append("no case is shared")
    return f"from version {later - 1} to version {later}: {'; '.join(parts)}"


def comparison_summary(compared: Comparison) -> list[str]:
    """Return the failures of each version, and a table of the cases of each change of version.

    Args:
        compared: the comparison.
    """
    names = []
    for number, version in enumerate(compared.versions, start=1):
        names.append(f"{number}  {version.vut}, {version.folder or 'now'}")
    width = max(map(len, names))
    lines = []
    for name, version in zip(names, compared.versions, strict=True):
        lines.append(f"{name:<{width}}  {version.summary.counts}")
        for level, found in version.summary.levels.items():
            if found.failures:
                lines.append(f"   level {level_name(level)}: FMC {found.fmc:.4f}")
        lines += version.summary.error_lines()
        lines += [f"  {late}" for late in late_errors(version.outcomes)]
    for version_change in compared.version_changes:
        lines.append(version_change_headline(version_change))
        for (change, before, after), number in version_change.transitions.items():
            lines.append(f"  {change.group:<12}{number:6d}  {before} -> {after} ({change})")
    return lines


@lines_of.register
def comparison_lines(compared: Comparison) -> list[str]:
    """Return the numbers of each version and each change, and the first of the cases.

    Args:
        compared: the comparison.
    """
    text = comparison_summary(compared)
    if compared.text is not None:
        return [*text, *compared.notes]
    for version_change in compared.version_changes:
        for change in Change:
            changed = [case for case in version_change.cases if case.change is change]
            if changed and change.group in ("worse", "not counted"):
                first = f"the first {LISTED} of " if len(changed) > LISTED else ""
                text.append(f"{first}{len(changed)} {change}:")
                for case in changed[:LISTED]:
                    text.append(f"  case {case.later.index}: {change_in_words(case)}")
    return [*text, compared.source, *compared.notes]


# Truths and samplers


def _too_small(truth: Truth) -> str:
    """Return the reason why a truth is too small, in a clause."""
    return (
        "too small for shares and regions: doubling the number of its cases could add up to "
        f"{truth.growth:.0%} to its FMC"
    )


@lines_of.register
def truth_lines(found: TruthResult) -> list[str]:
    """Return a line for each level, and the criterion.

    Args:
        found: the truths.
    """
    lines = []
    for level, truth in found.truths.items():
        line = (
            f"{found.vut} at level {level_name(level)}: "
            f"{counted(len(truth.failures), 'failure')} in "
            f"{counted(len(truth.margin), 'case')}, FMC {fmc(truth.failures):.4f}"
        )
        if not truth.is_small:
            regions = counted(len(truth.real_regions()), "region")
            line += f", {regions} with at least {REAL_REGION:.0%} of the failures"
        if truth.in_sumo < len(truth.margin):
            cases = counted(truth.in_sumo, "case")
            line += f"; by the equations of motion; {cases} ran in SUMO too, with equal results"
        lines.append(line)
        if truth.is_small:
            lines.append(f"  {_too_small(truth)}")
    return [*lines, f"  failure criterion: {found.criterion.description(found.scenario)}"]


def _spread(spread: Spread, form: str) -> str:
    """Return the median, with the quartiles in brackets."""
    quartiles = f"{_cell(spread.low, form)}, {_cell(spread.high, form)}"
    return f"{_cell(spread.median, form)} [{quartiles}]"


def _cell(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


@lines_of.register
def sampler_lines(study: SamplerStudy) -> list[str]:
    """Return the truth, the limit, and a table of the samplers: medians [quartiles].

    Args:
        study: the study.
    """
    failures = sum(len(truth.failures) for truth in study.truths.values())
    line = f"truth: FMC {study.truth_fmc:.4f}, {counted(failures, 'failure')}"
    if study.regions is not None:
        line += f", {counted(len(study.regions), 'region')}"
    lines = [line]
    for level, truth in study.truths.items():
        if truth.is_small:
            lines.append(f"  at level {level_name(level)} it is {_too_small(truth)}")
    line = f"limit: FMC {study.limit_fmc:.4f}, of all failures in the truth and the searches"
    if study.dense:
        line += f", or in {DENSE_CASES:,} uniform cases if that is more"
    lines.append(line)

    head = ["sampler", "FMC / truth", "FMC / limit", "covered share", "FMC", "failures", "regions"]
    rows = [[*head, "to 90 %"]]
    for name, one in study.samplers.items():
        row = [
            name,
            _spread(one.fmc_over_truth, ".3f"),
            _spread(one.fmc_over_limit, ".3f"),
            _spread(one.covered_share, ".3f"),
            _spread(one.fmc, ".4f"),
            _spread(one.failures, ".0f"),
            _spread(one.regions_found, ".1f"),
            _spread(one.cases_to_90_percent, ".0f"),
        ]
        rows.append(row)
    lines += [*aligned(rows), "medians [quartiles]"]
    if probes := sum(map(len, study.probes.values())):
        lines.append(f"covered share: the share of {counted(probes, 'failing uniform case')}")
    return lines if study.figure is None else [*lines, f"figure: {study.figure}"]


@lines_of.register
def reproduction_lines(found: Reproduction) -> list[str]:
    """Return Table II as Markdown: our medians, with the paper's numbers in brackets.

    Args:
        found: the reproduction.
    """
    rows = [
        f"| FMC: ours (the paper's) | {' | '.join(found.columns)} |",
        "|---|" + "---|" * len(found.columns),
    ]
    for name, cells in table_ii(found):
        rows.append(f"| {name} | {' | '.join(cells)} |")
    for title, one in found.columns.items():
        truth = one.study.truths[one.column.level]
        if truth.is_small:
            rows += ["", f"The truth of {title} is {_too_small(truth)}."]
    return rows if found.page is None else [*rows, f"all results: {found.page}"]


def table_ii(found: Reproduction) -> Iterator[tuple[str, list[str]]]:
    """Yield the rows of Table II: a name, and a cell for each column.

    Args:
        found: the reproduction.
    """
    rows: dict[str, list[str]] = {}
    for one in found.columns.values():
        paper = dict(one.column.paper)
        for name in ADAPTIVE:
            if name in paper:
                paper[f"{name} / truth"] = paper[name] / paper["truth"]
        for name, value in _fmc_of(one.study).items():
            form = ".2f" if "/" in name else ".4f"
            cell = _cell(value, form)
            cell += f" ({paper[name]:{form}})" if name in paper else ""
            rows.setdefault(name, []).append(cell)
    for name, cells in rows.items():
        if set(cells) != {"-"}:
            yield name, cells


def _fmc_of(study: SamplerStudy) -> dict[str, float | None]:
    """Return the values of a column of Table II by row; None for unknown values."""
    values: dict[str, float | None] = {"truth": study.truth_fmc}
    for name in PAPER_SAMPLERS:
        values[name] = study.samplers[name].fmc.median
    values["dense truth"] = sum(fmc(truth.failures) for truth in study.dense.values()) or None
    values["limit"] = study.limit_fmc
    for name in ADAPTIVE:
        values[f"{name} / truth"] = study.samplers[name].fmc_over_truth.median
    for name in ADAPTIVE:
        values[f"{name} / limit"] = study.samplers[name].fmc_over_limit.median
    for name in ADAPTIVE:
        one = study.samplers[name]
        batch = 0  # becomes the first one after which a quarter of all cases has run
        while one.cases_by_batch[batch] < one.cases_by_batch[-1] / 4:
            batch += 1
        row = f"{name} / truth after {one.cases_by_batch[batch]} cases"
        values[row] = None
        if study.truth_fmc and not study.is_small:
            _, medians, _ = one.fmc_by_batch
            values[row] = medians[batch] / study.truth_fmc
    return values


# Studies of a campaign


@lines_of.register
def probability_lines(found: ProbabilityResult) -> list[str]:
    """Return the probability and its interval, the strata, the levels, and the counted cases.

    Args:
        found: the probability.
    """
    if not found.is_judged:
        return ["P(fail) is unknown: no case was judged, the VUT never reached the merge point"]
    at = f"{100.0 * found.confidence:g} % interval"
    lines = [] if found.per_merge is None else _per_merge(found.per_merge, at)
    if found.overall is not None:
        lines.append(f"P(fail): {_interval(found.overall)}, {at}, by {found.cases:,} cases")
        for one in found.overall.strata:
            expected = "failures" if one.expects_failures else "no failure"
            lines.append(
                f"  {expected} expected ({one.share:.2%} of random cases): {one.failures:,} of "
                f"{one.cases:,} drawn here fail, P(fail) {one.low:.3g} to {one.high:.3g}"
            )
    if found.overall is None or len(found.levels) > 1:
        for level, estimate in found.levels.items():
            lines.append(f"  level {level_name(level)}: P(fail) {_interval(estimate)}")
    if found.without_verdict:
        lines.append(
            f"  {found.without_verdict} not judged (error or timeout): safe for lower ends, "
            "failures for upper ends"
        )
    if found.in_sumo < found.cases:
        lines.append(f"  by equations of motion; {found.in_sumo:,} in SUMO too, with equal results")
    return lines


def _interval(one: Estimate) -> str:
    return f"{one.probability:.3g} [{one.low:.3g}, {one.high:.3g}]"


def _per_merge(one: PerMerge, at: str) -> list[str]:
    traffic = one.traffic
    most = "" if one.most == one.least else f" to {one.most:.3g}"
    return [
        f"failures per merge: {one.least:.3g}{most} [{one.low:.3g}, {one.high:.3g}], "
        f"{at}, for any mix of the POV levels",
        f"  traffic {traffic.name}: {traffic.density_veh_per_km:g} veh/km ({traffic.source})",
        f"  counted: only cars that start in the pool, {one.cars:.2g} per merge; "
        f"{one.counted_speeds:.0%} of this traffic has such speeds",
    ]


@lines_of.register
def stress_lines(found: StressResult) -> list[str]:
    """Return a table of the changes, and the robust failures.

    Args:
        found: the stress test.
    """
    lines = [
        f"{counted(found.cases, 'case')} of {found.vut}, {len(found.failures)} of them "
        f"failures, ran {found.runs} times each",
        # The columns of the rows below: 8, 10, 10 and 12 characters wide.
        "   flips  now pass  now fail  no verdict  change",
    ]
    for rung in found.rungs:
        if rung.skipped:
            lines.append(f"{'not run':>40}  {rung.about}: {rung.skipped}")
            continue
        passing, failing, unjudged = rung.counts
        numbers = f"{found.share(rung):8.1%}{passing:10d}{failing:10d}{unjudged:12d}"
        drawn = f", {len(rung.runs)} random draws" if len(rung.runs) > 1 else ""
        lines.append(f"{numbers}  {rung.about}{drawn}")
    return [*lines, robustness(found)]


def robustness(found: StressResult) -> str:
    """Return the number of robust failures in a clause.

    Args:
        found: the stress test.
    """
    if not found.failures:
        return "no case failed; the table shows how many passing cases fail after a change"
    failures = counted(len(found.failures), "failure")
    return f"robust, because they fail with every change: {len(found.robust)} of {failures}"


@lines_of.register
def explanation_lines(result: ExplanationResult) -> list[str]:
    """Return the failure, its timeline, and the changes that make it pass.

    Args:
        result: the explanation.
    """
    run, found = result.run, result.found
    outcome = run.outcome(found.index)
    told = timelines(run, [outcome])[outcome.index]
    lines = told.lines(outcome.case, f"case {outcome.index}")
    if found.vut is not None:
        lines.append(f"  before: {printable(run.settings.vut)}; with {printable(found.vut)}:")
    for sentence in changes(found, outcome.case):
        lines.append(f"  {sentence}")
    return [*lines, f"in the report: {command('report', run.folder)}"]


def changes(found: Explanation, case: Case) -> Iterator[str]:
    """Yield the changes that make a failure pass: along axes, and at other levels.

    Args:
        found: the explanation.
        case: the failing case.
    """
    for axis, name, unit in axes_of(found, case):
        yield _axis(axis, name, unit)
    for level, passed in found.levels.items():
        psi = f", psi {PSI:g}" if level == level_name(2) else ""
        verb = "passes" if passed else "does not pass"
        yield f"the same start {verb} at level {level}{psi}"


def axes_of(found: Explanation, case: Case) -> Iterator[tuple[Axis, str, str]]:
    """Yield the changed quantities of an explanation, each with its name and its unit.

    Args:
        found: the explanation.
        case: the failing case.
    """
    known = {c.field: (c.name, c.unit) for c in case.scenario.dimensions(case.level)}
    for axis in found.start:
        yield axis, *known.get(axis.name, (axis.name, ""))
    for axis in found.parameters:
        yield axis, f"the VUT's {axis.name}", ""


def _axis(axis: Axis, name: str, unit: str) -> str:
    values = [axis.value, axis.low, axis.high, axis.step, *axis.passing]
    value, low, high, step, *passing = [f"{v:.{axis.digits}f} {unit}".rstrip() for v in values]
    tried = f"tried from {low} to {high} in steps of {step}"
    if not passing:
        return f"{name} is {value}; no other value passes ({tried})"
    found = f"{either(passing)} ({tried}, then refined to the last digit)"
    return f"{name} is {value}; the case passes at {found}"


@lines_of.register
def vut_check_lines(found: VutCheck) -> list[str]:
    """Return the problems in sentences, and the time of a step.

    Args:
        found: the check.
    """
    lines = list(found.problems) or ["nothing wrong"]
    for sentence in found.notes:
        lines.append(f"note: {sentence}")
    if found.us_per_step_median is not None:
        lines.append(f"a step takes {found.us_per_step_median:.0f} us (median)")
    return lines


# Campaigns and single cases


def notes_of(run: RecordedCampaign) -> list[str]:
    """Return the warnings about a campaign, and a sentence on cases that ran again.

    Args:
        run: the campaign.
    """
    notes = doubts(run.cases, run.settings.in_vain)
    if run.settings.ran_again:
        notes.append(run.ran_again_in_words)
    return notes


def timelines(run: RecordedCampaign, outcomes: Sequence[Outcome]) -> dict[int, Timeline]:
    """Return the timelines of cases by index, of failures with the drivers that avoid them.

    Args:
        run: the campaign.
        outcomes: outcomes of the cases.
    """
    motions = run.trajectories(outcome.index for outcome in outcomes)
    avoidance = {one.index: _avoidance(one) for one in AVOIDANCE.read_lines(run)}
    road_lines = centre_lines(road_or_shipped(run.scenario))
    found = {}
    for outcome in outcomes:
        others = avoidance.get(outcome.index, ())
        found[outcome.index] = timeline(outcome, motions.get(outcome.index), road_lines, others)
    return found


def _avoidance(one: Avoidance) -> list[Event]:
    """Return the drivers that avoid a failure from its start, and the last time to take over."""
    by = ", ".join(one.avoided_by) or "none"
    text = f"reference drivers that avoid this failure: {by}"
    events = [Event(0.0, f"{text}; also a careful POV" if one.pov_careful else text)]
    if one.latest_takeover_s is not None:
        text = f"last time at which the reference driver {TAKES_OVER} could still take over"
        events.append(Event(one.latest_takeover_s, text))
    return events


def episode_lines(
    outcome: Outcome, trajectory: Trajectory, from_s: float | None = None
) -> list[str]:
    """Return the case, its timeline, its measures, and its motion as a table.

    Args:
        outcome: the outcome of the case.
        trajectory: its motion.
        from_s: begin of the table in s before the first conflict, such as -3.
    """
    lines_of_road = centre_lines(road_for(outcome.case.scenario))
    first, begins = Conflict.of(trajectory, lines_of_road).begin(from_s)
    lines = timeline(outcome, trajectory, lines_of_road).lines(outcome.case)
    if outcome.margin is not None:
        verb = "fails" if outcome.failed else "does not fail"
        lines.append(f"{verb}: margin {outcome.margin:.3g}")
    return [*lines, "", *_measures(outcome), "", *begins, *_motion_lines(trajectory, first)]


def _measures(outcome: Outcome) -> Iterator[str]:
    """Yield a line for each measure with a label, of the car that the VUT meets, and errors."""
    found, scenario = outcome.measures, outcome.case.scenario
    car = NAMES[found.nearest]
    if car != "POV":
        yield f"  measures of the {car}, which is nearest to the VUT at the end:"
    rows = []
    for name, measure in recorded_measures(scenario).items():
        value = found.value(name)
        if measure.label and value is not None:
            label = scenario.wording(measure.label).replace("POV", car)
            rows.append((f"  {label}", f"{value:8.2f} {measure.unit}"))
    if found.clipped_steps:
        rows.append(("  steps beyond the VUT's limits", f"{found.clipped_steps:8d}"))
    if outcome.is_tested and found.error is not None:
        rows.append(("  error after M", found.error))
    yield from aligned(rows, left=2)


def _motion_lines(trajectory: Trajectory, first: int) -> list[str]:
    """Return the motion from a row on: a row for each second, for the merge, and for the end.

    A row has x in m, v in m/s and a in m/s2 of every vehicle, and the signals of the VUT.
    """
    motion, merge = trajectory.whole, len(trajectory.motion) - 1
    last = len(motion) - 1
    head = "  t s"
    for who in VEHICLES[: motion.shape[1]]:
        position = f"x {who.upper()}"
        head += f"  {position:>8}   m/s  m/s2"
    lines = [head]
    seconds = range(first, len(motion), round(1.0 / DT_S))
    for row in sorted({*seconds, max(merge, first), last}):
        line = f"{row * DT_S:5.1f}"
        for x_m, v_mps, a_mps2 in motion[row].tolist():
            line += f"  {x_m:8.1f} {v_mps:5.1f} {a_mps2:5.1f}"
        if row == merge < last:
            line += f"  {trajectory.case.scenario.place}"
        for name, values in (trajectory.signals or {}).items():
            if values[row] is not None:
                line += f"  {name} {values[row]}"
        lines.append(line)
    return lines
