"""Recorded cases of a campaign run again with a changed VUT, and are compared with the record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from merge_sumo.analysis.cases_file import CasesFile
from merge_sumo.analysis.comparison import (
    Change,
    ComparedCase,
    Comparison,
    Version,
    in_order,
    of_two,
    with_shares,
)
from merge_sumo.analysis.run_study import RunStudy
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.repeatability import (
    SecondRun,
    may_not_repeat,
    second_run_of,
    unrepeatable,
)
from merge_sumo.errors import UserError
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.printable import counted
from merge_sumo.scenario.scenario import AnyLevels, level_name, names_of_levels
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.simulation.evaluate import open_simulators, with_measures

AGAIN = (Change.BROKE, Change.WORSE, Change.WEAKER, Change.STILL_CONTACT, Change.FIXED)
"""Changes of which the case runs once more, where its controller may not repeat itself."""


def chosen(
    run: RecordedCampaign, indices: Sequence[int], level: AnyLevels = "all"
) -> list[Outcome]:
    """Return cases of a campaign by their indices and levels.

    Args:
        run: the campaign.
        indices: indices of cases; none for all.
        level: levels of the cases, as a user names them.

    Returns:
        The outcomes, in the order of the indices.

    Raises:
        UserError: for an index or a level without a case, and where no case is left.
    """
    outcomes = [run.outcome(index) for index in dict.fromkeys(indices)] or run.outcomes
    recorded, names = tuple(map(level_name, run.levels)), names_of_levels(level)
    if names == ("all",):
        names = recorded
    for name in names:
        if name not in recorded:
            raise UserError(
                f"{run.folder} has no cases at level {name!r}: it has {', '.join(recorded)}, or all"
            )
    found = [outcome for outcome in outcomes if level_name(outcome.case.level) in names]
    if not found:
        raise UserError(f"{run.folder} has none of these cases at this level: choose others")
    return found


def rerun(study: RunStudy, recorded: Sequence[Outcome]) -> Comparison:
    """Run cases of a campaign again, and compare them with the record.

    A case that changed runs once more where its controller may not repeat itself.

    Args:
        study: the campaign, and how its cases run now.
        recorded: outcomes of the campaign, whose cases run.

    Returns:
        The comparison; its earlier version is the record.

    Raises:
        UserError: where the net or the POV are not those of the campaign.
    """
    run, settings = study.run, study.settings
    study.check_same_system(may_change=True)
    study = replace(study, plan=study.plan.for_cases(len(recorded)))
    open_simulators(study.plan, study.workers)
    episodes = _episodes(study, recorded)
    outcomes, motions = [], {}
    for outcome in recorded:
        outcomes.append(episodes[outcome.index].outcome)
        motions[outcome.index] = episodes[outcome.index].trajectory
    earlier = replace(Version.of(run), outcomes=recorded)
    later = replace(earlier, vut=settings.vut, folder=None, outcomes=outcomes, motion=motions.get)
    source = (
        f"the cases come from the search with {run.vut}; to search for cases that only the new "
        "version fails, run a campaign with `against`"
    )
    compared = of_two(earlier, later, source)
    (version_change,) = compared.version_changes
    cases = version_change.cases
    if isinstance(run, CasesFile):
        cases = [replace(one, change=run.change_of(one)) for one in cases]
    cases, second_runs = _repeated(study, cases, motions)
    version_change = replace(version_change, cases=in_order(cases))
    notes = []
    if warning := unrepeatable(second_runs):
        notes.append(warning)
    if number := version_change.count(Change.NOT_REPEATABLE):
        version_change = with_shares(version_change, recorded, outcomes)
        notes.append(
            f"{counted(number, 'change')} may be chance and did not count. Draw random numbers "
            "from the seed of the case (in Python: `reset(seen, seed)`), or compare campaigns of "
            "both versions with `repeat`"
        )
    return replace(compared, version_changes=(version_change,), notes=tuple(notes))


def _repeated(
    study: RunStudy, cases: Sequence[ComparedCase], motions: Mapping[int, Trajectory]
) -> tuple[list[ComparedCase], list[SecondRun]]:
    """Run changed cases once more; return all cases, and how the second runs compare."""
    changed = [one.later for one in cases if one.change in AGAIN and one.later_runs is None]
    uncounted = RunStudy(study.run, study.settings, study.plan, study.workers)
    episodes = _episodes(uncounted, may_not_repeat(changed, study.settings))
    judged, second_runs = [], []
    for one in cases:
        change, later = one.change, one.later
        second = episodes.get(later.index)
        if second is not None:
            second_runs.append(second_run_of(later, motions[later.index], second))
            # Where the VUT reaches its goal neither time, the change is not chance.
            if not second_runs[-1].same and (later.is_tested or second.outcome.is_tested):
                change = Change.NOT_REPEATABLE
        judged.append(replace(one, change=change))
    return judged, second_runs


def _episodes(study: RunStudy, outcomes: Sequence[Outcome]) -> dict[int, Episode]:
    """Run the cases of outcomes again; return their episodes by index."""
    # In another order than that of the campaign, which a VUT with a memory would repeat.
    backwards = outcomes[::-1]
    cases = [outcome.case for outcome in backwards]
    episodes = {}
    for outcome, episode in zip(
        backwards, study.simulate(study.plan, cases, with_measures), strict=True
    ):
        episodes[outcome.index] = episode.at(outcome.index, outcome.batch)
    return episodes
