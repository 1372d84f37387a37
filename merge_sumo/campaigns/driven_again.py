"""Failures that are driven again: a reference driver in the VUT's place, or on the mainline.

What happens here happens in a worker process, in as many corridors at a time as there are.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, field, fields
from itertools import islice
from typing import Any, Final

import numpy as np

from merge_sumo.campaigns.ground import GroundPlan, opened_ground
from merge_sumo.campaigns.rollout import rollout
from merge_sumo.drivers.base import Driver, Scene
from merge_sumo.drivers.reference import REFERENCES, CarefulPov
from merge_sumo.sumo.centre_lines import centre_lines
from merge_sumo.values.bodies import CentreLines
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.criterion import Criterion
from merge_sumo.values.merge import brake_after_mps2
from merge_sumo.values.scenario import DT_S
from merge_sumo.values.score import is_close
from merge_sumo.values.trajectory import End, Trajectory

CAREFUL: Final = "careful"
"""The reference driver that takes over, and that the headline counts."""
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


Failure = tuple[int, Trajectory]
"""The index of a failing case, and what happened in it."""


def drive_again(plan: GroundPlan, failing: Sequence[Failure]) -> list[Avoidance | None]:
    """Return who would have avoided failures, by driving them again in this process."""
    found = [_Found(failure) for _, failure in failing]
    searches = [one.take_over() for one in found]
    searches += [one.on_the_mainline() for one in found]
    # One driver after the other: who is in no corridor costs nothing.
    searches += [one.in_its_place(by) for by in REFERENCES if by != CAREFUL for one in found]
    lines = centre_lines(plan.net)
    with opened_ground(plan) as ground:
        world, povs = ground.world, _Mainline(ground.pov)
        substitutes = _Substitutes(world.corridors, plan.scenario.max_steps)
        waiting = deque((search, case) for search in searches for case in islice(search, 1))

        def cases(begun: list[_Search]) -> Iterator[Case]:
            while waiting:
                search, case = waiting.popleft()
                begun.append(search)
                yield case

        while waiting:
            begun: list[_Search] = []
            for place, trajectory in rollout(world, povs, substitutes, cases(begun)):
                try:
                    case = begun[place].send(_passes(plan.criterion, trajectory, lines))
                except StopIteration:
                    continue
                waiting.appendleft((begun[place], case))
    return [one.avoidance(index) for (index, _), one in zip(failing, found, strict=True)]


_Search = Generator[_Again, bool, None]
"""Yields what is to be driven next, and is sent whether it was passed."""


class _Found:
    """What is known of a failure that is driven again, and what is asked about it."""

    def __init__(self, failure: Trajectory) -> None:
        """Take the failure."""
        case = failure.case
        self._same = {f.name: getattr(case, f.name) for f in fields(Case)}
        self._recorded = failure.a_vut_mps2[: case.scenario.max_steps + 1]
        self._steps = len(self._recorded) - 1
        self._avoided_by: set[str] = set()
        self._until: int | None = None
        self._pov_careful = False

    def take_over(self) -> _Search:
        """Search the last step at which a careful driver may take over, from the end backwards."""
        for until in reversed(range(0, self._steps, EVERY_STEPS)):
            if (yield self._again(until=until)):
                break
        else:
            return
        self._until = until
        for later in reversed(range(until + 1, min(until + EVERY_STEPS, self._steps))):
            if (yield self._again(until=later)):
                self._until = later
                break
        if until == 0 or (yield self._again()):
            self._avoided_by.add(CAREFUL)

    def in_its_place(self, name: str) -> _Search:
        """Ask whether a reference driver passes it in the VUT's place."""
        if (yield self._again(by=name)):
            self._avoided_by.add(name)

    def on_the_mainline(self) -> _Search:
        """Ask whether a careful driver on the mainline avoids it against what the VUT did."""
        self._pov_careful = yield self._again(until=self._steps, careful_pov=True)

    def avoidance(self, index: int) -> Avoidance:
        """Return what was found."""
        names = tuple(name for name in REFERENCES if name in self._avoided_by)
        until_s = None if self._until is None else round(self._until * DT_S, 1)
        return Avoidance(index, names, until_s, self._pov_careful)

    def _again(self, **other: Any) -> _Again:
        return _Again(**self._same, recorded=self._recorded, **other)


def _passes(criterion: Criterion, trajectory: Trajectory, lines: CentreLines) -> bool:
    """Return whether an episode ends at M without a failure.

    Nor is one avoided by a merge after which whoever is behind cannot brake hard enough.
    """
    if brake_after_mps2(trajectory) > -trajectory.case.scenario.a_min_mps2:
        return False
    if criterion.is_papers:  # which needs no measures
        return trajectory.end is End.MERGED and not is_close(trajectory)
    outcome = criterion.judged(trajectory, lines)
    return outcome.measures.end.is_tested and not outcome.failed


class _Substitutes(Driver):
    """Drives in the VUT's place: first what the VUT did, then a reference driver."""

    def __init__(self, corridors: int, steps: int) -> None:
        """Prepare for a number of corridors, and for failures of at most so many steps."""
        super().__init__(corridors)
        self._drivers = {name: make(corridors) for name, make in REFERENCES.items()}
        self._by = np.zeros(corridors, dtype=np.int64)
        self._until = np.zeros(corridors, dtype=np.int64)
        self._recorded = np.zeros((steps + 1, corridors))

    def begin(self, corridor: int, case: Case) -> None:
        assert isinstance(case, _Again), "only failures are driven again"  # noqa: S101
        self._by[corridor] = list(self._drivers).index(case.by)
        self._until[corridor] = case.until
        self._recorded[: len(case.recorded), corridor] = case.recorded
        self._drivers[case.by].begin(corridor, case)

    def act(self, scene: Scene) -> FloatArray:
        recorded = scene.step < self._until
        row = np.minimum(scene.step, len(self._recorded) - 1)
        answer: FloatArray = self._recorded[row, np.arange(self.corridors)]
        for number, driver in enumerate(self._drivers.values()):
            drives = scene.active & ~recorded & (self._by == number)
            if drives.any():
                answer[drives] = driver.act(scene)[drives]
                driver.forget_risk(recorded)
        return answer


class _Mainline(Driver):
    """Drives the cars of the mainline: the POVs of the campaign, or a careful driver."""

    def __init__(self, povs: Driver) -> None:
        """Take the drivers of the POVs."""
        super().__init__(povs.corridors)
        self._povs = povs
        self._careful = CarefulPov(povs.corridors)
        self._is_careful = np.zeros(povs.corridors, dtype=np.bool_)

    def begin(self, corridor: int, case: Case) -> None:
        self._is_careful[corridor] = isinstance(case, _Again) and case.careful_pov
        (self._careful if self._is_careful[corridor] else self._povs).begin(corridor, case)

    def act(self, scene: Scene) -> FloatArray:
        careful = scene.active & self._is_careful
        if not careful.any():
            return self._povs.act(scene)
        others = scene._replace(active=scene.active & ~careful)
        return np.where(careful, self._careful.act(scene), self._povs.act(others))

    def reason(self, corridor: int) -> str | None:
        return self._povs.reason(corridor)
