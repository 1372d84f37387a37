"""Plays a replay folder in headless SUMO and compares it with what was recorded.

Of the folder the case, the record and the net are read, as data. SUMO runs on files that are
written from them into a temporary folder, as in an export.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo.errors import UserError, notice
from merge_sumo.interrupt import stopping_in_order
from merge_sumo.metrics.cause import cause
from merge_sumo.metrics.merge import Conflict
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.records import convert, read_record, to_json
from merge_sumo.result import Result
from merge_sumo.road.finder import FARTHEST_M
from merge_sumo.road.loader import road_of
from merge_sumo.road.road import Road
from merge_sumo.road.xml_input import RECORD_TAGS, parse_xml, read_xml
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import (
    DT_S,
    MAX_EPISODE_S,
    MAX_FOLLOW_UP_S,
    US23,
    VEHICLES,
    VUT,
    Scenario,
)
from merge_sumo.scenario.trajectory import Trajectory, cut_at
from merge_sumo.sumo.binding import run_program, scratch_folder
from merge_sumo.sumo.net_copies import hosted_net
from merge_sumo.sumo.replay_folder import (
    CASE,
    CONFIG,
    HOLD_STEPS,
    HOSTED_NET,
    NET,
    RECORD,
    SCENARIO,
    ReplayRoad,
    case_line,
    files_of,
    motion_record,
    road_of_hosted,
)

REPLAYED = "replayed.fcd.xml"
TOLERANCE = 1e-6
"""Metres and m/s; the record is written with nine digits."""
MAX_TIMESTEPS = round((MAX_EPISODE_S + MAX_FOLLOW_UP_S) / DT_S) + 1 + HOLD_STEPS
COLUMNS = ("x", "y", "speed", "pos")
"""Numbers of a vehicle in floating car data."""
SPEED, POSITION = 2, 3
COMPARED = 3
"""The first columns: the position is that of a lane."""


@dataclass(frozen=True, slots=True, repr=False)
class Replay(Result):
    """A headless replay, compared with its record.

    Attributes:
        rows: number of rows that were compared.
        diverged_at_s: time of the first row that differs; None where none does.
        detail: the difference.
        words: the case and its cause, and when a later begin is.

    Example:
        >>> ms.replay("scenarios/pov-yields").identical
        True
    """

    computed = ("identical",)

    rows: int
    diverged_at_s: float | None
    detail: str
    words: tuple[str, ...] = ()

    @property
    def is_good(self) -> bool:
        """See `Result`."""
        return self.identical

    @property
    def identical(self) -> bool:
        """True where no row differs."""
        return self.diverged_at_s is None

    def lines(self) -> list[str]:
        """Return the case and its cause, and whether the replay is identical."""
        if self.diverged_at_s is None:
            return [*self.words, f"identical: {self.rows} rows of x, y and speed"]
        return [*self.words, f"diverged at t = {self.diverged_at_s:.1f} s: {self.detail}"]


def replay(folder: Path, from_s: float | None = None) -> Replay:
    """Replay a folder in headless SUMO and compare every row of all vehicles with the record.

    Positions and speeds must agree within 1e-6, and the record must be an episode: all vehicles on
    their lanes, moved by eq. (4) and held at its end. SUMO plays the positions on the lanes of the
    record, so these must agree with its x and y, too.

    Args:
        folder: the replay folder, which may have been received.
        from_s: SUMO begins at this time before the first conflict, in s, below 0, in the state that
            it has there in the whole replay.

    Returns:
        The comparison.

    Raises:
        UserError: the folder is not a replay folder, or SUMO cannot run it.
    """
    episode = _read(folder)
    first, begins = Conflict.of(episode.trajectory).begin(from_s)
    with _staged(episode, first) as (stage, arguments):
        arguments += ["--fcd-output", REPLAYED, "--device.fcd.begin", f"{first * DT_S:.1f}"]
        arguments += ["--precision", "9", "--no-step-log", "true"]
        if reason := run_program("sumo", arguments, stage):
            raise UserError(f"SUMO cannot replay {folder}: {reason}")
        rows, _ = _record(stage / REPLAYED, f"SUMO's replay of {folder}")
    recorded = episode.record[first:, :, :COMPARED]
    count, cars, _ = recorded.shape
    replayed = rows[first : first + count, :cars, :COMPARED]
    motion = episode.trajectory.whole
    off_m = np.diff(motion[:, :, 0], axis=0) - motion[:-1, :, 1] * DT_S
    diverged_at_s, detail = None, ""
    if place := _first(replayed - recorded):
        row, car, column = place
        diverged_at_s = (first + row) * DT_S
        detail = f"{COLUMNS[column]} of {VEHICLES[car]} is {replayed[place]}, recorded "
        detail += f"{recorded[place]}"
    elif place := _first(off_m):
        diverged_at_s = place[0] * DT_S
        detail = f"{VEHICLES[place[1]]} is recorded as not moving at its speed"
    outcome = episode.outcome
    words = case_line(outcome.case, outcome.index), cause(outcome, episode.trajectory), *begins
    return Replay(count * cars, diverged_at_s, detail, words)


def _first(difference: FloatArray) -> tuple[int, ...]:
    """Return the place of the first difference above the tolerance; empty without one."""
    places = np.argwhere(~(np.abs(difference) <= TOLERANCE)).tolist()
    return tuple(places[0]) if places else ()


def check_display() -> None:
    """Raise `UserError` without a display."""
    if os.name == "posix" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UserError(
            "sumo-gui needs a display and DISPLAY is not set: use a desktop or xvfb-run"
        )


def open_gui(folder: Path, from_s: float | None = None, *, silent: bool = False) -> int:
    """Open a replay folder in sumo-gui and wait until it is closed.

    Args:
        folder: the replay folder, which may have been received.
        from_s: as in `replay`.
        silent: whether no notice says when it begins.

    Returns:
        1 where sumo-gui failed, else 0.

    Raises:
        UserError: there is no display, or the folder is not a replay folder.
    """
    check_display()
    episode = _read(folder)
    first, begins = Conflict.of(episode.trajectory).begin(from_s)
    for sentence in [] if silent else begins:
        notice(sentence)
    with stopping_in_order(), _staged(episode, first) as (stage, arguments):
        return int(run_program("sumo-gui", arguments, stage, limit_s=None) != "")


@dataclass(frozen=True, slots=True)
class _Episode:
    """The content of a replay folder.

    Attributes:
        record: `COLUMNS` of each vehicle at each step, (T, A, 4).
    """

    road: ReplayRoad
    outcome: Outcome
    trajectory: Trajectory
    record: FloatArray


def _read(folder: Path) -> _Episode:
    """Read case, record and net of a folder that may have been received."""
    if not folder.is_dir():
        raise UserError(
            f"there is no folder {folder}: name a replay folder, or a campaign and a case"
        )
    net = HOSTED_NET if (folder / HOSTED_NET).exists() else NET
    for name in (net, CASE, RECORD):
        if not (folder / name).exists():
            raise UserError(f"{folder} is not a replay folder: it has no {name}")
    outcome = _outcome(folder / CASE)
    road = _road(folder / net, outcome)
    name, cars = f"the record {folder / RECORD}", outcome.case.scenario.vehicles
    record, lanes = _record(folder / RECORD, name)
    record = record[: len(lanes) // cars, :cars]
    if len(record) <= HOLD_STEPS or np.isnan(record).any():
        raise UserError(
            f"{name} must have {', '.join(VEHICLES[:cars])} every {DT_S:g} s, in {1 + HOLD_STEPS} "
            "or more rows"
        )
    motion = _motion(record, lanes, road.road, name)
    measures = outcome.measures
    end = round(measures.t_end_s / DT_S)
    if not 0 <= end < len(motion):
        raise UserError(f"{folder} ends at {measures.t_end_s:g} s, and its record does not")
    until_merge, after = cut_at(motion, end)
    trajectory = Trajectory(
        outcome.case, until_merge, measures.end, measures.error, measures.clipped_steps, after
    )
    return _Episode(road, outcome, trajectory, record)


def _outcome(path: Path) -> Outcome:
    record: Any = read_record(path, dict[str, Any])
    try:
        written = record.pop(SCENARIO, None)  # folders of older versions have none
        scenario = US23 if written is None else convert(written, Scenario)
        return Outcome.from_json(to_json(record), scenario)
    except UserError as error:
        raise UserError(f"{path} is not the case of a replay: {error}") from error


def _road(path: Path, outcome: Outcome) -> ReplayRoad:
    content = read_xml(path, "the net")
    if path.name == NET:
        shipped = road_of()
        if content != shipped.path.read_bytes():
            raise UserError(f"{path} is not the net of this version: export the case again")
        return ReplayRoad(content, shipped, NET)
    road = road_of_hosted(content, path, outcome.case.scenario.lane_m)
    return ReplayRoad(hosted_net(road, 1, lane_goes_on=True), road, HOSTED_NET)


def _record(path: Path, name: str) -> tuple[FloatArray, dict[tuple[int, int], str]]:
    """Return floating car data, and the lane of each vehicle by (step, row).

    The data are `COLUMNS` of each vehicle at each step, (T, A, 4); NaN where it is missing.
    """
    root = parse_xml(read_xml(path, "the record"), name, RECORD_TAGS)
    record = np.full((MAX_TIMESTEPS, len(VEHICLES), len(COLUMNS)), np.nan)
    lanes: dict[tuple[int, int], str] = {}
    for car in root.iterfind("timestep/vehicle"):
        above, values = car.getparent(), {str(key): str(value) for key, value in car.items()}
        assert above is not None, "a timestep"  # noqa: S101
        try:
            step = float(above.attrib["time"]) / DT_S
            place = round(step), VEHICLES.index(values["id"])
            numbers = [float(values[column]) for column in COLUMNS]
            in_range = all(abs(number) <= FARTHEST_M for number in numbers)
            if step < 0.0 or abs(step - place[0]) > TOLERANCE or place in lanes or not in_range:
                raise ValueError("it is out of range, between steps, or repeats one")
            record[place] = numbers
            lanes[place] = values["lane"]
        except (IndexError, KeyError, OverflowError, ValueError) as error:
            raise UserError(
                f"{name} has a missing or wrong value in line {car.sourceline} ({error!r:.100})"
            ) from error
    return record, lanes


def _motion(
    record: FloatArray, lanes: dict[tuple[int, int], str], road: Road, name: str
) -> FloatArray:
    """Return the motion of a record without the rows that hold its end, (T, A, 3).

    The VUT has the lanes of the ramp, and that of the mainline next to an acceleration lane.
    """
    starts_m = np.zeros(record.shape[:2])
    main = {piece.lane: piece.start_m for piece in road.mainline.pieces}
    ramp = {piece.lane: piece.start_m for piece in road.ramp.pieces}
    for (step, car), lane in lanes.items():
        own = main | ramp if car == VUT else main
        if lane not in own:
            raise UserError(
                f"{name} has {VEHICLES[car]} on lane {lane:.40}, which is not on its path"
            )
        starts_m[step, car] = own[lane]
    x_m, v_mps = starts_m + record[:, :, POSITION], record[:, :, SPEED]
    a_mps2 = np.diff(v_mps, axis=0, append=v_mps[-1:]) / DT_S
    motion = np.stack((x_m, v_mps, a_mps2), axis=2)[:-HOLD_STEPS]
    motion[-1, :, 2] = 0.0
    return motion


@contextmanager
def _staged(episode: _Episode, first: int) -> Iterator[tuple[Path, list[str]]]:
    """Yield a temporary folder with all that SUMO reads, and what has it play from a row on.

    SUMO begins one row earlier and inserts each vehicle where it last was outside of junctions: the
    route that it gives it begins there, and decides between lanes that lie on each other.
    """
    record = motion_record(episode.road.road, episode.trajectory)
    row = max(first - 1, 0)
    inserted = {car.get("id"): car for car in record[0]}
    for step in [*record][: row + 1]:
        for car in step:
            if ":" not in car.get("lane", ""):
                inserted[car.get("id")] = car
    record[row][:] = [*inserted.values()]
    with scratch_folder() as stage:
        files = files_of(episode.road, episode.outcome, episode.trajectory, record)
        for name, content in files.items():
            (stage / name).write_bytes(content)
        yield stage, ["-c", CONFIG, "--begin", f"{row * DT_S:.1f}"]
