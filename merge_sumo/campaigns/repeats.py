"""Repeatability: some cases of a campaign run a second time, and must move as the first time.

`repeats.jsonl` in the folder of the campaign has a line for each case that ran twice.
"""

# An episode must depend on its case alone. A controller that draws random numbers, reads a clock,
# or keeps a state from one episode to the next violates this: its results depend on the number of
# workers, on the sampler, and on chance. The first cases run again, which a new controller ran, and
# others, in reverse order. The VUTs of this package need no such check.
#
# A campaign with `--repeat` expects chance, but no state between episodes: cases that differ run
# twice more, each time with new controllers.

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np

from merge_sumo.campaigns.run import Run
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.controllers.kinds import is_built_in, waits_for_client
from merge_sumo.files import replace_own
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.records import Record, read_indexed, replaced, to_json
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, OWN, VEHICLES, EpisodeTime, Vehicle
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.evaluate import close_simulator, simulate, submit_cases
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import Workers

REPEATS = "repeats.jsonl"
MOST: Final = 20
"""Maximum number of cases that run twice at the end of a campaign."""
ONE_IN: Final = 8
"""One case of this number runs twice, up to the maximum."""


class Repeat(Record, frozen=True, omit_defaults=True):
    """A case that ran a second time.

    Attributes:
        index: of the case.
        differs_from_s: time of the first step with another motion; None where all is the same.
        first: the vehicle that differs first; None where none does, or not one alone.
        end: how the case ended the second time.
        failed: whether it failed the second time.
        other_verdict: whether it ended or failed otherwise than the first time.
        drawn: whether it differs by chance, and not by what ran before it: it differs in two new
            processes that run the same cases. None where that was not looked for.
    """

    index: int
    differs_from_s: EpisodeTime | None
    first: Vehicle | None
    end: End
    failed: bool
    other_verdict: bool
    drawn: bool | None = None

    @property
    def same(self) -> bool:
        """Whether both times are the same."""
        return self.differs_from_s is None and not self.other_verdict


def repeat(
    run: Run, settings: CampaignSettings, plan: SimulationPlan, workers: Workers
) -> list[Repeat]:
    """Run some cases of a campaign again, and write the comparison to `repeats.jsonl`.

    Cases whose trajectory is lost, and cases that end in an error now, are left out.

    Args:
        run: the campaign.
        settings: its settings.
        plan: how its cases run.
        workers: where they run.

    Returns:
        A comparison for each case, by index.
    """
    chosen = chosen_again(run.outcomes, settings)
    recorded = run.trajectories(outcome.index for outcome in chosen)
    again = [outcome for outcome in chosen if outcome.index in recorded]
    if not again:
        return []
    cases, found = [outcome.case for outcome in again], []
    job = submit_cases(plan, cases, workers)
    for outcome, ran in zip(again, workers.collect(job), strict=True):
        if not ran.outcome.measures.end.is_error:  # of a slow machine, perhaps
            found.append(repeat_of(outcome, recorded[outcome.index], ran))
    if settings.repeat != 1 and not all(one.same for one in found):
        first, second = (_simulated_again(plan, cases) for _ in range(2))
        drawn = {}
        for outcome, one, other in zip(again, first, second, strict=True):
            difference = _difference(one.trajectory, other.trajectory)
            drawn[outcome.index] = difference != (None, None)
        found = [one if one.same else replaced(one, drawn=drawn[one.index]) for one in found]
    found.sort(key=lambda one: one.index)
    replace_own(run.folder / REPEATS, b"".join(map(to_json, found)), b'"index"')
    return found


def _simulated_again(plan: SimulationPlan, cases: Sequence[Case]) -> list[Episode]:
    """Run cases in this process, with drivers that drove nothing before."""
    close_simulator()
    try:
        return simulate(plan, cases)
    finally:
        close_simulator()


def chosen_again(outcomes: Sequence[Outcome], settings: CampaignSettings) -> list[Outcome]:
    """Return the outcomes of the cases that are to run again, in that order.

    Only those of `others_drive`. Half are the first cases, which a new controller ran; the others
    are spread over the campaign, and run before those. Errors may be a slow machine's doing, and
    are left out.
    """
    tested = [
        outcome for outcome in others_drive(outcomes, settings) if not outcome.measures.end.is_error
    ]
    count = min(MOST, -(-len(tested) // ONE_IN))
    first = (count + 1) // 2
    others = np.linspace(len(tested) - 1, first, count - first).astype(np.int64).tolist()
    return [tested[place] for place in (*others, *reversed(range(first)))]


def others_drive(outcomes: Iterable[Outcome], settings: CampaignSettings) -> list[Outcome]:
    """Return the outcomes of the cases in which something drives that may not repeat itself.

    A TraCI client that a user starts has none: it may have ended.
    """
    if waits_for_client(settings.vut):
        return []
    own_vut = not is_built_in(settings.vut)
    own_pov = settings.pov is not None and not is_built_in(settings.pov)
    return [one for one in outcomes if own_vut or (own_pov and one.case.level == OWN)]


def repeat_of(outcome: Outcome, recorded: Trajectory, ran: Episode) -> Repeat:
    """Return how the second run of a case compares with the first one.

    Args:
        outcome: outcome of the first run.
        recorded: trajectory of the first run.
        ran: the second run.
    """
    differs_from_s, first = _difference(recorded, ran.trajectory)
    now = ran.outcome
    end = now.measures.end
    other = (end, now.failed) != (outcome.measures.end, outcome.failed)
    return Repeat(outcome.index, differs_from_s, first, end, now.failed, other)


def _difference(one: Trajectory, other: Trajectory) -> tuple[float | None, Vehicle | None]:
    """Return from when on two motions differ, and which vehicle differs first."""
    wholes = one.whole, other.whole
    rows = min(map(len, wholes))
    pairs = [whole[:rows].copy() for whole in wholes]
    for pair in pairs:
        pair[-1, :, 2] = 0.0  # a last acceleration is 0 by definition
    differs = pairs[0] != pairs[1]
    steps = np.flatnonzero(differs.any(axis=(1, 2)))
    if not steps.size:
        same = len(wholes[0]) == len(wholes[1])
        return (None, None) if same else (round((rows - 1) * DT_S, 1), None)
    step = int(steps[0])
    # The acceleration of a step is the answer to its state, which was the same.
    vehicles = np.flatnonzero(differs[step, :, 2]).tolist()
    return round(step * DT_S, 1), VEHICLES[vehicles[0]] if len(vehicles) == 1 else None


def read_repeats(run: Run) -> list[Repeat]:
    """Return what a folder says of cases that ran twice; `UserError` for a wrong line."""
    return read_indexed(run.folder / REPEATS, Repeat, range(len(run.outcomes)))


def unrepeatable(found: Iterable[Repeat]) -> str | None:
    """Return how many cases did not repeat, and what that means; None where each did."""
    known = list(found)
    differing = [one for one in known if not (one.same or one.drawn)]
    if not differing:
        return None
    verdicts = sum(one.other_verdict for one in differing)
    example = next((one for one in differing if one.other_verdict), differing[0])
    who = "VUT or the POV"
    for vehicle in ("vut", "pov"):
        if all(one.first == vehicle for one in differing):
            who = vehicle.upper()
    since = "" if example.differs_from_s is None else f" from {example.differs_from_s:g} s on"
    why = cause(who)
    if all(one.drawn is False for one in differing):
        why = f"The {who} keeps something from earlier episodes"
    cases = "case that ran" if len(known) == 1 else "cases that ran"
    return (
        f"Not repeatable: {len(differing)} of {len(known)} {cases} twice went differently the "
        f"second time, {verdicts or 'none'} of them with another verdict (case {example.index}"
        f"{since}). {why}: a result depends on more than its case, and "
        "other workers or another order may give others."
    )


def cause(who: str = "VUT") -> str:
    """Return in a clause why a case may go differently when it runs again."""
    return (
        f"Either the {who} draws random numbers or reads a clock, or it keeps something from "
        "earlier episodes"
    )
