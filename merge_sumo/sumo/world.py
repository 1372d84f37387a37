"""K corridors in one SUMO simulation, moved exactly by the paper's equations of motion.

SUMO holds the state. In its default (Euler) mode a vehicle advances by the speed it is given for a
step, so eq. (4),

    x(t+1) = x(t) + v(t) dt,    v(t+1) = v(t) + a(t) dt,

is had by stepping at v(t) and then telling SUMO that the speed now is v(t+1). Positions are read
back from SUMO after every step, and must be those of eq. (4). Speeds are read back where an episode
begins; from then on they are what SUMO was told, for to ask it again would give the same number,
and a vehicle that did not drive at it would show in its next position.

Where SUMO itself drives a vehicle, its car-following model and its junction logic decide v(t+1)
from the state at t. SUMO then moves by v(t+1) instead of v(t), so the vehicle is put where eq. (4)
has it.
"""

from __future__ import annotations

import bisect
import math
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import compress
from pathlib import Path
from typing import Any, Self

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.merge import road_of
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, POV, VEHICLES, VUT, Scenario
from merge_sumo.sumo.binding import (
    NO_COLLISIONS,
    SPEED_MODE_COMMANDED,
    SUMO_OPTIONS,
    load_libsumo,
    scratch_folder,
)
from merge_sumo.sumo.hosting import hosted_net, hosted_paths

PARKING_M = 182.0
"""Distance to M at which the vehicles of an idle corridor stand, or where their path begins."""
EXACT_M = 1e-9
"""Largest difference of SUMO from eq. (4) in a step; more is a position on another lane."""
MAX_SPEED_MPS = 200.0
"""Above what a POV can reach by the timeout, so that SUMO never caps a commanded speed."""

CAR = "car"
COMMANDED_VUT = "commanded"
VUT_TYPE = "vut"
OWN_CAR = "own"
"""Ids of the vTypes of the cars of the mainline and of VUTs that hold the speed that they are told,
and of VUTs and of cars of the mainline that SUMO drives."""
SLOWEST_MPS = 0.1
"""SUMO has no driver who wants to stand."""


class SimulationError(Exception):
    """SUMO gave up; the world that raised it can only be restarted or closed."""


class World:
    """A libsumo simulation with `corridors` independent corridors.

    State arrays have shape (A, corridors), a row for each vehicle of an episode (`POV`, `VUT` and,
    in traffic, `AHEAD` and `BEHIND`): `x_m`, lane coordinates with M = 0, read from SUMO, and
    `v_mps`, what SUMO holds as their speeds. Every step has new arrays.

    libsumo holds one simulation per process, so one world may be open at a time.
    """

    _open = False

    def __init__(
        self,
        corridors: int = 32,
        road: Corridor | None = None,
        vut_type: Mapping[str, str] | None = None,
        *,
        scenario: Scenario,
        car_type: Mapping[str, str] | None = None,
    ) -> None:
        """Start SUMO; raises `UserError` when it cannot start, or when a world is open already.

        `road` is where the merge is, by default the shipped net.
        `scenario` says how many vehicles there are, and how long.
        `vut_type` are attributes of a SUMO vType: with them SUMO's own models decide on the speed
        of the VUTs, and `wanted_v_mps` tells what they want.
        `car_type` are those of cars of the mainline in the episodes in which they are the tester's
        own; without a `maxSpeed` they want the speed with which they start.
        """
        if World._open:
            raise UserError("libsumo holds one simulation per process: close the other World first")
        self.corridors = corridors
        self.road = road or road_of()
        self.vut_type, self.car_type = vut_type, car_type
        self.scenario = scenario
        self.vehicles = scenario.vehicles
        self._libsumo = load_libsumo()
        self.x_m: FloatArray = np.empty((self.vehicles, corridors))
        self.v_mps: FloatArray = np.empty((self.vehicles, corridors))
        mainline, ramp = hosted_paths(self.road)
        self._paths = [ramp if row == VUT else mainline for row in range(self.vehicles)]
        self._parking_m = [max(-PARKING_M, path.starts_m[0]) for path in self._paths]
        self._lanes = [[path.lanes(k) for k in range(corridors)] for path in self._paths]
        self._mainline_lanes = [frozenset(lanes) for lanes in self._lanes[POV]]
        self._start_m_of_lane = {
            lane: start_m
            for path in self._paths
            for k in range(corridors)
            for lane, start_m in zip(path.lanes(k), path.starts_m, strict=True)
        }
        self._merged: NDArray[np.bool_] = np.zeros(corridors, dtype=np.bool_)
        """Whether SUMO has the VUT on the mainline's lane of a road with an acceleration lane."""
        self._start_m: FloatArray = np.zeros((self.vehicles, corridors))
        """Lane coordinates at which the lanes begin on which the vehicles are."""
        self._start()

    def restart(self) -> None:
        """Start SUMO afresh, with parked vehicles; what ran is gone."""
        self.close()
        self._start()

    def _start(self) -> None:
        libsumo = self._libsumo
        with scratch_folder() as folder:
            net_file = folder / "corridors.net.xml"
            net_file.write_bytes(hosted_net(self.road, self.corridors))
            types_file = folder / "types.add.xml"
            types_file.write_bytes(_types(self.vut_type, self.car_type, self.scenario))
            messages = folder / "messages"
            files = ("--net-file", str(net_file), "--additional-files", str(types_file))
            try:
                with _standard_error_into(messages):
                    libsumo.start(["sumo", *files, *SUMO_OPTIONS, *NO_COLLISIONS])
            except libsumo.TraCIException as error:
                said = messages.read_text(encoding="utf-8", errors="replace").split("\n")[0]
                reason = said.removeprefix("Error: ") or error
                raise UserError(
                    f"SUMO cannot load the net {self.road.path} and its vehicle types: {reason}"
                ) from error
        vehicle = libsumo.vehicle
        self._add, self._remove = vehicle.add, vehicle.remove
        names = VEHICLES[: self.vehicles]
        self._ids = [f"{who}.{k}" for who in names for k in range(self.corridors)]
        try:
            for index, name in enumerate(self._ids):
                row, k = divmod(index, self.corridors)
                libsumo.route.add(f"route.{name}", self._paths[row].route(k))
                self._enter(name, COMMANDED_VUT if row == VUT else CAR)
            libsumo.simulation.step()
            for name in self._ids:
                vehicle.setSpeedMode(name, SPEED_MODE_COMMANDED)
                vehicle.setLaneChangeMode(name, 0)
                vehicle.setSpeed(name, 0.0)
        except libsumo.TraCIException as error:
            libsumo.close()
            raise UserError(f"SUMO cannot use the net {self.road.path}: {error}") from error
        # Bound once: attribute look-ups cost as much as the calls themselves.
        self._step_simulation = libsumo.simulation.step
        self._move_to, self._set_lane_change_mode = vehicle.moveTo, vehicle.setLaneChangeMode
        self._set_speed_mode, self._set_max_speed = vehicle.setSpeedMode, vehicle.setMaxSpeed
        self._set_speed, self._set_previous_speed = _raw(libsumo, "setSpeed", "setPreviousSpeed")
        self._get_position, self._get_speed = _raw(libsumo, "getLanePosition", "getSpeed")
        self._get_lane = vehicle.getLaneID
        self._obeys = np.ones(self.x_m.shape, dtype=bool)
        """Who holds the speed that it is told, (A, corridors); SUMO drives the others."""
        self._obeys[VUT] = self.vut_type is None
        self._lane_changes = self.vut_type is not None and self.road.lane_m is not None
        """Whether SUMO's lane-change model decides when VUTs merge."""
        World._open = True
        self.read()

    def _enter(self, name: str, vtype: str) -> None:
        self._add(
            name,
            f"route.{name}",
            typeID=vtype,
            departLane="0",
            departPos="0",
            departSpeed="0",
        )

    def place(
        self, corridor: int, starts: Sequence[tuple[float, float]], *, own: bool = False
    ) -> None:
        """Put the vehicles of a corridor where an episode starts, and read them back.

        Args:
            corridor: number of the corridor.
            starts: (x in m, v in m/s) of the vehicles in the order of their rows.
            own: whether the cars of the mainline are the tester's own.
        """
        self._merged[corridor] = False
        for row, (x, v) in enumerate(starts):
            name = self._ids[row * self.corridors + corridor]
            lane, start_m = self._lane_at(row, corridor, x)
            by_sumo = self.vut_type is not None if row == VUT else own and self.car_type is not None
            renewed = by_sumo or not self._obeys[row, corridor] or self._lane_changes
            if renewed:
                # A new vehicle: some of SUMO's models remember how they drove, and its lane-change
                # model what it told the cars next to it.
                self._remove(name)
                self._enter(name, (VUT_TYPE if row == VUT else OWN_CAR) if by_sumo else CAR)
                self._obeys[row, corridor] = not by_sumo
            self._move_to(name, lane, x - start_m)
            self._set_previous_speed(name, v, 0.0)
            if renewed and not (row == VUT and self._lane_changes):
                self._set_lane_change_mode(name, 0)
            if not by_sumo:
                if renewed:
                    self._set_speed_mode(name, SPEED_MODE_COMMANDED)
                self._set_speed(name, v)
            elif row != VUT and self.car_type is not None and "maxSpeed" not in self.car_type:
                self._set_max_speed(name, max(v, SLOWEST_MPS))
            self._start_m[row, corridor] = start_m
            self.x_m[row, corridor] = self._get_position(name) + start_m
            self.v_mps[row, corridor] = self._get_speed(name)

    def park(self, corridor: int) -> None:
        """Put the vehicles of a corridor aside, at a stand before M."""
        self.place(corridor, [(x_m, 0.0) for x_m in self._parking_m])

    def _lane_at(self, row: int, corridor: int, x_m: float) -> tuple[str, float]:
        """Return the lane at a coordinate of a vehicle's path, and where that lane begins.

        The path of a VUT that has merged is the mainline's.
        """
        if row == VUT and self._merged[corridor]:
            row = POV
        starts_m = self._paths[row].starts_m
        number = bisect.bisect_right(starts_m, x_m) - 1
        if number < 0:
            raise UserError(
                f"a vehicle cannot be {-x_m:g} m before the merge point of {self.road.path}: its "
                f"path begins {-starts_m[0]:g} m before it"
            )
        return self._lanes[row][corridor][number], starts_m[number]

    def advance(self) -> None:
        """Let SUMO make its step; `x_m` and `v_mps` stay those before it until `command`.

        Raises `SimulationError`.
        """
        try:
            self._step_simulation()
        except (self._libsumo.TraCIException, self._libsumo.FatalTraCIError) as error:
            raise SimulationError(str(error)) from error

    def wanted_v_mps(self, rows: Sequence[int] = (VUT,)) -> FloatArray:
        """Return the speeds that SUMO's own models chose in its step, (R corridors,), row by row.

        They mean something of vehicles that SUMO drives.
        """
        k = self.corridors
        names = [name for row in rows for name in self._ids[row * k : (row + 1) * k]]
        return np.fromiter(map(self._get_speed, names), float, len(names))

    def wants_to_merge(self) -> NDArray[np.bool_]:
        """Return which VUTs SUMO's own lane-change models put on the mainline in its step, (K,)."""
        names = self._ids[VUT * self.corridors : (VUT + 1) * self.corridors]
        lanes = map(self._get_lane, names)
        return np.array([lane in of for lane, of in zip(lanes, self._mainline_lanes, strict=True)])

    def command(self, a_mps2: FloatArray, merged: NDArray[np.bool_] | None = None) -> None:
        """Set the speeds that follow from accelerations, (A, corridors), and read the state.

        `merged` says which VUTs are on the mainline after the step, (corridors,), where the road
        has an acceleration lane. Comes after `advance`; the two are one step. Raises
        `SimulationError`.
        """
        v_mps: FloatArray = np.maximum(self.v_mps + a_mps2 * DT_S, 0.0)
        expected_m = self.x_m + self.v_mps * DT_S
        try:
            if merged is not None:
                self._change_lanes(merged, expected_m[VUT], v_mps[VUT])
            driven_by_sumo = self.vut_type is not None or self.car_type is not None
            for row, k in np.argwhere(~self._obeys).tolist() if driven_by_sumo else ():
                name, x = self._ids[row * self.corridors + k], float(expected_m[row, k])
                lane, start_m = self._lane_at(row, k, x)
                self._move_to(name, lane, x - start_m)
                self._set_previous_speed(name, float(v_mps[row, k]), float(a_mps2[row, k]))
            # A vehicle that keeps its speed needs no command: SUMO holds the last one.
            told = (v_mps != self.v_mps) & self._obeys
            names, speeds = [*compress(self._ids, told.ravel().tolist())], v_mps[told].tolist()
            # The quickest loops that there are: C all the way down into SUMO.
            deque(map(self._set_previous_speed, names, speeds, a_mps2[told].tolist()), maxlen=0)
            deque(map(self._set_speed, names, speeds), maxlen=0)
            self.x_m, self.v_mps = self._read_x_m(expected_m), v_mps
        except (self._libsumo.TraCIException, self._libsumo.FatalTraCIError) as error:
            raise SimulationError(str(error)) from error

    def _change_lanes(self, merged: NDArray[np.bool_], x_m: FloatArray, v_mps: FloatArray) -> None:
        """Put VUTs that merge on the mainline, by their next states, (corridors,).

        SUMO stops a vehicle that would leave the end of the acceleration lane in a step, so one
        that is forced to merge by that step is moved before it.
        """
        assert self.road.lane_m is not None, "a road with a lane"  # noqa: S101
        leaves = x_m + v_mps * DT_S >= self.road.lane_m[1]
        for k in np.flatnonzero((merged | leaves) & ~self._merged).tolist():
            self._merged[k] = True
            lane, start_m = self._lane_at(VUT, k, float(x_m[k]))
            self._move_to(self._ids[VUT * self.corridors + k], lane, float(x_m[k]) - start_m)

    def read(self) -> None:
        """Read positions and speeds of all vehicles from SUMO, wherever it has driven them."""
        self.v_mps = self._of_all(self._get_speed)
        position_m = self._of_all(self._get_position)
        for index, name in enumerate(self._ids):
            self._start_m.flat[index] = self._lane_begins_m(name)
        self.x_m = position_m + self._start_m

    def _read_x_m(self, expected_m: FloatArray) -> FloatArray:
        """Read positions from SUMO, (A, corridors), and check that they are as expected."""
        position_m = self._of_all(self._get_position)
        # In most steps every vehicle is on the lane on which it was.
        x_m = position_m + self._start_m
        off_m = x_m - expected_m
        if np.vdot(off_m, off_m) <= EXACT_M**2:
            return x_m
        # The others are asked for their lanes.
        for row, k in np.argwhere(~(np.abs(off_m) <= EXACT_M / off_m.size)).tolist():
            self._start_m[row, k] = self._lane_begins_m(self._ids[row * self.corridors + k])
        x_m = position_m + self._start_m
        off = np.abs(x_m - expected_m).max()
        if not off <= EXACT_M:
            raise SimulationError(f"SUMO moved a vehicle {off} m away from where it drives")
        return x_m

    def _lane_begins_m(self, name: str) -> float:
        """Return the coordinate at which a vehicle's lane begins: nowhere without a lane."""
        return self._start_m_of_lane.get(self._get_lane(name), math.nan)

    def _of_all(self, get: Callable[[str], float]) -> FloatArray:
        """Return a value of SUMO for all vehicles, (A, corridors)."""
        return np.fromiter(map(get, self._ids), float, len(self._ids)).reshape(self.x_m.shape)

    def close(self) -> None:
        """End the simulation; the next world may start."""
        if World._open:
            World._open = False
            self._libsumo.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _types(
    vut_type: Mapping[str, str] | None, car_type: Mapping[str, str] | None, scenario: Scenario
) -> bytes:
    """Return the additional file with the vTypes."""
    root = etree.Element("additional")
    told = {"minGap": "0", "maxSpeed": repr(MAX_SPEED_MPS)}
    for name, length_m in ((CAR, scenario.pov_length_m), (COMMANDED_VUT, scenario.vut_length_m)):
        etree.SubElement(root, "vType", {"id": name, "length": repr(length_m), **told})
    for name, length_m, model in (
        (VUT_TYPE, scenario.vut_length_m, vut_type),
        (OWN_CAR, scenario.pov_length_m, car_type),
    ):
        if model is not None:
            # A driver who knows the limits and wants the level-0 speed.
            careful = {
                "length": repr(length_m),
                "maxSpeed": repr(scenario.level0_v_mps),
                "accel": repr(scenario.a_max_mps2),
                "decel": repr(-scenario.a_min_mps2),
                "emergencyDecel": repr(-scenario.a_min_mps2),
            }
            etree.SubElement(root, "vType", {"id": name, **careful, **model})
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8")


@contextmanager
def _standard_error_into(path: Path) -> Iterator[None]:
    """Send what a C++ library writes to standard error into a file."""
    sys.stderr.flush()
    kept = os.dup(2)
    try:
        with path.open("wb") as file:
            os.dup2(file.fileno(), 2)
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _raw(libsumo: Any, *names: str) -> list[Any]:
    """Return vehicle functions without their Python wrappers, where the build exposes them.

    The wrappers only pass their arguments on, and cost as much again as the call.
    """
    raw = getattr(libsumo, "_libsumo", None)
    return [getattr(raw, f"vehicle_{name}", getattr(libsumo.vehicle, name)) for name in names]
