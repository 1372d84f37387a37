"""The content of a report: cases, their motion, verdicts, and what is known beside them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, Final

from merge_sumo.analysis.comparison import compare_against
from merge_sumo.analysis.counterfactuals import AVOIDANCE
from merge_sumo.analysis.explanation import EXPLANATIONS
from merge_sumo.analysis.stress import STRESS
from merge_sumo.analysis.surface import Surface, learn_surface
from merge_sumo.campaigns.again import again, call, command
from merge_sumo.campaigns.repeats import read_repeats, unrepeatable
from merge_sumo.campaigns.run import Run, failures, regions_of, spread_failures
from merge_sumo.controllers.process import LOG, end_of
from merge_sumo.errors import UserError
from merge_sumo.metrics.cause import Diagnosis, Kind, diagnose, failure_boxes
from merge_sumo.metrics.plausibility import doubts, mostly_clipped
from merge_sumo.metrics.score import Outcome
from merge_sumo.metrics.summary import Summary, Trouble, by_case, judge, summarise, undecided
from merge_sumo.reports.facts import facts_of
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.merge import road_for, road_of
from merge_sumo.scenario.coordinates import Coordinate, coordinates
from merge_sumo.scenario.scenario import LEVELS

LISTED: Final = 10
"""Cases in a list, and messages of errors and timeouts."""
SHOWN: Final = 2000
"""Cases that the page holds one by one, with their motion; more are shown as counts."""

OnPart = Callable[[int, int], None]
"""Told of how many levels the surrogates are learned, and how many levels there are."""


class ReportModel:
    """Everything that the page shows of a run; each template has it as `model`.

    Attributes:
        run: the run.
        road: its road, to be drawn.
        cases: the run that stands for each case.
        repeated: by its index, all runs of a case that ran more than once.
        varies: whether runs of a case differ: then chance decides.
        undecided: cases that fail and ran too seldom to tell, by that index.
        facts: the facts of the campaign.
        levels: POV levels.
        surfaces: surrogate of each level; None where there is none.
        worst: failures, the worst first; `spread` the first of them, of as many regions as may be.
        near: cases that do not fail, those nearest to a failure first.
        shown: cases that the page holds one by one, in their order.
        motion: trajectory of each case that is shown, by its index, where it is not lost.
        boxes: regions of failures in words.
    """

    def __init__(
        self,
        run: Run,
        summary: Summary | None = None,
        on_part: OnPart = lambda _done, _total: None,
        *,
        learns: bool = True,
    ) -> None:
        """Read what the page shows.

        `summary` is that of the run, where it is known. Without `learns` there are no surrogates.
        """
        self.run, self.learns = run, learns
        self.road = _road_of(run)
        self.cases = run.cases
        runs = [one for one in by_case(run.outcomes) if one.runs > 1]
        self.repeated = {one.deciding(run.tolerated).index: one for one in runs}
        self.varies = any(one.varies for one in runs)
        self.summary = summary or summarise(run.outcomes, run.levels, run.tolerated)
        self.verdict = judge(run.outcomes, run.tolerated)
        self.undecided = undecided(run.outcomes, run.tolerated)
        self.facts = facts_of(run, self.summary, self.verdict)
        self.levels = list(self.summary.levels)
        self.surfaces: dict[int, Surface | None] = dict.fromkeys(self.levels)
        for done, level in enumerate(self.levels if learns else (), start=1):
            self.surfaces[level] = learn_surface(run.outcomes, level, run.tolerated)
            on_part(done, len(self.levels))
        self.coordinates = coordinates(run.scenario, self.levels or LEVELS)
        self.stress = STRESS.read(run.folder)
        self.avoidance = AVOIDANCE.read_lines(run)
        self.explanations = EXPLANATIONS.read_lines(run)
        self.against = compare_against(run)
        self._choose_cases()
        self.motion = run.trajectories(outcome.index for outcome in self.shown)
        self.diagnoses: dict[int, Diagnosis] = {
            o.index: diagnose(self.motion[o.index], o.measures)
            for o in self.shown
            if o.index in self.motion
        }
        self.kinds: dict[int, Kind] = {
            o.index: found.kind
            for o in self.worst
            if (found := self.diagnoses.get(o.index)) is not None and found.kind is not None
        }
        self.boxes = [
            box for level in self.levels for box in failure_boxes(self.worst + self.near, level)
        ]

    def _choose_cases(self) -> None:
        """Choose the cases that are listed, and those that the page holds one by one."""
        told: list[Outcome] = []
        untested: list[Outcome] = []
        for outcome in self.cases:
            is_told = outcome.is_tested and outcome.margin is not None
            (told if is_told else untested).append(outcome)
        self.worst = failures(self.cases)
        self.regions = regions_of(self.worst)
        robust = set() if self.stress is None else set(self.stress.robust)
        # The sort is stable: without a stress test the order is that of the regions.
        spread = sorted(spread_failures(self.worst), key=lambda o: o.index not in robust)
        self.spread = spread[:LISTED]
        self.near = sorted((o for o in told if not o.failed), key=lambda o: (o.margin, o.index))
        self.troubles = self.verdict.troubles[:LISTED]
        examples = [o for trouble in self.troubles for o in self.examples_of(trouble)]
        first = (*examples, *self.spread, *self.near[:LISTED], *self.worst, *untested, *self.near)
        shown = list({o.index: o for o in first}.values())[:SHOWN]
        self.shown = sorted(shown, key=lambda outcome: outcome.index)

    def coordinates_of(self, level: int) -> tuple[Coordinate, ...]:
        """Return the coordinates of a level, in the pool's order."""
        return coordinates(self.run.scenario, (level,))

    @property
    def dimensions(self) -> list[int]:
        """The numbers of coordinates that levels have, ascending."""
        return sorted({len(self.coordinates_of(level)) for level in self.levels})

    def examples_of(self, trouble: Trouble) -> list[Outcome]:
        """Return the cases that are listed for a message."""
        return [self.run.outcome(index) for index in trouble.cases[:LISTED]]

    @property
    def kind_counts(self) -> list[tuple[Kind, int]]:
        """Number of failures of each kind that occurs, the most frequent first."""
        return Counter(self.kinds.values()).most_common()

    @property
    def notes(self) -> list[str]:
        """Doubts about the outcomes, in sentences."""
        return doubts(self.cases, self.run.criterion, self.run.settings.in_vain)

    @property
    def mostly_clipped(self) -> str | None:
        """A sentence on a VUT that drove at its limits in most steps; None for others."""
        return mostly_clipped(self.cases)

    @property
    def unrepeatable(self) -> str | None:
        """A sentence on the cases that did not repeat; None where each did."""
        return unrepeatable(read_repeats(self.run))

    @property
    def lost(self) -> list[int]:
        """The cases that are shown and have no motion any more."""
        return [o.index for o in self.shown if o.index not in self.motion]

    @property
    def go_on(self) -> str:
        """The command that goes on with the campaign."""
        return again("resume", self.run.folder, self.run.record)

    @property
    def explain(self) -> tuple[str, str]:
        """The commands that explain a case and write the report, before and after its index."""
        folder, record = self.run.folder, self.run.record
        explained = again("explain", folder, record, _Index())
        first, _, rest = explained.partition(str(_Index()))
        if explained.startswith("ms."):
            return first, f"{rest}; {call('report', [folder])}"
        return first, f"{rest} && {command('report', folder)}"

    @property
    def printed(self) -> str:
        """The end of what the controller printed; empty where it printed nothing."""
        return end_of(self.run.folder / LOG)

    def settings(self) -> Iterator[tuple[str, Any]]:
        """Yield name and value of each setting, nested ones with their path."""
        rest = list(self.run.record.items())
        while rest:
            name, value = rest.pop(0)
            if isinstance(value, dict):
                rest[:0] = [(f"{name} {inner}", one) for inner, one in value.items()]
            else:
                yield name, ", ".join(map(str, value)) if isinstance(value, list) else value


class _Index(int):
    """The index of a case, which the page fills in."""

    def __str__(self) -> str:
        return "\0"


def _road_of(run: Run) -> Corridor:
    """Return the road of a run, or the shipped one to draw on where that is not there any more."""
    try:
        return road_for(run.scenario)
    except UserError:
        return road_of()
