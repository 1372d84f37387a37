"""The content of a report: cases, motion, verdicts, and results of studies in a run folder."""

from __future__ import annotations

from merge_sumo.analysis.comparison import compare_against
from merge_sumo.analysis.counterfactuals import AVOIDANCE
from merge_sumo.analysis.explanation import EXPLANATIONS
from merge_sumo.analysis.share import SHARES, LevelShare
from merge_sumo.analysis.stress import STRESS
from merge_sumo.analysis.surface import Surface, learn_surface
from merge_sumo.campaigns.recorded import RecordedCampaign, failures, regions_of, spread_failures
from merge_sumo.metrics.failure_regions import FailureRegion, failure_regions
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import ErrorGroup, by_case, summarise
from merge_sumo.reports.facts import facts_of
from merge_sumo.reports.text import timelines
from merge_sumo.road.loader import road_or_shipped
from merge_sumo.scenario.case import coordinates
from merge_sumo.scenario.scenario import LEVELS

LISTED = 10
"""Cases in a list, and messages of errors and timeouts."""
SHOWN = 2000
"""Cases that the page shows one by one, with their motion; further cases are counts."""


class ReportModel:
    """The content of the report of a campaign; each template has it as `model`.

    Attributes:
        run: the campaign.
        road: road of the campaign.
        repeated: by its index, all runs of a case that ran more than once.
        varies: whether runs of a case differ.
        summary: summary of the campaign, with its undecided cases.
        facts: facts of the campaign.
        levels: POV levels.
        surfaces: surrogate of each level; None without one.
        coordinates: coordinates of all levels.
        axes: coordinates of each level, in the pool's order.
        shares: the share of starts that fail, of each level where some uniform case has a verdict.
        stress: result of the stress test; None without one.
        avoidance: drivers that avoid a failure, by its index.
        explanations: explanations of failures.
        against: comparison with an earlier version; None without one.
        worst: failures, the worst first.
        spread: the listed failures: the worst of each region first.
        nearest: the listed cases that pass, with the lowest margins.
        error_groups: messages of errors and timeouts, each with its listed cases.
        shown: cases that the page shows one by one, in their order.
        regions: region of each failure, by its index.
        motion: trajectories of the shown cases by index; lost ones are missing.
        timelines: timelines of the shown cases by index.
        described: regions of the pool where cases fail, in words, by level.

    Example:
        >>> model = ReportModel(ms.open_run("runs/latest").recorded, learns=False)
        >>> model.worst[0].index, model.summary.counts
    """

    def __init__(self, run: RecordedCampaign, *, learns: bool = True) -> None:
        """Read the content.

        Args:
            run: the campaign.
            learns: whether to learn a surrogate of each level, which takes seconds.
        """
        self.run = run
        self.road = road_or_shipped(run.scenario)
        runs = [case for case in by_case(run.outcomes) if case.runs > 1]
        self.repeated = {case.deciding(run.tolerated).index: case for case in runs}
        self.varies = any(case.varies for case in runs)
        self.summary = summarise(run.outcomes, run.levels, run.tolerated)
        self.facts = facts_of(run, self.summary)
        self.levels = list(self.summary.levels)
        self.surfaces: dict[int, Surface | None] = {}
        for level in self.levels:
            surface = learn_surface(run.outcomes, level, run.tolerated) if learns else None
            self.surfaces[level] = surface
        self.coordinates = coordinates(run.scenario, self.levels or LEVELS)
        self.axes = {level: run.scenario.dimensions(level) for level in self.levels}
        self.shares: dict[int, LevelShare] = {}
        known = SHARES.read(run.folder)
        for one in known.levels if known else ():
            if one.without_verdict < one.cases:
                self.shares[one.level] = one
        self.stress = STRESS.read(run.folder)
        self.avoidance = {one.index: one for one in AVOIDANCE.read_lines(run)}
        self.explanations = EXPLANATIONS.read_lines(run)
        self.against = compare_against(run)
        self._choose_cases()
        self.motion = run.trajectories(outcome.index for outcome in self.shown)
        self.timelines = timelines(run, self.shown)
        self.described: list[FailureRegion] = []
        for level in self.levels:
            self.described += failure_regions(run.cases, level, self.regions)

    def _choose_cases(self) -> None:
        """Choose the cases for the lists, and the cases that the page shows one by one."""
        self.worst = failures(self.run.cases)
        self.regions = regions_of(self.worst)
        self.spread = spread_failures(self.worst)
        if self.stress is not None:
            robust = set(self.stress.robust)
            self.spread.sort(key=lambda outcome: outcome.index not in robust)
        self.spread = self.spread[:LISTED]
        others = [outcome for outcome in self.run.cases if not outcome.failed]
        # Cases without a verdict, then the cases nearest to a failure.
        others.sort(key=lambda one: (one.passes, one.margin or 0.0, one.index))
        passing = [one for one in others if one.passes and one.margin is not None]
        self.nearest = passing[:LISTED]
        self.error_groups: dict[ErrorGroup, list[Outcome]] = {}
        first: list[Outcome] = []
        for group in self.summary.error_groups[:LISTED]:
            examples = [self.run.outcome(index) for index in group.cases[:LISTED]]
            self.error_groups[group] = examples
            first += examples
        first += self.spread + self.nearest + self.worst + others
        by_index = {outcome.index: outcome for outcome in first}
        self.shown = sorted(list(by_index.values())[:SHOWN], key=lambda outcome: outcome.index)
