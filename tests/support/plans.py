"""Plans for tests, on the paper's road and by its criterion where a test does not say otherwise."""

from __future__ import annotations

from typing import Any

from merge_sumo.drivers.policies import policies_of, policies_sha256
from merge_sumo.engine.plan import MAX_CORRIDORS, SimulationPlan, plan_key, versions
from merge_sumo.engine.povs import Povs
from merge_sumo.road.merge import road_for
from merge_sumo.studies.truth import TruthKey
from merge_sumo.values.criterion import Criterion
from merge_sumo.values.scenario import US23, Scenario
from merge_sumo.vuts.base import VutOptions
from merge_sumo.vuts.factory import VutFactory

PAPERS = Criterion()
POVS = Povs(policies=policies_of(US23))


def plan_for(
    vut: str | VutFactory,
    *,
    scenario: Scenario = US23,
    criterion: Criterion = PAPERS,
    povs: Povs | None = None,
    corridors: int = MAX_CORRIDORS,
) -> SimulationPlan:
    povs = povs or Povs(policies=policies_of(scenario))
    options = VutOptions(policies=povs.policies)
    return SimulationPlan(
        scenario=scenario,
        road=road_for(scenario),
        vut=vut if isinstance(vut, VutFactory) else VutFactory.of(vut, options),
        povs=povs,
        criterion=criterion,
        corridors=corridors,
    )


def key_of(*, level: int = 0, cases: int = 300, seed: int = 0, **changes: Any) -> TruthKey:
    """Return what a truth of design1 is kept under, with some of it changed."""
    values: dict[str, Any] = {
        "vut": "design1",
        "deadline_s": 5.0,
        "pov": None,
        "policies_sha256": policies_sha256(policies_of(US23)),
        "road_sha256": road_for(US23).sha256,
        "scenario": US23,
        "criterion": PAPERS,
        "versions": versions(),
    }
    return TruthKey(plan_key(**values | changes), level, cases, seed)
