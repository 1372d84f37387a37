"""The paper's results in one go: Table II and its figures, our numbers beside the paper's.

Every number is the median over seeds; a picture of single cases shows the seed whose coverage is
the median. Same seeds and same versions give the same files.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.campaigns.experiments import (
    TRUTH_CASES,
    Comparison,
    Search,
    Truth,
    compare,
    ground_truth,
    oracle,
    search,
)
from merge_sumo.campaigns.settings import check_level, versions
from merge_sumo.drivers.povs import Povs
from merge_sumo.errors import UserError
from merge_sumo.reports import figures
from merge_sumo.reports.figures import Levels, Panel, Surface
from merge_sumo.samplers.gpr import predicted_score
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.system.folders import make_folder, write_new
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import FloatArray, Pool, to_unit
from merge_sumo.values.fmc import fmc
from merge_sumo.values.scenario import LEVELS
from merge_sumo.values.score import FAILURE_SCORE, Outcome

TABLE_JSON: Final = "table2.json"
TABLE_MARKDOWN: Final = "table2.md"
PAGE: Final = "index.html"
SAMPLERS: Final = ("uniform", "annealing", "subset", "gpr", "coverage")
ADAPTIVE: Final = ("gpr", "coverage")
"""The paper's sampler and ours: whose shares of the truth and of the levels are shown."""
SURFACE_BATCHES: Final = (1, 4, 13, 20)
SURFACE_POINTS: Final = 81
"""Points of a surface's grid, in each direction."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of Table II: a VUT against one POV level, and what the paper found.

    Attributes:
        paper: FMC of the truth and of each sampler that the paper has.
    """

    vut: str
    level: int
    paper: Mapping[str, float]

    @property
    def title(self) -> str:
        """What stands above the column."""
        return f"level-{self.level} POV, {self.vut}"


TABLE_II: Final = (
    Column(
        "design1",
        0,
        {"truth": 0.1296, "uniform": 0.0223, "annealing": 0.0497, "subset": 0.0830, "gpr": 0.1012},
    ),
    Column(
        "design2",
        1,
        {"truth": 0.0849, "uniform": 0.0144, "annealing": 0.0184, "subset": 0.0445, "gpr": 0.0585},
    ),
    Column(
        "design2",
        2,
        {"truth": 0.0073, "uniform": 0.0, "annealing": 0.0006, "subset": 0.0019, "gpr": 0.0032},
    ),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Scale:
    """How much is run. The default is the paper's; `UserError` for numbers that make none.

    Attributes:
        seeds: runs of each sampler.
        truth_cases: uniform cases of the truth at each level.
        batches: k, the batches of every run.
        batch: n, the cases per batch at one level; twice as many run where all levels do.
    """

    seeds: int = 10
    truth_cases: tuple[int, int, int] = (TRUTH_CASES[0], TRUTH_CASES[1], TRUTH_CASES[2])
    batches: int = 20
    batch: int = 20

    def __post_init__(self) -> None:
        """Check the number of seeds."""
        if self.seeds < 1:
            raise UserError(f"--seeds is {self.seeds}: it must be 1 or more")


def quick(seeds: int) -> Scale:
    """Return a scale for a first look and for tests: it shows that all works, and no more."""
    return Scale(seeds=seeds, truth_cases=(1000, 1000, 1000), batches=4, batch=15)


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
    _write(folder / TABLE_JSON, json.dumps(_table_record(table, scale), allow_nan=False) + "\n")
    _write(folder / TABLE_MARKDOWN, _markdown(table))
    index = folder / PAGE
    _write(index, _page(table, scale, work.pictures))
    return index


@dataclass(frozen=True, slots=True)
class Result:
    """A column that has run: what the truth holds, and each sampler beside it."""

    column: Column
    truth_fmc: float
    truth_failures: int
    truth_regions: int
    compared: dict[str, Comparison]


class _Work:
    def __init__(
        self, folder: Path, scale: Scale, povs: Povs, workers: Workers | None, on_run: OnRun
    ) -> None:
        self.folder, self.scale, self.povs = folder, scale, povs
        self.workers, self.on_run = workers, on_run
        self.pictures: dict[str, str] = {}

    def column(self, column: Column) -> Result:
        """Run one column of the table and draw its figures."""
        truth = self.truth(column)
        searches = self.search(column.vut, (column.level,), SAMPLERS, self.scale.batch)
        compared = {name: compare(found, {column.level: truth}) for name, found in searches.items()}
        result = Result(
            column,
            fmc(truth.failures),
            len(truth.failures),
            len(truth.real_regions()),
            compared,
        )
        batch = self.scale.batch
        of_oracle = oracle({column.level: truth}, self.scale.batches * batch, batch)
        self.draw(
            f"curves-level{column.level}",
            figures.coverage_curves(
                f"Coverage of {column.vut} against a level-{column.level} POV",
                compared,
                result.truth_fmc,
                of_oracle,
            ),
            "FMC against cases: median over the seeds, band from the first to the third quartile. "
            "The oracle knows the failures of the truth and takes the most useful one each time.",
        )
        middle = {name: _middle(found) for name, found in searches.items()}
        self.scatter(column, truth, middle)
        if column.level == 1:
            self.surfaces(column, truth, middle["gpr"], _middle_seed(searches["gpr"]))
        return result

    def truth(self, column: Column) -> Truth:
        """Return the truth of a column, from the cache where it is there."""
        cases = self.scale.truth_cases[column.level]
        title = f"truth of {column.title}"
        done = 0

        def count(more: int) -> None:
            nonlocal done
            done += more
            self.on_run(title, done, cases, "cases")

        count(0)
        truth = ground_truth(
            *(column.vut, column.level, cases),
            workers=self.workers,
            on_cases=count,
            povs=self.povs,
        )
        self.on_run(title, cases, cases, "cases")
        return truth

    def search(
        self, vut: str, levels: tuple[int, ...], samplers: tuple[str, ...], batch: int
    ) -> dict[str, list[Search]]:
        """Let samplers search with all seeds."""
        title = f"{vut} v level {'/'.join(map(str, levels))}"
        runs = len(samplers) * self.scale.seeds
        counter = iter(range(1, runs + 1))
        self.on_run(title, 0, runs, "runs")
        return search(
            vut,
            levels,
            samplers,
            seeds=self.scale.seeds,
            cases=self.scale.batches * batch,
            batch=batch,
            workers=self.workers,
            on_search=lambda *_: self.on_run(title, next(counter), runs, "runs"),
            povs=self.povs,
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


def _rows(table: Mapping[str, Result]) -> Iterator[tuple[str, list[tuple[float, float | None]]]]:
    """Yield the rows of the table: a name, and (ours, the paper's) for each column."""
    results = table.values()
    yield "truth", [(r.truth_fmc, r.column.paper["truth"]) for r in results]
    for name in SAMPLERS:
        yield name, [(r.compared[name].fmc_median, r.column.paper.get(name)) for r in results]


def _markdown(table: Mapping[str, Result]) -> str:
    """Return Table II as Markdown: our medians, with the paper's numbers in brackets."""
    lines = ["| FMC: ours (the paper's) | " + " | ".join(table) + " |"]
    lines.append("|---|" + "---|" * len(table))
    for name, pairs in _rows(table):
        cells = [
            f"{ours:.4f} ({'-' if paper is None else f'{paper:.4f}'})" for ours, paper in pairs
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    for name in ADAPTIVE:
        cells = []
        for result in table.values():
            paper = result.column.paper
            share = paper[name] / paper["truth"] if name in paper else None
            ours = result.compared[name].fmc_over_truth_median
            cells.append(f"{_or_dash(ours, '.2f')} ({_or_dash(share, '.2f')})")
        lines.append(f"| {name} / truth | " + " | ".join(cells) + " |")
    for name in ADAPTIVE:
        results = [(result, result.compared[name]) for result in table.values()]
        early = max(len(results[0][1].cases_by_batch) // 4, 1) - 1
        cases = results[0][1].cases_by_batch[early]
        cells = [
            _or_dash(
                found.fmc_by_batch_median[early] / result.truth_fmc if result.truth_fmc else None,
                ".2f",
            )
            for result, found in results
        ]
        lines.append(f"| {name} / truth after {cases} cases | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def _table_record(table: Mapping[str, Result], scale: Scale) -> dict[str, Any]:
    """Return Table II for a program; without seconds, so that it can be compared bit by bit."""
    columns = []
    for result in table.values():
        samplers = {name: asdict(found) for name, found in result.compared.items()}
        for found in samplers.values():
            del found["sampler_s_median"]
        columns.append(
            {
                "vut": result.column.vut,
                "level": result.column.level,
                "truth_fmc": result.truth_fmc,
                "truth_failures": result.truth_failures,
                "truth_regions": result.truth_regions,
                "paper_fmc": dict(result.column.paper),
                "samplers": samplers,
            }
        )
    return {"scale": asdict(scale), "versions": versions(), "columns": columns}


def _page(table: Mapping[str, Result], scale: Scale, pictures: Mapping[str, str]) -> str:
    from jinja2 import Environment, PackageLoader

    loader = PackageLoader("merge_sumo.reports")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True)
    return environment.get_template("reproduce.html.jinja").render(
        results=list(table.values()),
        rows=dict(_rows(table)),
        samplers=SAMPLERS,
        scale=scale,
        pictures=pictures,
        versions=versions(),
    )


def _write(path: Path, text: str) -> None:
    write_new(path, text.encode())
