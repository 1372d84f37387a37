"""A recorded episode as a folder that sumo and sumo-gui replay with nothing else running.

A road like the shipped one is replayed in its own net. Of any other road the folder has the net
that hosts it (`hosting`), with a speed limit above all speeds: there lanes have ids and ends that
every reader can check, and where the road goes on behind the end of the file, so does that net. The
lanes beside it are polygons.
"""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.sumo import allowed, received
from merge_sumo.sumo.binding import run_program, scratch_folder
from merge_sumo.sumo.corridor import Corridor, LanePath, LanePoint
from merge_sumo.sumo.finder import find_corridor
from merge_sumo.sumo.hosting import hosted_net
from merge_sumo.sumo.net import Net
from merge_sumo.sumo.netfile import NetFile, Point
from merge_sumo.sumo.road import MAINLINE_EDGES, RAMP_EDGES, corridor_of
from merge_sumo.system.folders import new_folder
from merge_sumo.values.scenario import DT_S, MAX_EPISODE_S, VEHICLES
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import Trajectory

CONFIG: Final = "replay.sumocfg"
NET: Final = "us23.net.xml"
"""The net of a road like the shipped one."""
HOSTED_NET: Final = "road.net.xml"
"""The net of any other road."""
SURROUNDINGS: Final = "surroundings.add.xml"
TYPES: Final = "vehicles.add.xml"
RECORD: Final = "episode.fcd.xml"
VIEW: Final = "view.settings.xml"
CASE: Final = "case.json"
REPLAYED: Final = "replayed.fcd.xml"

COMPARED: Final = ("x", "y", "pos", "speed")
TOLERANCE: Final = 1e-6
"""Metres and m/s; the record is written with nine digits."""

LANE_END_M: Final = 2e-3
"""Nearer than this to where a lane begins, a vehicle may be on the lane before or behind."""
SPEED_LIMIT_MPS: Final = 200.0
"""Above every speed: SUMO lets a vehicle enter a replay no faster than its lane allows."""

COLOURS: Final = {"pov": "0.90,0.25,0.15", "vut": "0.10,0.35,0.90"}
WINDOW: Final = (1280, 800)
SEEN_M: Final = 700.0
"""Width of the picture on the road."""
SURROUNDINGS_COLOUR: Final = "0.70,0.70,0.68"
LANE_WIDTH_M: Final = 3.2
MAX_SURROUNDINGS: Final = 2_000
HOLD_STEPS: Final = 10
"""Steps for which the last picture stays, so that a person sees how it ended."""
MIN_TIMESTEPS: Final = 1 + HOLD_STEPS
MAX_TIMESTEPS: Final = round(MAX_EPISODE_S / DT_S) + 1 + HOLD_STEPS


@dataclass(frozen=True, slots=True)
class _Road:
    """The road of a replay folder."""

    net: bytes
    corridor: Corridor
    """Found in that net, so that its lanes have the ids that they have there."""
    surroundings: etree._Element | None
    """None where the net itself has all lanes."""

    @property
    def file(self) -> str:
        """Name of the net in the folder."""
        return NET if self.surroundings is None else HOSTED_NET

    @property
    def additional(self) -> list[str]:
        """Names of the other files that SUMO loads at the start."""
        return [TYPES] if self.surroundings is None else [TYPES, SURROUNDINGS]


def write_scenario(
    folder: Path, road: Net | Corridor, outcome: Outcome, trajectory: Trajectory
) -> Path:
    """Write an episode as a replay folder and return the path of its configuration.

    Raises `UserError` when the folder exists or cannot be written; nothing is overwritten.
    """
    written = _road(road, folder)
    with new_folder(folder) as new:
        (new / CASE).write_text(json.dumps(outcome.to_record(), indent=2) + "\n", "utf-8")
        _write(new, written, _types(trajectory), _fcd(written.corridor, trajectory))
    return folder / CONFIG


def _road(road: Net | Corridor, folder: Path) -> _Road:
    """Return a road as a folder has it."""
    net = road if isinstance(road, Net) else _like_shipped(road)
    if net is not None:
        return _Road(net.text, corridor_of(net), None)
    corridor = corridor_of(road)
    fast = replace(corridor, mainline=_fast(corridor.mainline), ramp=_fast(corridor.ramp))
    content = hosted_net(fast, 1)
    drawn = _polygons(corridor.surroundings)
    return _Road(content, _corridor_of_hosted(content, folder / HOSTED_NET), drawn)


def _like_shipped(road: Corridor) -> Net | None:
    """Return the net of a road if it is one with the shipped edges, in which replays are exact."""
    if (road.mainline_edges, road.ramp_edges) != (MAINLINE_EDGES, RAMP_EDGES):
        return None
    try:
        net = Net(road.path)
    except UserError:
        return None
    return net if net.sha256 == road.sha256 else None


def _fast(path: LanePath) -> LanePath:
    return LanePath(tuple(replace(p, speed_limit_mps=SPEED_LIMIT_MPS) for p in path.pieces))


def _corridor_of_hosted(content: bytes, path: Path) -> Corridor:
    """Find the corridor in the net of a folder; `UserError` when it has none."""
    edges = re.findall(rb'<edge [^>]*\bid="((main|ramp|out)([0-9]{1,4})\.0)"', content)
    main, ramp, out = (
        [name.decode() for name, of, _ in sorted(edges, key=lambda e: int(e[2])) if of == kind]
        for kind in (b"main", b"ramp", b"out")
    )
    return find_corridor(NetFile(path, content), main + out, ramp + out, room_after_m=0.0)


def _write(folder: Path, road: _Road, types: etree._Element, record: etree._Element) -> None:
    """Write all that SUMO reads, the configuration last."""
    (folder / road.file).write_bytes(road.net)
    (folder / TYPES).write_bytes(received.serialize(types))
    if road.surroundings is not None:
        (folder / SURROUNDINGS).write_bytes(received.serialize(road.surroundings))
    (folder / RECORD).write_bytes(received.serialize(record))
    (folder / VIEW).write_bytes(received.serialize(_view(road)))
    (folder / CONFIG).write_bytes(received.serialize(_config(road, len(record))))


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
    replayed = _rows(received.parse(written, allowed.REPLAYED, name)[0], name)
    fault = _difference(episode, replayed) or _fault_of_record(episode)
    return Replay(len(episode.rows), *(fault or (None, "")))


Rows = dict[tuple[float, str], tuple[float, ...]]
"""The values of `COMPARED` by time and vehicle."""


@dataclass(frozen=True, slots=True)
class _Episode:
    """What is allowed of a received folder."""

    road: _Road
    types: etree._Element
    record: etree._Element
    rows: Rows
    x_m: dict[tuple[float, str], float | None]
    """Lane coordinates of the rows; None for a lane on which a vehicle does not drive."""

    def path(self, who: str) -> LanePath:
        """Return the lanes of a vehicle."""
        return _path(self.road.corridor, who)


def _path(road: Corridor, who: str) -> LanePath:
    return road.ramp if who == "vut" else road.mainline


def _received(folder: Path) -> _Episode:
    """Read net, vehicle types and record of a folder that somebody may have sent."""
    hosted = os.path.lexists(folder / HOSTED_NET)
    net_files = (HOSTED_NET, SURROUNDINGS) if hosted else (NET,)
    for name in (*net_files, TYPES, RECORD):
        if not os.path.lexists(folder / name):
            raise UserError(f"{folder} is not a replay folder: it has no {name}")
    types, record, net, *surroundings = (
        received.read_bytes(folder / name, "the file", follow_links=False)
        for name in (TYPES, RECORD, *net_files)
    )
    if surroundings:
        road = _checked_hosted(net, surroundings[0], folder)
    else:
        road = _road(Net.of_bytes(net, folder / NET), folder)
    root, rows = _checked_record(record, folder / RECORD)
    x_m = _lane_coordinates(root, road.corridor)
    return _Episode(road, _checked_types(types, folder / TYPES), root, rows, x_m)


def _checked_hosted(net: bytes, surroundings: bytes, folder: Path) -> _Road:
    root, _ = received.parse(net, allowed.HOSTED_NET, f"the net {folder / HOSTED_NET}")
    content = received.serialize(root)
    name = f"the file {folder / SURROUNDINGS}"
    drawn, _ = received.parse(surroundings, allowed.SURROUNDINGS, name)
    return _Road(content, _corridor_of_hosted(content, folder / HOSTED_NET), drawn)


def _checked_types(content: bytes, path: Path) -> etree._Element:
    root, _ = received.parse(content, allowed.TYPES, f"the file {path}")
    if sorted(str(vtype.get("id")) for vtype in root) != sorted(COLOURS):
        raise UserError(f"the file {path} must have one vType pov and one vType vut")
    return root


def _checked_record(content: bytes, path: Path) -> tuple[etree._Element, Rows]:
    root, _ = received.parse(content, allowed.RECORD, f"the record {path}")
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
        _write(stage, episode.road, episode.types, episode.record)
        yield stage


def _difference(episode: _Episode, replayed: Rows) -> tuple[float, str] | None:
    """Return when and in what a replay first differs from the record, or None."""
    for (time, who), values in episode.rows.items():
        seen = replayed.get((time, who))
        if seen is None:
            return (time, f"{who} is not there")
        x_m = episode.x_m[time, who]
        told = x_m is None or _is_told(x_m, episode.path(who))
        for name, was, now in zip(COMPARED, values, seen, strict=True):
            if not (abs(now - was) <= TOLERANCE or (name == "pos" and not told)):
                return (time, f"{name} of {who} is {now}, recorded {was}")
    for time, who in replayed.keys() - episode.rows.keys():
        return (time, f"{who} is not in the record")
    return None


def _is_told(x_m: float, path: LanePath) -> bool:
    """Return whether a replay tells the position on the lane; elsewhere x and y tell.

    SUMO keeps a vehicle a millimetre before the end of a lane, and where lanes overlap inside of a
    junction it may take the one before.
    """
    at_an_end = any(abs(x_m - start_m) <= LANE_END_M for start_m in path.starts_m)
    return not (at_an_end or path.piece(x_m).is_internal)


def _fault_of_record(episode: _Episode) -> tuple[float, str] | None:
    """Return when and why a checked record is no episode, or None when it is one."""
    rows = episode.rows
    times = sorted({time for time, _ in rows})
    moving = set(times[: -HOLD_STEPS - 1])
    for time, after in zip(times, [*times[1:], None], strict=True):
        for who in COLOURS:
            x, y, _, speed = rows[time, who]
            x_m = episode.x_m[time, who]
            if x_m is None or _is_beside(episode.path(who).point(x_m), x, y):
                return (time, f"{who} is recorded beside its lane")
            if after is None:
                continue
            if time not in moving:
                if rows[after, who] != rows[time, who]:
                    return (after, f"{who} is not held where the episode ended")
                continue
            to_m = episode.x_m[after, who]
            if to_m is None or not abs(to_m - x_m - speed * DT_S) <= TOLERANCE:
                return (time, f"{who} is recorded as not moving at its speed of {speed}")
    return None


def _is_beside(lane: LanePoint, x: float, y: float) -> bool:
    return not math.hypot(x - lane.x_m, y - lane.y_m) <= LANE_END_M


def _lane_coordinates(
    record: etree._Element, road: Corridor
) -> dict[tuple[float, str], float | None]:
    """Return the lane coordinates of the rows of a record that was checked."""
    starts_m = {
        who: {piece.lane: piece.start_m for piece in _path(road, who).pieces} for who in COLOURS
    }
    found: dict[tuple[float, str], float | None] = {}
    for timestep in record:
        time = round(float(timestep.get("time", "")), 3)
        for vehicle in timestep:
            who = str(vehicle.get("id"))
            start_m = starts_m[who].get(str(vehicle.get("lane")))
            position_m = float(vehicle.get("pos", ""))
            found[time, who] = None if start_m is None else start_m + position_m
    return found


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
    first_speeds = dict(zip(VEHICLES, trajectory.motion[0, :, 1].tolist(), strict=False))
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


def _fcd(road: Corridor, trajectory: Trajectory) -> etree._Element:
    root = etree.Element("fcd-export")
    motion = trajectory.motion.tolist()
    motion += [motion[-1]] * HOLD_STEPS
    for step, vehicles in enumerate(motion):
        timestep = etree.SubElement(root, "timestep", time=f"{step * DT_S:.2f}")
        for who, (x_m, v_mps, _) in zip(VEHICLES, vehicles, strict=False):
            lane, position, x, y, angle = road.lane_point(x_m, on_ramp=who == "vut")
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


def _polygons(shapes: tuple[tuple[Point, ...], ...]) -> etree._Element:
    root = etree.Element("additional")
    for number, shape in enumerate(shapes[:MAX_SURROUNDINGS]):
        etree.SubElement(
            root,
            "poly",
            id=f"lane{number}",
            color=SURROUNDINGS_COLOUR,
            fill="0",
            layer="-1",
            # To either side.
            lineWidth=f"{LANE_WIDTH_M / 2.0}",
            shape=" ".join(f"{x:.3f},{y:.3f}" for x, y, _ in shape),
        )
    return root


def _view(road: _Road) -> etree._Element:
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
    zoom, x, y = ("440", "-110", "-20") if road.surroundings is None else _viewport(road.corridor)
    etree.SubElement(root, "viewport", zoom=zoom, x=x, y=y)
    etree.SubElement(root, "delay", value="100")
    return root


def _viewport(road: Corridor) -> tuple[str, str, str]:
    """Return zoom and centre of a picture of the last 300 m of both paths before M.

    At a zoom of 100 the picture has the whole net.
    """
    points = [
        point for path in (road.mainline, road.ramp) for p in path.pieces for point in p.shape
    ]
    width_m, height_m = (
        max(values) - min(values)
        for values in ([x for x, *_ in points], [y for _, y, *_ in points])
    )
    whole_m = max(width_m, height_m * WINDOW[0] / WINDOW[1])
    seen = [
        path.point(max(x_m, -path.before_m))
        for path in (road.mainline, road.ramp)
        for x_m in (-300.0, 50.0)
    ]
    x, y = (
        (min(values) + max(values)) / 2.0
        for values in ([at.x_m for at in seen], [at.y_m for at in seen])
    )
    return f"{100.0 * whole_m / SEEN_M:.0f}", f"{x:.0f}", f"{y:.0f}"


def _config(road: _Road, timesteps: int) -> etree._Element:
    end_s = timesteps * DT_S
    sections = {
        "input": {"net-file": road.file, "additional-files": ",".join(road.additional)},
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
            "window-size": ",".join(map(str, WINDOW)),
        },
    }
    root = etree.Element("configuration")
    for section, values in sections.items():
        parent = etree.SubElement(root, section)
        for name, value in values.items():
            etree.SubElement(parent, name, value=value)
    return root
