"""Measures of recorded cases by CommonRoad-CriMe (Lin and Althoff, 2023), beside ours.

CriMe takes CommonRoad scenarios, and needs an environment of its own: `crime_program.py` runs
there. It measures each case twice:

- the scene at M, as our measures see it: both cars on one straight lane, at the places and speeds
  of the merge, which they keep; CriMe's ego vehicle is the car behind;
- the episode on its road, as exported, for the smallest distance of bodies before M.
"""

from __future__ import annotations

import json
import math
import subprocess
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.campaigns.store import Run
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.road.commonroad import commonroad, obstacle_ids, straight_road
from merge_sumo.road.corridor import Corridor
from merge_sumo.system.printable import printable
from merge_sumo.system.records import Record, decode
from merge_sumo.values.scenario import DT_S, POV, VUT
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import End, Trajectory

PROGRAM: Final = Path(__file__).with_name("crime_program.py")
TOOL: Final = "CommonRoad-CriMe"
MOST: Final = 20
"""Cases that it measures, some seconds each."""
START_S: Final = 120.0
CASE_S: Final = 10.0
"""What its program may take, and a case."""
STEPS: Final = 3
"""Rows of a scene, from which it takes accelerations."""
HOW: Final = (
    "make its environment with `python -m venv crime && crime/bin/pip install commonroad-crime`, "
    "and give crime/bin/python"
)
SHORT: Final = 300
"""Characters of what its program says."""


class Answer(Record, frozen=True):
    """What the program prints: the version of CriMe, and measures by name for each scene."""

    version: str
    values: tuple[dict[str, float | None], ...]


@dataclass(frozen=True, slots=True)
class Definition:
    """A measure of CriMe beside one of ours.

    Attributes:
        name: our measure.
        peer_name: that of CriMe.
        says: in what the definitions differ, in a sentence.
        expected: value that CriMe's definition has, by our record of a case; None for none.
        within: what the values may differ in: its rounding.
    """

    name: str
    peer_name: str
    says: str
    expected: Callable[[Measures], float | None]
    within: float


def _gap(measures: Measures) -> float | None:
    """Return the bumper gap, to a centimetre as CriMe takes it; None where bodies overlap."""
    gap_m = measures.bumper_gap_m
    return round(gap_m, 2) if gap_m is not None and gap_m >= 0.0 else None


def _closing(measures: Measures) -> float:
    """Return the speed at which the gap at M closes; below 0 where it opens."""
    dx_m, dv_mps = measures.dx_m or 0.0, measures.dv_mps or 0.0
    return -math.copysign(dv_mps, dx_m * dv_mps)


def _ttc(measures: Measures) -> float | None:
    gap_m, closing_mps = _gap(measures), _closing(measures)
    return None if gap_m is None or closing_mps <= 0.0 else gap_m / closing_mps


def _needed_mps2(measures: Measures) -> float | None:
    gap_m, closing_mps = _gap(measures), _closing(measures)
    # Without a headway it divides by infinity.
    return 0.0 if gap_m is None else -(closing_mps**2) / (2.0 * gap_m)


def _apart(measures: Measures) -> float | None:
    clearance_m = measures.before_clearance_m
    return None if clearance_m is None else max(clearance_m, 0.0)


DEFINITIONS: Final = (
    Definition(
        "bumper_gap_m",
        "HW",
        "the same distance, from the front bumper of the car behind to the rear bumper of the car "
        "ahead; where bodies overlap ours is negative, and CriMe has none",
        _gap,
        0.0101,
    ),
    Definition(
        "ttc_s",
        "TTC",
        "ours is that of the front bumpers, |dx| / |dv|, as the paper's; CriMe's is that of the "
        "bumper gap, a car length less",
        _ttc,
        0.0151,
    ),
    Definition(
        "drac_mps2",
        "ALongReq",
        "ours keeps the paper's 6 m between front bumpers, dv^2 / (2 (|dx| - 6)), and is 0 where "
        "the gap opens; CriMe's keeps the bumpers apart, has the other sign, and takes dv^2 where "
        "the gap opens, too",
        _needed_mps2,
        0.0151,
    ),
    Definition(
        "before_clearance_m",
        "DCE",
        "the smallest distance of bodies before M, where the lanes run together: ours by "
        "separating axes, which the distance of two corners exceeds, and negative for an overlap, "
        "where CriMe has 0",
        _apart,
        0.0101,
    ),
    Definition(
        "pet_s",
        "PET",
        "CriMe knows it at intersections alone, where paths cross, and has none for a merge",
        lambda _: None,
        0.0,
    ),
)


@dataclass(frozen=True, slots=True)
class Compared:
    """How a measure of CriMe compares with our record.

    Attributes:
        definition: the measure.
        cases: that were measured.
        same: of those, the cases in which CriMe's value is what its definition gives by our record.
        largest: largest difference in the others where both have a value; None without one.
    """

    definition: Definition
    cases: int
    same: int
    largest: float | None


def measured_by(python: Path, run: Run, road: Corridor) -> tuple[str, list[Compared]]:
    """Return CriMe's name and version, and how its measures of merges of a run compare.

    Args:
        python: of an environment with commonroad-crime.
        run: the campaign.
        road: its road.

    Raises:
        UserError: where that Python cannot be started, has no CriMe, or gives no answer.
    """
    chosen = _spread(run)
    with tempfile.TemporaryDirectory(prefix="merge-sumo-") as folder:
        scenes = [_written(Path(folder), outcome, one, road) for outcome, one in chosen]
        answer = _answer(python, scenes)
    measures = [outcome.measures for outcome, _ in chosen]
    return f"{TOOL} {printable(answer.version)}", [
        _compared(one, measures, answer.values) for one in DEFINITIONS
    ]


def _spread(run: Run) -> list[tuple[Outcome, Trajectory]]:
    """Return merges with their motion, spread over all scores."""
    merged = [o for o in run.outcomes if o.measures.end is End.MERGED]
    known = run.trajectories(outcome.index for outcome in merged)
    ranked = sorted((o for o in merged if o.index in known), key=lambda o: (o.score, o.index))
    places = np.linspace(0, len(ranked) - 1, min(MOST, len(ranked))).round().astype(np.int64)
    return [(ranked[place], known[ranked[place].index]) for place in places.tolist()]


def _written(folder: Path, outcome: Outcome, episode: Trajectory, road: Corridor) -> dict[str, Any]:
    """Write the files of a case; return what the program is told of it."""
    scenario, nearest = episode.case.scenario, episode.nearest
    pair = replace(episode, motion=episode.motion[:, [nearest, VUT]])
    last = pair.motion[-1]
    along_m = DT_S * np.arange(STEPS)[:, None] * last[:, 1]
    scene = np.stack(
        [last[:, 0] + along_m, np.broadcast_to(last[:, 1], along_m.shape), 0.0 * along_m], axis=2
    )
    behind = POV if last[POV, 0] < last[VUT, 0] else VUT
    told = {}
    for name, motion, on, step in (
        ("scene", scene, straight_road(scenario), 0),
        ("episode", pair.motion, road, _together(pair, road)),
    ):
        if step is None or (name == "episode" and outcome.measures.before_clearance_m is None):
            continue
        file = folder / f"{outcome.index}-{name}.xml"
        made = replace(pair, motion=motion, end=End.TIMEOUT if name == "scene" else pair.end)
        file.write_bytes(commonroad(made, on, number=1, source="merge-sumo"))
        cars = obstacle_ids(on, 2)
        ids = {"ego": cars[behind], "other": cars[1 - behind]}
        told[name] = {"file": str(file), **ids, "step": step}
    return told


def _together(trajectory: Trajectory, road: Corridor) -> int | None:
    """Return the first step at which the VUT is where the lanes run together; None for none."""
    steps = np.flatnonzero(trajectory.x_vut_m > -centre_lines(road).together_m).tolist()
    return steps[0] if steps else None


def _answer(python: Path, scenes: Sequence[dict[str, Any]]) -> Answer:
    """Return what the program prints."""
    try:
        done = subprocess.run(
            [str(python), "-I", str(PROGRAM)],
            input=json.dumps(scenes).encode(),
            capture_output=True,
            timeout=START_S + CASE_S * len(scenes),
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise UserError(f"--crime {python}: it cannot be run ({error})") from error
    if done.returncode:
        said = printable(done.stderr.decode(errors="replace").strip().split("\n")[-1][:SHORT])
        raise UserError(f"--crime {python}: it measures nothing ({said}); {HOW}")
    try:
        answer: Answer = decode(done.stdout, Answer)
    except UserError as error:
        raise UserError(
            f"--crime {python} does not answer as a Python with commonroad-crime; {HOW}"
        ) from error
    if len(answer.values) != len(scenes):
        raise UserError(f"--crime {python}: it has measured {len(answer.values)} cases")
    return answer


def _compared(
    definition: Definition,
    measures: Sequence[Measures],
    values: Sequence[dict[str, float | None]],
) -> Compared:
    """Return how a measure compares over all cases of which CriMe was asked for it."""
    name = definition.peer_name
    asked = [(m, v[name]) for m, v in zip(measures, values, strict=True) if name in v]
    same, others = 0, []
    for of_case, value in asked:
        expected = definition.expected(of_case)
        if expected is None or value is None:
            same += expected is value
        elif abs(expected - value) <= definition.within:
            same += 1
        else:
            others.append(abs(expected - value))
    return Compared(definition, len(asked), same, max(others, default=None))
