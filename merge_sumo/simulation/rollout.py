"""From cases to trajectories: two drivers in SUMO, or by eq. (4) alone."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.acceleration_lane import Merging
from merge_sumo.drivers.actuation import ROUNDING_MPS2
from merge_sumo.drivers.base import Driver, EpisodesLostError, PovEpisodesLostError, Scene
from merge_sumo.drivers.car_following import conflicting_car, keep_safe
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, MAX_EPISODE_S, OWN, VUT
from merge_sumo.scenario.signals import StepSignals, columns_of
from merge_sumo.scenario.trajectory import End, Trajectory, cut_at
from merge_sumo.simulation.kinematic_simulation import KinematicSimulation
from merge_sumo.sumo.sumo_simulation import SimulationError, SumoSimulation

RING_ROWS = round(MAX_EPISODE_S / DT_S) + 2
"""Rows of the record: an episode is copied out before its first row is written over."""

ANY_FAULT = (Exception, SystemExit)
"""Errors of a VUT: a black box may raise anything but the interruption by the user."""

OF_THE_POV = "the POV: "
"""Prefix of the reason of an error that a POV made."""

MAX_LOSSES = 2
"""Losses of a case that runs alone, after which it is at fault; one may have another cause."""

END_OF_ROAD_M = 20.0
"""Distance from the end of the road at which a follow-up ends."""

NEVER = 2**62
"""Row at which a corridor without an episode times out."""


@dataclass(slots=True)
class _Running:
    """The episode in a corridor.

    Attributes:
        index: index of the case in the rollout.
        case: the case.
        first_row: first row of its record.
        merge_row: row in which the VUT is at M; None before, and without a follow-up.
        clipped: number of answers that were clipped before M.
        left: row of the episode and signals, for each step in which the VUT set signals.
    """

    index: int
    case: Case
    first_row: int
    merge_row: int | None = None
    clipped: int = 0
    left: list[tuple[int, StepSignals]] = field(default_factory=list)


class Rollout:
    """Cases that run in the corridors of a simulation.

    A corridor is refilled when its episode ends, so episodes do not end in order. An episode
    depends neither on the number of corridors nor on its neighbours. An error of the VUT ends its
    episode as VUT_ERROR, an error of the POV as SIM_ERROR. After an `EpisodesLostError` the running
    episodes begin again, one at a time; an episode is at fault if it is lost `MAX_LOSSES` times
    while only that episode runs. When SUMO fails, the running episodes end as SIM_ERROR, and SUMO
    is started again for the others.

    A fault of a controller arrives as NaN, and `Driver.reason` says why, except where the
    controller itself answers NaN or infinity. Other exceptions than `EpisodesLostError` and
    `SimulationError` come only from a driver in this process.

    Example:
        trajectories = Rollout(simulation, pov, vut, cases).run()

    Attributes:
        ran_again: indices of the cases that ran again after a loss that no case explains, such as
            the death of a process from outside.
    """

    def __init__(
        self,
        simulation: SumoSimulation | KinematicSimulation,
        pov: Driver,
        vut: Driver,
        cases: Iterable[Case],
    ) -> None:
        """Take the corridors and their drivers.

        Args:
            simulation: the corridors.
            pov: drives the C cars of the mainline of the K corridors; car c of corridor k has the
                index c K + k.
            vut: drives the VUT of each corridor.
            cases: cases of the simulation's scenario.
        """
        corridors, vehicles = simulation.corridors, len(simulation.x_m)
        self.simulation, self.pov, self.vut = simulation, pov, vut
        self.mainline = [row for row in range(vehicles) if row != VUT]
        self.has_traffic = len(self.mainline) > 1
        self.queue = enumerate(cases)
        self.suspects: deque[tuple[int, Case]] = deque()
        """Cases whose episodes were lost: each runs again alone."""
        self.alone = False
        """Whether a suspect runs alone."""
        self.losses = Counter[int]()
        """How often an episode was lost while it ran alone, by the index of its case."""
        self.ran_again = set[int]()
        self.episodes: list[_Running | None] = [None] * corridors
        self.active = np.zeros(corridors, dtype=bool)
        self.step = np.zeros(corridors, dtype=np.int64)
        self.clipped = np.zeros(corridors, dtype=np.int64)
        self.errors: dict[int, tuple[End, str]] = {}
        """Faults of the drivers in this step, by corridor; `end_episodes` takes them."""
        self.raised: str | None = None
        """Error that the VUT raised instead of its last answer."""
        self.timeout_at = np.full(corridors, NEVER)
        """Rows of the record at which episodes, and after M their follow-ups, end."""
        self.follows_up = np.zeros(corridors, dtype=bool)
        """Whether an episode continues after M."""
        self.follow_steps = round(simulation.scenario.follow_up_s / DT_S)
        has_lane = simulation.scenario.lane_m is not None
        self.merging = Merging(corridors, simulation.scenario) if has_lane else None
        self.ring = RING_ROWS + self.follow_steps
        # One row per step of the simulation: x, v, a of every vehicle.
        self.record = np.zeros((corridors, self.ring, vehicles, 3))
        self.ended: dict[int, Trajectory] = {}
        self.row = 0
        """Number of rows begun so far: within a step, the present row is the one before."""
        self.now = self.record[:, 0]
        """The row of this step."""

    def run(self) -> list[Trajectory]:
        """Run all cases; return their trajectories in order."""
        simulation, everywhere = self.simulation, range(self.simulation.corridors)
        self.refill(everywhere)
        while self.active.any():
            self.now = self.record[:, self.row % self.ring]
            self.now[..., 0], self.now[..., 1] = simulation.x_m.T, simulation.v_mps.T
            self.row += 1
            try:
                simulation.advance()
                acceleration = self.limited(self.ask_drivers())
                merged = None
                if self.merging is not None:
                    merged = self.merging.step(simulation.x_m, simulation.v_mps)
                simulation.command(acceleration, merged)
            except EpisodesLostError as lost:
                self.begin_again(lost)
                continue
            except SimulationError as error:
                for corridor in np.flatnonzero(self.active).tolist():
                    self.finish(corridor, End.SIM_ERROR, f"SUMO failed: {error}")
                simulation.restart()
                self.errors.clear()
                self.refill(everywhere)
                continue
            self.step += 1
            self.end_episodes(merged)
        return [self.ended[index] for index in sorted(self.ended)]

    def end_episodes(self, merged: NDArray[np.bool_] | None) -> None:
        """End the episodes that end with this step, and begin others in their corridors.

        Args:
            merged: where the road has an acceleration lane, which VUTs are on the mainline, (K,).
        """
        simulation = self.simulation
        arrived = simulation.scenario.has_ended(simulation.x_m) if merged is None else merged
        arrived = arrived & self.active & ~self.follows_up
        for corridor in self.errors:
            arrived[corridor] = False
        if self.follow_steps:
            for corridor in np.flatnonzero(arrived).tolist():
                self.begin_follow_up(corridor)
            end_m = simulation.road.mainline.after_m - END_OF_ROAD_M
            ended = self.follows_up & (simulation.x_m.max(axis=0) >= end_m)
        else:
            ended = arrived.copy()
        ended |= self.row >= self.timeout_at
        for corridor in self.errors:
            ended[corridor] = True
        free = np.flatnonzero(ended).tolist()
        for corridor in free:
            if corridor in self.errors:
                self.finish(corridor, *self.errors.pop(corridor))
            elif arrived[corridor] or self.follows_up[corridor]:
                self.finish(corridor, End.MERGED)
            else:
                self.finish(corridor, End.TIMEOUT)
        self.refill(free)

    def begin_follow_up(self, corridor: int) -> None:
        """Note that the VUT of a corridor is at M; its episode continues."""
        episode = self.episodes[corridor]
        assert episode is not None, "only running episodes continue"  # noqa: S101
        episode.merge_row, episode.clipped = self.row, int(self.clipped[corridor])
        self.timeout_at[corridor] = self.row + self.follow_steps
        self.follows_up[corridor] = True

    def begin_again(self, lost: EpisodesLostError) -> None:
        """Let the running episodes begin again, one at a time; end the one at fault, if any.

        Until the last of these suspects has ended, `alone` is true, and `next_case` gives suspects
        instead of new cases. An episode at fault has caused all losses so far, so `ran_again` is
        emptied.

        Args:
            lost: why the episodes are lost.
        """
        is_alone = np.count_nonzero(self.active) == 1
        for corridor, episode in enumerate(self.episodes):
            if episode is None:
                continue
            self.losses[episode.index] += is_alone
            if self.losses[episode.index] == MAX_LOSSES:
                self.ran_again.clear()
                if isinstance(lost, PovEpisodesLostError):
                    self.finish(corridor, End.SIM_ERROR, OF_THE_POV + str(lost))
                else:
                    self.finish(corridor, End.VUT_ERROR, str(lost))
            else:
                self.ran_again.add(episode.index)
                self.suspects.append((episode.index, episode.case))
        self.errors.clear()
        self.active[:] = False
        self.alone = bool(self.suspects)
        self.refill(range(self.simulation.corridors))

    def refill(self, corridors: Sequence[int]) -> None:
        """Begin the next episodes in corridors whose own have ended."""
        if not corridors:
            return
        if self.alone:  # nothing else runs
            self.alone = bool(self.suspects)
            corridors = range(self.simulation.corridors)
        for corridor in corridors:
            self.active[corridor] = False
        for corridor in corridors:
            self.begin(corridor, *self.next_case())

    def next_case(self) -> tuple[int, Case | None]:
        """Return the next case and its index; None where a corridor is to stay empty."""
        if self.alone:
            return (-1, None) if self.active.any() else self.suspects.popleft()
        return next(self.queue, (-1, None))

    def begin(self, corridor: int, index: int, case: Case | None) -> None:
        """Begin an episode in a corridor, or park it.

        Args:
            corridor: index of the corridor.
            index: index of the case in the rollout.
            case: the case; None to leave the corridor empty.
        """
        self.active[corridor] = case is not None
        self.follows_up[corridor] = False
        self.step[corridor] = self.clipped[corridor] = 0
        if self.merging is not None:
            self.merging.begin(corridor)
        if case is None:
            self.episodes[corridor] = None
            self.simulation.park(corridor)
            self.timeout_at[corridor] = NEVER
            return
        self.timeout_at[corridor] = self.row + case.scenario.max_steps
        self.episodes[corridor] = _Running(index, case, self.row)
        self.simulation.place(corridor, case.starts(), own=case.level == OWN)
        for car in range(len(self.mainline)):
            self.pov.begin(car * self.simulation.corridors + corridor, case)
        try:
            self.vut.begin(corridor, case)
        except ANY_FAULT as error:
            said = f"reset raised {type(error).__name__}: {error}"
            self.errors[corridor] = End.VUT_ERROR, said

    def ask_drivers(self) -> FloatArray:
        """Return the answers of the drivers of all vehicles, (A, K), finite, in m/s2.

        Faults of drivers are noted in `errors`, where `end_episodes` finds them; their answer is 0.
        """
        simulation = self.simulation
        x_m, v_mps = simulation.x_m, simulation.v_mps
        merged = x_m[VUT] >= 0.0 if self.follow_steps else None
        if self.merging is not None:
            merged = self.merging.merged
        scene = Scene(self.active, self.step, x_m, v_mps, merged=merged)
        cars = self.pov.act(scene.of_mainline()).reshape(-1, simulation.corridors)
        if self.has_traffic:
            scene = scene._replace(conflicting=conflicting_car(x_m, v_mps, simulation.scenario))
        self.raised = None
        try:
            of_vut = np.asarray(self.vut.act(scene), dtype=np.float64)
            self.take_signals(of_vut)
        except (SimulationError, EpisodesLostError):
            raise
        except ANY_FAULT as error:
            self.raised = f"{type(error).__name__}: {error}"
            of_vut = np.full(simulation.corridors, np.nan)
        answer = np.concatenate((cars[:VUT], of_vut[None], cars[VUT:]))
        # Here, because the limits of car following turn an infinite answer into a number.
        return answer if np.isfinite(answer).all() else self.note_faults(answer)

    def limited(self, answer: FloatArray) -> FloatArray:
        """Return the accelerations of all vehicles, (A, K), and write them into the record.

        They keep the limits of car following, of the acceleration lane and of the scenario.

        Args:
            answer: answers of the drivers, (A, K), in m/s2; changed in place.
        """
        simulation, scenario = self.simulation, self.simulation.scenario
        if self.has_traffic:
            keep_safe(answer, simulation.x_m, simulation.v_mps, scenario)
        if self.merging is not None:
            requests = self.vut.merge_requests()
            self.merging.take(requests, answer, simulation.x_m, simulation.v_mps)
        acceleration: FloatArray = answer.clip(scenario.a_min_mps2, scenario.a_max_mps2)
        acceleration *= self.active
        self.now[..., 2] = acceleration.T
        clipped = self.vut.clipped()
        if clipped is None:
            clipped = np.abs(answer[VUT] - acceleration[VUT]) > ROUNDING_MPS2
        self.clipped += clipped
        return acceleration

    def take_signals(self, answer: FloatArray) -> None:
        """Keep the signals of the VUT; ValueError where its answer is not one a corridor."""
        if answer.shape != self.active.shape:
            raise ValueError(f"answered shape {answer.shape} instead of {self.active.shape}")
        for corridor, left in self.vut.signals().items():
            episode = self.episodes[corridor]
            if left and episode is not None:
                episode.left.append((self.row - 1 - episode.first_row, left))

    def note_faults(self, answer: FloatArray) -> FloatArray:
        """Return answers, (A, K), with 0 for those that are not finite; note these in `errors`.

        Where `Merging` drives instead of the VUT, the answer of the VUT is ignored.
        """
        finite = np.isfinite(answer)
        wrong = ~finite & self.active
        if self.merging is not None:
            wrong[VUT] &= ~self.merging.driven_for
        for row, corridor in np.argwhere(wrong).tolist():
            said = f"answered {answer[row, corridor]}"
            if row == VUT:
                error = End.VUT_ERROR, self.raised or self.vut.reason(corridor) or said
            else:
                place = self.mainline.index(row) * self.simulation.corridors + corridor
                error = End.SIM_ERROR, OF_THE_POV + (self.pov.reason(place) or said)
            self.errors.setdefault(corridor, error)
        return np.where(finite, answer, 0.0)

    def finish(self, corridor: int, end: End, error: str | None = None) -> None:
        """Keep the record of a corridor's episode; after an error without the last step.

        An error after M ends only the follow-up, because the VUT has merged. After a merge from an
        acceleration lane it is an error of the episode, because the time after it is judged.

        Args:
            corridor: index of the corridor.
            end: how the episode ends.
            error: message of an error; None without one.
        """
        episode = self.episodes[corridor]
        assert episode is not None, "only running episodes end"  # noqa: S101
        length = self.row - episode.first_row + (error is None)
        rows = np.arange(episode.first_row, episode.first_row + length) % self.ring
        motion = self.record[corridor, rows]
        if error is None:
            motion[-1, :, 0] = self.simulation.x_m[:, corridor]
            motion[-1, :, 1] = self.simulation.v_mps[:, corridor]
        motion[-1, :, 2] = 0.0
        # A vehicle that comes to a stand brakes only as hard as that takes.
        np.maximum(motion[..., 2], motion[..., 1] / -DT_S, out=motion[..., 2])
        left = columns_of(episode.left, len(motion)), tuple(sorted(self.vut.in_vain(corridor)))
        if episode.merge_row is None or (error is not None and self.merging is not None):
            after, clipped = None, int(self.clipped[corridor])
        else:
            motion, after = cut_at(motion, episode.merge_row - episode.first_row)
            end, clipped = End.MERGED, episode.clipped
        ended = Trajectory(episode.case, motion, end, error, clipped, after, *left)
        self.ended[episode.index] = ended
