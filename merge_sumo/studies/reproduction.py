"""The paper's results in one go: what Table II and the figures show, our numbers and the paper's.

Every number is the median over seeds; a picture of single cases shows the seed whose coverage is
the median. Same seeds and same versions give the same files.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo import config
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.coverage.fmc import fmc
from merge_sumo.drivers.policies import policies_of
from merge_sumo.engine.plan import versions
from merge_sumo.engine.povs import Povs
from merge_sumo.samplers.gpr import predicted_margin
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import FloatArray, Pool, to_unit
from merge_sumo.scenario.scenario import LEVELS, US23
from merge_sumo.studies.run_study import OnPart, check_least
from merge_sumo.studies.sampler_study import SamplerRun, SamplerStudy, Study
from merge_sumo.studies.truth import TRUTH_CASES
from merge_sumo.system.records import to_plain
from merge_sumo.system.result import Result
from merge_sumo.system.workers import Workers
from merge_sumo.verdict.score import Outcome

SAMPLERS: Final = ("uniform", "annealing", "subset", "gpr", "coverage")
ADAPTIVE: Final = ("gpr", "coverage")
"""The paper's sampler and ours: whose shares of the truth and of the levels are shown."""
SURFACE_BATCHES: Final = (1, 4, 13, 20)
"""Batches after which the paper shows its surrogate."""
SURFACE_POINTS: Final = 81
"""Points of a surrogate's grid, in each direction."""


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


PAPERS: Final = ("truth", "uniform", "annealing", "subset", "gpr")
TABLE_II: Final = tuple(
    Column(vut, level, dict(zip(PAPERS, found, strict=True)))
    for vut, level, found in (
        ("design1", 0, (0.1296, 0.0223, 0.0497, 0.0830, 0.1012)),
        ("design2", 1, (0.0849, 0.0144, 0.0184, 0.0445, 0.0585)),
        ("design2", 2, (0.0073, 0.0, 0.0006, 0.0019, 0.0032)),
    )
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Scale:
    """How much is run. The default is the paper's.

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


def quick(seeds: int) -> Scale:
    """Return a scale for a first look and for tests: it shows that all works, and no more."""
    return Scale(seeds=seeds, truth_cases=(1000, 1000, 1000), batches=4, batch=15)


def scale_of(asked: config.Reproduce) -> Scale:
    """Return the scale that a person asks for; `UserError` for numbers that make none."""
    check_least(asked, seeds=1)
    if asked.quick:
        return quick(2 if asked.seeds is None else asked.seeds)
    return Scale() if asked.seeds is None else Scale(seeds=asked.seeds)


@dataclass(frozen=True, slots=True)
class Panel:
    """Cases at one level in the unit cube, (n, d), which of them failed, (n,), and their FMC."""

    points: FloatArray
    failed: NDArray[np.bool_]
    fmc: float


@dataclass(frozen=True, slots=True)
class PredictedMargins:
    """What a surrogate predicts after a number of batches.

    Attributes:
        margin: on a regular grid, (n, n), rows along v_POV0, columns along x_POV0.
        learned: the cases that it has learned from.
    """

    margin: FloatArray
    learned: Panel


@dataclass(frozen=True, slots=True)
class LevelBatches:
    """How a sampler went on over batches at each level, one row per seed, (seeds, batches).

    Attributes:
        cases: cases at the level in each batch.
        margin: mean margin of them; NaN where there was none.
    """

    cases: Mapping[int, FloatArray]
    margin: Mapping[int, FloatArray]


@dataclass(frozen=True)
class ColumnResult:
    """A column that has run, and the study of its samplers at its level."""

    column: Column
    study: SamplerStudy

    @cached_property
    def panels(self) -> dict[str, Panel]:
        """Cases of the truth, and of each sampler with the seed whose coverage is its median."""
        level = self.column.level
        truth, searches = self.study.truths[level], reversed(self.study.searches.items())
        shown = Panel(truth.points, truth.margin < 0.0, fmc(truth.failures))
        found = {name: of_name[_median_seed(of_name)].outcomes for name, of_name in searches}
        return {"truth": shown, **{name: _panel(one, level) for name, one in found.items()}}

    def predicted(self) -> dict[int, PredictedMargins]:
        """Return what the surrogate of `gpr` predicts after some batches of its median search."""
        searches, level = self.study.searches["gpr"], self.column.level
        seed = _median_seed(searches)
        axis = np.linspace(0.0, 1.0, SURFACE_POINTS)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        result = {}
        for batch in (b for b in SURFACE_BATCHES if b <= len(searches[seed].fmc)):
            known = [outcome for outcome in searches[seed].outcomes if outcome.batch < batch]
            sampler = make_sampler("gpr", Pool(levels=(level,), scenario=US23), seed)
            sampler.tell(known)
            margin = predicted_margin(sampler.history(level), grid)
            square = margin.reshape(SURFACE_POINTS, SURFACE_POINTS)
            result[batch] = PredictedMargins(square, _panel(known, level))
        return result


@dataclass(frozen=True, repr=False)
class Reproduction(Result):
    """What ran.

    Attributes:
        scale: how much of it.
        columns: those of Table II, by title.
        levels: all levels together, by sampler.
        policies_sha256: the POVs.
        versions: the software.
        page: the page that shows it, if it was written.
    """

    scale: Scale
    columns: dict[str, ColumnResult]
    levels: dict[str, LevelBatches]
    policies_sha256: dict[str, str]
    versions: dict[str, str] = field(default_factory=versions)
    page: Path | None = None

    def to_record(self) -> dict[str, Any]:
        """Return Table II for a program."""
        return {
            "scale": to_plain(self.scale),
            "versions": self.versions,
            "policies_sha256": self.policies_sha256,
            "columns": [
                {**to_plain(one.column), **one.study.to_record()} for one in self.columns.values()
            ],
        }

    def lines(self) -> list[str]:
        """Return Table II as Markdown: our medians, with the paper's numbers in brackets."""
        rows = [
            f"| FMC: ours (the paper's) | {' | '.join(self.columns)} |",
            "|---|" + "---|" * len(self.columns),
            *(f"| {name} | {' | '.join(cells)} |" for name, cells in self.rows()),
        ]
        for title, one in self.columns.items():
            truth = one.study.truths[one.column.level]
            for remark in truth.remarks():
                rows += ["", f"The truth of {title} is {remark}."]
        return rows if self.page is None else [*rows, f"all of it: {self.page}"]

    def rows(self) -> Iterator[tuple[str, list[str]]]:
        """Yield the rows of the table: a name, and a cell for each column."""
        results = list(self.columns.values())
        studies = [one.study for one in results]

        def row(name: str, values: Iterable[float | None], form: str) -> tuple[str, list[str]]:
            return name, ["-" if value is None else f"{value:{form}}" for value in values]

        def beside(
            name: str, ours: Iterable[float | None], papers: Iterable[float | None], form: str
        ) -> tuple[str, list[str]]:
            pairs = zip(row(name, ours, form)[1], row(name, papers, form)[1], strict=True)
            return name, [f"{one} ({paper})" for one, paper in pairs]

        papers = [one.column.paper for one in results]
        for name in ("truth", *SAMPLERS):
            ours = [
                one.truth_fmc if name == "truth" else one.samplers[name].fmc.median
                for one in studies
            ]
            yield beside(name, ours, [paper.get(name) for paper in papers], ".4f")
        dense = [sum(fmc(truth.failures) for truth in one.dense.values()) for one in studies]
        if any(dense):
            yield row("dense truth", [value or None for value in dense], ".4f")
        yield row("limit", [one.limit_fmc for one in studies], ".4f")
        for name in ADAPTIVE:
            over = [one.samplers[name].fmc_over_truth.median for one in studies]
            shares = [p[name] / p["truth"] if name in p else None for p in papers]
            yield beside(f"{name} / truth", over, shares, ".2f")
        for name in ADAPTIVE:
            over = [one.samplers[name].fmc_over_limit.median for one in studies]
            yield row(f"{name} / limit", over, ".2f")
        for name in ADAPTIVE:
            after = studies[0].samplers[name].cases_by_batch
            # A quarter of all cases, or where a batch ended next.
            place = next(k for k, number in enumerate(after) if number >= after[-1] / 4)
            early = [one.samplers[name].fmc_by_batch[1][place] for one in studies]
            shares = [
                e / s.truth_fmc if s.truth_fmc and not s.is_small else None
                for s, e in zip(studies, early, strict=True)
            ]
            yield row(f"{name} / truth after {after[place]} cases", shares, ".2f")


def reproduce(
    scale: Scale,
    *,
    policies: Path | None = None,
    workers: Workers | None = None,
    on_part: OnPart = lambda *_: None,
) -> Reproduction:
    """Run what Table II and the figures need.

    The POVs are those of `policies`, by default the shipped ones; `on_part` is told how far it is.
    Raises `UserError` where a level has no POV.
    """
    povs = Povs(policies=policies or policies_of(US23))

    def study(vut: str) -> Study:
        folder = str(povs.policies)
        settings = CampaignSettings(vut=vut, levels=(0,), scenario=US23, policies=folder)
        return Study(resolve(settings), workers, on_part=on_part)

    for level in LEVELS:
        povs.check_level(level)
    columns = {}
    for column in TABLE_II:
        # In batches of Table II's size; those of `coverage` are a part of it.
        asked = config.Benchmark(
            column.vut,
            seeds=scale.seeds,
            cases=scale.batches * scale.batch,
            truth_cases=scale.truth_cases[column.level],
        )
        found = study(column.vut).compare((column.level,), SAMPLERS, asked)
        columns[column.title] = ColumnResult(column, found)
    batch = 2 * scale.batch
    together = study("design2").searches(
        LEVELS, ADAPTIVE, scale.seeds, scale.batches * batch, batch
    )
    levels = {name: _level_batches(of_name) for name, of_name in together.items()}
    return Reproduction(scale, columns, levels, povs.sha256())


def _median_seed(searches: Sequence[SamplerRun]) -> int:
    """Return the seed whose coverage is the median, the lower one of two."""
    order = sorted(range(len(searches)), key=lambda seed: (searches[seed].fmc[-1], seed))
    return order[(len(order) - 1) // 2]


def _panel(outcomes: Sequence[Outcome], level: int) -> Panel:
    points = to_unit((outcome.case for outcome in outcomes), level, US23)
    failed = np.array([outcome.failed for outcome in outcomes])
    return Panel(points, failed, fmc(points[failed]))


def _level_batches(searches: Sequence[SamplerRun]) -> LevelBatches:
    shape = len(LEVELS), len(searches), len(searches[0].fmc)
    cases, judged, total = np.zeros((3, *shape))
    for seed, one in enumerate(searches):
        for outcome in one.outcomes:
            place = LEVELS.index(outcome.case.level), seed, outcome.batch
            cases[place] += 1
            if outcome.margin is not None:
                judged[place] += 1
                total[place] += outcome.margin
    margin = np.divide(total, judged, out=np.full(shape, np.nan), where=judged > 0)
    return LevelBatches(
        dict(zip(LEVELS, cases, strict=True)), dict(zip(LEVELS, margin, strict=True))
    )
