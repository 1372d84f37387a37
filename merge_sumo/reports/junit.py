"""A campaign as JUnit XML, which CI systems read: Jenkins, GitLab, GitHub actions and others.

A case is a test case in the suite of its POV level; other suites have the gates, and the cases that
two versions ran.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from lxml import etree

from merge_sumo.analysis.comparison import GOT_WORSE, Change, Comparison, Step, compare_against
from merge_sumo.analysis.counterfactuals import causes
from merge_sumo.campaigns.run import NAME_CHARACTERS, Run
from merge_sumo.errors import UserError
from merge_sumo.files import check_new, write_new
from merge_sumo.metrics.summary import GateResult, Verdict, by_case, undecided
from merge_sumo.printable import printable
from merge_sumo.reports.facts import Fact, by_level
from merge_sumo.reports.text import change_in_words, step_headline
from merge_sumo.scenario.case import described
from merge_sumo.scenario.scenario import level_name

JUNIT = (".xml",)
"""Endings of the name of such a file."""
REGRESSION = "regression"
"""Type of a case that fails and passes with an earlier version."""


def check_junit(path: Path, folder: Path) -> None:
    """Raise `UserError` where a campaign in `folder` cannot write this JUnit file later."""
    if path.absolute() == folder.absolute():
        raise UserError(f"`junit` is {path}, the folder of the campaign: choose a file")
    check_new(path, "`junit`", JUNIT)


def write_junit(
    path: Path, run: Run, facts: Sequence[Fact], verdict: Verdict, gates: Sequence[GateResult]
) -> None:
    """Write the JUnit file of a campaign.

    A failure and a timeout are a `failure`, whose type is the severity; an error of the VUT or of
    the simulation is an `error`; an undecided case is `skipped`. The facts are properties. Times
    are simulated seconds up to M.

    Args:
        path: new file to write.
        run: the campaign.
        facts: its facts.
        verdict: its verdict.
        gates: results of its gates.

    Raises:
        UserError: the file exists or cannot be written.
    """
    root = etree.Element("testsuites", name=f"merge-sumo {run.vut}")
    _gates(root, facts, verdict, gates)
    compared = compare_against(run)
    if compared is not None:
        earlier = printable(str(run.settings.against)[:NAME_CHARACTERS])
        _step(root, f"against {earlier}", compared.steps[0])

    runs = {}
    for case in by_case(run.outcomes):
        if case.runs > 1:
            runs[case.deciding(run.tolerated).index] = f", {case.in_words}"
    unsure = undecided(run.outcomes, run.tolerated)
    cause_of = causes(run, [one for one in run.cases if one.failed or not one.is_tested])
    suites = {}
    for level in by_level(facts):
        suites[level] = etree.SubElement(root, "testsuite", name=f"POV level {level_name(level)}")
    for outcome in run.cases:
        index, level_of_case = outcome.index, level_name(outcome.case.level)
        name = f"case {index}: {described(outcome.case)}{runs.get(index, '')}"
        suite, time_s = suites[outcome.case.level], outcome.measures.t_end_s
        test = _test(suite, name, f"level{level_of_case}", time_s)
        if index in unsure:
            etree.SubElement(test, "skipped", message=f"undecided: {cause_of[index]}")
        elif index in cause_of:
            tag = "error" if outcome.measures.end.is_error else "failure"
            # A criterion may call a case a failure in which the VUT never reached M.
            kind = outcome.measures.severity or "failed"
            if not outcome.is_tested:
                kind = outcome.measures.end
            _wrong(test, tag, kind, cause_of[index])
    _write(path, root)


def write_junit_of_comparison(path: Path, compared: Comparison) -> None:
    """Write the JUnit file of a comparison; `UserError` when it exists or cannot be written."""
    root = etree.Element("testsuites", name="merge-sumo compare")
    for step in compared.steps:
        before, after = compared.versions[step.before - 1], compared.versions[step.after - 1]
        name = printable(f"{before.folder} to {after.folder or after.vut}")
        _step(root, name, step, every=compared.text is not None)
    _write(path, root)


def _write(path: Path, root: etree._Element) -> None:
    """Count the test cases of all suites, and write them."""
    for part in (*root.findall("testsuite"), root):
        tests = list(part.iter("testcase"))
        part.set("tests", str(len(tests)))
        if part is not root and (skipped := len(list(part.iter("skipped")))):
            part.set("skipped", str(skipped))
        part.set("failures", str(len(list(part.iter("failure")))))
        part.set("errors", str(len(list(part.iter("error")))))
        part.set("time", f"{sum(float(test.get('time', '0')) for test in tests):.1f}")
    text = etree.tostring(root, xml_declaration=True, encoding="UTF-8", pretty_print=True)
    write_new(path, text, "`junit`")


def _gates(
    root: etree._Element, facts: Sequence[Fact], verdict: Verdict, gates: Sequence[GateResult]
) -> None:
    suite = etree.SubElement(root, "testsuite", name="gates")
    properties = etree.SubElement(suite, "properties")
    for fact in facts:
        level = "" if fact.level is None else f"level {level_name(fact.level)}: "
        etree.SubElement(properties, "property", name=f"{level}{fact.name}", value=fact.shown)
    tested = _test(suite, f"the VUT reaches {verdict.goal}", "gates")
    if not verdict.tested:
        _wrong(tested, "failure", "NOTHING_TESTED", verdict.nothing_tested)
    for gate in gates:
        test = _test(suite, gate.name, "gates")
        if gate.met:
            _wrong(test, "failure", "GATE", gate.sentence)


def _step(root: etree._Element, name: str, step: Step, *, every: bool = False) -> None:
    """Add a suite of the cases that changed, or of all that two versions ran."""
    suite = etree.SubElement(root, "testsuite", name=name)
    if step.passes_less:
        test = _test(suite, "share of cases that pass", "against")
        _wrong(test, "failure", REGRESSION, step_headline(step))
    for one in step.cases:
        if one.change is Change.BOTH and not every:
            continue
        case = f"case {one.b.index}: {described(one.b.case)}"
        test = _test(suite, case, "against", one.b.measures.t_end_s)
        if one.change in GOT_WORSE:
            _wrong(test, "failure", REGRESSION, change_in_words(one))
        elif one.change in (Change.ACCEPTED, Change.NOT_REPEATABLE):
            etree.SubElement(test, "skipped", message=f"{one.change}: {change_in_words(one)}")


def _test(suite: etree._Element, name: str, group: str, time_s: float = 0.0) -> etree._Element:
    return etree.SubElement(
        suite, "testcase", name=name, classname=f"merge-sumo.{group}", time=f"{time_s:.1f}"
    )


def _wrong(test: etree._Element, tag: str, kind: str, message: str) -> None:
    # Jenkins shows the message, GitLab the text.
    etree.SubElement(test, tag, type=kind, message=message).text = message
