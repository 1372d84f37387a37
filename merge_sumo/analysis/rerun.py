"""The recorded cases of a campaign again, with a changed VUT, as a comparison of both."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from merge_sumo.analysis.cases_file import CasesFile
from merge_sumo.analysis.comparison import (
    LISTED,
    PAGE,
    Change,
    ComparedCase,
    Comparison,
    Step,
    Version,
    in_order,
    of_two,
    passes_less,
)
from merge_sumo.analysis.run_study import RunStudy
from merge_sumo.campaigns.again import campaign_in, command
from merge_sumo.campaigns.repeats import Repeat, others_drive, repeat_of, unrepeatable
from merge_sumo.campaigns.run import Run
from merge_sumo.controllers.kinds import waits_for_client
from merge_sumo.errors import UserError
from merge_sumo.files import free
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.printable import counted
from merge_sumo.scenario.scenario import LEVELS, OWN, AnyLevels, level_name, names_of_levels
from merge_sumo.simulation.evaluate import evaluate, open_simulators
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import Workers, workers_or_here

AGAIN = (Change.BROKE, Change.WORSE, Change.STILL_CONTACT, Change.FIXED)
"""Changes whose cases run a second time, where a controller drives that may not repeat itself."""


def chosen(run: Run, indices: Sequence[int], level: AnyLevels = "all") -> list[Outcome]:
    """Return cases of a campaign by their indices, by default all, of some levels or of all.

    Raises `UserError` for an index without a case, and where there is no such case.

    Args:
        run: the campaign.
        indices: indices of cases; none for all.
        level: levels of the cases.
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
    plan = study.plan.for_cases(len(before))
    with workers_or_here(study.workers) as processes:
        open_simulators(plan, processes)
        # In another order than the campaign's, which a VUT that remembers would repeat.
        ran = _ran(plan, before[::-1], processes, study.on_cases)
        after = [ran[outcome.index] for outcome in before]
        earlier = replace(Version.of(run), outcomes=before, levels=levels)
        compared = of_two(earlier, earlier.with_vut(settings.vut, after), _source(study))
        (step,) = compared.steps
        if isinstance(run, CasesFile):
            judged = [replace(one, judged=run.change_of(one)) for one in step.cases]
            step = replace(step, cases=judged)
        changed = [one.b for one in step.cases if one.change in AGAIN and one.runs_b is None]
        again = _ran(plan, others_drive(changed, settings)[::-1], processes)
    step, notes = _repeated(step, ran, again)
    differing = [one for one in step.cases if one.change is not Change.BOTH]
    indices = [one.b.index for one in differing[:LISTED]]
    drivers = {"vut": settings.vut, "pov": settings.pov}
    page = command("rerun", run.folder, indices, **drivers, out=free(PAGE))
    return replace(compared, steps=(step,), notes=notes, page_command=page)


def _source(study: RunStudy) -> str:
    """Return in a sentence where the cases come from, and how to search with the version of now.

    A scenario in a file that is not here has no command.
    """
    settings, before = study.settings, study.run.settings.vut
    earlier = None if before == settings.vut or waits_for_client(before) else before
    drivers = {"vut": settings.vut, "against": earlier, "pov": settings.pov}
    some_levels = OWN not in settings.levels and settings.levels != LEVELS
    own_rule = settings.fail_when != settings.scenario.criterion
    search = campaign_in(
        settings.scenario,
        **drivers,
        level=",".join(map(str, settings.levels)) if some_levels else None,
        fail_when=settings.fail_when if own_rule else None,
    )
    return (
        f"the cases come from the search of {study.run.vut} as it was recorded, so what the "
        "version of now alone fails may lie elsewhere"
        f"{f': `{search}` searches there' if search else ''}"
    )


def _ran(
    plan: SimulationPlan,
    outcomes: Sequence[Outcome],
    workers: Workers,
    on_cases: Callable[[int], None] = lambda _: None,
) -> dict[int, Episode]:
    """Run the cases of outcomes, in their order; return what became of them by index."""
    by_index = dict[int, Episode]()
    cases = [outcome.case for outcome in outcomes]
    for old, now in zip(outcomes, evaluate(plan, cases, workers), strict=True):
        by_index[old.index] = now.at(old.index, old.batch)
        on_cases(1)
    return by_index


def _repeated(
    step: Step, ran: Mapping[int, Episode], again: Mapping[int, Episode]
) -> tuple[Step, tuple[str, ...]]:
    """Return what changed by two runs of each case that did, and sentences on what differs.

    A case whose two runs differ is not repeatable, unless the VUT reaches its goal in neither:
    chance may be what changed it. Where there are such cases, the shares of cases that pass with
    each version decide.
    """
    found, cases = list[Repeat](), list[ComparedCase]()
    for one in step.cases:
        index = one.b.index
        if index in again:
            found.append(repeat_of(ran[index].outcome, ran[index].trajectory, again[index]))
            reached = one.b.is_tested or again[index].outcome.is_tested
            if reached and not found[-1].same:
                one = replace(one, judged=Change.NOT_REPEATABLE)  # noqa: PLW2901
        cases.append(one)
    step = replace(step, cases=in_order(cases))
    notes = list(filter(None, [unrepeatable(found)]))
    if number := step.count(Change.NOT_REPEATABLE):
        sides = [one.a for one in cases], [one.b for one in cases]
        chance, less = passes_less(*sides)
        step = replace(step, chance=chance, passes_less=less)
        notes.append(
            f"Not counted one by one, as it may be chance: {counted(number, 'change')}. Draw "
            "random numbers from the seed of the case, as `reset(seen, seed)` tells it in Python, "
            "or compare campaigns of both versions with `repeat`"
        )
    return step, tuple(notes)
