"""Write an episode as a folder that sumo and sumo-gui play without merge-sumo.

`write_replay_folder` writes all files. The net of the folder has the two paths of the road alone,
without speed limits (`net_copies`).
"""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from lxml import etree

from merge_sumo.files import write_folder
from merge_sumo.metrics.merge import merged_rows
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.timeline import Timeline, timeline
from merge_sumo.records import to_json
from merge_sumo.road.finder import find_road, read_net
from merge_sumo.road.loader import centre_lines
from merge_sumo.road.road import LanePath, Road
from merge_sumo.road.xml_input import to_bytes
from merge_sumo.scenario.case import FloatArray, described
from merge_sumo.scenario.scenario import (
    COLOURS,
    DT_S,
    NAMES,
    VEHICLES,
    VUT,
    Bounds,
    level_name,
)
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.sumo.net_copies import COPY, LANE, hosted_net

CONFIG = "replay.sumocfg"
"""The file that sumo and sumo-gui open."""
NET = "road.net.xml"
"""The net, which `hosted_net` writes."""
LANE_EDGE = LANE.replace(COPY, ".0")
"""Edge of that net with an acceleration lane and the mainline next to it."""
TYPES = "vehicles.add.xml"
"""Types of the vehicles."""
LABELS = "labels.add.xml"
"""Case, result and legend above the road. Names at the cars would cover each other at M."""
RECORD = "episode.fcd.xml"
"""Motion of the vehicles as floating car data."""
VIEW = "view.settings.xml"
"""View of sumo-gui."""
CASE = "case.json"
"""Scenario and outcome."""
SCENARIO = "scenario"
"""Key of the scenario in `CASE`."""
SHAPE = 614.0 / 1270.0
"""Height of the view in the window of sumo-gui, as a share of its width."""
HOLD_STEPS = 10
"""Number of rows of a record that repeat the last one, so that the last picture stays."""
UNIT = "unit"
"""Last entry of the legend: sumo-gui shows the speed of a car without its unit."""
LEGEND = {**NAMES, UNIT: "speeds in m/s"}
"""Texts of the legend."""
TEXT = "text"
"""Parameter of a point of interest that sumo-gui shows."""
PALE = "0.93,0.93,0.90"
"""Red, green and blue of the background, from 0 to 1."""
INK = "0.1,0.1,0.1"
"""Red, green and blue of texts."""
CONFIGURATION = """
<configuration>
    <net-file value="{net}"/>
    <additional-files value="{types},{labels}"/>
    <begin value="0"/>
    <end value="{end}"/>
    <step-length value="{step}"/>
    <collision.action value="none"/>
    <insertion-checks value="none"/>
    <time-to-teleport value="-1"/>
    <default.speeddev value="0"/>
    <device.fcd-replay.files value="{record}"/>
    <no-warnings value="true"/>
    <xml-validation value="never"/>
    <gui-settings-file value="{view}"/>
    <start value="true"/>
    <!-- For each simulated second: SUMO 1.28 counts it so. -->
    <delay value="1000"/>
    <!-- Of the speeds. -->
    <precision value="1"/>
    <!-- sumo-gui halts there. At the end it would show a dialog over the last picture. -->
    <breakpoints value="{last}"/>
    <window-size value="1280,800"/>
</configuration>
"""
"""Configuration of SUMO, which plays in real time and stops at the last picture."""
VIEW_SETTINGS = """
<viewsettings>
    <scheme name="merge">
        <edges laneShowBorders="1" showLinkDecals="0" showLinkRules="0">
            <!-- The colour of the report's roads. -->
            <colorScheme name="uniform"><entry name="road" color="0.79,0.78,0.76"/></colorScheme>
        </edges>
        <!-- It shows the value by which it would scale a car: that is the speed, at a scale of 1.
             The size of names, which are not shown, is how far the speed stands above its car. -->
        <vehicles vehicleQuality="3" vehicle_exaggeration="1" vehicleScaleMode="2"
            vehicleScaleValue_show="1" vehicleScaleValue_size="60" vehicleScaleValue_color="{ink}"
            vehicleScaleValue_constantSize="1" vehicleScaleValue_bgColor="{pale}"
            vehicleName_size="90">
            <scalingScheme name="by speed"><entry threshold="0" color="1"/></scalingScheme>
        </vehicles>
        <pois poiTextParam="{label}" poiText_show="1" poiText_size="60" poiText_color="{ink}"
            poiText_constantSize="1" poiText_bgColor="{pale}"/>
        <background backgroundColor="{pale}" showGrid="0"/>
    </scheme>
    <viewport zoom="{zoom}" x="{x}" y="{y}"/>
    <delay value="1000"/>
</viewsettings>
"""
"""Settings of sumo-gui for a view."""
FIRST_LINE_UP = 0.465
"""Distance of the first line of the labels from the middle, as a share of the view's height."""
LINE_DOWN = 0.035
"""Distance of two lines, as a share of the view's height."""
LEGEND_UP = 0.375
"""Distance of the legend from the middle, as a share of the view's height."""
LEGEND_RIGHT = 0.13
"""Distance of two entries of the legend, as a share of the view's width."""
DOT = 0.012
"""Size of a dot of the legend, as a share of the view's width."""


@dataclass(frozen=True, slots=True)
class View:
    """The part of the road that the window of sumo-gui shows.

    Attributes:
        zoom: zoom as SUMO counts it: at 100 the window shows the whole net.
        x_m: eastward coordinate of the middle in the net.
        y_m: northward coordinate of the middle in the net.
        width_m: width of the view on the road.
    """

    zoom: str
    x_m: float
    y_m: float
    width_m: float

    def place(self, right: float, up: float) -> tuple[float, float]:
        """Return a place of the view as x and y in the net, in m.

        Args:
            right: distance from the middle to the right, as a share of the width.
            up: distance from the middle upwards, as a share of the height.
        """
        return self.x_m + right * self.width_m, self.y_m + up * self.width_m * SHAPE


def write_replay_folder(folder: Path, road: Road, outcome: Outcome, trajectory: Trajectory) -> Path:
    """Write an episode as a replay folder.

    Args:
        folder: the new folder.
        road: road of the scenario.
        outcome: outcome of the case.
        trajectory: motion of the case.

    Returns:
        The path of the configuration, which `sumo -c` and `sumo-gui -c` play.

    Raises:
        UserError: something else is there, or the folder cannot be written.

    Example:
        >>> outcome, trajectory = run.outcomes[0], run.trajectory(0)
        >>> write_replay_folder(Path("case"), road_for(run.scenario), outcome, trajectory)
        PosixPath('case/replay.sumocfg')
    """
    road = _road_of_folder(road, folder)
    # The folder has its own net: no path of this machine.
    scenario = outcome.case.scenario.to_record() | {"net": None}
    case = to_json({SCENARIO: scenario, **outcome.to_record()}, indent=2)
    record = motion_record(road, trajectory)
    write_folder(folder, {CASE: case, **files_of(road, outcome, trajectory, record)})
    return folder / CONFIG


def _road_of_folder(road: Road, folder: Path) -> Road:
    """Return a road with the lanes of the net of a folder."""
    mainline, ramp = _without_limit(road.mainline), _without_limit(road.ramp)
    net = hosted_net(replace(road, mainline=mainline, ramp=ramp), 1, lane_goes_on=True)
    return road_of_hosted(net, folder / NET, road.used_lane_m)


def _without_limit(path: LanePath) -> LanePath:
    """Return a path with a speed limit above all speeds.

    SUMO inserts a vehicle of a replay at most at the speed limit of its lane.
    """
    pieces = [replace(piece, speed_limit_mps=200.0) for piece in path.pieces]
    return LanePath(tuple(pieces))


def road_of_hosted(content: bytes, path: Path, lane_m: Bounds | None) -> Road:
    """Find the road in a net that `hosted_net` has written.

    Args:
        content: the net, which may have been received.
        path: its file, for messages.
        lane_m: begin and end of the acceleration lane of the scenario; None for a merge at M.

    Returns:
        The road, with the ids of that net.

    Raises:
        UserError: the net has no such road.
    """
    net = read_net(path, content)
    names = set(net.edges)
    main, ramp, out = (_numbered(part, names) for part in ("main", "ramp", "out"))
    if not ramp:  # all vehicles are on one path
        ramp = main
    lane = [] if lane_m is None else [LANE_EDGE]
    return find_road(
        net,
        main + lane + out,
        ramp + lane + out,
        room_after_m=0.0,
        edge_at_m=out[0] if out else None,
        # The end alone: the lane of the net may begin anywhere before it.
        lane_m=None if lane_m is None else (lane_m[1], lane_m[1]),
    )


def _numbered(part: str, names: Set[str]) -> list[str]:
    """Return the edges of a part of a hosted road in driving order: main1.0, main2.0, ..."""
    candidates = [f"{part}{number}.0" for number in range(1, len(names) + 1)]
    return [name for name in candidates if name in names]


def files_of(
    road: Road, outcome: Outcome, trajectory: Trajectory, record: etree._Element
) -> dict[str, bytes]:
    """Return the files of an episode that SUMO reads.

    Args:
        road: road with the lanes of the net of the folder.
        outcome: outcome of the case.
        trajectory: motion of the case.
        record: the part of `motion_record` that SUMO plays.

    Returns:
        The contents by name, the configuration last.
    """
    view = _view_of(road, record)
    told = timeline(outcome, trajectory, centre_lines(road))
    roots = {
        TYPES: _types(trajectory),
        LABELS: _labels(outcome, told, view),
        RECORD: record,
        VIEW: view_settings(view),
        CONFIG: _config(len(record)),
    }
    net = hosted_net(road, 1, lane_goes_on=True)
    return {NET: net} | {name: to_bytes(root) for name, root in roots.items()}


def _types(trajectory: Trajectory) -> etree._Element:
    root = etree.Element("additional")
    scenario = trajectory.case.scenario
    for name, first_mps in zip(VEHICLES, trajectory.motion[0, :, 1].tolist(), strict=False):
        length_m = scenario.lengths_m[name == VEHICLES[VUT]]
        etree.SubElement(
            root,
            "vType",
            id=name,
            color=COLOURS[name],
            guiShape="passenger/sedan",
            length=f"{length_m:g}",
            minGap="0",
            # SUMO inserts a vehicle of a replay at its maximum speed: that is the first one here.
            maxSpeed=f"{max(first_mps, 1e-9):.9f}",
            speedFactor="2",
            # Then SUMO does not slow it down for the junction either.
            decel="1000",
            emergencyDecel="1000",
        )
    return root


def motion_record(road: Road, trajectory: Trajectory) -> etree._Element:
    """Return a motion as SUMO's floating car data, followed by `HOLD_STEPS` copies of its end.

    Args:
        road: road of the folder.
        trajectory: motion of the case. Where the VUT has merged from an acceleration lane it is on
            the lane of the mainline.
    """
    root = etree.Element("fcd-export")
    rows = list(zip(trajectory.whole.tolist(), merged_rows(trajectory).tolist(), strict=True))
    rows += [rows[-1]] * HOLD_STEPS
    lengths_m = trajectory.case.scenario.lengths_m
    for step, (vehicles, merged) in enumerate(rows):
        timestep = etree.SubElement(root, "timestep", time=f"{step * DT_S:.2f}")
        for who, (x_m, v_mps, _) in zip(VEHICLES, vehicles, strict=False):
            is_vut = who == VEHICLES[VUT]
            length_m = lengths_m[is_vut]
            at = road.front_bumper(x_m, length_m, on_ramp=is_vut and not merged)
            car = etree.SubElement(timestep, "vehicle", id=who)
            car.set("x", f"{at.x_m:.9f}")
            car.set("y", f"{at.y_m:.9f}")
            car.set("angle", f"{at.angle_deg:.9f}")
            car.set("type", who)
            car.set("speed", f"{v_mps:.9f}")
            car.set("pos", f"{at.position_m:.9f}")
            car.set("lane", at.lane)
    return root


def view_settings(view: View) -> etree._Element:
    """Return the settings of sumo-gui for a view.

    Args:
        view: the view.
    """
    place = {"zoom": view.zoom, "x": f"{view.x_m:g}", "y": f"{view.y_m:g}"}
    return _parsed(VIEW_SETTINGS, ink=INK, pale=PALE, label=TEXT, **place)


def _view_of(road: Road, record: etree._Element) -> View:
    """Return the view of all positions of the VUT in a record, and of the last of the POV."""
    net = [(x, y) for path in (road.mainline, road.ramp) for _, x, y in path.corners()]
    driven = []
    of_vut = record.iterfind(f"timestep/vehicle[@id='{VEHICLES[VUT]}']")
    for car in (*of_vut, *list(record[-1])[:2]):
        driven.append((float(car.get("x", "")), float(car.get("y", ""))))
    whole_m, _ = _box(net)
    driven_m, (x_m, y_m) = _box(driven)
    # The way of the VUT fills the width but for a margin, a way below 100 m less.
    width_m = 1.1 * max(driven_m, 100.0)
    return View(f"{100.0 * whole_m / width_m:.0f}", round(x_m), round(y_m), width_m)


def _box(points: Sequence[tuple[float, float]]) -> tuple[float, FloatArray]:
    """Return the width of a view that has points below the labels, and its middle."""
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    width_m, height_m = (high - low).tolist()
    # The labels take a fifth of the height.
    return max(width_m, height_m / (0.8 * SHAPE)), (low + high) / 2.0


def _config(timesteps: int) -> etree._Element:
    end_s = timesteps * DT_S
    times = {"end": f"{end_s:.1f}", "last": f"{end_s - 2.0 * DT_S:.1f}", "step": f"{DT_S}"}
    files = {"net": NET, "types": TYPES, "labels": LABELS, "record": RECORD, "view": VIEW}
    return _parsed(CONFIGURATION, **times, **files)


def _parsed(text: str, **values: str) -> etree._Element:
    """Return the XML of a text with a value in the place of each name in braces."""
    parser = etree.XMLParser(resolve_entities=False, remove_blank_text=True, remove_comments=True)
    return etree.fromstring(text.format(**values), parser)


def _labels(outcome: Outcome, told: Timeline, view: View) -> etree._Element:
    """Return case, result and legend as points of interest with a text."""
    case = outcome.case
    named = f"case {outcome.index}, POV level {level_name(case.level)}: {described(case)}"
    root = etree.Element("additional")
    # Lines from the top of the view downwards, and the legend in a row below them.
    for number, line in enumerate((named, told.result)):
        at = view.place(0.0, FIRST_LINE_UP - LINE_DOWN * number)
        _label(root, f"line{number}", at, line)
    cars = VEHICLES[: case.scenario.vehicles]
    for number, name in enumerate((*cars, UNIT)):
        at = view.place(LEGEND_RIGHT * (number - 0.5 * len(cars)), LEGEND_UP)
        colour = COLOURS.get(name, PALE)
        _label(root, name, at, LEGEND[name], colour, DOT * view.width_m)
    return root


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
