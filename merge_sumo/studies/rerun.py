"""The recorded cases of a campaign again, with a changed VUT, as a comparison of both."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from merge_sumo.campaigns.run import Run
from merge_sumo.engine.evaluate import evaluate, open_simulators, workers_or_here
from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import AnyLevels, level_name, names_of_levels
from merge_sumo.studies.comparison import LISTED, OUT, Change, Comparison, of_two
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.studies.version import Version
from merge_sumo.system.printable import quoted
from merge_sumo.verdict.episode import Episode
from merge_sumo.verdict.score import Outcome


def chosen(run: Run, indices: Sequence[int], level: AnyLevels = "all") -> list[Outcome]:
    """Return cases of a campaign by their indices, by default all, of some levels or of all.

    Raises `UserError` for an index without a case, and where there is no such case.
    """
    found = [run.outcome(index) for index in dict.fromkeys(indices)] or run.outcomes
    asked, there = names_of_levels(level), tuple(map(level_name, run.levels))
    names = there if asked == ("all",) else asked
    for name in (name for name in names if name not in there):
        raise UserError(
            f"{run.folder} has no cases at level {name!r}: it has {', '.join(there)}, or all"
        )
    found = [one for one in found if level_name(one.case.level) in names]
    if not found:
        raise UserError(f"{run.folder} has none of these cases: name others, or another level")
    return found


def rerun(study: RunStudy, before: Sequence[Outcome]) -> Comparison:
    """Run cases of a campaign again, with the settings of the study and their plan.

    Raises `UserError` where net or POV are not the campaign's: then not only the VUT would have
    changed.
    """
    run, settings = study.run, study.settings
    levels = sorted({outcome.case.level for outcome in before})
    study.check_same_system(levels, may_change=True)
    # In another order than the campaign's, which a VUT that remembers would repeat.
    order, by_index = before[::-1], dict[int, Episode]()
    plan = study.plan.for_cases(len(before))
    with workers_or_here(study.workers) as processes:
        open_simulators(plan, processes)
        for place, now in evaluate(plan, [outcome.case for outcome in order], processes):
            old = order[place]
            by_index[old.index] = now.at(old.index, old.batch)
            study.on_cases(1)
    after = [by_index[outcome.index] for outcome in before]
    search = f"merge-sumo campaign --vut {quoted(settings.vut)}"
    if settings.vut != run.vut:
        search += f" --against {quoted(run.vut)}"
    source = (
        f"the cases come from the search of {run.vut} as it was recorded, so what the version of "
        f"now alone fails may lie elsewhere: `{search}` searches there"
    )
    earlier = replace(Version.of(run), outcomes=before, levels=levels)
    compared = of_two(earlier, earlier.with_vut(settings.vut, after), source)
    differing = [one for one in compared.steps[0].cases if one.change is not Change.BOTH]
    indices = " ".join(str(one.b.index) for one in differing[:LISTED])
    again = f"merge-sumo rerun {quoted(run.folder)} {indices} --vut {quoted(settings.vut)}"
    if settings.pov is not None:
        again += f" --pov {quoted(settings.pov)}"
    return replace(compared, page_command=again + OUT)
