"""An episode as a folder that sumo and sumo-gui play by themselves.

On the shipped road it is played in the shipped net. Of any other road the folder has the net that
hosts it (`hosting`), with a speed limit above all speeds: there lanes have ids and ends that every
reader can check, and where the road continues after the end of the file, so does that net. A VUT on
an acceleration lane is on the lane of the mainline from the row in which it has merged. Labels are
at fixed places above the road, as points of interest with a text: names at the cars would cover
each other at M.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from pathlib import Path

import numpy as np
from lxml import etree

from merge_sumo.files import write_folder
from merge_sumo.metrics.cause import cause
from merge_sumo.metrics.merge import merged_rows
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.records import to_json
from merge_sumo.road.finder import find_road, read_net
from merge_sumo.road.loader import road_of
from merge_sumo.road.road import LanePath, Road
from merge_sumo.road.xml_input import to_bytes
from merge_sumo.scenario.case import Case, FloatArray, described
from merge_sumo.scenario.scenario import DT_S, VEHICLES, VUT, Bounds, level_name, rgb
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.sumo.net_copies import COPY, LANE, hosted_net

CONFIG = "replay.sumocfg"
NET = "us23.net.xml"
"""The net of the shipped road."""
HOSTED_NET = "road.net.xml"
"""The net of any other road."""
LANE_EDGE = LANE.replace(COPY, ".0")
"""Edge of that net with an acceleration lane and the mainline next to it."""
TYPES = "vehicles.add.xml"
LABELS = "labels.add.xml"
RECORD = "episode.fcd.xml"
VIEW = "view.settings.xml"
CASE = "case.json"
SCENARIO = "scenario"
"""Key of the scenario in that file, next to those of the outcome."""
SHAPE = 614.0 / 1270.0
"""Height of the picture in the window of sumo-gui, as a share of its width."""
REAL_TIME_MS = "1000"
"""Of delay for each simulated second, which is how SUMO 1.28 takes the option."""
HOLD_STEPS = 10
"""Steps for which the last picture stays."""
NAMES = {"pov": "POV", "vut": "VUT", "ahead": "car ahead", "behind": "car behind"}
TEXT = "text"
"""Parameter of a point of interest that is shown."""
PALE = "0.93,0.93,0.90"
INK = "0.1,0.1,0.1"


@dataclass(frozen=True, slots=True)
class Picture:
    """The picture of sumo-gui: its zoom, its middle, and its width on the road."""

    zoom: str
    x_m: float
    y_m: float
    width_m: float

    def place(self, right: float, up: float) -> tuple[float, float]:
        """Return the place at shares of width and height from the middle."""
        return self.x_m + right * self.width_m, self.y_m + up * self.width_m * SHAPE


@dataclass(frozen=True, slots=True)
class ReplayRoad:
    """The road of a replay folder."""

    net: bytes
    road: Road
    """Found in that net, so that its lanes have the ids that they have there."""
    file: str
    """Name of the net in the folder."""


def write_scenario(folder: Path, road: Road, outcome: Outcome, trajectory: Trajectory) -> Path:
    """Write an episode as a replay folder and return the path of its configuration.

    Args:
        folder: the new folder.
        road: the road of the scenario.
        outcome: the outcome of the case.
        trajectory: its motion.

    Raises:
        UserError: something else is there, or it cannot be written.
    """
    written = _road(road, folder)
    scenario = outcome.case.scenario.to_record() | {"net": None}
    case = to_json({SCENARIO: scenario, **outcome.to_record()}, indent=2)
    record = motion_record(written.road, trajectory)
    write_folder(folder, {CASE: case, **files_of(written, outcome, trajectory, record)})
    return folder / CONFIG


def _road(road: Road, folder: Path) -> ReplayRoad:
    """Return a road as a folder has it."""
    shipped = road_of()
    identity = attrgetter("sha256", "mainline_edges", "ramp_edges")
    if identity(road) == identity(shipped):
        return ReplayRoad(shipped.path.read_bytes(), shipped, NET)
    fast = replace(road, mainline=_fast(road.mainline), ramp=_fast(road.ramp))
    content = hosted_net(fast, 1, lane_goes_on=True)
    return ReplayRoad(
        content, road_of_hosted(content, folder / HOSTED_NET, fast.lane_m), HOSTED_NET
    )


def _fast(path: LanePath) -> LanePath:
    """Return a path with a limit above every speed.

    SUMO lets a vehicle enter a replay no faster than its lane allows.
    """
    return LanePath(tuple(replace(piece, speed_limit_mps=200.0) for piece in path.pieces))


def road_of_hosted(content: bytes, path: Path, lane_m: Bounds | None) -> Road:
    """Find the road in the net of a folder.

    Args:
        content: the net.
        path: its file, for messages.
        lane_m: begin and end of the acceleration lane of its scenario.

    Returns:
        The road.

    Raises:
        UserError: the net has no such road.
    """
    net = read_net(path, content)
    numbered: dict[str, dict[int, str]] = {"main": {}, "ramp": {}, "out": {}}
    for name in net.edges:
        if found := re.fullmatch(r"(main|ramp|out)([0-9]{1,4})[.]0", name):
            numbered[found[1]][int(found[2])] = name
    main, ramp, out = ([names[n] for n in sorted(names)] for names in numbered.values())
    # Without a ramp both vehicles drive on one path.
    is_one_path = len(main) + len(out) == len(net.edges)
    lane = [] if lane_m is None else [LANE_EDGE]
    return find_road(
        net,
        main + lane + out,
        (main if is_one_path else ramp) + lane + out,
        room_after_m=0.0,
        edge_at_m=out[0] if out else None,
        lane_m=lane_m and (lane_m[1], lane_m[1]),
    )


def files_of(
    road: ReplayRoad, outcome: Outcome, trajectory: Trajectory, record: etree._Element
) -> dict[str, bytes]:
    """Return the files that SUMO reads of an episode, the configuration last.

    Args:
        road: the road of the folder.
        outcome: the outcome of the case.
        trajectory: its motion.
        record: the part of the motion that SUMO plays (`motion_record`).

    Returns:
        The contents by name.
    """
    picture = _picture(road.road, record)
    roots = {
        TYPES: _types(trajectory),
        LABELS: _labels(outcome, trajectory, picture),
        RECORD: record,
        VIEW: view_settings(picture),
        CONFIG: _config(road, len(record)),
    }
    return {road.file: road.net} | {name: to_bytes(root) for name, root in roots.items()}


def _types(trajectory: Trajectory) -> etree._Element:
    root = etree.Element("additional")
    scenario = trajectory.case.scenario
    for name, first_mps in zip(VEHICLES, trajectory.motion[0, :, 1].tolist(), strict=False):
        length_m = scenario.vut_length_m if name == VEHICLES[VUT] else scenario.pov_length_m
        etree.SubElement(
            root,
            "vType",
            id=name,
            color=_colour(name),
            guiShape="passenger/sedan",
            length=f"{length_m:g}",
            minGap="0",
            # The replay inserts a vehicle at the highest speed it may drive: its first one here.
            maxSpeed=f"{max(first_mps, 1e-9):.9f}",
            speedFactor="2",
            # Nor does SUMO then slow it down for the junction.
            decel="1000",
            emergencyDecel="1000",
        )
    return root


def motion_record(road: Road, trajectory: Trajectory) -> etree._Element:
    """Return the motion as SUMO's floating car data, with the last row held."""
    root = etree.Element("fcd-export")
    rows = [*zip(trajectory.whole.tolist(), merged_rows(trajectory).tolist(), strict=True)]
    rows += [rows[-1]] * HOLD_STEPS
    for step, (vehicles, merged) in enumerate(rows):
        timestep = etree.SubElement(root, "timestep", time=f"{step * DT_S:.2f}")
        for who, (x_m, v_mps, _) in zip(VEHICLES, vehicles, strict=False):
            at = road.lane_point(x_m, on_ramp=who == VEHICLES[VUT] and not merged)
            car = etree.SubElement(timestep, "vehicle", id=who)
            car.set("x", f"{at.x_m:.9f}")
            car.set("y", f"{at.y_m:.9f}")
            car.set("angle", f"{at.angle_deg:.9f}")
            car.set("type", who)
            car.set("speed", f"{v_mps:.9f}")
            car.set("pos", f"{at.position_m:.9f}")
            car.set("lane", at.lane)
    return root


def view_settings(picture: Picture) -> etree._Element:
    """Return the settings of a view."""
    root = etree.Element("viewsettings")
    scheme = etree.SubElement(root, "scheme", name="merge")
    etree.SubElement(scheme, "edges", laneShowBorders="1")
    etree.SubElement(scheme, "vehicles", vehicleQuality="3", vehicle_exaggeration="1")
    etree.SubElement(
        scheme,
        "pois",
        poiTextParam=TEXT,
        poiText_show="1",
        poiText_size="60",
        poiText_color=INK,
        poiText_constantSize="1",
        poiText_bgColor=PALE,
    )
    etree.SubElement(scheme, "background", backgroundColor=PALE, showGrid="0")
    x, y = f"{picture.x_m:g}", f"{picture.y_m:g}"
    etree.SubElement(root, "viewport", zoom=picture.zoom, x=x, y=y)
    etree.SubElement(root, "delay", value=REAL_TIME_MS)
    return root


def _colour(vehicle: str) -> str:
    """Return the colour of a vehicle as SUMO writes it."""
    return ",".join(f"{part / 255.0:.2f}" for part in rgb(vehicle))


def _picture(road: Road, record: etree._Element) -> Picture:
    """Return a picture of the way of the VUT; at a zoom of 100 it has the whole net."""
    net = [(x, y) for path in (road.mainline, road.ramp) for _, x, y in path.corners()]
    driven = []
    for car in record.iterfind(f"timestep/vehicle[@id='{VEHICLES[VUT]}']"):
        driven.append((float(car.get("x", "")), float(car.get("y", ""))))
    whole_m, _ = _box(net)
    driven_m, (x_m, y_m) = _box(driven)
    width_m = 1.3 * max(driven_m, 100.0)
    return Picture(f"{100.0 * whole_m / width_m:.0f}", round(x_m), round(y_m), width_m)


def _box(points: Sequence[tuple[float, float]]) -> tuple[float, FloatArray]:
    """Return the width of a picture of points below the labels, and its middle."""
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    width_m, height_m = (high - low).tolist()
    return max(width_m, height_m / (0.8 * SHAPE)), (low + high) / 2.0


def _config(road: ReplayRoad, timesteps: int) -> etree._Element:
    end_s = timesteps * DT_S
    sections = {
        "input": {"net-file": road.file, "additional-files": f"{TYPES},{LABELS}"},
        "time": {"begin": "0", "end": f"{end_s:.1f}", "step-length": f"{DT_S}"},
        "processing": {
            "collision.action": "none",
            "insertion-checks": "none",
            "time-to-teleport": "-1",
            "default.speeddev": "0",
        },
        "fcd_replay_device": {"device.fcd-replay.files": RECORD},
        "report": {"no-warnings": "true", "xml-validation": "never"},
        "gui_only": {
            "gui-settings-file": VIEW,
            "start": "true",
            "delay": REAL_TIME_MS,
            # It halts there: at its end it would show a dialog over the last picture.
            "breakpoints": f"{end_s - 2.0 * DT_S:.1f}",
            "window-size": "1280,800",
        },
    }
    root = etree.Element("configuration")
    for section, values in sections.items():
        parent = etree.SubElement(root, section)
        for name, value in values.items():
            etree.SubElement(parent, name, value=value)
    return root


def _labels(outcome: Outcome, trajectory: Trajectory, picture: Picture) -> etree._Element:
    """Return the case, its cause and a legend of the cars as an additional file."""
    words = cause(outcome, trajectory).removesuffix(".")
    if outcome.measures.end.is_error:
        words = words.partition(":")[0]  # a message may hold anything
    lines = [case_line(outcome.case, outcome.index), *re.split(r"(?<=:) |\. ", words)]
    root = etree.Element("additional")
    for number, line in enumerate(lines[:4]):
        _label(root, f"line{number}", picture.place(0.0, 0.465 - 0.035 * number), line)
    cars = VEHICLES[: outcome.case.scenario.vehicles]
    for number, name in enumerate(cars):
        at = picture.place(0.13 * (number - 0.5 * (len(cars) - 1)), 0.315)
        _label(root, name, at, NAMES[name], _colour(name), 0.012 * picture.width_m)
    return root


def case_line(case: Case, index: int | None) -> str:
    """Return which case it is, with its index where it has one."""
    named = "" if index is None else f"case {index}, "
    return f"{named}POV level {level_name(case.level)}: {described(case)}"


def _label(
    root: etree._Element,
    name: str,
    at: tuple[float, float],
    text: str,
    colour: str = INK,
    size_m: float = 0.1,
) -> None:
    """Add a dot with a text, which is drawn above it."""
    place = {"x": f"{at[0]:.2f}", "y": f"{at[1]:.2f}"}
    size = {"width": f"{size_m:.2f}", "height": f"{size_m:.2f}"}
    poi = etree.SubElement(root, "poi", {"id": name, **place, "color": colour, **size}, layer="200")
    etree.SubElement(poi, "param", key=TEXT, value=text)
