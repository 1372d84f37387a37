"""The proving ground: a VUT, the POVs and SUMO, opened in whatever process runs the cases."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from threading import RLock
from typing import Any, Final, Self

import numpy as np

from merge_sumo.engine.pov_library import PovLibrary
from merge_sumo.engine.povs import Povs
from merge_sumo.engine.rollout import rollout
from merge_sumo.engine.versions import POLICY, differences, software
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.merge import road_of
from merge_sumo.sumo.world import World
from merge_sumo.system.blame import MAX_DEATHS
from merge_sumo.system.pickling import quickly_pickled
from merge_sumo.system.resources import resource
from merge_sumo.system.workers import Workers, when_worker_ends
from merge_sumo.values.case import Case
from merge_sumo.values.criterion import Criterion
from merge_sumo.values.scenario import Scenario
from merge_sumo.values.score import Measures, Outcome, measure, measure_all
from merge_sumo.values.trajectory import End, Trajectory
from merge_sumo.vuts.files import Files, hashed
from merge_sumo.vuts.registry import VutFactory

MAX_CORRIDORS: Final = 32


class Simulator:
    """A VUT and the POV library in a SUMO world: takes cases, gives trajectories."""

    def __init__(
        self,
        vut: VutFactory,
        corridors: int,
        net: Corridor,
        scenario: Scenario,
        povs: Povs,
        binding: Any = None,
    ) -> None:
        """Start SUMO and the drivers, with fewer corridors where one cannot serve as many.

        `binding` takes the place of libsumo: see `World`.
        """
        cars = scenario.vehicles - 1
        corridors = min(corridors, vut.vut.max_corridors or corridors)
        corridors = povs.corridors(corridors, cars)
        with ExitStack() as opened:
            car_type = None if povs.own is None else povs.own.vut.vut_type
            self.world = World(corridors, net, vut.vut.vut_type, scenario, car_type, binding)
            opened.callback(self.world.close)
            self.vut = vut(corridors, self.world)
            opened.callback(self.vut.close)
            self.pov = PovLibrary(corridors * cars, povs, self.world)
            opened.callback(self.pov.close)
            self._opened = opened.pop_all()

    def run(
        self, cases: Iterable[Case], ran_again: set[int] | None = None
    ) -> Iterator[tuple[int, Trajectory]]:
        """Run cases; yield (place in `cases`, trajectory) as they end.

        `ran_again` is told the places of those that ran again: see `rollout`.
        """
        return rollout(self.world, self.pov, self.vut, cases, ran_again)

    def __enter__(self) -> Self:
        """Return the proving ground."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the POVs, the VUT, then SUMO."""
        self._opened.close()


@dataclass(frozen=True, kw_only=True, slots=True)
class SimulationPlan:
    """What it takes to open a `Simulator` in any process; it travels with every chunk."""

    vut: VutFactory
    corridors: int
    net: Corridor
    povs: Povs
    scenario: Scenario
    criterion: Criterion
    software: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Note with what software this process would carry it out, unless that is given."""
        if not self.software:
            object.__setattr__(self, "software", software(self.povs))

    def key(self) -> tuple[object, ...]:
        """Return what tells one plan from another."""
        vut = self.vut.spec, self.vut.options, self.vut.files
        edges = self.net.sha256, self.net.mainline_edges, self.net.ramp_edges
        return *vut, self.corridors, *edges, self.scenario, self.povs, *self.software.items()

    def check_software(self) -> None:
        """Raise `UserError` where other software would give other outcomes."""
        for name, (there, here) in differences(self.software, software(self.povs)).items():
            if name.startswith(POLICY):
                raise UserError(
                    f"a worker has another {name} in {self.povs.policies} than this process, or "
                    "none: put the same files there"
                )
            raise UserError(
                f"a worker has {name} {here}, and this process {there}: install the same there"
            )

    def open(self, binding: Any = None) -> Simulator:
        """Open the proving ground; `UserError` where other software would give other outcomes.

        `binding` takes the place of libsumo: see `World`.
        """
        self.check_software()
        drivers = self.vut, self.corridors, self.net, self.scenario, self.povs
        return Simulator(*drivers, binding)


@quickly_pickled
@dataclass(frozen=True, slots=True)
class CaseResult:
    """What became of one case, and the files that had decided on it by then.

    Attributes:
        measures: verdict and measures.
        trajectory: what happened.
        files: those of the user's that the VUT has loaded, with their hashes.
        pov_files: those that a POV of the user's own has loaded.
        margin: that of the plan's criterion; None where it needs none.
        again: whether it ran again, because a process had died or had been stopped.
    """

    measures: Measures
    trajectory: Trajectory
    files: Files = field(default_factory=dict)
    pov_files: Files = field(default_factory=dict)
    margin: float | None = None
    again: bool = False

    @property
    def score(self) -> float | None:
        """The score under the plan's criterion, as `Outcome` has it."""
        return Outcome(0, 0, self.trajectory.case, self.measures, margin=self.margin).score


_kept: tuple[tuple[object, ...], Simulator] | None = None
"""The proving ground of this process, with the key of its plan: it stays open between chunks."""
_one_at_a_time = RLock()
"""libsumo holds one simulation per process, and some clusters give a process several threads."""


def run_cases(plan: SimulationPlan, cases: Sequence[Case]) -> list[CaseResult]:
    """Run cases on the proving ground of this process and return what became of each."""
    with opened_simulator(plan) as ground:
        ran_again: set[int] = set()
        ran = dict(ground.run(cases, ran_again))
        files = hashed(ground.vut.files()), hashed(ground.pov.files())
    lines = centre_lines(plan.net)
    done: list[CaseResult] = []
    measured = measure_all([ran[place] for place in range(len(cases))], lines)
    for place, measures in enumerate(measured):
        margin = plan.criterion.margin(ran[place], measures)
        done.append(CaseResult(measures, ran[place], *files, margin, place in ran_again))
    return done


@contextmanager
def opened_simulator(plan: SimulationPlan) -> Iterator[Simulator]:
    """Give the proving ground of this process, which stays open for who comes next with a plan."""
    with _one_at_a_time:
        try:
            yield _opened_simulator(plan)
        except BaseException:
            _close_simulator()  # it stands in the middle of episodes
            raise


def _opened_simulator(plan: SimulationPlan) -> Simulator:
    global _kept  # noqa: PLW0603 (one SUMO per process)
    if _kept is None or _kept[0] != plan.key():
        _close_simulator()
        _kept = plan.key(), plan.open()
        when_worker_ends(_close_simulator)
    return _kept[1]


def _close_simulator() -> None:
    global _kept
    with _one_at_a_time:
        if _kept is not None:
            ground, _kept = _kept[1], None
            ground.__exit__(None, None, None)


def lost_case(case: Case) -> CaseResult:
    """Return what is recorded of a case that ended every worker that ran it."""
    start = [[(x, v, 0.0) for x, v in case.starts()]]
    reason = f"its worker process died {MAX_DEATHS} times"
    trajectory = Trajectory(case, np.array(start), End.SIM_ERROR, reason)
    return CaseResult(measure(trajectory), trajectory)


def _marked(ran: CaseResult) -> CaseResult:
    return replace(ran, again=True)


RunCases = Callable[[Sequence[Case]], Iterable[tuple[int, CaseResult]]]
"""Runs cases somewhere; gives (place, what became of the case) in any order."""


@dataclass(frozen=True, slots=True)
class OnWorkers:
    """Runs cases on workers."""

    workers: Workers
    plan: SimulationPlan

    def __call__(self, cases: Sequence[Case]) -> Iterator[tuple[int, CaseResult]]:
        """Run cases; yield (place, what became of the case) in any order."""
        return self.workers.run(partial(run_cases, self.plan), cases, lost_case, ran_again=_marked)

    def chunks(
        self, chunks: Iterable[Sequence[Case]]
    ) -> Generator[tuple[int, Sequence[CaseResult]], None, None]:
        """Run chunks; yield (place of the first case, what became of the chunk) in any order."""
        return self.workers.run_chunks(
            partial(run_cases, self.plan), chunks, lost_case, ran_again=_marked
        )


def runs_on(workers: Workers, plan: SimulationPlan) -> OnWorkers:
    """Return what runs cases on workers; `UserError` when the plan cannot be carried out there."""

    def died(_: None) -> None:
        own = plan.povs.own
        pov = "" if own is None else f" or the POV {own.spec}"
        raise UserError(f"opening the VUT {plan.vut.spec}{pov} ended its process: look into it")

    # All of them at once: a worker takes as long to start as to run hundreds of cases.
    everywhere = [None] * min(workers.count, plan.corridors)
    for _ in workers.run(partial(_open_simulator, plan), everywhere, died, chunk=1):
        pass
    return OnWorkers(workers, plan)


def _open_simulator(plan: SimulationPlan, nothing: Sequence[None]) -> Sequence[None]:
    with opened_simulator(plan):
        return nothing


def road_for(scenario: Scenario, net: Path | None = None) -> Corridor:
    """Return the road of a scenario, or another net with the same edges.

    Raises `UserError` where there is no such merge, or not room enough for its vehicles.
    """
    if net is None and scenario.net is not None:
        # Where a path says nothing of folders, the net is one that the package brings.
        net = resource("sumo_net") / scenario.net
    road = road_of(net, scenario.mainline, scenario.ramp, scenario.room_after_m)
    road.check_room(scenario.mainline_m, -scenario.x_vut0_m)
    return road
