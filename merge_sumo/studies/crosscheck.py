"""Whether other simulators agree with a campaign: on motion, on verdicts, on measures.

- Motion: the recorded accelerations are given to HighwayEnv's vehicles, from the recorded starts.
- Verdicts: POVs and VUT drive HighwayEnv's vehicles, and the criterion of the campaign judges them.
- Measures: CommonRoad-CriMe measures what the record says (`studies/crime.py`).

crosscheck.json         in the folder of a campaign: what agrees, and each verdict that does not

The file of a folder which somebody sent is data as everything in it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Final

import numpy as np
from msgspec import Meta
from msgspec.structs import replace as replaced

from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.campaigns.store import Run
from merge_sumo.engine.evaluate import CaseResult, evaluate, workers_or_here
from merge_sumo.engine.highway_env_simulator import HighwayEnvWorld, peer_name, why_sumo_alone
from merge_sumo.engine.plan import Engine, SimulationPlan
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.studies.crime import measured_by
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.system.folders import replace_own
from merge_sumo.system.printable import quoted
from merge_sumo.system.records import Record, read_record, to_plain
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import Case
from merge_sumo.values.scenario import DT_S, VEHICLES
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import Trajectory
from merge_sumo.vuts.output import LOG

CROSSCHECK: Final = "crosscheck.json"
AGREED: Final = 1e-6
"""Positions and speeds this near to each other, in m and m/s, are the same. Measured: 5e-12."""
CHUNK: Final = 64
"""Recorded motions that a worker takes at a time."""
STREAM: Final = 0xC0
"""Of the random numbers of fresh cases."""
Count = Annotated[int, Meta(ge=0)]
Deviation = Annotated[float, Meta(ge=0.0)]


class Motion(Record, frozen=True):
    """How far recorded motions are from those of the other simulator.

    Attributes:
        cases: recorded cases whose accelerations were given to its vehicles.
        steps: steps of all of them.
        largest_m: largest difference of a position.
        largest_mps: largest difference of a speed.
        worst_case: index of the case with the largest difference of a position; None without cases.
    """

    cases: Count
    steps: Count
    largest_m: Deviation
    largest_mps: Deviation
    worst_case: Count | None

    @property
    def in_words(self) -> str:
        """The largest differences, in a phrase."""
        speeds = f"within {self.largest_mps:.0e} m/s" if self.largest_mps else "equal"
        return f"positions within {self.largest_m:.0e} m, speeds {speeds}"


class Difference(Record, frozen=True):
    """A case with another verdict, or another end, in the other simulator.

    Attributes:
        index: of the recorded case, or of the fresh one.
        fresh: whether it is a fresh case.
        level: level of the POV.
        in_sumo: how it ended in SUMO, as "failed, MERGED".
        in_peer: how it ended in the other simulator.
        time_s: of the first step with another motion; None where one only goes on for longer.
        reason: why, in a clause.
    """

    index: Count
    fresh: bool
    level: int
    in_sumo: str
    in_peer: str
    time_s: float | None
    reason: str

    @property
    def is_explained(self) -> bool:
        """Whether the difference is not one of the simulators."""
        return self.reason != MOVES_OTHERWISE


class Verdicts(Record, frozen=True):
    """How many verdicts are the same where VUT and POV drive in the other simulator.

    Attributes:
        recorded: cases of the campaign that ran there.
        fresh: uniform cases that ran in both simulators.
        failures: those among both that fail in SUMO.
        largest_m: largest difference of a position in cases whose motion is the same.
        other_motion: cases with the same verdict in which a driver answers otherwise at some step,
            where a rounding error decides.
        differences: the cases with another verdict or another end.
        lowest_only: whether the campaign has more cases, and those recorded have its lowest scores.
    """

    recorded: Count
    fresh: Count
    failures: Count
    largest_m: Deviation
    other_motion: Count
    differences: tuple[Difference, ...]
    lowest_only: bool = False

    @property
    def cases(self) -> int:
        """Number of cases that ran in both simulators."""
        return self.recorded + self.fresh

    @property
    def same(self) -> int:
        """Number of cases with the same verdict and end."""
        return self.cases - len(self.differences)


class MeasureCheck(Record, frozen=True):
    """How a measure compares with that of another tool.

    Attributes:
        name: our measure.
        peer_name: its name there.
        cases: cases of which the other tool was asked for it.
        same: cases in which its value is what its definition gives by our record, to its rounding.
        largest: largest difference in the others where both have a value; None where none is.
        definition: in what the definitions differ, in a clause.
    """

    name: str
    peer_name: str
    cases: Count
    same: Count
    largest: Deviation | None
    definition: str

    @property
    def sentence(self) -> str:
        """How it compares, in a sentence without its full stop."""
        apart = "" if self.largest is None else f", the others to {self.largest:.2g}"
        return (
            f"{self.name} and {self.peer_name}: {self.same} of {self.cases} as defined there"
            f"{apart} ({self.definition})"
        )


class Measured(Record, frozen=True):
    """Measures by another tool.

    Attributes:
        tool: its name and version.
        cases: recorded cases that it measured.
        measures: how each compares.
    """

    tool: str
    cases: Count
    measures: tuple[MeasureCheck, ...]


class Crosscheck(Record, frozen=True):
    """What other simulators say of a campaign.

    Attributes:
        peer: name and version of the other simulator.
        motion: of the recorded cases.
        verdicts: of VUT and POV driving there; None where they cannot.
        why_no_verdicts: why they cannot, in a clause; empty where they can.
        measured: measures by another tool; None where it was not asked.
        vut: name of the VUT.
        seed: of the fresh cases.
    """

    peer: str
    motion: Motion
    verdicts: Verdicts | None
    why_no_verdicts: str
    measured: Measured | None
    vut: str
    seed: int

    @property
    def agrees(self) -> bool:
        """Whether both simulators move vehicles alike, and each other verdict has its reason."""
        largest = max(self.motion.largest_m, self.motion.largest_mps)
        others = () if self.verdicts is None else self.verdicts.differences
        return largest <= AGREED and all(one.is_explained for one in others)


def crosscheck_of(folder: Path) -> Crosscheck | None:
    """Return what the folder of a campaign says of a crosscheck; None where it says nothing.

    Raises `UserError` for a file that is not as it was written.
    """
    return read_record(folder / CROSSCHECK, Crosscheck)


def check_crosscheck_of(run: Run, known: Crosscheck) -> None:
    """Raise `UserError` where a crosscheck is of another VUT, or of more cases, than a run."""
    if known.vut != run.vut or known.motion.cases > len(run.outcomes):
        raise UserError(
            f"{run.folder / CROSSCHECK} is of another campaign, or of cases that {run.folder} no "
            f"longer has: run `merge-sumo crosscheck {quoted(run.folder)}` again"
        )


OnCases = Callable[[int], None]
"""Told how many cases have just run in both simulators."""


def crosscheck(
    study: RunStudy, *, cases: int | None = None, seed: int = 0, crime: Path | None = None
) -> Crosscheck:
    """Let another simulator run a campaign; return what agrees, and write it into its folder.

    Args:
        study: the campaign, and how its cases run.
        cases: cases that drive there: those recorded, and fresh uniform ones where there are fewer;
            of more, those with the lowest scores. By default those recorded.
        seed: of the fresh cases.
        crime: Python of an environment with commonroad-crime, which then measures merges, too.

    Raises:
        UserError: where HighwayEnv is not installed, for numbers that make no sense, and a run
            whose net or policies are not those of today.
    """
    for name, number, least in (("cases", 1 if cases is None else cases, 1), ("seed", seed, 0)):
        if number < least:
            raise UserError(f"--{name} is {number}: it must be {least} or more")
    peer = peer_name()
    study.check_same_system()
    run = study.run
    known = run.trajectories(outcome.index for outcome in run.outcomes)
    plan = study.plan.with_log(run.folder.resolve() / LOG)
    why = why_sumo_alone(plan)
    measured = None if crime is None else _measured(crime, run, plan)
    with workers_or_here(study.workers) as processes:
        motion = motion_of(plan, known, processes)
        verdicts = None
        if why is None:
            judged = [o for o in run.outcomes if o.index in known and o.score is not None]
            recorded = judged if cases is None else _lowest(judged, cases)
            fresh = _fresh(study.settings, (cases or 0) - len(recorded), seed)
            verdicts = replaced(
                verdicts_of(plan, recorded, known, fresh, processes, study.on_cases),
                lowest_only=len(recorded) < len(judged),
            )
    found = Crosscheck(
        peer=peer,
        motion=motion,
        verdicts=verdicts,
        why_no_verdicts=why or "",
        measured=measured,
        vut=run.vut,
        seed=seed,
    )
    write_crosscheck(run.folder, found)
    return found


def _measured(crime: Path, run: Run, plan: SimulationPlan) -> Measured:
    """Return how measures by CommonRoad-CriMe compare with ours."""
    tool, compared = measured_by(crime, run, plan.road)
    checks = [
        MeasureCheck(
            name=one.definition.name,
            peer_name=one.definition.peer_name,
            cases=one.cases,
            same=one.same,
            largest=one.largest,
            definition=one.definition.says,
        )
        for one in compared
    ]
    return Measured(tool=tool, cases=max(one.cases for one in compared), measures=tuple(checks))


def write_crosscheck(folder: Path, found: Crosscheck) -> None:
    """Write a crosscheck into the folder of its campaign, in the place of an older one."""
    content = json.dumps(to_plain(found), indent=2, allow_nan=False) + "\n"
    replace_own(folder / CROSSCHECK, content.encode())


def _lowest(judged: Sequence[Outcome], cases: int) -> list[Outcome]:
    """Return at most so many outcomes, those with the lowest scores, in the order of the cases."""
    lowest = sorted(judged, key=lambda o: (o.score, o.index))[:cases]
    return sorted(lowest, key=lambda o: o.index)


def _fresh(settings: CampaignSettings, count: int, seed: int) -> list[Case]:
    """Return uniform cases, about as many at each level."""
    shares = np.array_split(np.arange(max(count, 0)), len(settings.levels))
    fresh: list[Case] = []
    for level, share in zip(settings.levels, shares, strict=True):
        dims = len(settings.scenario.dimensions(level))
        points = np.random.default_rng([seed, STREAM, level]).random((len(share), dims))
        fresh += settings.pool.cases(points, level)
    return fresh


# Recorded motions, by their accelerations.


def motion_of(plan: SimulationPlan, known: dict[int, Trajectory], workers: Workers) -> Motion:
    """Return how far recorded motions, by index, are from HighwayEnv's."""
    moved = list(known.items())
    chunks = (moved[first : first + CHUNK] for first in range(0, len(moved), CHUNK))
    largest_m = largest_mps = 0.0
    worst, steps = next(iter(known), None), 0
    with closing(workers.run_chunks(partial(_deviations, plan), chunks, _lost)) as results:
        for _, some in results:
            for index, of_case, off_m, off_mps in some:
                if off_m > largest_m:
                    worst = index
                steps += of_case
                largest_m, largest_mps = max(largest_m, off_m), max(largest_mps, off_mps)
    return Motion(
        cases=len(known),
        steps=steps,
        largest_m=largest_m,
        largest_mps=largest_mps,
        worst_case=worst,
    )


Moved = tuple[int, Trajectory]
"""The index of a case, and its recorded motion."""


def _lost(moved: Moved) -> tuple[int, int, float, float]:
    raise UserError(f"HighwayEnv ends the process in which it moves case {moved[0]}")


def _deviations(
    plan: SimulationPlan, moved: Sequence[Moved]
) -> list[tuple[int, int, float, float]]:
    """Return (index, steps, largest difference in m, in m/s) of motions by HighwayEnv."""
    world = HighwayEnvWorld(len(moved), plan.road, plan.scenario)
    motions = [trajectory.motion for _, trajectory in moved]
    for corridor, motion in enumerate(motions):
        world.place(corridor, motion[0, :, :2].tolist())
    off = np.zeros((len(moved), 2))
    for step in range(1, max(map(len, motions))):
        a_mps2 = np.zeros_like(world.x_m)
        running = [k for k, motion in enumerate(motions) if step < len(motion)]
        for k in running:
            a_mps2[:, k] = motions[k][step - 1, :, 2]
        world.command(a_mps2)
        for k in running:
            recorded = motions[k][step]
            off_m = np.abs(world.x_m[:, k] - recorded[:, 0]).max()
            off_mps = np.abs(world.v_mps[:, k] - recorded[:, 1]).max()
            off[k] = np.maximum(off[k], (off_m, off_mps))
            if step == len(motions[k]) - 1:
                world.park(k)
    return [
        (index, len(trajectory.motion) - 1, off_m, off_mps)
        for (index, trajectory), (off_m, off_mps) in zip(moved, off.tolist(), strict=True)
    ]


# Verdicts, where POVs and VUT drive there.


def verdicts_of(
    plan: SimulationPlan,
    recorded: Sequence[Outcome],
    known: dict[int, Trajectory],
    fresh: Sequence[Case],
    workers: Workers,
    on_cases: OnCases,
) -> Verdicts:
    """Return how the verdicts of both simulators compare, on recorded cases and on fresh ones.

    Args:
        plan: how cases run in SUMO.
        recorded: outcomes of cases that ran in SUMO.
        known: their motions by index.
        fresh: cases that run in both.
        workers: where they run.
        on_cases: told how many cases have just run.
    """
    there = replace(plan, engine=Engine.HIGHWAY_ENV)
    in_sumo: dict[int, CaseResult] = dict(evaluate(plan, fresh, workers)) if fresh else {}
    places = [(o.index, False, o, known[o.index]) for o in recorded]
    places += [
        (place, True, in_sumo[place].outcome(place), in_sumo[place].trajectory)
        for place in range(len(fresh))
    ]
    compared: list[Difference | float | None] = [None] * len(places)
    for place, peer in evaluate(there, [sumo.case for _, _, sumo, _ in places], workers):
        index, is_fresh, sumo, trajectory = places[place]
        compared[place] = _compared(plan, index, is_fresh, sumo, trajectory, peer)
        on_cases(1)
    offs_m = [one for one in compared if isinstance(one, float)]
    return Verdicts(
        recorded=len(recorded),
        fresh=len(fresh),
        failures=sum(sumo.failed for _, _, sumo, _ in places),
        largest_m=max((off_m for off_m in offs_m if off_m <= AGREED), default=0.0),
        other_motion=sum(off_m > AGREED for off_m in offs_m),
        differences=tuple(one for one in compared if isinstance(one, Difference)),
    )


def _compared(
    plan: SimulationPlan,
    index: int,
    is_fresh: bool,
    sumo: Outcome,
    trajectory: Trajectory,
    peer: CaseResult,
) -> Difference | float:
    """Return how a case differs; the largest difference of a position where verdicts agree."""
    other = peer.outcome(index)
    ends = sumo.measures.end, other.measures.end
    rows = min(len(trajectory.motion), len(peer.trajectory.motion))
    apart = np.abs(trajectory.motion[:rows] - peer.trajectory.motion[:rows])
    if ends[0] == ends[1] and sumo.failed == other.failed:
        same_rows = len(trajectory.motion) == len(peer.trajectory.motion)
        return float(apart[..., 0].max()) if same_rows else np.inf
    differs = np.flatnonzero((apart[..., :2] > AGREED).any(axis=(1, 2))).tolist()
    step = differs[0] if differs else None
    return Difference(
        index=index,
        fresh=is_fresh,
        level=sumo.case.level,
        in_sumo=_ended(sumo),
        in_peer=_ended(other),
        time_s=None if step is None else round(step * DT_S, 1),
        reason=_reason(plan, trajectory, peer.trajectory, apart, step),
    )


def _ended(outcome: Outcome) -> str:
    return f"{'failed' if outcome.failed else 'passed'}, {outcome.measures.end}"


MOVES_OTHERWISE: Final = "its vehicles move otherwise"
"""The reason that is a difference of the simulators."""


def _reason(
    plan: SimulationPlan,
    sumo: Trajectory,
    peer: Trajectory,
    apart: np.ndarray[tuple[int, int, int], np.dtype[np.float64]],
    step: int | None,
) -> str:
    """Return why a verdict is another one, in a clause.

    `apart` are the differences of both motions, (T, A, 3), and `step` is the first at which a
    position or a speed differs.
    """
    if peer.error is not None and peer.error != sumo.error:
        return f"there it is {peer.end}: {peer.error}"
    if step is None:
        lines = centre_lines(plan.road)
        if any(plan.criterion.is_close_call(one, AGREED, lines) for one in (sumo, peer)):
            return "a rounding error decides: the case is at the limit of the criterion"
        return "a rounding error decides in which step it ends"
    answers = np.flatnonzero(apart[step - 1, :, 2] > AGREED / DT_S).tolist() if step else []
    if not answers:
        return MOVES_OTHERWISE
    names = " and ".join(VEHICLES[row].upper() for row in answers)
    return f"the {names} answers otherwise to a state that is the same but for rounding"
