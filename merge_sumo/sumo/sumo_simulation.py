"""K corridors in one SUMO simulation, moved exactly by the paper's equations of motion.

SUMO holds the state. In its default (Euler) mode a vehicle advances by the speed it is given for a
step, so eq. (4),

    x(t+1) = x(t) + v(t) dt,    v(t+1) = v(t) + a(t) dt,

is had by stepping at v(t) and then telling SUMO that the speed now is v(t+1). Positions are read
back from SUMO after every step, and must be those of eq. (4). Speeds are read back only where an
episode begins. After that the commanded ones are taken: a wrong speed would show as a wrong
position in the next step.

Where SUMO itself drives a vehicle, its car-following model and its junction logic decide v(t+1)
from the state at t. SUMO then moves by v(t+1) instead of v(t), so the vehicle is put where eq. (4)
has it.
"""

from __future__ import annotations

import bisect
import math
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.road.loader import road_of
from merge_sumo.road.road import Road
from merge_sumo.road.xml_input import to_bytes
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, POV, VEHICLES, VUT, Scenario
from merge_sumo.sumo.binding import (
    NO_COLLISIONS,
    SPEED_MODE_COMMANDED,
    SUMO_OPTIONS,
    load_libsumo,
    scratch_folder,
)
from merge_sumo.sumo.net_copies import hosted_net, hosted_paths

PARKING_M = 182.0
"""Distance to M at which the vehicles of an idle corridor stand, or where their path begins."""
EXACT_M = 1e-9
"""Largest difference of SUMO from eq. (4) in a step; more is a position on another lane."""
MAX_SPEED_MPS = 200.0
"""Above the speed that a POV can reach by the timeout, so that SUMO never caps a speed."""
SLOWEST_MPS = 0.1
"""Least speed that a driver of SUMO can want."""


class SimulationError(Exception):
    """SUMO gave up; the simulation that raised it can only be restarted or closed."""


class SumoSimulation:
    """A libsumo simulation with independent corridors; a process can have one at a time.

    Attributes:
        x_m: lane coordinates with M = 0, (A, corridors), read from SUMO: a row for each vehicle of
            an episode (`POV`, `VUT` and, in traffic, `AHEAD` and `BEHIND`). Every step has a new
            array.
        v_mps: speeds, (A, corridors).

    Example:
        >>> with SumoSimulation(1, scenario=US23) as simulation:
        ...     simulation.place(0, [(-300.0, 30.0), (-182.0, 18.0)])
        ...     simulation.advance()
        ...     simulation.command(np.zeros((2, 1)))
    """

    _open = False

    def __init__(
        self,
        corridors: int = 32,
        road: Road | None = None,
        vut_type: Mapping[str, str] | None = None,
        *,
        scenario: Scenario,
        car_type: Mapping[str, str] | None = None,
    ) -> None:
        """Start SUMO.

        Args:
            corridors: number of corridors, K.
            road: where the merge is, by default the shipped net.
            vut_type: attributes of a SUMO vType: with them SUMO's own models decide on the speed
                of the VUTs (`wanted_v_mps`).
            scenario: gives the number of vehicles and their lengths.
            car_type: as `vut_type`, for the cars of the mainline in the episodes in which they are
                the tester's own; without a `maxSpeed` they want the speed with which they start.

        Raises:
            UserError: SUMO cannot start, or a simulation is open already.
        """
        if SumoSimulation._open:
            raise UserError(
                "libsumo runs one simulation per process: close the other SumoSimulation first"
            )
        self.corridors = corridors
        self.road = road or road_of()
        self.vut_type, self.car_type = vut_type, car_type
        self.scenario = scenario
        self.vehicles = scenario.vehicles
        self._libsumo = load_libsumo()
        shape = self.vehicles, corridors
        self.x_m: FloatArray = np.empty(shape)
        self.v_mps: FloatArray = np.empty(shape)
        mainline, ramp = hosted_paths(self.road)
        self._paths = [ramp if row == VUT else mainline for row in range(self.vehicles)]
        self._lanes = [[path.lanes(k) for k in range(corridors)] for path in self._paths]
        self._start_m_of_lane: dict[str, float] = {}
        for path, lanes in zip(self._paths, self._lanes, strict=True):
            for names in lanes:
                self._start_m_of_lane |= zip(names, path.starts_m, strict=True)
        self._ids = [f"{who}.{k}" for who in VEHICLES[: self.vehicles] for k in range(corridors)]
        self._merged: NDArray[np.bool_] = np.zeros(corridors, dtype=np.bool_)
        """Whether SUMO has the VUT on the mainline's lane of a road with an acceleration lane."""
        self._start_m: FloatArray = np.zeros(shape)
        """Lane coordinates at which the lanes begin on which the vehicles are."""
        self._by_sumo: NDArray[np.bool_] = np.zeros(shape, dtype=np.bool_)
        """Whether SUMO drives a vehicle; the others hold the speed that they are told."""
        self._lane_changes = vut_type is not None and self.road.used_lane_m is not None
        """Whether SUMO's lane-change model decides when VUTs merge."""
        self._start()

    def restart(self) -> None:
        """Start SUMO again, with vehicles at a stand."""
        self.close()
        self._start()

    def _start(self) -> None:
        libsumo, vehicle = self._libsumo, self._libsumo.vehicle
        self._by_sumo[:] = self._merged[:] = False
        with scratch_folder() as folder:
            net_file, types_file = folder / "corridors.net.xml", folder / "types.add.xml"
            net_file.write_bytes(hosted_net(self.road, self.corridors))
            types_file.write_bytes(_types(self.vut_type, self.car_type, self.scenario))
            messages = folder / "messages"
            files = ("--net-file", str(net_file), "--additional-files", str(types_file))
            try:
                with _standard_error_into(messages):
                    libsumo.start(["sumo", *files, *SUMO_OPTIONS, *NO_COLLISIONS])
            except libsumo.TraCIException as error:
                message = messages.read_text(encoding="utf-8", errors="replace").split("\n")[0]
                reason = message.removeprefix("Error: ") or error
                raise UserError(
                    f"SUMO cannot load the net {self.road.path} and its vehicle types: {reason}"
                ) from error
        # Bound once: attribute look-ups cost as much as the calls themselves.
        self._add, self._remove, self._move_to = vehicle.add, vehicle.remove, vehicle.moveTo
        self._step_simulation, self._get_lane = libsumo.simulation.step, vehicle.getLaneID
        self._set_speed, self._set_previous_speed = _raw(libsumo, "setSpeed", "setPreviousSpeed")
        self._get_position, self._get_speed = _raw(libsumo, "getLanePosition", "getSpeed")
        try:
            for index, name in enumerate(self._ids):
                row, k = divmod(index, self.corridors)
                libsumo.route.add(f"route.{name}", self._paths[row].route(k))
                self._enter(name, row, by_sumo=False)
            libsumo.simulation.step()
            for name in self._ids:
                vehicle.setSpeed(name, 0.0)
        except libsumo.TraCIException as error:
            libsumo.close()
            raise UserError(f"SUMO cannot use the net {self.road.path}: {error}") from error
        SumoSimulation._open = True
        self.read()

    def _enter(self, name: str, row: int, *, by_sumo: bool) -> None:
        """Add a vehicle of a row to the simulation."""
        at_start = {"departLane": "0", "departPos": "0", "departSpeed": "0"}
        self._add(name, f"route.{name}", typeID=_type_id(row, by_sumo=by_sumo), **at_start)
        if not (row == VUT and self._lane_changes):
            self._libsumo.vehicle.setLaneChangeMode(name, 0)
        if not by_sumo:
            self._libsumo.vehicle.setSpeedMode(name, SPEED_MODE_COMMANDED)

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
            own_type = self.vut_type if row == VUT else self.car_type
            by_sumo = own_type is not None and (row == VUT or own)
            if by_sumo or self._by_sumo[row, corridor] or self._lane_changes:
                # A new vehicle: some of SUMO's models remember how they drove, and its lane-change
                # model remembers messages to the cars next to it.
                self._remove(name)
                self._enter(name, row, by_sumo=by_sumo)
                self._by_sumo[row, corridor] = by_sumo
            self._move_to(name, lane, x - start_m)
            self._set_previous_speed(name, v, 0.0)
            if not by_sumo:
                self._set_speed(name, v)
            elif own_type is not None and row != VUT and "maxSpeed" not in own_type:
                self._libsumo.vehicle.setMaxSpeed(name, max(v, SLOWEST_MPS))
            self._start_m[row, corridor] = start_m
            self.x_m[row, corridor] = self._get_position(name) + start_m
            self.v_mps[row, corridor] = self._get_speed(name)

    def park(self, corridor: int) -> None:
        """Put the vehicles of a corridor aside, at a stand before M."""
        self.place(corridor, [(max(-PARKING_M, path.starts_m[0]), 0.0) for path in self._paths])

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

        Raises:
            SimulationError: SUMO gave up.
        """
        try:
            self._step_simulation()
        except (self._libsumo.TraCIException, self._libsumo.FatalTraCIError) as error:
            raise SimulationError(str(error)) from error

    def wanted_v_mps(self, rows: Sequence[int]) -> FloatArray:
        """Return the speeds that SUMO's own models chose in its step, (R corridors,), row by row.

        They mean something of vehicles that SUMO drives.
        """
        k = self.corridors
        names = [name for row in rows for name in self._ids[row * k : (row + 1) * k]]
        return np.fromiter(map(self._get_speed, names), float, len(names))

    def requests_merge(self) -> NDArray[np.bool_]:
        """Return which VUTs SUMO's own lane-change models put on the mainline in its step, (K,)."""
        wants = np.zeros(self.corridors, dtype=np.bool_)
        for k, lanes in enumerate(self._lanes[POV]):
            wants[k] = self._get_lane(self._ids[VUT * self.corridors + k]) in lanes
        return wants

    def command(self, a_mps2: FloatArray, merged: NDArray[np.bool_] | None = None) -> None:
        """Set the speeds that follow from accelerations, and read the state.

        Comes after `advance`; the two are one step.

        Args:
            a_mps2: accelerations, (A, corridors).
            merged: where the road has an acceleration lane, which VUTs are on the mainline after
                the step, (corridors,).

        Raises:
            SimulationError: SUMO gave up, or a vehicle is not where eq. (4) has it.
        """
        v_mps: FloatArray = np.maximum(self.v_mps + a_mps2 * DT_S, 0.0)
        expected_m = self.x_m + self.v_mps * DT_S
        speeds, accelerations = v_mps.ravel().tolist(), a_mps2.ravel().tolist()
        try:
            if merged is not None:
                self._change_lanes(merged, expected_m[VUT], v_mps[VUT])
            for index in np.flatnonzero(self._by_sumo).tolist():
                row, k = divmod(index, self.corridors)
                name, x = self._ids[index], float(expected_m[row, k])
                lane, start_m = self._lane_at(row, k, x)
                self._move_to(name, lane, x - start_m)
                self._set_previous_speed(name, speeds[index], accelerations[index])
            # A vehicle that keeps its speed needs no command: SUMO holds the last one.
            for index in np.flatnonzero((v_mps != self.v_mps) & ~self._by_sumo).tolist():
                name = self._ids[index]
                self._set_previous_speed(name, speeds[index], accelerations[index])
                self._set_speed(name, speeds[index])
            self.x_m, self.v_mps = self._read_x_m(expected_m), v_mps
        except (self._libsumo.TraCIException, self._libsumo.FatalTraCIError) as error:
            raise SimulationError(str(error)) from error

    def _change_lanes(self, merged: NDArray[np.bool_], x_m: FloatArray, v_mps: FloatArray) -> None:
        """Put VUTs that merge on the mainline, by their next states, (corridors,).

        SUMO stops a vehicle that would leave the end of the acceleration lane in a step, so one
        that is forced to merge by that step is moved before it.
        """
        assert self.road.used_lane_m is not None, "a road with a lane"  # noqa: S101
        leaves = x_m + v_mps * DT_S >= self.road.used_lane_m[1]
        for k in np.flatnonzero((merged | leaves) & ~self._merged).tolist():
            self._merged[k] = True
            lane, start_m = self._lane_at(VUT, k, float(x_m[k]))
            self._move_to(self._ids[VUT * self.corridors + k], lane, float(x_m[k]) - start_m)

    def read(self) -> None:
        """Read positions and speeds of all vehicles from SUMO, wherever it has driven them."""
        self.v_mps = self._of_all(self._get_speed)
        self._start_m = self._of_all(self._lane_begins_m)
        self.x_m = self._of_all(self._get_position) + self._start_m

    def _read_x_m(self, expected_m: FloatArray) -> FloatArray:
        """Read positions from SUMO, (A, corridors), and check that they are as expected."""
        position_m = self._of_all(self._get_position)
        x_m = position_m + self._start_m
        exact = np.abs(x_m - expected_m) <= EXACT_M
        if exact.all():
            return x_m
        for index in np.flatnonzero(~exact).tolist():  # it may be on another lane
            self._start_m.flat[index] = self._lane_begins_m(self._ids[index])
        x_m = position_m + self._start_m
        off_m = np.abs(x_m - expected_m).max()
        if not off_m <= EXACT_M:
            raise SimulationError(f"SUMO moved a vehicle {off_m} m away from where it drives")
        return x_m

    def _lane_begins_m(self, name: str) -> float:
        """Return the coordinate at which a vehicle's lane begins: nowhere without a lane."""
        return self._start_m_of_lane.get(self._get_lane(name), math.nan)

    def _of_all(self, get: Callable[[str], float]) -> FloatArray:
        """Return a value of SUMO for all vehicles, (A, corridors)."""
        return np.fromiter(map(get, self._ids), float, len(self._ids)).reshape(self.x_m.shape)

    def close(self) -> None:
        """End the simulation; the next simulation may start."""
        if SumoSimulation._open:
            SumoSimulation._open = False
            self._libsumo.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _type_id(row: int, *, by_sumo: bool) -> str:
    """Return the id of the vType of the vehicles of a row."""
    who = "vut" if row == VUT else "car"
    return f"{who}.sumo" if by_sumo else who


def _types(
    vut_type: Mapping[str, str] | None, car_type: Mapping[str, str] | None, scenario: Scenario
) -> bytes:
    """Return the additional file with the vTypes."""
    root = etree.Element("additional")
    for row, own_type in ((POV, car_type), (VUT, vut_type)):
        length_m = repr(scenario.lengths_m[row == VUT])
        told = {"id": _type_id(row, by_sumo=False), "minGap": "0", "maxSpeed": repr(MAX_SPEED_MPS)}
        etree.SubElement(root, "vType", told, length=length_m)
        if own_type is not None:
            # A driver who knows the limits and wants the level-0 speed.
            careful = {
                "id": _type_id(row, by_sumo=True),
                "length": length_m,
                "maxSpeed": repr(scenario.level0_v_mps),
                "accel": repr(scenario.a_max_mps2),
                "decel": repr(-scenario.a_min_mps2),
                "emergencyDecel": repr(-scenario.a_min_mps2),
            }
            etree.SubElement(root, "vType", {**careful, **own_type})
    return to_bytes(root)


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
