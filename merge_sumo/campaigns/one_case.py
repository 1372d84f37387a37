"""One case on its own: the same world, drivers and verdict as in a campaign."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from merge_sumo.config import COORDINATES
from merge_sumo.errors import UserError
from merge_sumo.metrics.episode import Episode
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import Scenario, level_name
from merge_sumo.simulation.evaluate import simulate
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import open_workers

ONE: Final[dict[str, Any]] = {
    "cases": 1,
    "batch": 1,
    "in_flight": None,
    "sampler": "uniform",
    "stop_when_converged": False,
    "repeat": 1,
}
"""Settings of a campaign that is one case."""


def case_of(scenario: Scenario, level: int, values: Mapping[str, Any]) -> Case:
    """Return the case of a scenario with values by the names of its fields.

    Raises `UserError` for a coordinate that is missing or unknown, and for values out of range.
    """
    given: dict[str, float] = {}
    for name, value in values.items():
        try:
            given |= {} if value is None else {name: float(value)}
        except (TypeError, ValueError):
            raise UserError(f"{name} is {value!r}: it must be a number") from None
    fixed = scenario.v_vut0_mps
    if isinstance(fixed, float):
        given.setdefault("v_vut0_mps", fixed)
    names = {**scenario.notation, "v_vut0_mps": None}
    for name in given:
        if name not in names:
            raise UserError(f"a case has no {name}: it has {', '.join(names)}")
    for dimension in scenario.dimensions(level):
        if dimension.field not in given:
            raise UserError(
                f"{_option(dimension.field)} is missing: the pool has {dimension.low:g} to "
                f"{dimension.high:g}"
            )
    known = {"v_vut0_mps", *(dimension.field for dimension in scenario.dimensions(level))}
    for name in given.keys() - known:
        raise UserError(
            f"{_option(name)} is none of the coordinates of {scenario.name} at level "
            f"{level_name(level)}: leave it out"
        )
    case: Case = scenario.case_type(level=level, scenario=scenario, **given)
    return case


def _option(name: str) -> str:
    """Return how a person gives a coordinate."""
    return f"`{name}`" if name in COORDINATES else f"`at` {name}=NUMBER"


def run_one(plan: SimulationPlan, case: Case) -> Episode:
    """Run one case in SUMO; its outcome is that of the same case in a campaign."""
    with open_workers(1):  # which closes the simulator
        (episode,) = simulate(plan.for_cases(1), [case])
    return episode
