"""The end of a campaign in a terminal: a summary line, a table of POV levels, and remarks."""

from __future__ import annotations

import textwrap
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence

from merge_sumo.campaigns.printed_commands import campaign_command, command
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.drivers.reference_drivers import REFERENCE_DRIVERS
from merge_sumo.metrics.summary import Summary
from merge_sumo.reports.facts import (
    AT_MOST,
    AVOIDED,
    AVOIDED_BY_POV,
    CASES,
    CONTACT,
    DRIVEN,
    ERRORS,
    FAILURES,
    KIND,
    PROBABILITY_TO_FAIL,
    RULE,
    STARTS_THAT_FAIL,
    TIMEOUTS,
    VUT,
    WORST,
    Fact,
)
from merge_sumo.reports.text import aligned
from merge_sumo.scenario.scenario import level_name

LABEL_CHARACTERS = 13
COLUMNS = (
    "POV level",
    "starts that fail       ",  # as wide as the widest usual cell
    "failures found",
    "undecided",
    "no verdict",
    "regions",
    "FMC",
)


def campaign_lines(run: RecordedCampaign, summary: Summary, facts: Sequence[Fact]) -> list[str]:
    """Return the summary line, the table, and the remarks of a campaign.

    Args:
        run: the campaign.
        summary: its summary.
        facts: its facts, as `facts_of` returns them.

    Example:
        >>> campaign_lines(run, summary, facts)[0]
        'design2 on us23: 480 cases, 180 failures (front bumpers within 6 m when the VUT ...'
    """
    of = {fact.name: fact for fact in facts if fact.level is None}
    things = {CASES: "case", ERRORS: "error", TIMEOUTS: "timeout"}
    if summary.tested:
        things[FAILURES] = "failure"
    found = [_counted(of[name], thing) for name, thing in things.items() if name in of]
    if not summary.tested:
        found.append("nothing tested")
    head = f"{of[VUT].shown} on {run.scenario.name}: {', '.join(found)}"
    rule = f"({of[RULE].shown})"
    is_short = len(head) + len(rule) < 105  # else the rule has its own line
    lines = [f"{head} {rule}", ""] if is_short else [head, rule, ""]
    shares = {fact.level: fact.shown for fact in facts if fact.name == STARTS_THAT_FAIL}
    if summary.levels:
        lines += [*aligned(level_table(summary, shares), left=1 + bool(shares)), ""]
    for label, remarks in _remarks(run, summary, of, bool(shares)):
        lines += labelled(label, remarks)
    return lines


def labelled(label: str, lines: Iterable[str]) -> Iterator[str]:
    """Yield lines, the first of them with a label.

    Args:
        label: the label, up to its colon.
        lines: the lines.
    """
    for line in lines:
        yield f"{label:<{LABEL_CHARACTERS}}{line}"
        label = ""


def level_table(summary: Summary, shares: Mapping[int | None, str]) -> list[list[str]]:
    """Return the table of POV levels without empty columns: a head, and a row for each level.

    Args:
        summary: summary of the campaign.
        shares: share of all starts that fail, as text, by level; unknown shares are missing.
    """
    rows = [list(COLUMNS)]
    for level, of in summary.levels.items():
        found = f"{of.failures:,}" if of.tested else "nothing tested" if of.cases else "not run"
        coverage = f"{of.fmc:.3f}".removeprefix("0") if of.fmc >= 0.001 else "< .001"
        row = [level_name(level), shares.get(level, ""), found]
        for number in (of.undecided, of.cases - of.tested, of.regions):
            row.append(f"{number:,}" if number else "")
        rows.append([*row, coverage if of.fmc else ""])
    columns = [column for column in zip(*rows, strict=True) if any(column[1:])]
    return [list(row) for row in zip(*columns, strict=True)]


def _remarks(
    run: RecordedCampaign, summary: Summary, of: Mapping[str, Fact], has_shares: bool
) -> Iterator[tuple[str, list[str]]]:
    """Yield labels, each with its lines."""
    yield "Not judged:", [line.strip() for line in summary.error_lines()]
    if CONTACT in of:
        cases = _counted(of[CONTACT], "case")
        yield "Not counted:", [f"{cases} with contact (`fail_when` unsafe counts them)"]
    if not has_shares and PROBABILITY_TO_FAIL not in of:
        measure = campaign_command("probability", run.folder, run.record)
        yield "Not known:", ["the share of all starts that fail; to measure it, run", measure]
    if AT_MOST in of:
        limit = f"(limit: {of[AT_MOST].shown} cases)"
        yield "Converged:", [f"the last 100 cases added less than 1 % to the FMC {limit}"]
    if AVOIDED_BY_POV in of:
        yield "Avoidable:", textwrap.wrap(_avoidable(of), 87)
    if WORST in of:
        replay = command("replay", run.folder, of[WORST].value, gui=True)
        yield "Worst:", [f"case {of[WORST].value}, {of[KIND].shown}", replay]


def _counted(fact: Fact, thing: str) -> str:
    return f"{fact.shown} {thing}" if fact.value == 1 else f"{fact.shown} {thing}s"


def _avoidable(of: Mapping[str, Fact]) -> str:
    """Return how many failures the reference drivers and a careful POV avoid."""
    driven = of[DRIVEN if DRIVEN in of else FAILURES]
    drivers: defaultdict[float | str, list[str]] = defaultdict(list)
    for name in REFERENCE_DRIVERS:
        drivers[of[AVOIDED.format(name)].value].append(name)
    parts = []
    for number in sorted(drivers, key=float, reverse=True):
        parts.append(f"{_times(number, driven)} by {', '.join(drivers[number])}")
    parts.append(f"{_times(of[AVOIDED_BY_POV].value, driven)} if the POV brakes carefully")
    text = "; ".join(parts)
    return f"of the {driven.shown} worst: {text}" if DRIVEN in of else text


def _times(number: float | str, whole: Fact) -> str:
    if not number:
        return "none"
    return f"all {number:,}" if number == whole.value and number != 1 else f"{number:,}"
