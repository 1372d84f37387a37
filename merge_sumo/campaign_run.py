"""Results of the verbs: campaigns and cases, as lines, as JSON, and for a notebook."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from merge_sumo.analysis.cases_file import CasesFile, verdict_of
from merge_sumo.analysis.comparison import Change, Comparison, compare_against
from merge_sumo.analysis.share import SHARES
from merge_sumo.campaigns.recorded import AGAINST, RecordedCampaign, failures
from merge_sumo.campaigns.repeatability import SecondRun, read_second_runs, unrepeatable
from merge_sumo.config import AnyRun
from merge_sumo.errors import UserError
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.metrics.plausibility import in_vain
from merge_sumo.metrics.summary import (
    GateResult,
    Summary,
    parse_gates,
    summarise,
)
from merge_sumo.metrics.timeline import Timeline, timeline
from merge_sumo.records import to_plain
from merge_sumo.reports.campaign_table import campaign_lines, labelled
from merge_sumo.reports.comparison_page import AGAINST_PAGE
from merge_sumo.reports.facts import Fact, facts_of
from merge_sumo.reports.figures import draw_case, draw_map, maps_picture, require
from merge_sumo.reports.text import comparison_summary, episode_lines, notes_of, timelines
from merge_sumo.result import Result
from merge_sumo.road.loader import centre_lines, road_for
from merge_sumo.road.scenario_file import SUFFIX
from merge_sumo.scenario.trajectory import End, Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

Rows = list[dict[str, Any]]
"""Cases as in `outcomes.jsonl`, which `pandas.DataFrame` takes as they are."""


def _rows(outcomes: Iterable[Outcome]) -> Rows:
    return [outcome.to_record() for outcome in outcomes]


class CampaignRun(Result):
    """A campaign that has run: its cases, its summary and its gates.

    `ms.campaign`, `ms.resume` and `ms.open_run` return it.

    Attributes:
        recorded: the campaign as other parts of the package use it.
        folder: the run folder.

    Example:
        ```python
        run = ms.campaign("design2", cases=400, seed=1)
        print(len(run.failures), "failures; see", run.report_file)
        ```
    """

    def __init__(self, folder: Path | str | RecordedCampaign, gates: Iterable[str] = ()) -> None:
        """Read a run folder.

        Args:
            folder: the run folder, or a campaign that was read from one.
            gates: names of gates, as for `--gate`.

        Raises:
            UserError: the folder is not a run folder, or a gate is unknown.
        """
        self.recorded = (
            folder if isinstance(folder, RecordedCampaign) else RecordedCampaign(Path(folder))
        )
        self.folder = self.recorded.folder
        self._gates = parse_gates(gates, against=self.recorded.settings.against is not None)

    @property
    def settings(self) -> dict[str, Any]:
        """The content of `campaign.json`."""
        return self.recorded.record

    @property
    def outcomes(self) -> list[Outcome]:
        """All outcomes, in the order of their index."""
        return self.recorded.outcomes

    @property
    def cases(self) -> Rows:
        """All cases as rows of `outcomes.jsonl`, in the order of their index."""
        return _rows(self.recorded.outcomes)

    @property
    def failures(self) -> Rows:
        """The failures as rows of `outcomes.jsonl`, the worst first."""
        return _rows(failures(self.recorded.cases))

    @property
    def errors(self) -> Rows:
        """The cases that ended in an error, as rows of `outcomes.jsonl` with the message."""
        return _rows(o for o in self.recorded.outcomes if o.measures.end.is_error)

    @property
    def timeouts(self) -> Rows:
        """The cases in which the VUT never merged, as rows of `outcomes.jsonl`."""
        return _rows(o for o in self.recorded.outcomes if o.measures.end is End.TIMEOUT)

    @cached_property
    def repeats(self) -> list[SecondRun]:
        """The cases that ran a second time, and whether both runs are the same."""
        return read_second_runs(self.recorded)

    @cached_property
    def summary(self) -> Summary:
        """The numbers of failures, errors and timeouts, and the FMC, by POV level."""
        return summarise(self.recorded.outcomes, self.recorded.levels, self.recorded.tolerated)

    @cached_property
    def facts(self) -> list[Fact]:
        """The facts of the report, each with its file and its key."""
        return facts_of(self.recorded, self.summary)

    @cached_property
    def against(self) -> Comparison | None:
        """The changes since the earlier version of `against`; None without one."""
        return compare_against(self.recorded)

    @property
    def regressions(self) -> Rows:
        """The cases that only the earlier version passes, the worst first."""
        cases = [] if self.against is None else self.against.version_changes[0].cases
        broke = [case.later.index for case in cases if case.change is Change.BROKE]
        return _rows(self.recorded.outcome(index) for index in broke)

    @cached_property
    def gates(self) -> list[GateResult]:
        """The gates of this object, and whether the campaign meets each."""
        regressions = len(self.regressions)
        return [gate.check(self.summary, regressions) for gate in self._gates]

    @property
    def passed(self) -> bool:
        """Whether at least one case was judged and no gate is met."""
        return self.summary.tested > 0 and not any(gate.met for gate in self.gates)

    is_good = passed

    @property
    def converged(self) -> bool:
        """Whether the search ended early, because it found little new."""
        return self.recorded.converged

    def trajectory(self, index: int) -> Trajectory:
        """Return the motion of a case.

        Args:
            index: index of the case.

        Raises:
            UserError: the campaign has no such case, or its motion cannot be read.
        """
        return self.recorded.trajectory(index)

    def to_dataframe(self) -> DataFrame:
        """Return the cases as a pandas data frame, with the columns `margin` and `verdict`.

        Raises:
            UserError: pandas is not installed.

        Example:
            ```python
            run.to_dataframe().groupby("level").verdict.value_counts()
            ```
        """
        frame = require("pandas", "notebook").json_normalize(self.cases)
        frame["margin"] = [outcome.margin for outcome in self.outcomes]
        frame["verdict"] = [verdict_of(outcome) for outcome in self.outcomes]
        return frame

    def plot_map(self, level: int, axes: Axes | None = None) -> Axes:
        """Draw the map of a POV level: the start of each case.

        Args:
            level: POV level.
            axes: axes of matplotlib to draw into; None for a new figure.

        Returns:
            The axes.

        Raises:
            UserError: the campaign has no such level, or matplotlib is not installed.
        """
        if level not in self.recorded.levels:
            raise UserError(
                f"no level {level!r} in {self.folder}: choose from {self.recorded.levels}"
            )
        at_level = [one for one in self.recorded.cases if one.case.level == level]
        return draw_map(at_level, self.recorded.scenario.dimensions(level), axes)

    def plot_case(self, index: int, axes: Axes | None = None) -> Axes:
        """Draw the position of each car of a case over time, with the timeline.

        Args:
            index: index of the case.
            axes: axes of matplotlib to draw into; None for a new figure.

        Returns:
            The axes.

        Raises:
            UserError: the campaign has no such case, or matplotlib is not installed.
        """
        told = timelines(self.recorded, [self.recorded.outcome(index)])[index]
        return draw_case(self.trajectory(index), told, axes)

    def _repr_html_(self) -> str:
        """Return the lines, and the maps of all levels side by side."""
        try:
            maps = maps_picture(self.plot_map, self.recorded.levels)
        except UserError as error:
            maps = f"<p>{error}</p>"
        return super()._repr_html_() + maps

    @property
    def report_file(self) -> Path:
        """The path of the HTML report."""
        return self.folder / "report.html"

    def report(self) -> Path:
        """Write the HTML report, and return its path."""
        from merge_sumo.reports.report import write_report

        return write_report(self.recorded)

    def to_record(self) -> dict[str, Any]:
        """Return the object that `merge-sumo campaign --json` prints.

        Its keys include:

        - `contacts`: number of failures in which bodies overlap.
        - `shares`: the uniform starts of each level, with the number of `failures` and of starts
          that are not judged (`without_verdict`).
        - `worst_case`: index of the failure with the lowest margin.
        """
        shares, worst = SHARES.read(self.folder), failures(self.recorded.cases)
        record = {
            **self.summary.to_record(),
            "worst_case": worst[0].index if worst else None,
            "shares": [] if shares is None else to_plain(shares.levels),
            "gates": {gate.name: gate.met for gate in self.gates},
            "passed": self.passed,
            "stopped": "converged" if self.converged else "cases",
            "fail_when": self.recorded.criterion.as_written,
            "notes": notes_of(self.recorded),
            "repeats": to_plain(self.repeats),
            "run": str(self.folder),
            "report": str(self.report_file),
        }
        if self.against is not None:
            record[AGAINST] = self.against.version_changes[0].to_record()
        return record

    def lines(self) -> list[str]:
        """Return the table of POV levels, the remarks, and the path of the report."""
        run, warning = self.recorded, unrepeatable(self.repeats)
        return [
            *([] if warning is None else [warning]),
            *self._against_lines(),
            *campaign_lines(run, self.summary, self.facts),
            *labelled("Note:", notes_of(run)),
            *labelled("Report:", [str(self.report_file)]),
        ]

    def _against_lines(self) -> list[str]:
        if self.against is None:
            return []
        page = labelled("Changes:", [str(self.folder / AGAINST_PAGE)])
        return [*comparison_summary(self.against), *page, ""]

    def remarks(self) -> list[str]:
        """Return a sentence for each gate, and one if no case could be judged."""
        untested = [] if self.summary.tested else [self.summary.nothing_tested]
        return [*(gate.sentence for gate in self.gates), *untested]

    def __repr__(self) -> str:
        return f"<campaign {self.folder}: {self.summary.counts}>"


class CaseRun(Result):
    """One case that has run. `ms.run` returns it.

    Attributes:
        outcome: the result of the case.
        trajectory: the motion of all vehicles.

    Example:
        ```python
        case = ms.run("design1", level=0, x_pov0_m=-285, v_pov0_mps=33)
        print(case.failed, case.measures.severity, case.timeline.result)
        ```
    """

    def __init__(self, episode: Episode, from_s: float | None = None) -> None:
        """Take a simulated case.

        Args:
            episode: the simulated case.
            from_s: begin of the printed motion, in s before the first conflict; None for the start.
        """
        self.outcome, self.trajectory = episode.outcome, episode.trajectory
        self._from_s = from_s

    @property
    def measures(self) -> Measures:
        """The measures of the case."""
        return self.outcome.measures

    @property
    def failed(self) -> bool:
        """Whether the case fails by the failure criterion."""
        return self.outcome.failed

    @property
    def passed(self) -> bool:
        """Whether the VUT merged and the case does not fail."""
        return self.measures.end is End.MERGED and not self.failed

    is_good = passed

    @property
    def timeline(self) -> Timeline:
        """The events of the case, with the kind of a failure."""
        return timeline(
            self.outcome, self.trajectory, centre_lines(road_for(self.outcome.case.scenario))
        )

    def __repr__(self) -> str:
        return f"<case: {self.timeline.result}>"

    def to_record(self) -> dict[str, Any]:
        """Return the object that `merge-sumo run --json` prints: outcome, motion and signals."""
        record = {**self.outcome.to_record(), "motion": self.trajectory.whole.tolist()}
        left = {"signals": self.trajectory.signals, "in_vain": self.trajectory.in_vain}
        return record | {name: value for name, value in left.items() if value}

    def lines(self) -> list[str]:
        """Return result, measures and motion, as `merge-sumo run` prints them."""
        notes = [f"note: {note}" for note in in_vain(dict.fromkeys(self.trajectory.in_vain, 1))]
        return [*episode_lines(self.outcome, self.trajectory, self._from_s), *notes]


def campaign_of(run: AnyRun) -> CampaignRun:
    """Open a campaign.

    Args:
        run: the campaign, or its folder.

    Raises:
        UserError: the folder is not that of a campaign.
    """
    return run if isinstance(run, CampaignRun) else CampaignRun(folder_of(run))


def open_recorded(run: AnyRun) -> RecordedCampaign:
    """Open a campaign, or a cases file.

    Args:
        run: the campaign, its folder, or a cases file.

    Raises:
        UserError: it is neither of them.
    """
    path = folder_of(run)
    is_file = not path.is_dir() and (path.suffix == SUFFIX or path.exists())
    return CasesFile(path) if is_file else campaign_of(run).recorded


def folder_of(run: AnyRun) -> Path:
    """Return the folder of a campaign.

    Args:
        run: the campaign, or its folder.
    """
    return Path(run) if isinstance(run, str | Path) else run.folder
