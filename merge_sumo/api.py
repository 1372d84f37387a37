"""merge-sumo from Python: run a campaign or open one, and look at it in a notebook.

import merge_sumo as ms

run = ms.campaign("design2", cases=400, seed=1)
run.failures        # rows for pandas.DataFrame(run.failures); a table in a notebook
run.report()        # path of the HTML report
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any, Final

from merge_sumo.campaigns.conductor import OnCase, run_campaign
from merge_sumo.campaigns.ground import road_for
from merge_sumo.campaigns.run import SETTINGS, Run, failures
from merge_sumo.campaigns.settings import (
    DEFAULT_CASES,
    CampaignSettings,
    parse_levels,
    povs_of,
)
from merge_sumo.drivers.vuts.base import VutOptions
from merge_sumo.errors import UserError
from merge_sumo.reports.coordinates import coordinates
from merge_sumo.reports.summary import Summary, summarise
from merge_sumo.reports.verdict import MESSAGE_CHARACTERS, Verdict, judge, shortened
from merge_sumo.samplers import DEFAULT_SAMPLER
from merge_sumo.scenarios.scenario_file import named_scenario
from merge_sumo.system.folders import dated
from merge_sumo.system.workers import open_workers
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB, US23, Scenario, level_name
from merge_sumo.values.score import Outcome
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

    def __init__(self, folder: Path | str) -> None:
        """Open the folder of a campaign; `UserError` when it is none."""
        self._run = Run(Path(folder))
        if not isinstance(self._run.settings.get("levels"), list):
            raise UserError(f"{Path(folder) / SETTINGS} is no campaign's: it has no levels")

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
    def verdict(self) -> Verdict:
        """How many cases failed, erred or timed out; errors and timeouts by message."""
        return judge(self._run.outcomes)

    @cached_property
    def summary(self) -> Summary:
        """Cases, failures, regions and failure mode coverage by POV level."""
        return summarise(self._run.outcomes, self.settings["levels"])

    def trajectory(self, index: int) -> Trajectory:
        """Return the motion of a case; `UserError` when there is none."""
        return self._run.trajectory(index)

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
        wrong = "".join(f"<p><b>{escape(text)}</b></p>" for text in self.verdict.sentences)
        return (
            f"<p><b>{title}</b><br>{escape(str(self.folder))}</p>{wrong}"
            "<table><thead><tr><th>POV level</th><th>cases</th><th>failures</th><th>regions</th>"
            f"<th>FMC</th></tr></thead><tbody>{rows}</tbody></table>"
        )


def campaign(
    vut: str,
    *,
    level: int | str = "all",
    sampler: str = DEFAULT_SAMPLER,
    cases: int = DEFAULT_CASES,
    batch: int | None = None,
    seed: int = 0,
    v_vut0_mps: float | None = None,
    vut_command: str | None = None,
    deadline_s: float = DEADLINE_S,
    vut_memory_gib: float = MEMORY_GIB,
    in_process: bool = False,
    stop_after_converged: float | None = None,
    workers: int = 1,
    out: Path | str | None = None,
    net: Path | str | None = None,
    scenario: Scenario | Path | str = US23,
    policies: Path | str | None = None,
    pov: str | None = None,
    learn_from: Sequence[Path | str] = (),
    on_case: OnCase | None = None,
) -> CampaignRun:
    """Test a VUT and return the campaign; the same as `merge-sumo campaign`.

    Args:
        vut: vehicle under test, as after `--vut`.
        level: POV level 0, 1 or 2, "own" for a `pov`, or "all".
        sampler: who chooses the cases.
        cases: number of cases.
        batch: cases per batch; when left out, as many as the sampler wants: 10, later 20 and 40
            for `coverage`, 40 for the others.
        seed: same seed, same outcomes.
        v_vut0_mps: initial speed of the VUT; the scenario's when left out.
        vut_command: command that starts the controller of `vut="traci"`.
        deadline_s: time that a VUT may take for a step before it is a VUT_ERROR.
        vut_memory_gib: memory that the process of a VUT of your own may take.
        in_process: run such a VUT in this process, where a debugger reaches it.
        stop_after_converged: stop early when less than this share of new coverage is expected.
        workers: processes that run cases; the outcomes are the same.
        out: new folder to write; `runs/<vut>-<date>` when left out.
        net: SUMO net to use instead of the scenario's.
        scenario: a scenario, its name, or its TOML file.
        policies: folder of learned drivers in the place of the shipped ones.
        pov: a POV of your own, as after `--pov`.
        learn_from: folders of earlier campaigns to learn the VUT from.
        on_case: told of every case as it ends.

    Raises `UserError` for values that make no campaign, or when the folder exists.
    """
    where = scenario if isinstance(scenario, Scenario) else named_scenario(str(scenario))
    options = VutOptions(deadline_s=deadline_s, memory_gib=vut_memory_gib, in_process=in_process)
    settings = CampaignSettings(
        vut=vut,
        levels=parse_levels(str(level), povs_of(policies, where, pov, options)),
        sampler=sampler,
        cases=cases,
        batch=batch,
        seed=seed,
        v_vut0_mps=v_vut0_mps,
        stop_after_converged=stop_after_converged,
        vut_command=vut_command,
        deadline_s=deadline_s,
        vut_memory_gib=vut_memory_gib,
        in_process=in_process,
        policies=None if policies is None else str(policies),
        pov=pov,
        learn_from=tuple(map(str, learn_from)),
        scenario=where,
    )
    folder = dated(vut) if out is None else Path(out)
    road = road_for(settings.scenario, None if net is None else Path(net))
    with open_workers(settings.workers(workers)) as there:
        run_campaign(settings, folder, road, on_case, workers=there)
    run = CampaignRun(folder)
    run.report()
    return run


def open_run(folder: Path | str) -> CampaignRun:
    """Open the folder of a campaign; `UserError` when it is none."""
    return CampaignRun(folder)
