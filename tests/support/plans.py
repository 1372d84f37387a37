"""Plans for tests, on the paper's road and by its criterion where a test does not say otherwise."""

from __future__ import annotations

from typing import Any

from merge_sumo.campaigns.plan import resolve
from merge_sumo.drivers.policies import policies_of, policies_sha256
from merge_sumo.engine.povs import Povs
from merge_sumo.engine.simulator import MAX_CORRIDORS, SimulationPlan
from merge_sumo.studies.truth import TruthKey
from merge_sumo.values.criterion import Criterion
from merge_sumo.values.scenario import US23, Scenario
from merge_sumo.vuts.registry import VutFactory

PAPERS = Criterion()


def plan_for(
    vut: str | VutFactory,
    *,
    scenario: Scenario = US23,
    criterion: Criterion = PAPERS,
    povs: Povs | None = None,
    corridors: int = MAX_CORRIDORS,
) -> SimulationPlan:
    return resolve(vut, scenario=scenario, criterion=criterion, povs=povs, corridors=corridors)


def key_of(**changes: Any) -> TruthKey:
    """Return what a truth of design1 at level 0 is kept under, with some of it changed."""
    values: dict[str, Any] = {
        "vut": "design1",
        "level": 0,
        "cases": 300,
        "seed": 0,
        "command": None,
        "deadline_s": 5.0,
        "scenario": US23,
        "policies": policies_sha256(policies_of(US23)),
        "pov": None,
        "criterion": PAPERS,
    }
    return TruthKey(**values | changes)
