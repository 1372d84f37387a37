"""Who would have avoided a failure: reference drivers in the very same case.

Every failure of a campaign is driven again, in SUMO, without the VUT and without running any code
of it:

- by each reference driver in the VUT's place, from the start;
- by a careful driver who takes over: until some time the VUT does what it did, by its recorded
  accelerations, and from then on the driver is at the wheel, who has to perceive and react first.
  That is tried every half second, and after the last success every step;
- with a careful driver on the mainline in the POV's place, against what the VUT did.

avoidance.jsonl         in the folder of the campaign: one line per failure, in the order of cases;
                        of very many, the worst

That of a folder which somebody sent is data as everything in it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.campaigns.ground import MAX_CORRIDORS, world_to_itself
from merge_sumo.campaigns.rollout import rollout
from merge_sumo.campaigns.run import Run, failures
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.pov import PovLibrary
from merge_sumo.drivers.povs import Povs
from merge_sumo.drivers.reference import REFERENCES, CarefulPov
from merge_sumo.errors import UserError
from merge_sumo.sumo.centre_lines import centre_lines
from merge_sumo.sumo.corridor import Corridor
from merge_sumo.sumo.world import World
from merge_sumo.system.arrays import regular
from merge_sumo.system.folders import replace_own
from merge_sumo.values.bodies import CentreLines
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.scenario import DT_S, MAX_EPISODE_S
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import Trajectory

AVOIDANCE: Final = "avoidance.jsonl"
CAREFUL: Final = "careful"
"""The reference driver that takes over, and that the headline counts."""
MOST: Final = 500
"""Failures that are driven again, the worst: each takes some thirty episodes."""
EVERY_STEPS: Final = 5
"""A take-over is tried every half second first."""


@dataclass(frozen=True, slots=True)
class Avoidance:
    """Who would have avoided a failure.

    Attributes:
        index: of the case in its campaign.
        avoided_by: names of the reference drivers that pass the case in the VUT's place.
        careful_until_s: the last time at which a careful driver who takes over still passes it;
            None where that is too late from the start.
        pov_careful: whether a careful driver on the mainline would have avoided it against what
            the VUT did.
    """

    index: int
    avoided_by: tuple[str, ...]
    careful_until_s: float | None
    pov_careful: bool

    @property
    def by_careful(self) -> bool:
        """Whether a careful and competent driver avoids it in the VUT's place."""
        return CAREFUL in self.avoided_by


@dataclass(frozen=True, kw_only=True, slots=True)
class _Again(Case):
    """A case that is driven again.

    Attributes:
        by: reference driver in the VUT's place.
        recorded: accelerations of the VUT in the failure, (T,).
        until: steps for which the VUT does what it did.
        careful_pov: whether a careful driver is in the POV's place.
    """

    by: str = CAREFUL
    recorded: FloatArray = field(compare=False, repr=False)
    until: int = 0
    careful_pov: bool = False


def avoidance(run: Run, settings: CampaignSettings, net: Corridor) -> list[Avoidance]:
    """Return who would have avoided each failure of a campaign, in the order of its cases.

    Of more than `MOST` failures, of the worst ones. Failures whose trajectory is lost are left out.
    The POVs are those of `settings`; a POV of the tester's own runs again.
    """
    found = sorted(failures(run.outcomes)[:MOST], key=lambda outcome: outcome.index)
    motion = {o.index: kept for o in found if (kept := _trajectory(run, o)) is not None}
    failing = [outcome for outcome in found if outcome.index in motion]
    if not failing:
        return []
    corridors = settings.povs.corridors(MAX_CORRIDORS, settings.scenario.vehicles - 1)
    own = settings.povs.own
    car_type = None if own is None else own.vut.vut_type
    with ExitStack() as opened:
        opened.enter_context(world_to_itself())
        world = World(corridors, net, None, settings.scenario, car_type)
        opened.callback(world.close)
        povs = _Mainline(corridors * (world.vehicles - 1), settings.povs, world)
        opened.callback(povs.close)
        return _avoidance(run, failing, motion, world, povs)


def _trajectory(run: Run, outcome: Outcome) -> Trajectory | None:
    try:
        return run.trajectory(outcome.index)
    except UserError:
        return None


def _avoidance(
    run: Run,
    failing: Sequence[Outcome],
    motion: Mapping[int, Trajectory],
    world: World,
    povs: Driver,
) -> list[Avoidance]:
    rows = max(len(kept.motion) for kept in motion.values())
    substitutes, lines = _Substitutes(world.corridors, rows), centre_lines(world.road)

    def pass_again(asked: Sequence[tuple[int, dict[str, Any]]]) -> list[bool]:
        """Return which episodes are passed: (index of the failure, what is different)."""
        cases = [_again(motion[index], **other) for index, other in asked]
        passed = [False] * len(cases)
        for place, trajectory in rollout(world, povs, substitutes, cases):
            passed[place] = _passes(run, trajectory, lines)
        return passed

    steps = {index: len(kept.motion) - 1 for index, kept in motion.items()}
    asked: list[tuple[int, dict[str, Any]]] = []
    for o in failing:
        asked += [(o.index, {"by": name}) for name in REFERENCES if name != CAREFUL]
        asked.append((o.index, {"until": steps[o.index], "careful_pov": True}))
        asked += [(o.index, {"until": n}) for n in range(0, steps[o.index], EVERY_STEPS)]
    avoided: dict[int, set[str]] = {o.index: set() for o in failing}
    last: dict[int, int] = {}
    pov_careful: set[int] = set()
    for (index, other), passed in zip(asked, pass_again(asked), strict=True):
        if not passed:
            continue
        if "careful_pov" in other:
            pov_careful.add(index)
        elif "by" in other:
            avoided[index].add(other["by"])
        else:
            last[index] = other["until"]
            if other["until"] == 0:
                avoided[index].add(CAREFUL)
    later = [
        (index, {"until": n})
        for index, coarse in last.items()
        for n in range(coarse + 1, min(coarse + EVERY_STEPS, steps[index]))
    ]
    for (index, other), passed in zip(later, pass_again(later), strict=True):
        if passed:
            last[index] = max(last[index], other["until"])
    return [
        Avoidance(
            o.index,
            tuple(name for name in REFERENCES if name in avoided[o.index]),
            round(last[o.index] * DT_S, 1) if o.index in last else None,
            o.index in pov_careful,
        )
        for o in failing
    ]


def _again(failure: Trajectory, **other: Any) -> _Again:
    same = {f.name: getattr(failure.case, f.name) for f in fields(Case)}
    return _Again(**same, recorded=failure.a_vut_mps2, **other)


def _passes(run: Run, trajectory: Trajectory, lines: CentreLines) -> bool:
    """Return whether an episode ends at M without a failure, by the criterion of the campaign."""
    outcome = run.criterion.outcome(0, 0, trajectory, lines)
    return outcome.measures.end.is_tested and not outcome.failed


class _Substitutes(Driver):
    """Drives in the VUT's place: first what the VUT did, then a reference driver."""

    def __init__(self, corridors: int, rows: int) -> None:
        super().__init__(corridors)
        self._drivers = {name: make(corridors) for name, make in REFERENCES.items()}
        self._by = np.zeros(corridors, dtype=np.int64)
        self._until = np.zeros(corridors, dtype=np.int64)
        self._recorded = np.zeros((rows, corridors))

    def begin(self, corridor: int, case: Case) -> None:
        assert isinstance(case, _Again), "only failures are driven again"  # noqa: S101
        self._by[corridor] = list(self._drivers).index(case.by)
        self._until[corridor] = case.until
        self._recorded[: len(case.recorded), corridor] = case.recorded
        for driver in self._drivers.values():
            driver.begin(corridor, case)

    def act(self, scene: Scene) -> FloatArray:
        recorded = scene.step < self._until
        row = np.minimum(scene.step, len(self._recorded) - 1)
        answer: FloatArray = self._recorded[row, np.arange(self.corridors)]
        for number, driver in enumerate(self._drivers.values()):
            mine = scene.active & (self._by == number)
            if mine.any():
                drives = mine & ~recorded
                answer[drives] = driver.act(scene)[drives]
                driver.forget_risk(recorded)
        return answer


class _Mainline(Driver):
    """Drives the cars of the mainline: the POVs of the campaign, or a careful driver."""

    def __init__(self, corridors: int, povs: Povs, world: World) -> None:
        super().__init__(corridors)
        self._povs = PovLibrary(corridors, povs, world)
        self._careful = CarefulPov(corridors)
        self._is_careful = np.zeros(corridors, dtype=np.bool_)

    def begin(self, corridor: int, case: Case) -> None:
        self._povs.begin(corridor, case)
        self._careful.begin(corridor, case)
        self._is_careful[corridor] = isinstance(case, _Again) and case.careful_pov

    def act(self, scene: Scene) -> FloatArray:
        answer = self._povs.act(scene)
        if not self._is_careful.any():
            return answer
        return np.where(self._is_careful, self._careful.act(scene), answer)

    def reason(self, corridor: int) -> str | None:
        return self._povs.reason(corridor)

    def close(self) -> None:
        self._povs.close()


def note_avoidance(run: Run, settings: CampaignSettings, net: Corridor) -> str | None:
    """Find and write who would have avoided the failures of a campaign; return it in a sentence."""
    found = avoidance(run, settings, net)
    if not found:
        return None
    write_avoidance(run.folder, found)
    return in_a_sentence(found)


def write_avoidance(folder: Path, found: Iterable[Avoidance]) -> Path:
    """Write what was found into the folder of a campaign, in the place of an older one."""
    path = folder / AVOIDANCE
    lines = "".join(json.dumps(asdict(one), allow_nan=False) + "\n" for one in found)
    replace_own(path, lines.encode())
    return path


def read_avoidance(run: Run) -> dict[int, Avoidance]:
    """Return by index what the folder of a campaign says of its failures.

    Empty where it says nothing. Raises `UserError` for a line that is not of one of its failures.
    """
    path = run.folder / AVOIDANCE
    try:
        lines = regular(path).read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    failing = {outcome.index for outcome in run.outcomes if outcome.failed}
    found: dict[int, Avoidance] = {}
    for number, line in enumerate(lines, start=1):
        try:
            one = _of_record(json.loads(line))
            if one.index not in failing or one.index in found:
                raise ValueError(f"case {one.index}")
        except (ValueError, TypeError, KeyError, RecursionError) as error:
            raise UserError(f"line {number} of {path} is of no failure of the campaign") from error
        found[one.index] = one
    return found


def _of_record(record: Any) -> Avoidance:
    one = Avoidance(**record)
    until, names = one.careful_until_s, record["avoided_by"]
    if type(one.index) is not int or type(one.pov_careful) is not bool or type(names) is not list:
        raise TypeError("not as it is written")
    if not (until is None or (type(until) is float and 0.0 <= until <= MAX_EPISODE_S)):
        raise ValueError("careful_until_s")
    if [name for name in REFERENCES if name in names] != names:
        raise ValueError("avoided_by")
    return Avoidance(one.index, tuple(names), until, one.pov_careful)


def in_a_sentence(found: Iterable[Avoidance]) -> str | None:
    """Return how many failures a careful driver would have avoided; None where nothing is known."""
    known = list(found)
    if not known:
        return None
    count = sum(one.by_careful for one in known)
    pov = sum(one.pov_careful for one in known)
    times = sorted(one.careful_until_s for one in known if one.careful_until_s is not None)
    plural = "failure" if len(known) == 1 else "failures"
    said = (
        f"{count} of {len(known)} {plural} would have been avoided by a careful and competent "
        "driver"
    )
    if times:
        middle = times[math.floor((len(times) - 1) / 2)]
        said += f" (who takes over until {middle:.1f} s, in the median)"
    return f"{said}, {pov} by a careful driver on the mainline."
