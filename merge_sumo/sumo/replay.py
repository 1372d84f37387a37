"""Plays a replay folder in headless SUMO and tells whether what it shows is what was recorded."""

from __future__ import annotations

import copy
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from lxml import etree

from merge_sumo.errors import UserError, notice
from merge_sumo.road import allowed, received
from merge_sumo.road.corridor import Corridor, LanePath
from merge_sumo.road.received import Allowed
from merge_sumo.scenario.scenario import DT_S, MAX_EPISODE_S, MAX_FOLLOW_UP_S, VEHICLES, VUT
from merge_sumo.sumo.binding import run_program, scratch_folder
from merge_sumo.sumo.replay_folder import (
    CONFIG,
    HOLD_STEPS,
    HOSTED_NET,
    LABELS,
    NET,
    RECORD,
    TYPES,
    Road,
    corridor_of_hosted,
    corridor_of_shipped,
    files_of,
)
from merge_sumo.system.interrupt import stopping_in_order
from merge_sumo.system.result import Result
from merge_sumo.verdict.conflict import Conflict

REPLAYED: Final = "replayed.fcd.xml"

COMPARED: Final = ("x", "y", "pos", "speed")
TOLERANCE: Final = 1e-6
"""Metres and m/s; the record is written with nine digits."""

LANE_END_M: Final = 2e-3
"""Nearer than this to where a lane begins, a vehicle may be on the lane before or behind."""
MIN_TIMESTEPS: Final = 1 + HOLD_STEPS
MAX_TIMESTEPS: Final = round((MAX_EPISODE_S + MAX_FOLLOW_UP_S) / DT_S) + 1 + HOLD_STEPS


@dataclass(frozen=True, slots=True, repr=False)
class Replay(Result):
    """A headless replay beside its record.

    Attributes:
        rows: rows that were compared.
        diverged_at_s: time of the first row that differs; None where none does.
        detail: in what it differs.
        words: the case and its cause, as the folder has them, and when a later begin is.
    """

    computed = ("identical",)

    rows: int
    diverged_at_s: float | None
    detail: str
    words: tuple[str, ...] = ()

    @property
    def identical(self) -> bool:
        """True where no row differs."""
        return self.diverged_at_s is None

    def lines(self) -> list[str]:
        """Return the case and its cause, and whether the replay is identical."""
        if self.diverged_at_s is None:
            return [*self.words, f"identical: {self.rows} rows of x, y, position and speed"]
        return [*self.words, f"diverged at t = {self.diverged_at_s:.1f} s: {self.detail}"]


def replay(folder: Path, from_s: float | None = None) -> Replay:
    """Replay a folder in headless SUMO and compare every row of all vehicles with the record.

    Positions (x, y, along the lane) and speeds must agree within 1e-6, and the record must be an
    episode: all vehicles on their lanes, moved by eq. (4) and held at its end. With `from_s` SUMO
    begins so long before the first conflict, in the state that it has there in the whole replay.

    The folder is data: net, vehicle types and record are read from it and nothing else, and SUMO
    runs in a temporary folder on what is allowed of them and on a configuration of ours. Raises
    `UserError` when the folder is no replay folder or SUMO cannot run it.
    """
    episode = _received(folder)
    first, begins = _conflict(episode).begin(from_s)
    with _staged(episode, first) as (stage, arguments):
        arguments += ["--fcd-output", REPLAYED, "--device.fcd.begin", f"{first * DT_S:.1f}"]
        arguments += ["--precision", "9", "--no-step-log", "true"]
        ended = run_program("sumo", arguments, stage)
        if ended.code != 0:
            raise UserError(f"SUMO cannot replay {folder}: {ended.reason}")
        written = received.read_bytes(stage / REPLAYED, "the replay", follow_links=False)
    name = f"SUMO's replay of {folder}"
    replayed = _rows(received.parse(written, allowed.REPLAYED, name), name)
    rows = {key: of for key, of in episode.rows.items() if round(key[0] / DT_S) >= first}
    fault = _difference(replace(episode, rows=rows), replayed) or _fault_of_record(episode)
    diverged_at_s, detail = fault or (None, "")
    return Replay(len(rows), diverged_at_s, detail, (*_words(episode.lines), *begins))


def _conflict(episode: _Episode) -> Conflict:
    """Find the first conflict of a received folder; a place that is missing is told as a fault."""
    cars, mainline = VEHICLES[: len(episode.types)], episode.road.corridor.mainline
    times = sorted({time for time, _ in episode.rows})[:-HOLD_STEPS]
    at = [[episode.places[time, who] or _OnPath(mainline, 0.0) for who in cars] for time in times]
    x_m = [[place.x_m for place in places] for places in at]
    v_mps = [[episode.rows[time, who][-1] for who in cars] for time in times]
    lanes = {piece.lane for piece in mainline.pieces}
    merged = (row for row, of in enumerate(at) if of[VUT].path.piece(of[VUT].x_m).lane in lanes)
    length_m = {vtype.get("id"): float(vtype.get("length", "5")) for vtype in episode.types}
    lengths_m = length_m["pov"], length_m["vut"]
    return Conflict.find(np.stack((x_m, v_mps), axis=2), next(merged, None), lengths_m)


def _words(lines: Sequence[str]) -> tuple[str, ...]:
    """Return the case and its cause as sentences, where there are any."""
    cause = ". ".join(lines[1:]).replace(":. ", ": ")
    return (lines[0], f"{cause}.") if cause else ()


Rows = dict[tuple[float, str], tuple[float, ...]]
"""The values of `COMPARED` by time and vehicle."""


class _OnPath(NamedTuple):
    path: LanePath
    x_m: float
    """Lane coordinate on it."""

    def is_at(self, x: float, y: float) -> bool:
        """Whether a point in the plane is this one."""
        lane = self.path.point(self.x_m)
        return math.hypot(x - lane.x_m, y - lane.y_m) <= LANE_END_M


Places = dict[tuple[float, str], _OnPath | None]
"""Path and lane coordinate by time and vehicle; None for a lane where the vehicle has no path."""


@dataclass(frozen=True, slots=True)
class _Episode:
    """The allowed content of a received folder."""

    road: Road
    types: etree._Element
    record: etree._Element
    lines: Sequence[str]
    """Texts of the case and its cause."""
    rows: Rows
    places: Places


def _received(folder: Path) -> _Episode:
    """Read net, vehicle types and record of a folder that somebody may have sent."""
    hosted = os.path.lexists(folder / HOSTED_NET)
    file = HOSTED_NET if hosted else NET
    for name in (file, TYPES, RECORD):
        if not os.path.lexists(folder / name):
            raise UserError(f"{folder} is not a replay folder: it has no {name}")
    path, schema, find = folder / file, allowed.NET, corridor_of_shipped
    if hosted:
        schema, find = allowed.HOSTED_NET, corridor_of_hosted
    net = received.cleaned(_bytes(path), schema, f"the net {path}")
    road = Road(net, find(net, path), file)
    types = _read(folder / TYPES, allowed.TYPES)
    if sorted(_vehicles(types)) not in map(sorted, (VEHICLES[:2], VEHICLES)):
        raise UserError(
            f"the file {folder / TYPES} must have one vType pov and one vType vut, and in traffic "
            "one ahead and one behind"
        )
    root, rows = _checked_record(folder / RECORD, _vehicles(types))
    lines = []
    if os.path.lexists(folder / LABELS):  # not in folders of older versions
        for poi in _read(folder / LABELS, allowed.LABELS).iterfind("poi[param]"):
            if poi.get("id", "").startswith("line"):
                lines.append(str(poi[0].get("value")))
    return _Episode(road, types, root, lines, rows, _places(root, road.corridor))


def _bytes(path: Path) -> bytes:
    return received.read_bytes(path, "the file", follow_links=False)


def _read(path: Path, schema: Mapping[str, Allowed]) -> etree._Element:
    return received.parse(_bytes(path), schema, f"the file {path}")


def _vehicles(types: etree._Element) -> tuple[str, ...]:
    return tuple(str(vtype.get("id")) for vtype in types)


def _checked_record(path: Path, vehicles: Sequence[str]) -> tuple[etree._Element, Rows]:
    root = _read(path, allowed.RECORD)
    if not MIN_TIMESTEPS <= len(root) <= MAX_TIMESTEPS:
        raise UserError(
            f"the record {path} must have from {MIN_TIMESTEPS} to {MAX_TIMESTEPS} timesteps"
        )
    for step, timestep in enumerate(root):
        if not abs(float(timestep.get("time", "")) - step * DT_S) <= TOLERANCE:
            raise UserError(f"the record {path} must have a timestep every {DT_S:g} s from 0 s on")
    rows = _rows(root, f"the record {path}")
    if rows.keys() != {(time, who) for time, _ in rows for who in vehicles} or (
        len(rows) != len(vehicles) * len(root)
    ):
        raise UserError(f"the record {path} must have every vehicle in every timestep")
    return root, rows


@contextmanager
def _staged(episode: _Episode, first: int) -> Iterator[tuple[Path, list[str]]]:
    """Yield a temporary folder, all in it checked, and what has SUMO play it from a row on.

    SUMO begins one row earlier and inserts each vehicle where it last was outside of junctions: the
    route that it gives it begins there, and decides between lanes that lie on each other.
    """
    row, record = max(first - 1, 0), copy.deepcopy(episode.record)
    outer = [car for step in [*record][: row + 1] for car in step if ":" not in car.get("lane", "")]
    record[row][:] = [*{car.get("id"): car for car in (*record[0], *outer)}.values()]
    with scratch_folder() as stage:
        files = files_of(episode.road, episode.types, record, episode.lines)
        for name, content in files.items():
            (stage / name).write_bytes(content)
        yield stage, ["-c", CONFIG, "--begin", f"{row * DT_S:.1f}"]


def _difference(episode: _Episode, replayed: Rows) -> tuple[float, str] | None:
    """Return when and in what a replay first differs from the record, or None."""
    for (time, who), values in episode.rows.items():
        seen = replayed.get((time, who))
        if seen is None:
            return (time, f"{who} is not there")
        place = episode.places[time, who]
        told = place is None or _is_told(place.x_m, place.path)
        for name, was, now in zip(COMPARED, values, seen, strict=True):
            if not (abs(now - was) <= TOLERANCE or (name == "pos" and not told)):
                return (time, f"{name} of {who} is {now}, recorded {was}")
    for time, who in replayed.keys() - episode.rows.keys():
        return (time, f"{who} is not in the record")
    return None


def _is_told(x_m: float, path: LanePath) -> bool:
    """Whether a replay tells the position on the lane; elsewhere x and y tell.

    SUMO keeps a vehicle a millimetre before the end of a lane, and where lanes overlap inside of a
    junction it may take the one before.
    """
    at_an_end = any(abs(x_m - start_m) <= LANE_END_M for start_m in path.starts_m)
    return not (at_an_end or path.piece(x_m).is_internal)


def _fault_of_record(episode: _Episode) -> tuple[float, str] | None:
    """Return when and why a checked record is no episode, or None when it is one."""
    rows, road = episode.rows, episode.road.corridor
    _, end_m = road.lane_m or (0.0, 0.0)
    times = sorted({time for time, _ in rows})
    moving = set(times[: -HOLD_STEPS - 1])
    for time, after in zip(times, [*times[1:], None], strict=True):
        for who in _vehicles(episode.types):
            x, y, _, speed = rows[time, who]
            place = episode.places[time, who]
            if place is None or not place.is_at(x, y):
                return (time, f"{who} is recorded beside its lane")
            if after is None:
                continue
            if time not in moving:
                if rows[after, who] != rows[time, who]:
                    return (after, f"{who} is not held where the episode ended")
                continue
            to = episode.places[after, who]
            if to is None or not abs(to.x_m - place.x_m - speed * DT_S) <= TOLERANCE:
                return (time, f"{who} is recorded as not moving at its speed of {speed}")
            if place.path is road.mainline and to.path is road.ramp and to.x_m < end_m:
                return (after, f"{who} is recorded back on the acceleration lane")
    return None


def _places(record: etree._Element, road: Corridor) -> Places:
    """Return the places of the vehicles in the rows of a record that was checked.

    The VUT has the lanes of the ramp, and that of the mainline beside an acceleration lane.
    """
    main, ramp = (
        {piece.lane: _OnPath(path, piece.start_m) for piece in path.pieces}
        for path in (road.mainline, road.ramp)
    )
    begin_m, end_m = road.lane_m or (0.0, 0.0)
    beside = {lane: at for lane, at in main.items() if begin_m <= at.x_m < end_m}
    begins = {who: main if who != VEHICLES[VUT] else beside | ramp for who in VEHICLES}
    found: Places = {}
    for timestep in record:
        time = round(float(timestep.get("time", "")), 3)
        for vehicle in timestep:
            who = str(vehicle.get("id"))
            begin = begins[who].get(str(vehicle.get("lane")))
            position_m = float(vehicle.get("pos", ""))
            found[time, who] = begin and _OnPath(begin.path, begin.x_m + position_m)
    return found


def check_display() -> None:
    """Raise `UserError` when there is no display."""
    if os.name == "posix" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UserError(
            "sumo-gui needs a display and DISPLAY is not set: use a desktop or xvfb-run"
        )


def open_gui(folder: Path, from_s: float | None = None) -> int:
    """Open a replay folder in sumo-gui, wait until it is closed, and return its exit code.

    As for `replay`, sumo-gui runs in a temporary folder, on nothing that was not checked. Raises
    `UserError` when there is no display or the folder is no replay folder. A late begin is noticed.
    """
    check_display()
    episode = _received(folder)
    first, begins = _conflict(episode).begin(from_s)
    for sentence in begins:
        notice(sentence)
    with stopping_in_order(), _staged(episode, first) as (stage, arguments):
        return run_program("sumo-gui", arguments, stage, limit_s=None).code


def _rows(root: etree._Element, name: str) -> Rows:
    """Return the rows of an FCD file that was checked; `UserError` where one stands there twice."""
    rows: Rows = {}
    for timestep in root:
        time = round(float(timestep.get("time", "")), 3)
        for vehicle in timestep:
            key = (time, str(vehicle.get("id")))
            if key in rows:
                raise UserError(f"{name} has two rows of {key[1]} at {time:g} s")
            rows[key] = tuple(float(vehicle.get(column, "")) for column in COMPARED)
    return rows
