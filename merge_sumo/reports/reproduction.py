"""The paper's results in one go: Table II and its figures, our numbers beside the paper's.

Every number is the median over seeds; a picture of single cases shows the seed whose coverage is
the median. Same seeds and same versions give the same files.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import check_level
from merge_sumo.engine.povs import Povs
from merge_sumo.engine.simulator import SimulationPlan
from merge_sumo.engine.versions import versions
from merge_sumo.reports import figures
from merge_sumo.reports.figures import Levels, Panel, Surface
from merge_sumo.samplers.gpr import predicted_score
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.studies.benchmark import Search, compare, limit_fmc, oracle, search
from merge_sumo.studies.table2 import (
    ADAPTIVE,
    SAMPLERS,
    TABLE_II,
    Column,
    Result,
    Scale,
    table_markdown,
    table_record,
    table_rows,
)
from merge_sumo.studies.truth import DENSE_CASES, Truth, ground_truth, known_truth
from merge_sumo.system.folders import make_folder, write_new
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import FloatArray, Pool, to_unit
from merge_sumo.values.criterion import Criterion
from merge_sumo.values.fmc import fmc
from merge_sumo.values.scenario import LEVELS, US23
from merge_sumo.values.score import FAILURE_SCORE, Outcome

TABLE_JSON: Final = "table2.json"
TABLE_MARKDOWN: Final = "table2.md"
PAGE: Final = "index.html"
SURFACE_BATCHES: Final = (1, 4, 13, 20)
SURFACE_POINTS: Final = 81
"""Points of a surface's grid, in each direction."""


OnRun = Callable[[str, int, int, str], None]
"""Told what is going on: title, things done, things in all, and what a thing is."""


def reproduce(
    folder: Path,
    scale: Scale,
    *,
    povs: Povs | None = None,
    workers: Workers | None = None,
    on_run: OnRun | None = None,
) -> Path:
    """Write Table II and the figures into a new folder; return the path of its `index.html`.

    Each column's figures are written as soon as the column has run. Raises `UserError` when the
    folder exists or cannot be written, where a level has no POV, or where matplotlib is missing.
    """
    figures.require_matplotlib()
    povs = povs or Povs()
    for level in LEVELS:
        check_level(level, povs)
    make_folder(folder)
    work = _Work(folder, scale, povs, workers, on_run or (lambda *_: None))
    table = {column.title: work.column(column) for column in TABLE_II}
    work.all_levels()
    record = {**table_record(table, scale), "policies_sha256": povs.sha256()}
    _write(folder / TABLE_JSON, json.dumps(record, allow_nan=False) + "\n")
    _write(folder / TABLE_MARKDOWN, table_markdown(table))
    index = folder / PAGE
    _write(index, _page(table, scale, work.pictures))
    return index


class _Work:
    def __init__(
        self, folder: Path, scale: Scale, povs: Povs, workers: Workers | None, on_run: OnRun
    ) -> None:
        self.folder, self.scale, self.povs = folder, scale, povs
        self.workers, self.on_run = workers, on_run
        self.pictures: dict[str, str] = {}

    def plan(self, vut: str) -> SimulationPlan:
        """Return the plan for a VUT of the paper on its road, by its criterion."""
        return resolve(vut, scenario=US23, criterion=Criterion(), povs=self.povs)

    def column(self, column: Column) -> Result:
        """Run one column of the table and draw its figures."""
        truth = self.truth(column, self.scale.truth_cases[column.level])
        dense = self.dense(column)
        searches = self.search(column.vut, (column.level,), SAMPLERS)
        truths, denses = {column.level: truth}, {} if dense is None else {column.level: dense}
        limit = limit_fmc(chain.from_iterable(searches.values()), truths, denses)
        compared = {name: compare(found, truths, limit) for name, found in searches.items()}
        result = Result(
            column,
            fmc(truth.failures),
            len(truth.failures),
            len(truth.real_regions()),
            None if dense is None else fmc(dense.failures),
            limit,
            compared,
        )
        batch = self.scale.batch
        of_oracle = oracle(truths, self.scale.batches * batch, batch)
        self.draw(
            f"curves-level{column.level}",
            figures.coverage_curves(
                f"Coverage of {column.vut} against a level-{column.level} POV",
                compared,
                result.truth_fmc,
                of_oracle,
                limit,
            ),
            "FMC against cases: median over the seeds, band from the first to the third quartile. "
            "The oracle knows the failures of the truth and takes the most useful one each time. "
            "The limit is the coverage of all that is known to fail.",
        )
        middle = {name: _middle(found) for name, found in searches.items()}
        self.scatter(column, truth, middle)
        if column.level == 1:
            self.surfaces(column, truth, middle["gpr"], _middle_seed(searches["gpr"]))
        return result

    def dense(self, column: Column) -> Truth | None:
        """Return the dense truth of a column, if there is one or it is to be made."""
        if self.scale.dense is None:
            return known_truth(self.plan(column.vut), column.level, DENSE_CASES)
        return self.truth(column, DENSE_CASES) if self.scale.dense else None

    def truth(self, column: Column, cases: int) -> Truth:
        """Return the truth of a column, from the cache where it is there."""
        dense = "dense " if cases == DENSE_CASES else ""
        title = f"{dense}truth of {column.title}"
        done = 0

        def count(more: int) -> None:
            nonlocal done
            done += more
            self.on_run(title, done, cases, "cases")

        count(0)
        truth = ground_truth(
            self.plan(column.vut), column.level, cases, workers=self.workers, on_cases=count
        )
        self.on_run(title, cases, cases, "cases")
        return truth

    def search(
        self,
        vut: str,
        levels: tuple[int, ...],
        samplers: tuple[str, ...],
        batch: int | None = None,
    ) -> dict[str, list[Search]]:
        """Let samplers search with all seeds, in batches of the paper's size if nobody says.

        `coverage` has batches of its own then: they are a part of it.
        """
        title = f"{vut} v level {'/'.join(map(str, levels))}"
        runs = len(samplers) * self.scale.seeds
        counter = iter(range(1, runs + 1))
        self.on_run(title, 0, runs, "runs")
        return search(
            self.plan(vut),
            levels,
            samplers,
            seeds=self.scale.seeds,
            cases=self.scale.batches * (batch or self.scale.batch),
            batch=batch,
            workers=self.workers,
            on_search=lambda *_: self.on_run(title, next(counter), runs, "runs"),
        )

    def scatter(self, column: Column, truth: Truth, middle: Mapping[str, Search]) -> None:
        """Draw where the truth and each method fail."""
        level = column.level
        panels = {"truth": Panel(truth.points, truth.score < FAILURE_SCORE, fmc(truth.failures))}
        panels |= {name: _panel(middle[name].outcomes, level) for name in reversed(SAMPLERS)}
        self.draw(
            f"cases-level{level}",
            figures.maps(f"Where {column.vut} fails against a level-{level} POV", panels, level),
            "Cases that fail, in colour, and cases that do not, in grey: the truth, and each "
            "sampler with the seed whose coverage is its median.",
        )

    def surfaces(self, column: Column, truth: Truth, found: Search, seed: int) -> None:
        """Draw what the surrogate of `gpr` expects after some batches."""
        level = column.level
        axis = np.linspace(0.0, 1.0, SURFACE_POINTS)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        shown = {}
        for batch in SURFACE_BATCHES:
            if batch > self.scale.batches:
                continue
            known = [outcome for outcome in found.outcomes if outcome.batch < batch]
            sampler = make_sampler("gpr", Pool(levels=(level,)), seed)
            sampler.tell(known)
            predicted = predicted_score(sampler.history(level), grid)
            square = predicted.reshape(SURFACE_POINTS, SURFACE_POINTS)
            shown[batch] = Surface(square, _panel(known, level))
        self.draw(
            "gpr-surface-level1",
            figures.surfaces(
                f"The surrogate of gpr on {column.vut} against a level-{level} POV",
                shown,
                level,
                truth.failures,
            ),
            "The score that the surrogate predicts, with the cases that it has learned from "
            "(white) and the failures of the truth (orange). Inside the white line it predicts a "
            "failure.",
        )

    def all_levels(self) -> None:
        """Run all levels together and draw the shares and the scores of the levels."""
        batch = 2 * self.scale.batch
        searches = self.search("design2", LEVELS, ADAPTIVE, batch)
        rows = {name: _levels(found) for name, found in searches.items()}
        self.draw(
            "allocation",
            figures.allocation(
                f"design2 against all levels, {self.scale.batches} batches of {batch}", rows
            ),
            "How the samplers share each batch out over the POV levels, and the mean score at "
            "each level: median over the seeds, band from the first to the third quartile.",
        )

    def draw(self, name: str, figure: Any, caption: str) -> None:
        """Write a figure and remember it for the page."""
        figures.save(figure, self.folder / f"{name}.png")
        self.pictures[f"{name}.png"] = caption


def _middle_seed(searches: list[Search]) -> int:
    """Return the seed whose coverage is the median, the lower one of two."""
    order = sorted(range(len(searches)), key=lambda seed: (searches[seed].fmc[-1], seed))
    return order[(len(order) - 1) // 2]


def _middle(searches: list[Search]) -> Search:
    return searches[_middle_seed(searches)]


def _panel(outcomes: list[Outcome], level: int) -> Panel:
    points = to_unit((outcome.case for outcome in outcomes), level)
    failed = np.array([outcome.failed for outcome in outcomes])
    return Panel(points, failed, fmc(points[failed]))


def _levels(searches: list[Search]) -> Levels:
    """Return cases and mean scores by level, batch and seed."""
    cases: dict[int, FloatArray] = {}
    score: dict[int, FloatArray] = {}
    batches = len(searches[0].fmc)
    for level in LEVELS:
        number, total = np.zeros((2, len(searches), batches))
        judged = np.zeros((len(searches), batches))
        for seed, found in enumerate(searches):
            for outcome in found.outcomes:
                if outcome.case.level != level:
                    continue
                number[seed, outcome.batch] += 1
                if outcome.measures.score is not None:
                    judged[seed, outcome.batch] += 1
                    total[seed, outcome.batch] += outcome.measures.score
        cases[level] = number
        score[level] = np.divide(total, judged, out=np.full_like(total, np.nan), where=judged > 0)
    return Levels(cases, score)


def _page(table: Mapping[str, Result], scale: Scale, pictures: Mapping[str, str]) -> str:
    from jinja2 import Environment, PackageLoader

    loader = PackageLoader("merge_sumo.reports")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True)
    return environment.get_template("reproduce.html.jinja").render(
        results=list(table.values()),
        rows=dict(table_rows(table)),
        samplers=SAMPLERS,
        scale=scale,
        pictures=pictures,
        versions=versions(),
    )


def _write(path: Path, text: str) -> None:
    write_new(path, text.encode())
