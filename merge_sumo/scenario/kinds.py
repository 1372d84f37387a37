"""Kinds of scenarios by name: the merge of this package, and those of installed packages."""

from __future__ import annotations

from typing import Any, Final

from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import MergeScenario, Scenario
from merge_sumo.system.records import convert
from merge_sumo.system.registry import Registry

SCENARIO_KINDS: Final[Registry[type[Scenario]]] = Registry(
    "merge_sumo.scenario_kinds",
    "kind of scenario",
    {MergeScenario.kind: "merge_sumo.scenario.scenario:MergeScenario"},
    accepts=lambda item: isinstance(item, type) and issubclass(item, Scenario),
    contract="a subclass of Scenario",
)


def scenario_of_record(record: Any) -> Scenario:
    """Return the scenario that JSON or TOML describes; `UserError` where it is none.

    Without a `kind` it is a merge.
    """
    values = dict(convert(record, dict[str, Any]))
    kind = values.pop("kind", MergeScenario.kind)
    if not isinstance(kind, str):
        raise UserError(f"kind is {kind!r:.60}: it must be a text")
    return convert(values, SCENARIO_KINDS[kind])
