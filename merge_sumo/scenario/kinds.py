"""The scenario that a record describes."""

from __future__ import annotations

from typing import Any

from merge_sumo.errors import UserError
from merge_sumo.records import convert
from merge_sumo.scenario.scenario import MergeScenario, Scenario


def scenario_of_record(record: Any) -> Scenario:
    """Return the scenario that JSON or TOML describes; `UserError` where it is none."""
    values = dict(convert(record, dict[str, Any]))
    kind = values.pop("kind", MergeScenario.kind)
    if kind != MergeScenario.kind:
        raise UserError(f"kind is {kind!r:.60}: it must be {MergeScenario.kind!r}")
    return convert(values, MergeScenario)
