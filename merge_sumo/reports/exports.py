"""Cases of a campaign in the formats of other tools."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from merge_sumo.campaigns.campaign import SCENARIOS, case_name, export_case
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.errors import UserError
from merge_sumo.files import check_own, make_folder, write_folder, write_new
from merge_sumo.metrics.bodies import WIDTH_M
from merge_sumo.metrics.merge import merged_rows
from merge_sumo.reports.cases_toml import new_file_in, write_cases
from merge_sumo.reports.pages import environment
from merge_sumo.road.loader import road_for
from merge_sumo.road.road import Road
from merge_sumo.scenario.case import coordinates
from merge_sumo.scenario.scenario import DT_S, VEHICLES, VUT
from merge_sumo.scenario.trajectory import Trajectory
from merge_sumo.sumo.opendrive import opendrive

EXPORTS = "exports"
TABLE = "trajectories.csv"
ROAD = "road.xodr"
SIGNAL = "signal_"
"""First part of the names of columns of signals, which come from the controller."""
MERGED = "merged"
"""Column of scenarios with an acceleration lane: 1 where the VUT has left it, else 0."""
FORMULA = ("=", "+", "-", "@")
"""First characters of a formula in a spreadsheet."""

FORMATS = {
    "sumo": "a folder for each case, to replay in sumo-gui",
    "openscenario": "a folder for each case, with OpenSCENARIO and OpenDRIVE",
    "csv": "one table with the motion of the cases",
    "cases": "one file of cases to commit: at most 40, or the cases that you name",
}
"""Content of each format."""


def export_cases(
    run: RecordedCampaign, indices: Sequence[int], file_format: str, target: Path | None = None
) -> list[Path]:
    """Write cases of a campaign in a format of `FORMATS`.

    Args:
        run: the campaign.
        indices: the cases. Without any, a table has all cases, and a cases file at most 40
            (`watching`).
        file_format: the format.
        target: new file, or folder for the new files; None for the folder of the campaign.

    Returns:
        The files to open.

    Raises:
        UserError: a format or case is unknown, or a file exists; nothing is written then.

    Example:
        >>> export_cases(run, [12], "openscenario", Path("for-esmini"))
        [PosixPath('for-esmini/case-12/case-12.xosc')]
    """
    if file_format not in FORMATS:
        raise UserError(f"no format {file_format!r}: choose one of {', '.join(FORMATS)}")
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


def write_table(run: RecordedCampaign, indices: Sequence[int], target: Path) -> Path:
    """Write the motion of cases, or of all cases, as one table with a row for each step.

    The columns are time and motion of all vehicles, the case, its severity, and signals.

    Args:
        run: the campaign.
        indices: the cases; all without any.
        target: the new file, or a folder for it.

    Returns:
        The path of the file.

    Raises:
        UserError: the file exists, or a case has no trajectory.
    """
    rows: list[dict[str, Any]] = []
    columns: dict[str, Any] = {}
    for index in indices or range(len(run.outcomes)):
        of_case = list(_rows(run, index))
        columns |= of_case[0]
        rows += of_case
    path = new_file_in(target, TABLE)
    table = io.StringIO(newline="")
    writer = csv.DictWriter(table, columns)
    writer.writeheader()
    writer.writerows(rows)
    write_new(path, table.getvalue().encode())
    return path


def _rows(run: RecordedCampaign, index: int) -> Iterator[dict[str, Any]]:
    """Yield the rows of a case by column; a text that begins like a formula gets a quote."""
    trajectory, scenario = run.trajectory(index), run.scenario
    merged = merged_rows(trajectory)
    starts = {one.field: one.of(trajectory.case) for one in coordinates(scenario)}
    for step, state in enumerate(trajectory.whole):
        row: dict[str, Any] = {"case": index, "level": trajectory.case.level}
        row["time_s"] = round(step * DT_S, 1)
        for who, (x_m, v_mps, a_mps2) in zip(VEHICLES, state.tolist(), strict=False):
            row |= {f"x_{who}_m": x_m, f"v_{who}_mps": v_mps, f"a_{who}_mps2": a_mps2}
        if scenario.lane_m is not None:
            row[MERGED] = int(merged[step])
        row |= starts | {"severity": run.outcome(index).measures.severity}
        for name, values in (trajectory.signals or {}).items():
            value = values[step]
            is_formula = isinstance(value, str) and value.startswith(FORMULA)
            row[f"{SIGNAL}{name}"] = f"'{value}" if is_formula else value
        yield row


def write_openscenario(run: RecordedCampaign, index: int, folder: Path, road: Road) -> Path:
    """Write a case as an OpenDRIVE file and two OpenSCENARIO files.

    In the first OpenSCENARIO file all cars follow their recorded trajectories. In the second,
    `...-free.xosc`, the parameter `EgoController` names the controller of the VUT, which starts at
    its recorded position and speed. The other cars follow their trajectories, then keep their last
    speed until the timeout of the scenario.

    A merge from an acceleration lane is a step of the trajectory of the VUT, from lane to lane. The
    reference point of a car is its front bumper, as in the record of SUMO.

    Args:
        run: the campaign.
        index: index of the case.
        folder: new folder to write.
        road: road of the scenario.

    Returns:
        The path of the first OpenSCENARIO file.

    Raises:
        UserError: the folder exists, or the case has no trajectory.
    """
    trajectory, name, scenario = run.trajectory(index), case_name(index), run.scenario
    cars = []
    for row, who in enumerate(VEHICLES[: scenario.vehicles]):
        v_mps = trajectory.whole[:, row, 1].tolist()
        cars.append({"name": who, "v_mps": v_mps, "places": _places(road, trajectory, row)})
    files = {ROAD: opendrive(road)}
    template = environment().get_template("scenario.xosc.jinja")
    result = run.outcome(index).measures.result
    for suffix, title, free in (("-free", "free VUT", True), ("", result, False)):
        text = template.render(
            title=f"{run.vut}, {name}, {title}",
            name=name,
            scenario=scenario,
            road=ROAD,
            cars=cars,
            free=free,
            width_m=WIDTH_M,
            dt_s=DT_S,
            recorded_s=round((len(trajectory.whole) - 1) * DT_S, 1),
        )
        files[f"{name}{suffix}.xosc"] = text.strip().encode()
    write_folder(folder, files)
    return folder / f"{name}.xosc"


def _places(road: Road, trajectory: Trajectory, row: int) -> list[tuple[float, float, float]]:
    """Return x, y and heading of a car at all steps, in m and rad."""
    places, length_m = [], trajectory.case.scenario.lengths_m[row == VUT]
    for x_m, merged in zip(trajectory.whole[:, row, 0], merged_rows(trajectory), strict=True):
        _, _, x, y, angle_deg = road.front_bumper(
            float(x_m), length_m, on_ramp=row == VUT and not merged
        )
        # SUMO's angles run clockwise from north, OpenSCENARIO's counterclockwise from east.
        heading = math.remainder(math.radians(90.0 - angle_deg), math.tau)
        places.append((round(x, 9), round(y, 9), round(heading, 9)))
    return places
