"""Play a replay folder in SUMO and compare the motion with the record.

The folder may have been received: its case, record and net are read as data, and SUMO runs on new
files that are written from them into a temporary folder.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo.errors import UserError, explained, notice
from merge_sumo.interrupt import stopping_in_order
from merge_sumo.metrics.merge import Conflict
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.timeline import timeline
from merge_sumo.records import convert, read_record, to_json
from merge_sumo.result import Result
from merge_sumo.road.finder import FARTHEST_M
from merge_sumo.road.loader import centre_lines
from merge_sumo.road.road import Road
from merge_sumo.road.xml_input import RECORD_TAGS, parse_xml, read_xml
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import (
    DT_S,
    MAX_EPISODE_S,
    MAX_FOLLOW_UP_S,
    VEHICLES,
    VUT,
    Scenario,
)
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.sumo.binding import run_program, scratch_folder
from merge_sumo.sumo.replay_folder import (
    CASE,
    CONFIG,
    HOLD_STEPS,
    NET,
    RECORD,
    SCENARIO,
    files_of,
    motion_record,
    road_of_hosted,
)

REPLAYED = "replayed.fcd.xml"
TOLERANCE = 1e-6
"""Maximum difference in m and m/s; a record has nine digits."""
MAX_TIMESTEPS = round((MAX_EPISODE_S + MAX_FOLLOW_UP_S) / DT_S) + 1 + HOLD_STEPS
COLUMNS = ("x", "y", "speed", "pos")
"""Numbers of a vehicle in floating car data; "pos" is a position on a lane."""
SPEED, POSITION = 2, 3
COMPARED = 3
"""Number of the first columns that are compared."""


@dataclass(frozen=True, slots=True, repr=False)
class Replay(Result):
    """The comparison of a replay with the recorded motion. `ms.replay` returns it.

    Attributes:
        rows: number of rows that were compared, over all vehicles.
        diverged_at_s: time of the first row that differs, in s; None if the replay is identical.
        detail: the difference, in words.
        words: lines about the case: its timeline, and a later begin of the replay.

    Example:
        ```python
        assert ms.replay("scenarios/pov-yields").identical
        ```
    """

    computed = ("identical",)

    rows: int
    diverged_at_s: float | None
    detail: str
    words: tuple[str, ...] = ()

    @property
    def is_good(self) -> bool:
        """Whether the replay is identical."""
        return self.identical

    @property
    def identical(self) -> bool:
        """Whether all rows are equal."""
        return self.diverged_at_s is None

    def lines(self) -> list[str]:
        """Return the case and its timeline, and whether the replay is identical."""
        if self.diverged_at_s is None:
            return [*self.words, f"identical: {self.rows} rows of x, y and speed"]
        return [*self.words, f"diverged at t = {self.diverged_at_s:.1f} s: {self.detail}"]


def replay(folder: Path, from_s: float | None = None) -> Replay:
    """Replay a folder in SUMO without a window, and compare all vehicles in every row.

    The record itself must be an episode, whose vehicles are on their lanes, move by eq. (4) and
    stand at the end. SUMO plays the positions on lanes, which must agree with x and y of the
    record.

    Args:
        folder: the replay folder.
        from_s: begin before the first conflict, in s, not above 0; None for the start of the
            episode. SUMO begins in the state of that time.

    Returns:
        The comparison, with a tolerance of 1e-6 m and m/s.

    Raises:
        UserError: the folder is not a replay folder, or SUMO cannot run it.

    Example:
        >>> replay(Path("scenarios/pov-yields")).identical
        True
    """
    episode = _read(folder)
    first, begins = episode.conflict.begin(from_s)
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
    if different := _first(replayed - recorded):
        row, car, column = different
        diverged_at_s = (first + row) * DT_S
        detail = f"{COLUMNS[column]} of {VEHICLES[car]} is {replayed[different]}, recorded "
        detail += f"{recorded[different]}"
    elif different := _first(off_m):
        row, car = different
        diverged_at_s = row * DT_S
        detail = f"the recorded motion of {VEHICLES[car]} does not match its speed"
    outcome = episode.outcome
    told = timeline(outcome, episode.trajectory, centre_lines(episode.road))
    words = *told.lines(outcome.case, f"case {outcome.index}"), *begins
    return Replay(count * cars, diverged_at_s, detail, words)


def _first(difference: FloatArray) -> tuple[int, ...]:
    """Return the index of the first number above the tolerance; empty without one."""
    indices = np.argwhere(~(np.abs(difference) <= TOLERANCE)).tolist()
    return tuple(indices[0]) if indices else ()


def open_gui(folder: Path, from_s: float | None = None, *, silent: bool = False) -> None:
    """Open a replay folder in sumo-gui and wait until it is closed.

    Args:
        folder: the replay folder.
        from_s: begin before the first conflict, as in `replay`.
        silent: whether to print no notice of the beginning.

    Raises:
        UserError: sumo-gui failed, or the folder is not a replay folder.
    """
    episode = _read(folder)
    first, begins = episode.conflict.begin(from_s)
    if not silent:
        for sentence in begins:
            notice(sentence)
    with stopping_in_order(), _staged(episode, first) as (stage, arguments):
        if reason := run_program("sumo-gui", arguments, stage, limit_s=None):
            raise UserError(f"sumo-gui failed ({reason}): it needs a desktop, or xvfb-run")


@dataclass(frozen=True, slots=True)
class _Episode:
    """The content of a replay folder, with a record of `COLUMNS`, (T, A, 4)."""

    road: Road
    outcome: Outcome
    trajectory: Trajectory
    record: FloatArray

    @property
    def conflict(self) -> Conflict:
        """The first conflict."""
        return Conflict.of(self.trajectory, centre_lines(self.road))


def _read(folder: Path) -> _Episode:
    """Read case, record and net of a folder as data."""
    if not (folder / CASE).exists():
        raise UserError(
            f"{folder} is not a replay folder: it has no {CASE}; name a replay folder, or a "
            "campaign and a case"
        )
    net = folder / NET
    if not net.exists():
        raise UserError(
            f"{folder} has no {NET}, because an earlier version wrote it: move it, and export the "
            "case again"
        )
    outcome = _outcome(folder / CASE)
    road = road_of_hosted(read_xml(net, "the net"), net, outcome.case.scenario.lane_m)
    name, cars = f"the record {folder / RECORD}", outcome.case.scenario.vehicles
    record, lanes = _record(folder / RECORD, name)
    record = record[: len(lanes) // cars, :cars]
    if len(record) <= HOLD_STEPS or np.isnan(record).any():
        raise UserError(
            f"{name} must have {', '.join(VEHICLES[:cars])} every {DT_S:g} s, in {1 + HOLD_STEPS} "
            "or more rows"
        )
    motion = _motion(record, lanes, road, name)
    end_s = outcome.measures.t_end_s
    if not 0 <= round(end_s / DT_S) < len(motion):
        raise UserError(f"{folder} ends at {end_s:g} s, but its record does not")
    return _Episode(road, outcome, outcome.trajectory(motion), record)


def _outcome(path: Path) -> Outcome:
    record: Any = read_record(path, dict[str, Any])
    with explained(f"{path} is not the case of a replay"):
        scenario = convert(record.pop(SCENARIO, None), Scenario)
        return Outcome.from_json(to_json(record), scenario)


def _record(path: Path, name: str) -> tuple[FloatArray, dict[tuple[int, int], str]]:
    """Read floating car data.

    Returns:
        `COLUMNS` of each vehicle at each step, (T, A, 4), NaN where a vehicle is missing; and the
        lane of each vehicle by (step, vehicle).
    """
    root = parse_xml(read_xml(path, "the record"), name, RECORD_TAGS)
    record = np.full((MAX_TIMESTEPS, len(VEHICLES), len(COLUMNS)), np.nan)
    lanes: dict[tuple[int, int], str] = {}
    for timestep in root.iterfind("timestep"):
        for car in timestep.iterfind("vehicle"):
            try:
                step = float(timestep.attrib["time"]) / DT_S
                index = round(step), VEHICLES.index(str(car.attrib["id"]))
                numbers = [float(car.attrib[column]) for column in COLUMNS]
                in_range = all(abs(number) <= FARTHEST_M for number in numbers)
                if step < 0.0 or abs(step - index[0]) > TOLERANCE or index in lanes or not in_range:
                    raise ValueError("a value is out of range, between steps or repeated")
                record[index] = numbers
                lanes[index] = str(car.attrib["lane"])
            except (IndexError, KeyError, OverflowError, ValueError) as error:
                raise UserError(
                    f"{name} has a missing or wrong value in line {car.sourceline} ({error!r:.100})"
                ) from error
    return record, lanes


def _motion(
    record: FloatArray, lanes: dict[tuple[int, int], str], road: Road, name: str
) -> FloatArray:
    """Return the motion of a record without the rows that hold its end, (T, A, 3)."""
    starts_m = np.zeros(record.shape[:2])
    main = {piece.lane: piece.start_m for piece in road.mainline.pieces}
    # On the mainline, too, where it has merged from an acceleration lane.
    of_vut = main | {piece.lane: piece.start_m for piece in road.ramp.pieces}
    for (step, car), lane in lanes.items():
        start_m = (of_vut if car == VUT else main).get(lane)
        if start_m is None:
            raise UserError(
                f"{name} has {VEHICLES[car]} on lane {lane:.40}, which is not on its path"
            )
        starts_m[step, car] = start_m
    x_m, v_mps = starts_m + record[:, :, POSITION], record[:, :, SPEED]
    a_mps2 = np.diff(v_mps, axis=0, append=v_mps[-1:]) / DT_S
    motion = np.stack((x_m, v_mps, a_mps2), axis=2)[:-HOLD_STEPS]
    motion[-1, :, 2] = 0.0
    return motion


@contextmanager
def _staged(episode: _Episode, first: int) -> Iterator[tuple[Path, list[str]]]:
    """Yield a temporary folder with the files of an episode, and the arguments to play them.

    SUMO begins one row before `first`. It inserts each vehicle where it last was outside of
    junctions: the route of the vehicle begins there, and decides between lanes that overlap.
    """
    record = motion_record(episode.road, episode.trajectory)
    row = max(first - 1, 0)
    inserted = {}
    for step in [*record][: row + 1]:
        for car in step:
            if step is record[0] or ":" not in car.get("lane", ""):
                inserted[car.get("id")] = car
    record[row][:] = inserted.values()
    with scratch_folder() as stage:
        files = files_of(episode.road, episode.outcome, episode.trajectory, record)
        for name, content in files.items():
            (stage / name).write_bytes(content)
        yield stage, ["-c", CONFIG, "--begin", f"{row * DT_S:.1f}"]
