"""What `import merge_sumo as ms` gives back: campaigns and cases, with tables for a notebook."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, Final

from merge_sumo.analysis.coordinates import coordinates
from merge_sumo.analysis.result import Result
from merge_sumo.analysis.summary import Summary, summarise
from merge_sumo.analysis.verdict import MESSAGE_CHARACTERS, Verdict, judge, shortened
from merge_sumo.campaigns.one_case import Ended
from merge_sumo.campaigns.repeats import Repeat, read_repeats, unrepeatable
from merge_sumo.campaigns.run import SETTINGS, Run, failures
from merge_sumo.errors import UserError
from merge_sumo.reports.motion import lines_of, verdict_of
from merge_sumo.studies.avoidance import in_a_sentence, read_avoidance
from merge_sumo.values.scenario import US23, level_name
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import End, Trajectory

MOST_ROWS: Final = 20
"""Rows that a notebook shows of a table."""
PLACE: Final = ("index", "level")
VERDICT: Final = ("end", "score", "dx_m", "dv_mps", "avoidable", "error")
"""Columns that it shows before and behind the coordinates of the case; the rows hold all of
`outcomes.jsonl`."""


class Table(list[dict[str, Any]]):
    """Rows of cases, as in `outcomes.jsonl`: a list that `pandas.DataFrame` takes as it is."""

    def __init__(self, outcomes: Iterable[Outcome]) -> None:
        """Take the rows of outcomes, in their order."""
        taken = list(outcomes)
        super().__init__(outcome.to_record() for outcome in taken)
        scenario = taken[0].case.scenario if taken else US23
        self._columns = (*PLACE, *(c.field for c in coordinates(scenario)), *VERDICT)

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{name}</th>" for name in self._columns)
        body = "".join(
            "<tr>" + "".join(f"<td>{_cell(row[name])}</td>" for name in self._columns) + "</tr>"
            for row in self[:MOST_ROWS]
        )
        more = f"<p>{len(self) - MOST_ROWS} more rows</p>" if len(self) > MOST_ROWS else ""
        return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>{more}"


def _cell(value: object) -> str:
    if value is None:
        return ""
    text = f"{value:.2f}" if isinstance(value, float) else str(value)
    return escape(shortened(text, MESSAGE_CHARACTERS))


class CampaignRun:
    """A campaign that was run, as it lies in its folder."""

    def __init__(self, folder: Path | str | Run) -> None:
        """Open the folder of a campaign, unless it is read already; `UserError` when it is none."""
        self._run = folder if isinstance(folder, Run) else Run(Path(folder))
        if not isinstance(self._run.settings.get("levels"), list):
            raise UserError(f"{self.folder / SETTINGS} is no campaign's: it has no levels")

    @property
    def run(self) -> Run:
        """The campaign as the rest of the package takes it."""
        return self._run

    @property
    def folder(self) -> Path:
        """The folder of the campaign."""
        return self._run.folder

    @property
    def settings(self) -> dict[str, Any]:
        """What `campaign.json` holds."""
        return self._run.settings

    @property
    def cases(self) -> Table:
        """All cases, in the order in which they were chosen."""
        return Table(self._run.outcomes)

    @property
    def failures(self) -> Table:
        """The failing cases, the worst first."""
        return Table(failures(self._run.outcomes))

    @property
    def errors(self) -> Table:
        """The cases that ended in an error of the VUT or of the simulation, with the message."""
        return Table(o for o in self._run.outcomes if o.measures.end.is_error)

    @property
    def timeouts(self) -> Table:
        """The cases in which the VUT never reached the merge point."""
        return Table(o for o in self._run.outcomes if o.measures.end is End.TIMEOUT)

    @cached_property
    def repeats(self) -> list[Repeat]:
        """The cases that ran a second time, and whether they went as before."""
        return read_repeats(self._run)

    @cached_property
    def verdict(self) -> Verdict:
        """How many cases failed, erred or timed out; errors and timeouts by message."""
        return judge(self._run.outcomes)

    @cached_property
    def summary(self) -> Summary:
        """Cases, failures, regions and failure mode coverage by POV level."""
        return summarise(self._run.outcomes, self.settings["levels"])

    @cached_property
    def careful(self) -> str | None:
        """Which share of the failures a careful driver would have avoided, in a sentence.

        None where no failure was driven again.
        """
        return in_a_sentence(read_avoidance(self._run).values())

    def trajectory(self, index: int) -> Trajectory:
        """Return the motion of a case; `UserError` when there is none."""
        return self._run.trajectory(index)

    @property
    def report_file(self) -> Path:
        """Where the HTML report is."""
        return self.folder / "report.html"

    def report(self) -> Path:
        """Write the HTML report and return its path."""
        from merge_sumo.reports.report import write_report

        return write_report(self._run)

    def __repr__(self) -> str:
        """Return folder and result in a line."""
        return f"<campaign {self.folder}: {self.verdict.counts}>"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td>{level_name(level)}</td><td>{found.cases}</td><td>{found.failures}</td>"
            f"<td>{found.regions}</td><td>{found.fmc:.4f}</td></tr>"
            for level, found in self.summary.levels.items()
        )
        title = escape(f"{self._run.vut}: {self.verdict.counts}")
        unsaid = unrepeatable(self.repeats)
        said = [*([unsaid] if unsaid else []), *self.verdict.sentences]
        wrong = "".join(f"<p><b>{escape(text)}</b></p>" for text in said)
        return (
            f"<p><b>{title}</b><br>{escape(str(self.folder))}</p>{wrong}"
            "<table><thead><tr><th>POV level</th><th>cases</th><th>failures</th><th>regions</th>"
            f"<th>FMC</th></tr></thead><tbody>{rows}</tbody></table>"
        )


class CaseRun(Result):
    """One case that was run."""

    def __init__(self, ended: Ended) -> None:
        """Take what became of it."""
        self.outcome, self.trajectory = ended.outcome, ended.trajectory

    @property
    def measures(self) -> Measures:
        """Verdict and measures."""
        return self.outcome.measures

    @property
    def failed(self) -> bool:
        """Whether this case is a failure of the VUT under the criterion."""
        return self.outcome.failed

    @property
    def verdict(self) -> str:
        """What became of it in a sentence."""
        return verdict_of(self.outcome, self.trajectory)

    def __repr__(self) -> str:
        """Return the verdict in a line."""
        return f"<case: {self.verdict}>"

    def to_record(self) -> dict[str, Any]:
        """Return what `merge-sumo run --json` prints: outcome, motion and signals of the VUT."""
        record = {**self.outcome.to_record(), "motion": self.trajectory.motion.tolist()}
        return record | ({"signals": self.trajectory.signals} if self.trajectory.signals else {})

    def lines(self) -> list[str]:
        """Return verdict, measures and motion, as `merge-sumo run` prints them."""
        return lines_of(self.outcome, self.trajectory)
