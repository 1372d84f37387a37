"""A recorded episode as a folder that sumo and sumo-gui replay with nothing else running."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.folders import new_folder
from merge_sumo.scenario import DT_S, MAX_STEPS
from merge_sumo.score import Outcome
from merge_sumo.sumo import received
from merge_sumo.sumo.binding import run_program, scratch_folder
from merge_sumo.sumo.net import Net
from merge_sumo.trajectory import Trajectory

CONFIG: Final = "replay.sumocfg"
NET: Final = "us23.net.xml"
TYPES: Final = "vehicles.add.xml"
RECORD: Final = "episode.fcd.xml"
VIEW: Final = "view.settings.xml"
CASE: Final = "case.json"
REPLAYED: Final = "replayed.fcd.xml"

COMPARED: Final = ("x", "y", "pos", "speed")
TOLERANCE: Final = 1e-6
"""Metres and m/s; the record is written with nine digits."""

LANE_END_M: Final = 2e-3
"""Nearer than this to M, a vehicle may be on the lane before or behind."""

COLOURS: Final = {"pov": "0.90,0.25,0.15", "vut": "0.10,0.35,0.90"}
HOLD_STEPS: Final = 10
"""Steps for which the last picture stays, so that a person sees how it ended."""
MIN_TIMESTEPS: Final = 1 + HOLD_STEPS
MAX_TIMESTEPS: Final = MAX_STEPS + 1 + HOLD_STEPS


def write_scenario(folder: Path, net: Net, outcome: Outcome, trajectory: Trajectory) -> Path:
    """Write an episode as a replay folder and return the path of its configuration.

    Raises `UserError` when the folder exists or cannot be written; nothing is overwritten.
    """
    with new_folder(folder) as new:
        (new / CASE).write_text(json.dumps(outcome.to_record(), indent=2) + "\n", "utf-8")
        _write(new, net, _types(trajectory), _fcd(net, trajectory))
    return folder / CONFIG


def _write(folder: Path, net: Net, types: etree._Element, record: etree._Element) -> None:
    """Write all that SUMO reads, the configuration last."""
    (folder / NET).write_bytes(net.text)
    (folder / TYPES).write_bytes(received.serialize(types))
    (folder / RECORD).write_bytes(received.serialize(record))
    (folder / VIEW).write_bytes(received.serialize(_view()))
    (folder / CONFIG).write_bytes(received.serialize(_config(len(record))))


@dataclass(frozen=True, slots=True)
class Replay:
    """What a headless replay showed: rows compared, and where the first differed, if one did."""

    rows: int
    diverged_at_s: float | None
    detail: str


def replay(folder: Path) -> Replay:
    """Replay a folder in headless SUMO and compare every row of both vehicles with the record.

    Positions (x, y, along the lane) and speeds must agree within 1e-6, and the record must be an
    episode: both vehicles on their lanes, moved by eq. (4) and held at its end.

    The folder is data: net, vehicle types and record are read from it and nothing else, and SUMO
    runs in a temporary folder on what is allowed of them and on a configuration of ours. Raises
    `UserError` when the folder is no replay folder or SUMO cannot run it.
    """
    episode = _received(folder)
    with _staged(episode) as stage:
        arguments = ["-c", CONFIG, "--fcd-output", REPLAYED, "--precision", "9"]
        ended = run_program("sumo", [*arguments, "--no-step-log", "true"], stage)
        if ended.code != 0:
            raise UserError(f"SUMO cannot replay {folder}: {ended.reason}")
        written = received.read_bytes(stage / REPLAYED, "the replay", follow_links=False)
    name = f"SUMO's replay of {folder}"
    replayed = _rows(received.parse(written, received.REPLAYED, name)[0], name)
    fault = _difference(episode.rows, replayed) or _fault_of_record(episode.rows, episode.net)
    return Replay(len(episode.rows), *(fault or (None, "")))


Rows = dict[tuple[float, str], tuple[float, ...]]
"""The values of `COMPARED` by time and vehicle."""


@dataclass(frozen=True, slots=True)
class _Episode:
    """What is allowed of a received folder."""

    net: Net
    types: etree._Element
    record: etree._Element
    rows: Rows


def _received(folder: Path) -> _Episode:
    """Read net, vehicle types and record of a folder that somebody may have sent."""
    for name in (NET, TYPES, RECORD):
        if not os.path.lexists(folder / name):
            raise UserError(f"{folder} is not a replay folder: it has no {name}")
    net, types, record = (
        received.read_bytes(folder / name, "the file", follow_links=False)
        for name in (NET, TYPES, RECORD)
    )
    return _Episode(
        Net.of_bytes(net, folder / NET),
        _checked_types(types, folder / TYPES),
        *_checked_record(record, folder / RECORD),
    )


def _checked_types(content: bytes, path: Path) -> etree._Element:
    root, _ = received.parse(content, received.TYPES, f"the file {path}")
    if sorted(str(vtype.get("id")) for vtype in root) != sorted(COLOURS):
        raise UserError(f"the file {path} must have one vType pov and one vType vut")
    return root


def _checked_record(content: bytes, path: Path) -> tuple[etree._Element, Rows]:
    root, _ = received.parse(content, received.RECORD, f"the record {path}")
    if not MIN_TIMESTEPS <= len(root) <= MAX_TIMESTEPS:
        raise UserError(
            f"the record {path} must have from {MIN_TIMESTEPS} to {MAX_TIMESTEPS} timesteps"
        )
    for step, timestep in enumerate(root):
        if not abs(float(timestep.get("time", "")) - step * DT_S) <= TOLERANCE:
            raise UserError(f"the record {path} must have a timestep every {DT_S:g} s from 0 s on")
    rows = _rows(root, f"the record {path}")
    if len(rows) != len(COLOURS) * len(root):
        raise UserError(f"the record {path} must have both vehicles in every timestep")
    return root, rows


@contextmanager
def _staged(episode: _Episode) -> Iterator[Path]:
    """Yield a temporary folder that holds an episode, with nothing in it that was not checked."""
    with scratch_folder() as stage:
        _write(stage, episode.net, episode.types, episode.record)
        yield stage


def _difference(recorded: Rows, replayed: Rows) -> tuple[float, str] | None:
    """Return when and in what a replay first differs from the record, or None."""
    for (time, who), values in recorded.items():
        seen = replayed.get((time, who))
        if seen is None:
            return (time, f"{who} is not there")
        # SUMO keeps a vehicle a millimetre before the end of a lane: there x and y tell.
        at_m = math.hypot(values[0], values[1]) <= LANE_END_M
        for name, was, now in zip(COMPARED, values, seen, strict=True):
            if not (abs(now - was) <= TOLERANCE or (name == "pos" and at_m)):
                return (time, f"{name} of {who} is {now}, recorded {was}")
    for time, who in replayed.keys() - recorded.keys():
        return (time, f"{who} is not in the record")
    return None


def _fault_of_record(rows: Rows, net: Net) -> tuple[float, str] | None:
    """Return when and why a checked record is no episode, or None when it is one."""
    times = sorted({time for time, _ in rows})
    moving = set(times[: -HOLD_STEPS - 1])
    for time, after in zip(times, [*times[1:], None], strict=True):
        for who in COLOURS:
            x, y, position, speed = rows[time, who]
            x_m = _lane_coordinate(x, position, net, on_ramp=who == "vut")
            _, _, x_of_lane, y_of_lane, _ = net.lane_point(x_m, on_ramp=who == "vut")
            if not math.hypot(x - x_of_lane, y - y_of_lane) <= LANE_END_M:
                return (time, f"{who} is recorded beside its lane")
            if after is None:
                continue
            if time not in moving:
                if rows[after, who] != rows[time, who]:
                    return (after, f"{who} is not held where the episode ended")
                continue
            x_after, _, position_after, _ = rows[after, who]
            to_m = _lane_coordinate(x_after, position_after, net, on_ramp=who == "vut")
            if not abs(to_m - x_m - speed * DT_S) <= TOLERANCE:
                return (time, f"{who} is recorded as not moving at its speed of {speed}")
    return None


def _lane_coordinate(x: float, position: float, net: Net, *, on_ramp: bool) -> float:
    lane = net.ramp if on_ramp else net.main_in
    return position if x >= 0.0 else position - lane.length_m


def open_gui(folder: Path) -> int:
    """Open a replay folder in sumo-gui, wait until it is closed, and return its exit code.

    As for `replay`, sumo-gui runs in a temporary folder, on nothing that was not checked. Raises
    `UserError` when there is no display or the folder is no replay folder.
    """
    if os.name == "posix" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        raise UserError(
            "sumo-gui needs a display and DISPLAY is not set: use a desktop or xvfb-run"
        )
    with _staged(_received(folder)) as stage:
        return run_program("sumo-gui", ["-c", CONFIG], stage, limit_s=None).code


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


def _types(trajectory: Trajectory) -> etree._Element:
    root = etree.Element("additional")
    first_speeds = {"pov": trajectory.v_pov_mps[0], "vut": trajectory.v_vut_mps[0]}
    for name, colour in COLOURS.items():
        etree.SubElement(
            root,
            "vType",
            id=name,
            color=colour,
            guiShape="passenger/sedan",
            length="5",
            minGap="0",
            # The replay inserts a vehicle at the highest speed it may drive, so make that the
            # first speed of the record; all later speeds come from the record itself.
            maxSpeed=f"{max(first_speeds[name], 1e-9):.9f}",
            speedFactor="2",
            # Nor does SUMO then slow it down for the junction.
            decel="1000",
            emergencyDecel="1000",
        )
    return root


def _fcd(net: Net, trajectory: Trajectory) -> etree._Element:
    root = etree.Element("fcd-export")
    motion = trajectory.motion.tolist()
    motion += [motion[-1]] * HOLD_STEPS
    for step, (x_pov, v_pov, _, x_vut, v_vut, _) in enumerate(motion):
        timestep = etree.SubElement(root, "timestep", time=f"{step * DT_S:.2f}")
        for who, x_m, v_mps in (("pov", x_pov, v_pov), ("vut", x_vut, v_vut)):
            lane, position, x, y, angle = net.lane_point(x_m, on_ramp=who == "vut")
            etree.SubElement(
                timestep,
                "vehicle",
                id=who,
                x=f"{x:.9f}",
                y=f"{y:.9f}",
                angle=f"{angle:.9f}",
                type=who,
                speed=f"{v_mps:.9f}",
                pos=f"{position:.9f}",
                lane=lane,
            )
    return root


def _view() -> etree._Element:
    root = etree.Element("viewsettings")
    scheme = etree.SubElement(root, "scheme", name="merge")
    etree.SubElement(
        scheme,
        "vehicles",
        vehicleQuality="3",
        vehicle_exaggeration="4",
        vehicleName_show="1",
        vehicleName_size="60",
        vehicleName_color="0.1,0.1,0.1",
    )
    etree.SubElement(scheme, "background", backgroundColor="0.93,0.93,0.90", showGrid="0")
    etree.SubElement(root, "viewport", zoom="440", x="-110", y="-20")
    etree.SubElement(root, "delay", value="100")
    return root


def _config(timesteps: int) -> etree._Element:
    end_s = timesteps * DT_S
    sections = {
        "input": {"net-file": NET, "additional-files": TYPES},
        "time": {"begin": "0", "end": f"{end_s:.1f}", "step-length": f"{DT_S}"},
        "processing": {
            "collision.action": "none",
            "time-to-teleport": "-1",
            "default.speeddev": "0",
        },
        "fcd_replay_device": {"device.fcd-replay.files": RECORD},
        "report": {"no-warnings": "true", "xml-validation": "never"},
        "gui_only": {
            "gui-settings-file": VIEW,
            "start": "true",
            "delay": "100",
            "window-size": "1280,800",
        },
    }
    root = etree.Element("configuration")
    for section, values in sections.items():
        parent = etree.SubElement(root, section)
        for name, value in values.items():
            etree.SubElement(parent, name, value=value)
    return root
