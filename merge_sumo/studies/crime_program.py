"""Measures scenes by CommonRoad-CriMe; a Python that has commonroad-crime runs it, apart from us.

It takes a JSON list of cases on standard input, each with a `scene` and, where it is to measure
that, an `episode`: the path of a CommonRoad `file`, the numbers of its obstacles `ego` and `other`,
and the `step` from which on it measures. It prints a JSON object with `version` and `values`: by
case the measures by name, None where CriMe has none.
"""

from __future__ import annotations

import contextlib
import json
import logging
import math
import sys
import warnings
from importlib.metadata import version
from typing import Any

AT_ONCE = ("HW", "TTC", "ALongReq", "PET")
"""Measures of the scene, in which all keep their speeds."""
OVER_TIME = ("DCE",)
"""Measures of the whole episode."""


def measured(
    file: str, ego: int, other: int, step: int, names: tuple[str, ...]
) -> dict[str, float | None]:
    """Return measures of a file from a step on, with an obstacle as CriMe's ego vehicle."""
    from commonroad.common.file_reader import CommonRoadFileReader
    from commonroad_crime import measure
    from commonroad_crime.data_structure.configuration import CriMeConfiguration

    scenario, _ = CommonRoadFileReader(file).open(lanelet_assignment=True)
    configuration = CriMeConfiguration()
    configuration.update(ego_id=ego, sce=scenario)
    values: dict[str, float | None] = {}
    for name in names:
        value: Any = getattr(measure, name)(configuration).compute(other, step, verbose=False)
        values[name] = float(value) if value is not None and math.isfinite(value) else None
    return values


def main() -> None:
    """Measure what standard input says, and print it."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    values = []
    with contextlib.redirect_stdout(sys.stderr):
        for one in json.load(sys.stdin):
            found = measured(**one["scene"], names=AT_ONCE)
            if "episode" in one:
                found |= measured(**one["episode"], names=OVER_TIME)
            values.append(found)
    sys.stdout.write(json.dumps({"version": version("commonroad-crime"), "values": values}))


if __name__ == "__main__":
    main()
