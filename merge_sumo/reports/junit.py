"""A campaign as JUnit XML, which CI systems read: Jenkins, GitLab, GitHub actions and others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from merge_sumo.analysis.comparison import Change, Comparison, VersionChange
from merge_sumo.campaign_run import CampaignRun
from merge_sumo.campaigns.recorded import NAME_CHARACTERS, RecordedCampaign
from merge_sumo.files import write_new
from merge_sumo.metrics.summary import by_case
from merge_sumo.printable import printable
from merge_sumo.reports.facts import Fact
from merge_sumo.reports.pages import environment
from merge_sumo.reports.text import change_in_words, timelines, version_change_headline
from merge_sumo.scenario.case import described
from merge_sumo.scenario.scenario import level_name

JUNIT = (".xml",)
"""Ending of JUnit files."""
REGRESSION = "regression"
"""Type of the failure of a case that passes with an earlier version."""


@dataclass(slots=True)
class TestCase:
    """A test case of JUnit.

    Attributes:
        name: its name.
        group: last part of its class name.
        time_s: simulated time up to M.
        tag: failure, error or skipped; empty where it passed.
        kind: type of the failure or error, such as a severity.
        message: reason of the tag, or a remark on a case that passed.
    """

    name: str
    group: str
    time_s: float = 0.0
    tag: str = ""
    kind: str = ""
    message: str = ""


def write_junit(path: Path, result: CampaignRun) -> None:
    """Write the JUnit file of a campaign.

    It has a suite of gates, a suite of the cases that an earlier version also ran, and a suite of
    each POV level. A failing case or a timeout is a `failure`, and its type is the severity. An
    error of the VUT or of the simulation is an `error`. An undecided case is `skipped`.

    Args:
        path: new file to write.
        result: the campaign, with its gates.

    Raises:
        UserError: the file exists or cannot be written.
    """
    run, summary = result.recorded, result.summary
    tested = TestCase(f"the VUT reaches {summary.goal}", "gates")
    if not summary.tested:
        tested.tag, tested.kind = "failure", "NOTHING_TESTED"
        tested.message = summary.nothing_tested
    suites = {"gates": [tested]}
    for gate in result.gates:
        test = TestCase(gate.name, "gates", kind="GATE", message=gate.sentence)
        test.tag = "failure" if gate.met else ""
        suites["gates"].append(test)
    if result.against is not None:
        earlier = printable(str(run.settings.against)[:NAME_CHARACTERS])
        (version_change,) = result.against.version_changes
        suites[f"against {earlier}"] = _tests(version_change)
    for level in summary.levels:
        suites[f"POV level {level_name(level)}"] = []
    for test in _cases(run, summary.undecided_cases):
        suites[f"POV {test.group}"].append(test)
    _write(path, f"merge-sumo {run.vut}", suites, result.facts)


def write_junit_of_comparison(path: Path, compared: Comparison) -> None:
    """Write the JUnit file of a comparison.

    Args:
        path: new file to write.
        compared: the comparison.

    Raises:
        UserError: the file exists or cannot be written.
    """
    suites = {}
    for version_change in compared.version_changes:
        earlier, later = compared.versions[version_change.number - 2 :][:2]
        name = printable(f"{earlier.folder} to {later.folder or later.vut}")
        suites[name] = _tests(version_change, every=compared.text is not None)
    _write(path, "merge-sumo compare", suites)


def _write(
    path: Path, name: str, suites: dict[str, list[TestCase]], facts: Sequence[Fact] = ()
) -> None:
    template = environment().get_template("junit.xml.jinja")
    text = template.render(name=name, suites=suites, facts=facts)
    write_new(path, text.strip().encode(), "`junit`")


def _cases(run: RecordedCampaign, undecided: frozenset[int]) -> list[TestCase]:
    runs = {}
    for case in by_case(run.outcomes):
        if case.runs > 1:
            runs[case.deciding(run.tolerated).index] = f", {case.in_words}"
    told = timelines(run, [one for one in run.cases if one.failed or not one.is_tested])
    tests = []
    for outcome in run.cases:
        index, measures = outcome.index, outcome.measures
        name = f"case {index}: {described(outcome.case)}{runs.get(index, '')}"
        test = TestCase(name, f"level {level_name(outcome.case.level)}", measures.t_end_s)
        if index in undecided:
            test.tag, test.message = "skipped", f"undecided: {told[index].in_a_line}"
        elif index in told:
            test.tag = "error" if measures.end.is_error else "failure"
            # Under some criteria a case fails without reaching M.
            test.kind = (measures.severity or "failed") if outcome.is_tested else measures.end
            test.message = told[index].in_a_line
        tests.append(test)
    return tests


def _tests(version_change: VersionChange, *, every: bool = False) -> list[TestCase]:
    """Return the cases of both versions that changed, or `every` case."""
    tests = []
    if version_change.passes_less:
        test = TestCase("share of cases that pass", "against", 0.0, "failure", REGRESSION)
        test.message = version_change_headline(version_change)
        tests.append(test)
    for one in version_change.cases:
        if one.change is Change.BOTH and not every:
            continue
        name = f"case {one.later.index}: {described(one.later.case)}"
        test = TestCase(name, "against", one.later.measures.t_end_s)
        if one.change.group == "worse":
            test.tag, test.kind, test.message = "failure", REGRESSION, change_in_words(one)
        elif one.change in (Change.ACCEPTED, Change.NOT_REPEATABLE):
            test.tag, test.message = "skipped", f"{one.change}: {change_in_words(one)}"
        elif one.change is Change.WEAKER:
            test.message = f"{one.change}: {change_in_words(one)}"
        tests.append(test)
    return tests
