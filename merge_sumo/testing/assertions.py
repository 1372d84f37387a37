"""Assertions on a controller: a campaign that raises `AssertionError` for a failure."""

from __future__ import annotations

from merge_sumo import api
from merge_sumo.api import verb
from merge_sumo.campaign_run import CampaignRun
from merge_sumo.campaigns.printed_commands import campaign_command, command
from merge_sumo.campaigns.recorded import failures
from merge_sumo.config import NoFailures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.printable import printable
from merge_sumo.reports.text import timelines


@verb(NoFailures)
def assert_no_failures(config: NoFailures) -> CampaignRun:
    """Test a VUT in a campaign, and raise where a case fails or ends in an error."""
    __tracebackhide__ = True
    run = api.campaign(**{**vars(config), "progress": False})
    message = _message(run, config.seed)
    if message is not None:
        raise AssertionError(message)
    return run


def _message(run: CampaignRun, seed: int) -> str | None:
    """Return the message of an assertion; None for a campaign without failures and errors."""
    outcomes = run.recorded.cases
    failed = failures(outcomes)
    wrong = [*failed, *(outcome for outcome in outcomes if outcome.measures.end.is_error)]
    if run.summary.tested and not wrong:
        return None
    lines = [f"{run.recorded.vut}: {run.summary.counts}, with seed {seed}"]
    lines.append(
        f"  failure criterion: {run.recorded.criterion.description(run.recorded.scenario)}"
    )
    lines += run.summary.error_lines()
    if not run.summary.tested:
        lines.append(f"  {run.summary.nothing_tested}")
    if wrong:
        lines += _worst(run, wrong[0], "worst case" if failed else "first error")
    return "\n".join(map(printable, [*lines, f"  report: {run.report_file}"]))


def _worst(run: CampaignRun, outcome: Outcome, title: str) -> list[str]:
    """Return lines on a case, and the commands that show it."""
    index, told = outcome.index, timelines(run.recorded, [outcome])[outcome.index]
    return [
        *(f"  {line}" for line in told.lines(outcome.case, f"{title}: case {index}")),
        f"    replay it: {command('replay', run.folder, index, gui=True)}",
        f"    run it again: {campaign_command('run', run.folder, run.settings, index)}",
    ]
