"""Plays a replay folder in headless SUMO and tells whether what it shows is what was recorded.

Of the folder the case, the record and the net are read, as data. What SUMO runs is written from
them into a temporary folder, in the same way as an export: whoever sent the folder decides on
numbers, and on nothing else.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from merge_sumo.errors import UserError, notice
from merge_sumo.interrupt import stopping_in_order
from merge_sumo.metrics.cause import cause
from merge_sumo.metrics.merge import Conflict
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.records import Record, convert, read_record, to_json
from merge_sumo.result import Result
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.finder import FARTHEST_M
from merge_sumo.road.merge import road_of
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
from merge_sumo.sumo.hosting import hosted_net
from merge_sumo.sumo.replay_folder import (
    CASE,
    CONFIG,
    HOLD_STEPS,
    HOSTED_NET,
    NET,
    RECORD,
    SCENARIO,
    Road,
    case_line,
    corridor_of_hosted,
    files_of,
    motion_record,
)

REPLAYED = "replayed.fcd.xml"
TOLERANCE = 1e-6
"""Metres and m/s; the record is written with nine digits."""
MAX_TIMESTEPS = round((MAX_EPISODE_S + MAX_FOLLOW_UP_S) / DT_S) + 1 + HOLD_STEPS


@dataclass(frozen=True, slots=True, repr=False)
class Replay(Result):
    """A headless replay, compared with its record.

    Attributes:
        rows: rows that were compared.
        diverged_at_s: time of the first row that differs; None where none does.
        detail: in what it differs.
        words: the case and its cause, and when a later begin is.
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
        from_s: SUMO begins so long before the first conflict, in the state that it has there in
            the whole replay.

    Raises:
        UserError: the folder is not a replay folder, or SUMO cannot run it.
    """
    episode = _read(folder)
    first, begins = Conflict.of(episode.trajectory).begin(from_s)
    with _staged(episode, first) as (stage, arguments):
        arguments += ["--fcd-output", REPLAYED, "--device.fcd.begin", f"{first * DT_S:.1f}"]
        arguments += ["--precision", "9", "--no-step-log", "true"]
        ended = run_program("sumo", arguments, stage)
        if ended.code != 0:
            raise UserError(f"SUMO cannot replay {folder}: {ended.reason}")
        replayed = _record(stage / REPLAYED, f"SUMO's replay of {folder}")
    recorded = {at: row for at, row in episode.rows.items() if at[0] >= first}
    fault = _difference(recorded, replayed) or _broken_motion(episode.trajectory)
    diverged_at_s, detail = fault or (None, "")
    outcome = episode.outcome
    words = case_line(outcome.case, outcome.index), cause(outcome, episode.trajectory), *begins
    return Replay(len(recorded), diverged_at_s, detail, words)


def check_display() -> None:
    """Raise `UserError` when there is no display."""
    if os.name == "posix" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UserError(
            "sumo-gui needs a display and DISPLAY is not set: use a desktop or xvfb-run"
        )


def open_gui(folder: Path, from_s: float | None = None, *, silent: bool = False) -> int:
    """Open a replay folder in sumo-gui, wait until it is closed, and return its exit code.

    Args:
        folder: the replay folder, which may have been received.
        from_s: as in `replay`.
        silent: whether no notice says when it begins.

    Raises:
        UserError: there is no display, or the folder is not a replay folder.
    """
    check_display()
    episode = _read(folder)
    first, begins = Conflict.of(episode.trajectory).begin(from_s)
    for sentence in [] if silent else begins:
        notice(sentence)
    with stopping_in_order(), _staged(episode, first) as (stage, arguments):
        return run_program("sumo-gui", arguments, stage, limit_s=None).code


Place = Annotated[float, Meta(ge=-FARTHEST_M, le=FARTHEST_M)]


class RecordedTime(Record, frozen=True, forbid_unknown_fields=False):
    """A step of a record."""

    time: Annotated[float, Meta(ge=0.0, le=MAX_TIMESTEPS * DT_S)]


class RecordedMotion(Record, frozen=True, forbid_unknown_fields=False):
    """The motion of a vehicle at a step, as SUMO's floating car data has it."""

    id: Literal["pov", "vut", "ahead", "behind"]
    x: Place
    y: Place
    pos: Place
    speed: Annotated[float, Meta(ge=0.0, le=1000.0)]
    lane: str


Rows = dict[tuple[int, str], RecordedMotion]
"""The motion of each vehicle at each step."""


@dataclass(frozen=True, slots=True)
class _Episode:
    """The content of a replay folder."""

    road: Road
    outcome: Outcome
    trajectory: Trajectory
    rows: Rows


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
    rows = _record(folder / RECORD, f"the record {folder / RECORD}")
    motion = _motion(rows, road.corridor, outcome, f"the record {folder / RECORD}")
    measures = outcome.measures
    end = round(measures.t_end_s / DT_S)
    if not 0 <= end < len(motion):
        raise UserError(f"{folder} ends at {measures.t_end_s:g} s, and its record does not")
    until_merge, after = cut_at(motion, end)
    trajectory = Trajectory(
        outcome.case, until_merge, measures.end, measures.error, measures.clipped_steps, after
    )
    return _Episode(road, outcome, trajectory, rows)


def _outcome(path: Path) -> Outcome:
    record: Any = read_record(path, dict[str, Any])
    try:
        written = record.pop(SCENARIO, None)  # folders of older versions have none
        scenario = US23 if written is None else convert(written, Scenario)
        return Outcome.from_json(to_json(record), scenario)
    except UserError as error:
        raise UserError(f"{path} is not the case of a replay: {error}") from error


def _road(path: Path, outcome: Outcome) -> Road:
    content = read_xml(path, "the net")
    if path.name == NET:
        shipped = road_of()
        if content != shipped.path.read_bytes():
            raise UserError(f"{path} is not the net of this version: export the case again")
        return Road(content, shipped, NET)
    corridor = corridor_of_hosted(content, path, outcome.case.scenario.lane_m)
    return Road(hosted_net(corridor, 1, lane_goes_on=True), corridor, HOSTED_NET)


def _motion(rows: Rows, road: Corridor, outcome: Outcome, name: str) -> FloatArray:
    """Return the motion of a record without the rows that hold its end, (steps, vehicles, 3).

    The VUT has the lanes of the ramp, and that of the mainline next to an acceleration lane.
    """
    cars = VEHICLES[: outcome.case.scenario.vehicles]
    steps = len(rows) // len(cars) - HOLD_STEPS
    if steps < 1 or rows.keys() != {*product(range(steps + HOLD_STEPS), cars)}:
        raise UserError(
            f"{name} must have {', '.join(cars)} every {DT_S:g} s, in {1 + HOLD_STEPS} or more rows"
        )
    main = {piece.lane: piece.start_m for piece in road.mainline.pieces}
    ramp = {piece.lane: piece.start_m for piece in road.ramp.pieces}
    motion = np.zeros((steps, len(cars), 3))
    for (step, who), row in rows.items():
        lanes = main | ramp if who == VEHICLES[VUT] else main
        if row.lane not in lanes:
            raise UserError(f"{name} has {who} on lane {row.lane:.40}, which is not on its path")
        if step < steps:
            motion[step, cars.index(who), :2] = lanes[row.lane] + row.pos, row.speed
    motion[:-1, :, 2] = np.diff(motion[:, :, 1], axis=0) / DT_S
    return motion


def _record(path: Path, name: str) -> Rows:
    """Return the rows of floating car data; `UserError` where one has a wrong value."""
    root = parse_xml(read_xml(path, "the record"), name, RECORD_TAGS)
    if len(root) > MAX_TIMESTEPS:
        raise UserError(f"{name} has {len(root)} timesteps, and at most {MAX_TIMESTEPS} are read")
    rows: Rows = {}
    for timestep in root:
        try:
            time = convert(dict(timestep.items()), RecordedTime, strict=False).time
            moved = [convert(dict(car.items()), RecordedMotion, strict=False) for car in timestep]
        except UserError as error:
            raise UserError(f"{name}: {error}") from error
        step = round(time / DT_S)
        if abs(time - step * DT_S) > TOLERANCE:
            raise UserError(f"{name} has a timestep at {time:g} s: there is one every {DT_S:g} s")
        for row in moved:
            if (step, row.id) in rows:
                raise UserError(f"{name} has two rows of {row.id} at {time:g} s")
            rows[step, row.id] = row
    return rows


@contextmanager
def _staged(episode: _Episode, first: int) -> Iterator[tuple[Path, list[str]]]:
    """Yield a temporary folder with all that SUMO reads, and what has it play from a row on.

    SUMO begins one row earlier and inserts each vehicle where it last was outside of junctions: the
    route that it gives it begins there, and decides between lanes that lie on each other.
    """
    record = motion_record(episode.road.corridor, episode.trajectory)
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


def _difference(recorded: Rows, replayed: Rows) -> tuple[float, str] | None:
    """Return when and in what a replay first differs from the record, or None."""
    for (step, who), row in recorded.items():
        shown = replayed.get((step, who))
        if shown is None:
            return step * DT_S, f"{who} is not there"
        for name in ("x", "y", "speed"):
            was, now = getattr(row, name), getattr(shown, name)
            if abs(now - was) > TOLERANCE:
                return step * DT_S, f"{name} of {who} is {now}, recorded {was}"
    return None


def _broken_motion(trajectory: Trajectory) -> tuple[float, str] | None:
    """Return when a vehicle of the record does not move by eq. (4), or None."""
    x_m, v_mps = trajectory.whole[:, :, 0], trajectory.whole[:, :, 1]
    away_m = np.abs(np.diff(x_m, axis=0) - v_mps[:-1] * DT_S)
    for step, car in np.argwhere(away_m > TOLERANCE).tolist():
        speed = v_mps[step, car]
        return step * DT_S, f"{VEHICLES[car]} is recorded as not moving at its speed of {speed}"
    return None
