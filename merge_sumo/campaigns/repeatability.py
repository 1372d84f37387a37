"""Repeatability: some cases of a campaign run a second time, and must move as the first time.

`repeats.jsonl` in the folder of the campaign has a line for each case that ran twice.
"""

# An episode must depend on its case alone. A controller that draws random numbers without the seed
# of its case, reads a clock, or keeps a state from one episode to the next violates this: its
# results depend on the number of workers, on the sampler, and on chance. `cases_for_second_runs`
# chooses the cases. The VUTs of this package need no such check. The option --repeat is another
# thing: it runs each case several times with other random numbers.

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Final

import numpy as np

from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.controllers.kinds import is_built_in, waits_for_client
from merge_sumo.files import replace_own
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.printable import counted
from merge_sumo.records import Record, read_indexed, to_json
from merge_sumo.scenario.scenario import DT_S, OWN, EpisodeTime
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.evaluate import lost_episode, simulate_part, with_measures
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import Workers

REPEATS = "repeats.jsonl"
MOST: Final = 20
"""Maximum number of cases that run twice at the end of a campaign."""
ONE_IN: Final = 8
"""One case of this number runs twice, up to the maximum."""


class SecondRun(Record, frozen=True, forbid_unknown_fields=False):
    """How the second run of a case compares with the first; older lines have more keys.

    Attributes:
        index: of the case.
        differs_from_s: time of the first step with another motion; None where all is the same.
        end: how the case ended the second time.
        failed: whether it failed the second time.
        other_verdict: whether it ended or failed otherwise than the first time.
    """

    index: int
    differs_from_s: EpisodeTime | None
    end: End
    failed: bool
    other_verdict: bool

    @property
    def same(self) -> bool:
        """Whether both times are the same."""
        return self.differs_from_s is None and not self.other_verdict


def check_repeatability(
    run: RecordedCampaign, settings: CampaignSettings, plan: SimulationPlan, workers: Workers
) -> None:
    """Run some cases of a campaign again, and write the comparison to `repeats.jsonl`.

    Cases that end in an error now are left out.

    Args:
        run: the campaign.
        settings: its settings.
        plan: how its cases run.
        workers: where they run.
    """
    outcomes = cases_for_second_runs(run.outcomes, settings)
    if not outcomes:
        return
    second_runs = []
    cases = [outcome.case for outcome in outcomes]
    job = workers.submit(
        partial(simulate_part, plan, keep=with_measures), cases, partial(lost_episode, plan)
    )
    for outcome, episode in zip(outcomes, workers.collect(job), strict=True):
        if not episode.outcome.measures.end.is_error:  # of a slow machine, perhaps
            second_runs.append(second_run_of(outcome, run.trajectory(outcome.index), episode))
    second_runs.sort(key=lambda second: second.index)
    replace_own(run.folder / REPEATS, b"".join(map(to_json, second_runs)), b'"index"')


def cases_for_second_runs(outcomes: Sequence[Outcome], settings: CampaignSettings) -> list[Outcome]:
    """Return the outcomes of the cases that are to run again, in that order.

    Half are spread over the campaign, and run first. The other half are the first cases of the
    campaign, which a new controller ran; they run last. Both are in reverse order. Errors are left
    out: a slow machine may have caused them.

    Args:
        outcomes: all outcomes of the campaign.
        settings: its settings.
    """
    candidates = may_not_repeat(outcomes, settings)
    tested = [outcome for outcome in candidates if not outcome.measures.end.is_error]
    count = min(MOST, -(-len(tested) // ONE_IN))
    first = (count + 1) // 2
    others = np.linspace(len(tested) - 1, first, count - first).astype(np.int64).tolist()
    return [tested[place] for place in (*others, *reversed(range(first)))]


def may_not_repeat(outcomes: Iterable[Outcome], settings: CampaignSettings) -> list[Outcome]:
    """Return the outcomes of the cases in which something drives that may not repeat itself.

    A TraCI client that a user starts has none: it may have ended.

    Args:
        outcomes: outcomes of a campaign.
        settings: its settings.
    """
    if waits_for_client(settings.vut):
        return []
    own_vut = not is_built_in(settings.vut)
    own_pov = settings.pov is not None and not is_built_in(settings.pov)
    return [one for one in outcomes if own_vut or (own_pov and one.case.level == OWN)]


def second_run_of(outcome: Outcome, trajectory: Trajectory, second: Episode) -> SecondRun:
    """Return how the second run of a case compares with the first one.

    Args:
        outcome: outcome of the first run.
        trajectory: trajectory of the first run.
        second: the second run.
    """
    differs_from_s = difference(trajectory, second.trajectory)
    end, failed = second.outcome.measures.end, second.outcome.failed
    other_verdict = (end, failed) != (outcome.measures.end, outcome.failed)
    return SecondRun(outcome.index, differs_from_s, end, failed, other_verdict)


def difference(one: Trajectory, other: Trajectory) -> float | None:
    """Compare the motions of two runs of a case.

    Args:
        one: a run.
        other: another run.

    Returns:
        The time in s from which they differ; None where they do not.
    """
    rows = min(len(one.whole), len(other.whole))
    first, second = one.whole[:rows].copy(), other.whole[:rows].copy()
    first[-1, :, 2] = second[-1, :, 2] = 0.0  # a last acceleration is 0 by definition
    differs = (first != second).any(axis=(1, 2))
    if not differs.any() and len(one.whole) == len(other.whole):
        return None
    step = int(differs.argmax()) if differs.any() else rows - 1
    return round(step * DT_S, 1)


def read_second_runs(run: RecordedCampaign) -> list[SecondRun]:
    """Read the comparisons of a campaign.

    Args:
        run: the campaign.

    Raises:
        UserError: a line is not as it was written.
    """
    return read_indexed(run.folder / REPEATS, SecondRun, range(len(run.outcomes)))


def unrepeatable(second_runs: Sequence[SecondRun]) -> str | None:
    """Return a sentence on the cases that did not repeat; None where each did.

    Args:
        second_runs: all cases that ran twice.
    """
    differing = [second for second in second_runs if not second.same]
    if not differing:
        return None
    verdicts = [second for second in differing if second.other_verdict]
    example = (verdicts or differing)[0]
    since = "" if example.differs_from_s is None else f" from {example.differs_from_s:g} s on"
    return (
        f"Not repeatable: {counted(len(second_runs), 'case')} ran twice, and {len(differing)} of "
        f"them went differently the second time, {len(verdicts) or 'none'} with another verdict "
        f"(case {example.index}{since}). The controller draws random numbers, reads a clock, or "
        "keeps values from earlier episodes. Its results may change with the order of the cases "
        "and the number of workers."
    )
