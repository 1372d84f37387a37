"""Cases of a campaign for others: SUMO folders, OpenSCENARIO, tables of motion.

Nothing here loads libsumo.
"""

from __future__ import annotations

import csv
import importlib
import io
import math
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo.campaigns.campaign import SCENARIOS, case_name, export_case
from merge_sumo.campaigns.run import Run
from merge_sumo.errors import UserError
from merge_sumo.files import check_own, make_folder, new_file, write_folder
from merge_sumo.metrics.bodies import WIDTH_M
from merge_sumo.metrics.merge import merged_rows
from merge_sumo.reports.cases_toml import new_file_in, write_cases
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.merge import road_for
from merge_sumo.scenario.case import coordinates
from merge_sumo.scenario.scenario import DT_S, VEHICLES, VUT, Scenario
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.sumo.opendrive import opendrive

EXPORTS = "exports"
TABLE = "trajectories.csv"
SEVERITY = "severity"
"""Column with one of our words."""
SIGNAL = "signal_"
"""Begins the names of the columns of signals, whose names and words are a stranger's."""
MERGED = "merged"
"""Column of scenarios with an acceleration lane: 1 where the VUT has left it, else 0."""
ROAD = "road.xodr"
CONTROLLER = "EgoController"
"""Parameter that names the controller of a free VUT."""
WHEEL_M = 0.7

FORMATS = {
    "sumo": "folders that sumo-gui replays",
    "openscenario": "folders with OpenSCENARIO and OpenDRIVE",
    "csv": "one table of motion",
    "cases": "one file to commit: at most 40 cases, or those named",
}
"""What is written, by the name that follows `--format`."""


def export_cases(
    run: Run, indices: Sequence[int], file_format: str, target: Path | None = None
) -> list[Path]:
    """Write cases of a campaign in a format of `FORMATS`.

    Args:
        run: the campaign.
        indices: the cases; of tables none are all, of cases files those that watch a controller.
        file_format: the format.
        target: where they go; by default a folder in that of the campaign.

    Returns:
        The files to open.

    Raises:
        UserError: before anything is written, if there is no such format, case or place.
    """
    if file_format not in FORMATS:
        raise UserError(f"there is no format {file_format!r}: choose one of {', '.join(FORMATS)}")
    if target is None:
        check_own(run.folder / SCENARIOS, run.folder / EXPORTS)
        target = run.folder / (SCENARIOS if file_format == "sumo" else EXPORTS)
    if file_format == "cases":
        return [write_cases(run, indices, target)]
    if file_format == "csv":
        return [write_table(run, indices, target)]
    if not indices:
        raise UserError(f"`file_format` {file_format} needs the indices of cases")
    for index in indices:
        run.outcome(index)
    make_folder(target, exist_ok=True)
    road = road_for(run.scenario)
    write = export_case if file_format == "sumo" else write_openscenario
    return [write(run, index, target / case_name(index), road) for index in indices]


def write_table(run: Run, indices: Sequence[int], target: Path) -> Path:
    """Write the motion of cases, or of all, as one table with a row for each step.

    Args:
        run: the campaign.
        indices: the cases; none are all.
        target: the new file, or a folder for it.

    Returns:
        The path of the file.

    Raises:
        UserError: if the file exists, or a case has no trajectory.
    """
    rows: list[dict[str, Any]] = []
    for index in indices or range(len(run.outcomes)):
        rows += _rows(run, index)
    path = new_file_in(target, TABLE)
    signals = dict.fromkeys(name for row in rows for name in row if name.startswith(SIGNAL))
    with new_file(path) as file:
        text = io.TextIOWrapper(file, encoding="utf-8", newline="")
        writer = csv.DictWriter(text, (*columns_of(run.scenario), *signals))
        writer.writeheader()
        writer.writerows(rows)
        text.flush()
        text.detach()
    return path


def columns_of(scenario: Scenario) -> tuple[str, ...]:
    """Return the columns of a table: time and motion of all vehicles, the case, its severity."""
    merged = () if scenario.lane_m is None else (MERGED,)
    place = (c.field for c in coordinates(scenario))
    return ("case", "level", "time_s", *_motion(scenario), *merged, *place, SEVERITY)


def _motion(scenario: Scenario) -> list[str]:
    parts = (("x", "m"), ("v", "mps"), ("a", "mps2"))
    cars = VEHICLES[: scenario.vehicles]
    return [f"{what}_{who}_{unit}" for who in cars for what, unit in parts]


def _rows(run: Run, index: int) -> Iterator[dict[str, Any]]:
    """Yield the rows of a case by column; no text in them is a formula."""
    trajectory, scenario = run.trajectory(index), run.scenario
    case, names = trajectory.case, _motion(scenario)
    start = {c.field: c.of(case) for c in coordinates(scenario)}
    merged = merged_rows(trajectory)
    severity = run.outcome(index).measures.severity
    for step, state in enumerate(trajectory.whole.reshape(len(merged), -1).tolist()):
        row: dict[str, Any] = {
            "case": index,
            "level": case.level,
            "time_s": round(step * DT_S, 1),
            **start,
        }
        row |= {**dict(zip(names, state, strict=True)), SEVERITY: severity}
        if scenario.lane_m is not None:
            row[MERGED] = int(merged[step])
        for name, values in (trajectory.signals or {}).items():
            value = values[step]
            # Beginnings of a formula for a spreadsheet.
            is_formula = isinstance(value, str) and value.startswith(("=", "+", "-", "@"))
            row[f"{SIGNAL}{name}"] = f"'{value}" if is_formula else value
        yield row


def write_openscenario(run: Run, index: int, folder: Path, road: Corridor) -> Path:
    """Write a case as OpenSCENARIO, twice, and OpenDRIVE; return the path of the first.

    In the first all cars follow their recorded trajectories. In the second, `...-free.xosc`, the
    VUT is only placed at its position and speed and has a controller whose name is the parameter
    `EgoController`; the other cars do what they did, whatever it does, and keep their last speed
    where the record ends. That one ends by the scenario's timeout.

    A merge from an acceleration lane is a step of the VUT's trajectory, from lane to lane. In the
    road that lane has OpenDRIVE's type "entry".

    The reference point of each car is its front bumper, as in the record: x, y and heading are
    those of SUMO's record, and the bounding box lies behind them. Raises `UserError` when the
    folder exists or the package scenariogeneration is missing.

    Args:
        run: the campaign.
        index: index of the case.
        folder: new folder to write.
        road: corridor of the scenario.
    """
    try:
        importlib.import_module("scenariogeneration.xosc")
        scenariogeneration: Any = importlib.import_module("scenariogeneration")
    except ImportError as error:
        raise UserError(
            "this format needs scenariogeneration: run `pip install 'merge-sumo[export]'`"
        ) from error
    xosc, prettify = scenariogeneration.xosc, scenariogeneration.prettify
    trajectory, name = run.trajectory(index), case_name(index)
    title = f"{run.vut}, {name} ({run.outcome(index).measures.became})"
    recorded = _scenario(xosc, trajectory, road, name, title, free=False)
    free = _scenario(xosc, trajectory, road, name, f"{run.vut}, {name}, free VUT", free=True)
    scenarios = {f"{name}-free.xosc": free, f"{name}.xosc": recorded}
    files = {of: prettify(scenario.get_element(), "utf-8") for of, scenario in scenarios.items()}
    write_folder(folder, {ROAD: opendrive(road), **files})
    return folder / f"{name}.xosc"


def _scenario(
    xosc: Any, trajectory: Trajectory, road: Corridor, name: str, title: str, *, free: bool
) -> Any:
    """Return a case as a scenario; where the VUT is free, another controller drives it."""
    scenario = trajectory.case.scenario
    entities, init = xosc.Entities(), xosc.Init()
    act = xosc.Act("drive", _at_time(xosc, "start", 0.0))
    for row, who in enumerate(VEHICLES[: trajectory.motion.shape[1]]):
        entities.add_scenario_object(who, _car(xosc, who, scenario))
        places = _places(xosc, road, trajectory, row)
        init.add_init_action(who, xosc.TeleportAction(places[0]))
        init.add_init_action(who, _speed(xosc, float(trajectory.motion[0, row, 1])))
        if free and row == VUT:
            controller = xosc.Controller(f"${CONTROLLER}", xosc.Properties())
            init.add_init_action(who, xosc.AssignControllerAction(controller))
        else:
            after = _speed(xosc, float(trajectory.whole[-1, row, 1])) if free else None
            act.add_maneuver_group(_follow(xosc, who, places, after))
    story = xosc.Story(name)
    story.add_act(act)
    shown_s = round((len(trajectory.whole) - 1) * DT_S, 1)
    end_s = scenario.timeout_s if free else shown_s
    board = xosc.StoryBoard(init, _at_time(xosc, "end", end_s))
    board.add_story(story)
    parameters = xosc.ParameterDeclarations()
    if free:
        parameters.add_parameter(xosc.Parameter(CONTROLLER, xosc.ParameterType.string, "user"))
    return xosc.Scenario(
        title,
        "merge-sumo",
        parameters,
        entities,
        board,
        xosc.RoadNetwork(ROAD),
        xosc.Catalog(),
        # OpenSCENARIO 1.2.
        osc_minor_version=2,
        # A fixed date: the same case gives the same bytes.
        creation_date=datetime(2000, 1, 1),
    )


def _places(xosc: Any, road: Corridor, trajectory: Trajectory, row: int) -> list[Any]:
    """Return the places of a car at all steps."""
    places = []
    for x_m, merged in zip(
        trajectory.whole[:, row, 0].tolist(), merged_rows(trajectory).tolist(), strict=True
    ):
        _, _, x, y, angle_deg = road.lane_point(x_m, on_ramp=row == VUT and not merged)
        # SUMO's angles run clockwise from north, OpenSCENARIO's the other way round from east.
        heading = math.remainder(math.radians(90.0 - angle_deg), 2.0 * math.pi)
        places.append(xosc.WorldPosition(round(x, 9), round(y, 9), 0.0, round(heading, 9)))
    return places


def _follow(xosc: Any, who: str, places: Sequence[Any], afterwards: Any) -> Any:
    """Return the maneuvers of a car: to follow its places, and then an action, if any."""
    times = np.round(np.arange(len(places)) * DT_S, 1).tolist()
    track = xosc.Trajectory(f"{who} recorded", closed=False)
    track.add_shape(xosc.Polyline(times, list(places)))
    follow = xosc.FollowTrajectoryAction(
        track,
        xosc.FollowingMode.position,
        reference_domain=xosc.ReferenceContext.absolute,
        scale=1.0,
        offset=0.0,
    )
    maneuver = xosc.Maneuver(f"{who} maneuver")
    event = xosc.Event(f"{who} event", xosc.Priority.override)
    event.add_trigger(_at_time(xosc, f"{who} start", 0.0))
    event.add_action(f"{who} follows", follow)
    maneuver.add_event(event)
    if afterwards is not None:
        event = xosc.Event(f"{who} afterwards", xosc.Priority.override)
        event.add_trigger(_at_time(xosc, f"{who} has followed", times[-1]))
        event.add_action(f"{who} keeps its speed", afterwards)
        maneuver.add_event(event)
    group = xosc.ManeuverGroup(f"{who} group")
    group.add_actor(who)
    group.add_maneuver(maneuver)
    return group


def _at_time(xosc: Any, name: str, time_s: float) -> Any:
    condition = xosc.SimulationTimeCondition(time_s, xosc.Rule.greaterOrEqual)
    point = "stop" if name == "end" else "start"
    return xosc.ValueTrigger(name, 0, xosc.ConditionEdge.none, condition, point)


def _speed(xosc: Any, v_mps: float) -> Any:
    at_once = xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0.0)
    return xosc.AbsoluteSpeedAction(v_mps, at_once)


def _car(xosc: Any, who: str, scenario: Scenario) -> Any:
    length = scenario.vut_length_m if who == VEHICLES[VUT] else scenario.pov_length_m
    width, height, limits = WIDTH_M, 1.5, (scenario.a_max_mps2, -scenario.a_min_mps2)
    box = xosc.BoundingBox(width, length, height, -length / 2.0, 0.0, height / 2.0)
    front = xosc.Axle(0.5, WHEEL_M, width - 0.2, -0.2 * length, WHEEL_M / 2.0)
    rear = xosc.Axle(0.0, WHEEL_M, width - 0.2, -0.8 * length, WHEEL_M / 2.0)
    return xosc.Vehicle(who, xosc.VehicleCategory.car, box, front, rear, 70.0, *limits)
