"""What the report shows of a run: cases, their motion, verdicts, and what is known beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from merge_sumo.analysis.coordinates import Coordinate, coordinates
from merge_sumo.analysis.diagnosis import Diagnosis, Kind, diagnose, failure_boxes
from merge_sumo.analysis.predictions import surprises
from merge_sumo.analysis.summary import Summary, summarise
from merge_sumo.analysis.surface import Surface, learn_surface
from merge_sumo.analysis.verdict import Trouble, judge
from merge_sumo.campaigns.repeats import read_repeats
from merge_sumo.campaigns.run import Run, failures, regions_of, spread_failures
from merge_sumo.engine.plan import plan_key, versions
from merge_sumo.engine.simulator import road_for
from merge_sumo.errors import UserError
from merge_sumo.reports.facts import facts_of
from merge_sumo.reports.report_maps import GRID
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.merge import road_of
from merge_sumo.studies.counterfactuals import read_avoidance
from merge_sumo.studies.explanation import read_explanations
from merge_sumo.studies.stress import stress_of
from merge_sumo.studies.truth import TRUTH_CASES, Truth, TruthKey
from merge_sumo.system.workers import Workers
from merge_sumo.values.chance import by_case
from merge_sumo.values.scenario import DEADLINE_S, LEVELS, OWN
from merge_sumo.values.score import Outcome

LISTED: Final = 10
"""Cases in a list, and messages of errors and timeouts."""
SHOWN: Final = 2000
"""Cases that the page holds one by one, with their motion; more are shown as counts."""
ERROR_CHARACTERS: Final = 2000
"""Of the message of a case; `outcomes.jsonl` has the whole."""

OnPart = Callable[[int, int], None]
"""Told of how many levels the surrogates are learned, and how many levels there are."""


class ReportModel:
    """Everything that the page shows of a run.

    Attributes:
        cases: the run that stands for each case.
        repeated: by its index, all runs of a case that ran more than once.
    """

    def __init__(
        self,
        run: Run,
        summary: Summary | None = None,
        workers: Workers | None = None,
        on_part: OnPart = lambda _done, _total: None,
        *,
        learns: bool = True,
    ) -> None:
        """Read what the page shows; `UserError` where settings have no list of levels.

        `summary` is that of the run, where it is known; on several `workers` its surrogates are
        asked. Without `learns` there are no surrogates.
        """
        self.run = run
        self.road = road_of_run(run)
        self.cases = run.cases
        runs = [one for one in by_case(run.outcomes) if one.runs > 1]
        self.repeated = {one.deciding(run.tolerated).index: one for one in runs}
        self.summary = summary or summarise(run.outcomes, run.levels, run.tolerated)
        self.verdict = judge(self.cases)
        self.facts = facts_of(run, self.summary, self.verdict)
        self.levels = list(self.summary.levels)
        self.learns = learns
        self.surfaces: dict[int, Surface | None] = dict.fromkeys(self.levels)
        for done, level in enumerate(self.levels if learns else ()):
            surface = self.surfaces[level] = learn_surface(
                run.outcomes, level, workers, run.tolerated
            )
            if surface is not None:
                surface.work_out(GRID.get(len(run.scenario.dimensions(level))))
            on_part(done + 1, len(self.levels))
        self.coordinates = coordinates(run.scenario, self.levels or LEVELS)
        self.worst = failures(self.cases)
        self.regions = regions_of(self.worst)
        self.stress = stress_of(run.folder)
        robust = set() if self.stress is None else set(self.stress.robust)
        # The sort is stable: without a stress test the order is that of the regions.
        spread = sorted(spread_failures(self.worst), key=lambda o: o.index not in robust)
        self.spread = spread[:LISTED]
        self.avoidance = read_avoidance(run)
        self.explanations = read_explanations(run)
        self.repeats = read_repeats(run)
        self.near = sorted(
            (o for o in self.cases if _is_told(o) and not o.failed),
            key=lambda o: (o.margin, o.index),
        )
        self.surprises = surprises(self.cases)[:LISTED]
        self.untested = [o for o in self.cases if not _is_told(o)]
        examples = [o for trouble in self.troubles() for o in self.examples_of(trouble)]
        listed = [*(*examples, *self.spread, *self.near[:LISTED], *self.surprises)]
        telling = {o.index: o for o in (*listed, *self.worst, *self.untested, *self.near)}
        self.shown = sorted(list(telling.values())[:SHOWN], key=lambda outcome: outcome.index)
        self.motion = run.trajectories(outcome.index for outcome in self.shown)
        self.diagnoses: dict[int, Diagnosis] = {
            o.index: diagnose(self.motion[o.index], o.measures)
            for o in self.shown
            if o.index in self.motion
        }
        failed = {o.index for o in self.worst}
        self.kinds: dict[int, Kind] = {
            index: found.kind
            for index, found in self.diagnoses.items()
            if found.kind is not None and index in failed
        }
        self.boxes = [
            box for level in self.levels for box in failure_boxes(self.worst + self.near, level)
        ]
        self.truths = {level: _truth(run, self.road, level) for level in self.levels}

    def coordinates_of(self, level: int) -> tuple[Coordinate, ...]:
        """Return the coordinates of a level, in the pool's order."""
        return coordinates(self.run.scenario, (level,))

    def troubles(self) -> Sequence[Trouble]:
        """Return the errors and timeouts that are listed, by message."""
        return self.verdict.troubles[:LISTED]

    def examples_of(self, trouble: Trouble) -> list[Outcome]:
        """Return the cases that are listed for a message."""
        return [self.run.outcome(index) for index in trouble.cases[:LISTED]]


def _is_told(outcome: Outcome) -> bool:
    return outcome.is_tested and outcome.margin is not None


def road_of_run(run: Run) -> Corridor:
    """Return the road of a run, or the shipped one to draw on where that is not there any more."""
    try:
        return road_for(run.scenario)
    except UserError:
        return road_of()


def _truth(run: Run, road: Corridor, level: int) -> Truth | None:
    """Return the ground truth that is cached for what this run tested, if there is one."""
    kept = kept_truth(run, road, level)
    return None if kept is None else kept[0]


def kept_truth(run: Run, road: Corridor, level: int) -> tuple[Truth, Path] | None:
    """Return the ground truth of `_truth`, and its file in the cache."""
    settings = run.settings
    same = settings.get("net_sha256") == road.sha256 and settings.get("versions") == versions()
    policies = settings.get("policies_sha256", {})
    if not same or not isinstance(policies, dict):
        return None
    plan = plan_key(
        vut=str(settings.get("vut")),
        deadline_s=settings.get("deadline_s", DEADLINE_S),
        pov=settings.get("pov") if level == OWN else None,
        policies_sha256=policies,
        road_sha256=road.sha256,
        scenario=run.scenario,
        criterion=run.criterion,
        versions=versions(),
    )
    return TruthKey(plan, level, TRUTH_CASES[level], seed=0).read(run.scenario)
