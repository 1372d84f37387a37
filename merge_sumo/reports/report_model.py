"""The content of a report, read from the folder of a campaign.

It has the cases, their motion, the verdicts, and the results of studies that the folder holds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

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
from merge_sumo.metrics.cause import Diagnosis, FailureBox, Kind, diagnose, failure_boxes
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.plausibility import doubts, mostly_clipped
from merge_sumo.metrics.summary import Summary, Trouble, by_case, judge, summarise, undecided
from merge_sumo.reports.facts import facts_of
from merge_sumo.road.corridor import Corridor
from merge_sumo.road.merge import road_for, road_of
from merge_sumo.scenario.case import coordinates
from merge_sumo.scenario.scenario import LEVELS

LISTED = 10
"""Cases in a list, and messages of errors and timeouts."""
SHOWN = 2000
"""Cases that the page holds one by one, with their motion; more are shown as counts."""

OnPart = Callable[[int, int], None]
"""Called with the number of levels whose surrogate is learned, and the number of levels."""


class ReportModel:
    """Everything that the page shows of a campaign; each template has it as `model`.

    Attributes:
        run: the campaign.
        road: its road, to be drawn.
        cases: the run that stands for each case.
        repeated: by its index, all runs of a case that ran more than once.
        varies: whether runs of a case differ: then chance decides.
        undecided: cases that fail and ran too seldom to tell, by that index.
        facts: the facts of the campaign.
        levels: POV levels.
        surfaces: surrogate of each level; None where there is none.
        axes: coordinates of each level, in the pool's order.
        worst: failures, the worst first; `spread` the first of them, of as many regions as may be.
        near: cases that do not fail, those nearest to a failure first.
        troubles: messages of errors and timeouts, with the cases that are listed for each.
        shown: cases that the page holds one by one, in their order.
        motion: trajectory of each case that is shown, by its index, where it is not lost.
        kinds: kind of each failure that has one, by its index.
        kind_counts: number of failures of each kind, the most frequent first.
        boxes: regions of failures in words.
        notes: doubts about the outcomes, in sentences.
        mostly_clipped: a sentence on a VUT that drove at its limits in most steps, else None.
        unrepeatable: a sentence on the cases that did not repeat; None where each did.
        go_on: the command that goes on with the campaign.
        explain: the commands that explain a case and write the report, before and after its index.
        printed: the end of what the controller printed; empty where it printed nothing.
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

        Args:
            run: the campaign.
            summary: its summary, where that is known.
            on_part: called after each surrogate.
            learns: whether there are surrogates.
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
        self.axes = {level: coordinates(run.scenario, (level,)) for level in self.levels}
        self.stress = STRESS.read(run.folder)
        self.avoidance = {one.index: one for one in AVOIDANCE.read_lines(run)}
        self.explanations = EXPLANATIONS.read_lines(run)
        self.against = compare_against(run)
        self._choose_cases()
        self.motion = run.trajectories(outcome.index for outcome in self.shown)
        self.diagnoses: dict[int, Diagnosis] = {}
        for outcome in self.shown:
            if motion := self.motion.get(outcome.index):
                self.diagnoses[outcome.index] = diagnose(motion, outcome.measures)
        self.kinds: dict[int, Kind] = {}
        for outcome in self.worst:
            diagnosis = self.diagnoses.get(outcome.index)
            if diagnosis is not None and diagnosis.kind is not None:
                self.kinds[outcome.index] = diagnosis.kind
        self.kind_counts = Counter(self.kinds.values()).most_common()
        self.boxes = list[FailureBox]()
        for level in self.levels:
            self.boxes += failure_boxes(self.worst + self.near, level)
        self.notes = doubts(self.cases, run.criterion, run.settings.in_vain)
        self.mostly_clipped = mostly_clipped(self.cases)
        self.unrepeatable = unrepeatable(read_repeats(run))
        self.go_on = again("resume", run.folder, run.record)
        self.explain = _explain(run)
        self.printed = end_of(run.folder / LOG)

    def _choose_cases(self) -> None:
        """Choose the cases that are listed, and those that the page holds one by one."""
        judged: list[Outcome] = []
        untested: list[Outcome] = []
        for outcome in self.cases:
            is_judged = outcome.is_tested and outcome.margin is not None
            (judged if is_judged else untested).append(outcome)
        self.worst = failures(self.cases)
        self.regions = regions_of(self.worst)
        robust = set() if self.stress is None else set(self.stress.robust)
        # The sort is stable: without a stress test the order is that of the regions.
        spread = sorted(spread_failures(self.worst), key=lambda o: o.index not in robust)
        self.spread = spread[:LISTED]
        self.near = sorted((o for o in judged if not o.failed), key=lambda o: (o.margin, o.index))
        self.troubles: list[tuple[Trouble, list[Outcome]]] = []
        first: list[Outcome] = []
        for trouble in self.verdict.troubles[:LISTED]:
            examples = [self.run.outcome(index) for index in trouble.cases[:LISTED]]
            self.troubles.append((trouble, examples))
            first += examples
        first += self.spread + self.near[:LISTED] + self.worst + untested + self.near
        shown = list({o.index: o for o in first}.values())[:SHOWN]
        self.shown = sorted(shown, key=lambda outcome: outcome.index)

    def settings(self) -> list[tuple[str, Any]]:
        """Return name and value of each setting, nested ones with their path."""
        rows, rest = [], list(self.run.record.items())
        while rest:
            name, value = rest.pop(0)
            if isinstance(value, dict):
                rest[:0] = [(f"{name} {inner}", one) for inner, one in value.items()]
                continue
            if isinstance(value, list):
                value = ", ".join(map(str, value))
            rows.append((name, value))
        return rows


class _Index(int):
    """The index of a case, which the page fills in."""

    def __str__(self) -> str:
        return "\0"


def _explain(run: Run) -> tuple[str, str]:
    explain = again("explain", run.folder, run.record, _Index())
    first, _, rest = explain.partition(str(_Index()))
    if explain.startswith("ms."):
        return first, f"{rest}; {call('report', [run.folder])}"
    return first, f"{rest} && {command('report', run.folder)}"


def _road_of(run: Run) -> Corridor:
    """Return the road of a run, or the shipped one to draw on where that is not there any more."""
    try:
        return road_for(run.scenario)
    except UserError:
        return road_of()
