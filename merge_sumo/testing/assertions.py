"""Assertions on a controller: a campaign that raises `AssertionError` for a failure."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Unpack

from merge_sumo import api
from merge_sumo.analysis.coordinates import described
from merge_sumo.api.keywords import Settings
from merge_sumo.api.results import CampaignRun
from merge_sumo.campaigns.run import failures
from merge_sumo.campaigns.settings import named_again
from merge_sumo.reports.motion import verdict_of
from merge_sumo.system.printable import printable, quoted
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import Outcome
from merge_sumo.vuts.in_memory import AnyVut

DEFAULT_CASES: Final = 200
"""Cases of an assertion: seconds for a controller that answers at once."""


def assert_no_failures(
    vut: AnyVut,
    *,
    out: Path | str | None = None,
    workers: int = 1,
    **settings: Unpack[Settings],
) -> CampaignRun:
    """Test a VUT in a campaign, and raise `AssertionError` where a case fails or ends in an error.

    Args:
        vut: vehicle under test: a spec, a class, a function, or an object.
        out: new folder to write; `runs/<vut>-<date>` by default.
        workers: processes that run cases; the outcomes are the same.
        settings: as of `merge_sumo.campaign`, with 200 `cases` by default; `fail_when` says what
            counts as a failure.

    Returns:
        The campaign, where nothing fails. A timeout is no failure, unless `fail_when` says so.

    Raises:
        AssertionError: where a case fails, ends in an error, or no case reaches the merge point.
            The message names the counts, the worst case, the report, and the command that
            replays the case.
        UserError: for values that make no campaign.
    """
    __tracebackhide__ = True
    settings.setdefault("cases", DEFAULT_CASES)
    run = api.campaign(vut, out=out, workers=workers, progress=False, **settings)
    message = _message(run, settings.get("seed", 0))
    if message is not None:
        raise AssertionError(message)
    return run


def _message(run: CampaignRun, seed: int) -> str | None:
    """Return the message of an assertion; None for a campaign without failures and errors."""
    outcomes = run.run.cases
    failed = failures(outcomes)
    wrong = [*failed, *(outcome for outcome in outcomes if outcome.measures.end.is_error)]
    if run.verdict.tested and not wrong:
        return None
    lines = [f"{run.run.vut}: {run.verdict.counts}, with seed {seed}"]
    lines.append(f"  a case fails when {run.run.criterion.words}")
    lines += run.verdict.trouble_lines()
    if not run.verdict.tested:
        lines.append(f"  {run.verdict.nothing_tested}")
    if wrong:
        lines += _worst(run, wrong[0], "worst case" if failed else "first error")
    return "\n".join(map(printable, [*lines, f"  report: {run.report_file}"]))


def _worst(run: CampaignRun, outcome: Outcome, title: str) -> list[str]:
    """Return which case to look at, and how."""
    case, index = outcome.case, outcome.index
    return [
        f"  {title}: case {index}, POV level {level_name(case.level)}, {described(case)}",
        f"    {verdict_of(outcome, run.trajectory(index))}",
        f"    replay it: merge-sumo replay {quoted(run.folder)} {index} --gui",
        f"    run it again: merge-sumo run --case {quoted(run.folder)} {index}"
        f"{named_again(run.settings)}",
    ]
